"""Orbit and attitudes from the SPICE kernels that a dump names, by NAIF's toolkit (spiceypy, extra `spice`).

The bytes of a kernel are read as those of every file of a dump, checked, and copied to a folder of their own
that the toolkit loads: it never follows a name that a kernel states. The kernels that a program has loaded
itself are set aside meanwhile and are loaded again afterwards.

An ephemeris kernel (SPK) of any type is evaluated at equal steps over every interval that it covers, ends
included: states relative to the Earth, axes of ICRF. Attitudes of a C-kernel (CK), with its clock (SCLK) and
frames (FK), are those at its own instants: of segments of type 1, 3 and 5 the instants of the attitudes, of
type 2 (constant rates) the begins of its intervals and the end of the last. Other segments, polynomials (type
4, 6), are evaluated at equal steps. The matrix that NAIF's `pxform` gives from J2000 to a frame is R_si;
NAIF's J2000 has the axes of ICRF. The frame is that of the CK, or one with a fixed rotation from it (TK).
"""

from __future__ import annotations

import struct
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import DAY_S
from boresight.geometry.epoch import Epoch, seconds_from_ephemeris_time
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.attitude_files import AttitudeRows, check_rows
from boresight.pipeline.files.content import check_extent, content_of, limited_content
from boresight.pipeline.files.orbit_file import Ephemeris, check_components, check_states
from boresight.pipeline.files.text_files import MAX_ROWS
from boresight.records.record import Floats, record, scalar

__all__ = ["CK", "NO_KERNELS", "SPK", "Kernels", "is_kernel", "read_ck", "read_spk"]

CK, SPK = "CK", "SPK"  # kinds of kernels: attitudes, orbit
# First bytes of binary kernels of either kind, and those of files older than 1993.
BINARY = {CK: b"DAF/CK  ", SPK: b"DAF/SPK "}
OF_OLD_FILES = b"NAIF/DAF"
RECORD = 1024  # bytes of a DAF record
BYTE_ORDERS = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}  # a DAF's LOCFMT, and the sign that `struct` uses for it
MAX_BYTES = 256 * 2**20  # of a kernel; a day of attitudes at 8 Hz takes 28 MB
OTHER_KERNELS = ("KERNELS_TO_LOAD", "PATH_SYMBOLS", "PATH_VALUES")  # keywords that name further files
# The toolkit has one pool of kernels for the whole process.
_ONE_AT_A_TIME = threading.Lock()


@record(kw_only=True)
class Kernels:
    """Kernels beside those of attitudes and orbit: LSK, SCLK, FK."""

    files: tuple[str, ...] = scalar("their names in errors")
    paths: tuple[Path, ...] = scalar("of the same files")
    spacecraft: int | None = scalar("NAIF id of the satellite in the SPK; None: the only object in it")


NO_KERNELS = Kernels(files=(), paths=(), spacecraft=None)  # of a dump without SPICE files


def is_kernel(path: Path, file: str, kind: str) -> bool:
    """Whether the file is a binary kernel of this kind, CK or SPK; False for one that cannot be read.

    `RawDataError` for one of the other kind.
    """
    try:
        start = content_of(path)[:8] if path.stat().st_size <= MAX_BYTES else b""
    except (OSError, ValueError):  # its reader reports it
        return False
    for other, name in BINARY.items():
        if start == name and other != kind:
            raise RawDataError(file, "byte 0", f"a SPICE {other}", f"a {kind}, or another form of this file")
    return start == BINARY[kind]


@contextmanager
def loaded(path: Path, file: str, kernels: Kernels) -> Iterator[tuple[Any, str]]:
    """The toolkit with the binary kernel `file` and those beside it loaded, and the name to use in it.

    `RawDataError` about `file` where the toolkit is not installed, and for its errors.
    """
    with refusing(file, "SPICE kernel", "spiceypy: pip install 'boresight[spice]'", ImportError):
        import spiceypy as spice
    with tempfile.TemporaryDirectory(prefix="boresight-", ignore_cleanup_errors=True) as folder:
        copies = [
            _copy(*one, Path(folder) / f"{n}.kernel")
            for n, one in enumerate([*zip(kernels.paths, kernels.files), (path, file)])
        ]
        with _ONE_AT_A_TIME:
            try:
                with spice.KernelPool(copies):
                    yield spice, copies[-1]
            except (spice.exceptions.SpiceyError, spice.exceptions.NotFoundError) as error:
                raise RawDataError(file, "SPICE", _reason(error), _remedy(error)) from error


def _copy(path: Path, file: str, copy: Path) -> str:
    """Write a checked kernel to `copy`."""
    raw = limited_content(path, file, "a SPICE kernel", MAX_BYTES)
    if raw.startswith((*BINARY.values(), b"DAF/", OF_OLD_FILES)):
        _check_daf(raw, file)
    elif not raw.startswith(b"KPL/"):
        raise RawDataError(file, "byte 0", raw[:8], "KPL/LSK, KPL/SCLK or KPL/FK, or a DAF")
    elif named := [word for word in OTHER_KERNELS if word.encode() in raw.upper()]:
        expected = "no such keyword; name the kernels themselves under [spice] in dump.toml"
        raise RawDataError(file, named[0], "a meta-kernel", expected)
    copy.write_bytes(raw)
    return str(copy)


def _check_daf(raw: bytes, file: str) -> None:
    """`RawDataError` where the list of segments of a DAF leaves the file, or leads in a circle."""
    order = BYTE_ORDERS.get(raw[88:96])
    if order is None or len(raw) < 2 * RECORD:
        found = f"{raw[88:96]!r}, {len(raw)} bytes"
        raise RawDataError(file, "byte 88", found, "a DAF with LTL-IEEE or BIG-IEEE numbers")
    nd, ni = struct.unpack_from(f"{order}2i", raw, 8)
    if (nd, ni) != (2, 6):
        raise RawDataError(file, "byte 8", f"{nd} and {ni} components", "2 and 6, as a CK and an SPK have")
    at, visited = struct.unpack_from(f"{order}i", raw, 76)[0], set()
    while at:
        if at in visited or not 2 <= at <= len(raw) // RECORD:
            found = f"record {at} of {len(raw) // RECORD}"
            raise RawDataError(file, "list of segments", found, "each record once, inside the file")
        visited.add(at)
        base = (at - 1) * RECORD
        following, _, count = struct.unpack_from(f"{order}3d", raw, base)
        if not (0.0 <= count <= 25.0 and 0.0 <= following < 2**31 and following == int(following)):
            found = f"{count:g} segments, then record {following:g}"
            raise RawDataError(file, f"record {at}", found, "at most 25 segments, and a whole number")
        for n in range(int(count)):
            begin, end = struct.unpack_from(f"{order}2i", raw, base + 24 + 40 * n + 32)
            if not 1 <= begin <= end <= len(raw) // 8:
                found = f"numbers {begin} to {end} of {len(raw) // 8}"
                raise RawDataError(file, f"segment {n + 1} of record {at}", found, "numbers inside the file")
        at = int(following)


def _reason(error: Exception) -> str:
    """What the toolkit says, in one line."""
    short, long = (str(getattr(error, name, "") or "") for name in ("short", "long"))
    return " ".join(f"{short} {long}".split()) or " ".join(str(error).split())


def _remedy(error: Exception) -> str:
    """What may help, by the toolkit's own short names of errors."""
    text = str(error)
    if "MISSINGTIMEINFO" in text or "DELTET" in text or "NOLEAPSECONDS" in text:
        return "a leap-second kernel (LSK) among the kernels under [spice] in dump.toml"
    if "SCLK" in text or "KERNELVARNOTFOUND" in text:
        return "the clock kernel (SCLK) of the satellite among the kernels under [spice] in dump.toml"
    return "whole kernels that belong together; the others are named under [spice] in dump.toml"


EARTH = 399  # NAIF's id
# Steps, s, of which the smallest with at most MAX_STATES states is taken. Of 60 s the interpolation below
# errs by less than 1e-6 m in a low orbit.
STEPS_OF_SPK_S = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0)
MAX_STATES = 100_000  # of an orbit: a day at 1 s
DEGREE = 9  # of Hermite's interpolation


def read_spk(path: Path, file: str, kernels: Kernels) -> Ephemeris:
    """States of the satellite of `kernels`, or of the only object in the SPK; `file` names it in errors.

    Raises `RawDataError`.
    """
    with loaded(path, file, kernels) as (spice, spk):
        body = _body(spice, spk, kernels, file)
        cover = spice.spkcov(spk, body)
        ends = np.array([spice.wnfetd(cover, n) for n in range(spice.wncard(cover))]).reshape(-1, 2)
        et = _instants(ends, file)
        states = np.reshape([spice.spkgeo(body, one, "J2000", EARTH)[0] for one in et.tolist()], (-1, 6))
    check_components(states, file)
    positions_m, velocities_m_s = np.split(1e3 * states, 2, axis=1)
    epoch = Epoch(int(np.floor(seconds_from_ephemeris_time(Epoch(0), et[:1])[0])))
    t_s = seconds_from_ephemeris_time(epoch, et)
    check_states(t_s, positions_m, file)
    first, last = epoch.utc_from_seconds([float(t_s[0]), float(t_s[-1])])
    return Ephemeris(
        epoch=epoch,
        t_s=t_s,
        positions_m=positions_m,
        velocities_m_s=velocities_m_s,
        frame="GCRF",
        method="hermite",
        interpolation_degree=DEGREE,
        first_time=first,
        last_time=last,
    )


def _body(spice: Any, spk: str, kernels: Kernels, file: str) -> int:
    """NAIF's id of the satellite."""
    bodies = sorted(int(one) for one in spice.spkobj(spk))
    if kernels.spacecraft is None and len(bodies) == 1:
        return bodies[0]
    if kernels.spacecraft in bodies:
        return int(kernels.spacecraft)
    expected = "one object, or `spacecraft = ID` of one of them under [spice] in dump.toml"
    if kernels.spacecraft is not None:
        expected = f"{kernels.spacecraft}, the spacecraft under [spice] in dump.toml"
    raise RawDataError(file, "objects", ", ".join(map(str, bodies[:16])), expected)


def _instants(cover: Floats, file: str) -> Floats:
    """Ephemeris times (N,), increasing, at equal steps over each interval `cover` (K, 2), ends included."""
    lengths = cover[:, 1] - cover[:, 0]
    if not np.isfinite(lengths).all() or (longest := lengths.sum()) > MAX_STATES * STEPS_OF_SPK_S[-1]:
        days, most = (one / DAY_S for one in (lengths.sum(), MAX_STATES * STEPS_OF_SPK_S[-1]))
        expected = f"at most {most:.0f} days; cut it with NAIF's `spkmerge`"
        raise RawDataError(file, "cover", f"{days:.0f} days", expected)
    step = next(one for one in STEPS_OF_SPK_S if longest <= MAX_STATES * one)
    filled = cover[lengths > 0.0].tolist()
    parts = [np.linspace(begin, end, int(np.ceil((end - begin) / step)) + 1) for begin, end in filled]
    return np.unique(np.concatenate([np.zeros(0), *parts]))


OF_CK, FIXED = 3, 4  # NAIF's classes of frames
MOST_FIXED = 16  # rotations between a frame and that of the CK
# Numbers that an attitude of a segment of type 1 and 3 takes without angular velocities: its quaternion; with
# them 7. Of type 5, by the subtype. Of type 2: attitude, rates, seconds a tick; begin and end follow.
QUATERNION = 4
WITH_RATES = 7
OF_SUBTYPE = {0: 8, 1: 4, 2: 14, 3: 7}
OF_INTERVAL = 8
OWN_INSTANTS = (1, 2, 3, 5)  # types of segments that list instants
IN_DIRECTORY = 100  # every so many instants are listed again
# Steps, s, of polynomials, of which the smallest with at most MOST_STEPS is taken: 8 Hz as of star cameras.
# Cubics between attitudes 0.125 s apart follow motion of up to 1 Hz to 1e-3 of its size.
STEPS_OF_CK_S = (0.125, 0.25, 0.5, 1.0)
MOST_STEPS = 100_000  # attitudes of a segment of polynomials, 1 s of processor time
# Type 4: a packet has middle, radius, the code of the numbers of coefficients of seven polynomials (in base
# 128) and the coefficients. The last 17 numbers of a segment tell where packets and the list of their places
# begin. Type 6: the last number is that of its parts.
PARTS = 6
CHEBYSHEV, FIRST, BASE, POLYNOMIALS, MOST_COEFFICIENTS, META = 4, 3, 128, 7, 19, 17
ROUNDING = 1e-3  # of a step, by which an interval may be longer than whole steps


def read_ck(path: Path, file: str, epoch: Epoch, frame: str, kernels: Kernels) -> AttitudeRows:
    """Attitudes of a CK, `file` in errors, times since `epoch`: of the head's `frame`, named as in the FK,
    by SCLK and FK among the `kernels`, and an LSK where the clock counts in TDT. `RawDataError` with file,
    field, found and expected.
    """
    with loaded(path, file, kernels) as (spice, ck):
        R_sf, instrument = _from_ck_frame(spice, frame)
        ticks = _ticks(spice, ck, instrument, file)
        found = [spice.ckgp(instrument, tick, 0, "J2000")[0] for tick in ticks.tolist()]
        matrices = np.array(found).reshape(-1, 3, 3)
        clock = spice.ckmeta(instrument, "SCLK")
        et = np.array([spice.sct2e(clock, tick) for tick in ticks.tolist()])
    if not np.isfinite(matrices).all():
        raise RawDataError(file, "attitudes", "one that is not finite", "quaternions")
    R_si = R_sf * Rotation.from_matrix(matrices)
    rows = AttitudeRows(t_s=seconds_from_ephemeris_time(epoch, et), R_si=R_si)
    check_rows(rows, file)
    return rows


def _from_ck_frame(spice: Any, frame: str) -> tuple[Rotation, int]:
    """Rotation from the frame of a CK to the named one, and NAIF's id of the CK's object.

    `RawDataError` for a frame that no kernel defines or that is not fixed to that of a CK.
    """
    if (code := spice.namfrm(frame)) == 0:
        of_fk = [spice.frmnam(int(one)) for kind in (OF_CK, FIXED) for one in spice.kplfrm(kind)]
        expected = f"a frame of the kernels: {', '.join(sorted(of_fk)[:8]) or 'they have none, name the FK'}"
        raise RawDataError("dump.toml", "spice_frame", frame, expected)
    R_sf = Rotation.identity()
    for _ in range(MOST_FIXED):
        _, kind, object_id = spice.frinfo(code)
        if kind == OF_CK:
            return R_sf, int(object_id)
        if kind != FIXED:
            break
        to_next, code = spice.tkfram(object_id)
        R_sf = R_sf * Rotation.from_matrix(to_next).inv()
    expected = "a frame of a CK (class 3), or one with a fixed rotation from it (class 4)"
    raise RawDataError("dump.toml", "spice_frame", f"{frame}, of class {kind}", expected)


def _ticks(spice: Any, ck: str, instrument: int, file: str) -> Floats:
    """Encoded clock times (N,) of the attitudes of an object, increasing, each once."""
    objects = list(spice.ckobj(ck))
    found: list[Floats] = []
    handle = spice.dafopr(ck)
    try:
        spice.dafbfs(handle)
        while spice.daffna():
            span, whole = spice.dafus(spice.dafgs(), 2, 6)
            if int(whole[0]) == instrument and int(whole[2]) in OWN_INSTANTS:
                found.append(_ticks_of_segment(spice, handle, [int(one) for one in whole], file))
            elif int(whole[0]) == instrument:
                kind, begin, end = int(whole[2]), int(whole[4]), int(whole[5])
                if not _is_whole(kind, spice.dafgda(handle, begin, end)):
                    expected = "a CK as NAIF's toolkit writes it"
                    raise RawDataError(file, f"segment of type {kind}", "counts that do not fit", expected)
                found.append(_steps(spice, ck, instrument, span, file))
    finally:
        spice.dafcls(handle)
    if not found:
        others = ", ".join(str(int(one)) for one in objects[:8])
        expected = f"{instrument}, the object of the frame that is asked for"
        raise RawDataError(file, "objects", others, expected)
    ticks = np.unique(np.concatenate(found))
    check_extent(file, "segments", ticks.shape, MAX_ROWS, "attitudes")
    return ticks


def _steps(spice: Any, ck: str, instrument: int, span: Floats, file: str) -> Floats:
    """Encoded clock times (N,) at equal steps over what a segment with ticks from `span[0]` on covers."""
    cover = spice.ckcov(ck, instrument, False, "INTERVAL", 0.0, "SCLK")
    of_segment = spice.cell_double(2)
    spice.wninsd(*span, of_segment)
    both = spice.wnintd(cover, of_segment)
    ends = np.array([spice.wnfetd(both, n) for n in range(spice.wncard(both))]).reshape(-1, 2)
    clock = spice.ckmeta(instrument, "SCLK")
    lengths = np.diff([[spice.sct2e(clock, tick) for tick in pair] for pair in ends.tolist()]).ravel()
    if not np.isfinite(lengths).all() or (total := lengths.sum()) > STEPS_OF_CK_S[-1] * MOST_STEPS:
        hours, most = (one / 3600.0 for one in (lengths.sum(), STEPS_OF_CK_S[-1] * MOST_STEPS))
        expected = f"at most {most:.0f} hours; cut it with NAIF's `ckslicer`"
        raise RawDataError(file, "segment", f"{hours:.0f} hours", expected)
    step = next(one for one in STEPS_OF_CK_S if total <= one * MOST_STEPS)
    counts = [int(np.ceil(s / step - ROUNDING)) + 1 for s in lengths.tolist()]
    parts = [np.linspace(a, b, count) for (a, b), count in zip(ends, counts)]
    return np.concatenate([np.zeros(0), *parts])


def _is_whole(kind: int, numbers: Floats) -> bool:
    """Whether packets of a segment of type 4 are as long as they state, and one of type 6 has room for its
    parts: NAIF's toolkit reads beyond the ends of others.
    """
    if kind == PARTS:
        return bool(1.0 <= numbers[-1] <= len(numbers))
    if kind != CHEBYSHEV:
        return True
    meta, size = numbers[-META:], len(numbers)
    times_at, n_times, places_at, n_places, first, n, header = meta[[5, 6, 7, 8, 10, 11, 15]]
    is_laid_out = 1.0 <= n == n_times == n_places - 1.0 and (first, header, meta[-1]) == (0.0, 2.0, META)
    if not (is_laid_out and all(0.0 <= at <= size - n_places for at in (times_at, places_at))):
        return False
    places = np.asarray(numbers[int(places_at) : int(places_at + n_places)], dtype=float) - 1.0
    lengths = np.diff(places) - header
    whole = np.all(places == np.round(places)) and np.all(lengths >= FIRST)
    if not (whole and 0.0 <= places[0] <= places[-1] <= size):
        return False
    codes = np.asarray(numbers[places[:-1].astype(np.int64) + FIRST - 1], dtype=float)
    counts = np.floor(codes[:, None] / float(BASE) ** np.arange(POLYNOMIALS)) % BASE
    known = (codes >= 0.0) & (codes < float(BASE) ** POLYNOMIALS) & (codes == np.round(codes))
    fits = (counts.max(axis=1) <= MOST_COEFFICIENTS) & (counts.sum(axis=1) + FIRST <= lengths)
    return bool(np.all(known & fits))


def _ticks_of_segment(spice: Any, handle: int, whole: list[int], file: str) -> Floats:
    """Encoded clock times (N,) of a segment; NAIF's CK Required Reading has the layout."""
    _, _, kind, has_rates, begin, end = whole
    count = float(spice.dafgda(handle, end, end)[0])
    size = WITH_RATES if has_rates else QUATERNION
    if kind == 5 and end - 3 > begin:
        size = OF_SUBTYPE.get(round(spice.dafgda(handle, end - 3, end - 3)[0]), end)
    if kind == 2:  # the number of intervals follows from that of numbers
        size = OF_INTERVAL
        count = IN_DIRECTORY * (end - begin + 2) // (IN_DIRECTORY * (size + 2) + 1)
    if not (1.0 <= count <= MAX_ROWS and begin + count * (size + 1) <= end):
        found = f"{count:g} attitudes in {end - begin + 1} numbers"
        raise RawDataError(file, "segment", found, f"at most {MAX_ROWS}, inside the segment")
    n = int(count)
    ticks = np.asarray(spice.dafgda(handle, begin + n * size, begin + n * (size + 1) - 1), dtype=float)
    if kind == 2:
        ticks = np.append(ticks, spice.dafgda(handle, begin + n * (size + 2) - 1, begin + n * (size + 2) - 1))
    if not np.isfinite(ticks).all() or np.any(np.diff(ticks) <= 0.0):
        raise RawDataError(file, "segment", "clock times out of order", "strictly increasing times")
    return ticks
