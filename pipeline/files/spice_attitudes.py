"""Read attitudes of a star camera from a SPICE C-kernel (CK), with its clock (SCLK) and frames (FK).

The attitudes are those at the CK's own instants, what it interpolates between them is not used: of segments
of type 1, 3 and 5 the instants of the attitudes, of type 2 (constant rates) the begins of its intervals and
the end of the last. The matrix that NAIF's `pxform` gives from J2000 to a frame is R_si; NAIF's
J2000 has the axes of ICRF. The frame is that of the CK, or one with a fixed rotation from it (TK).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.ephemeris_time import seconds_from_ephemeris_time
from boresight.geometry.epoch import Epoch
from boresight.geometry.record import Floats
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.attitude_files import AttitudeRows, check_rows
from boresight.pipeline.files.spice_kernels import Kernels, loaded, toolkit
from boresight.pipeline.files.text_files import MAX_ROWS

__all__ = ["read_ck"]

OF_CK, FIXED = 3, 4  # NAIF's classes of frames
MOST_FIXED = 16  # rotations between a frame and that of the CK
# Numbers that an attitude of a segment of type 1 and 3 takes without angular velocities: its quaternion; with
# them 7. Of type 5, by the subtype. Of type 2: attitude, rates, seconds a tick; begin and end follow.
QUATERNION = 4
WITH_RATES = 7
OF_SUBTYPE = {0: 8, 1: 4, 2: 14, 3: 7}
OF_INTERVAL = 8
IN_DIRECTORY = 100  # every so many instants are listed again


def read_ck(path: Path, file: str, epoch: Epoch, frame: str, kernels: Kernels) -> AttitudeRows:
    """Attitudes of a CK.

    Parameters
    ----------
    path, file : Path, str
        The CK, and its name in errors.
    epoch : Epoch
        Zero of the times.
    frame : str
        NAIF name of the head's frame, as the FK has it.
    kernels : Kernels
        SCLK and FK, and an LSK where the clock counts in TDT.

    Raises
    ------
    RawDataError
        With file, field, found and expected.
    """
    spice = toolkit(file)
    with loaded(path, file, kernels) as ck:
        R_sf, instrument = _from_ck_frame(spice, frame)
        ticks = _ticks(spice, ck, instrument, file)
        matrices = [spice.ckgp(instrument, tick, 0, "J2000")[0] for tick in ticks.tolist()]
        clock = spice.ckmeta(instrument, "SCLK")
        et = np.array([spice.sct2e(clock, tick) for tick in ticks.tolist()])
    rows = AttitudeRows(
        t_s=seconds_from_ephemeris_time(epoch, et),
        R_si=R_sf * Rotation.from_matrix(np.array(matrices).reshape(-1, 3, 3)),
    )
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
            _, whole = spice.dafus(spice.dafgs(), 2, 6)
            if int(whole[0]) == instrument:
                found.append(_ticks_of_segment(spice, handle, [int(one) for one in whole], file))
    finally:
        spice.dafcls(handle)
    if not found:
        others = ", ".join(str(int(one)) for one in objects[:8])
        raise RawDataError(
            file, "objects", others, f"{instrument}, the object of the frame that is asked for"
        )
    ticks = np.unique(np.concatenate(found))
    if len(ticks) > MAX_ROWS:
        raise RawDataError(file, "attitudes", f"{len(ticks)}", f"at most {MAX_ROWS}")
    return ticks


def _ticks_of_segment(spice: Any, handle: int, whole: list[int], file: str) -> Floats:
    """Encoded clock times (N,) of a segment; NAIF's CK Required Reading has the layout."""
    _, _, kind, has_rates, begin, end = whole
    if kind not in (1, 2, 3, 5):
        expected = "type 1, 2, 3 or 5; NAIF's `ckslicer` and `msopck` write type 3"
        raise RawDataError(file, "segment", f"type {kind}", expected)
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
