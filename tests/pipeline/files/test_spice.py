"""Attitudes and orbits from SPICE kernels that NAIF's own toolkit wrote, compared with what it reads."""

import ctypes
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import spiceypy
from edits import replaced
from handmade import give_heads, write_handmade_dump
from leap_seconds import leap_second_kernel
from scipy.spatial.transform import Rotation
from spiceypy.utils.libspicehelper import libspice

from boresight.geometry.epoch import Epoch, ephemeris_time, seconds_from_ephemeris_time
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, dump_or_faults, open_dump
from boresight.pipeline.files.spice_kernels import Kernels, read_ck
from boresight.pipeline.files.star_side import SolvedAttitudes

SATELLITE, BUS, HEAD = -999, -999000, -999001
EPOCH = Epoch.from_utc("2024-11-20T03:40:00Z")
TICKS_PER_S = 65536
# From the axes of the bus, which the CK describes, to those of the head.
R_HB = Rotation.from_euler("xyz", [70.0, -35.0, 130.0], degrees=True)


def clock(time_system: int = 1) -> str:
    """SCLK text: ticks of 1/65536 s since a day before the epoch, 1 ppm slow."""
    start = EPOCH.tai_s - 86_400.0
    return (
        f"KPL/SCLK\n\\begindata\nSCLK_KERNEL_ID = ( @2024-01-01 )\nSCLK_DATA_TYPE_999 = ( 1 )\n"
        f"SCLK01_TIME_SYSTEM_999 = ( {time_system} )\nSCLK01_N_FIELDS_999 = ( 2 )\n"
        f"SCLK01_MODULI_999 = ( 4294967296 {TICKS_PER_S} )\nSCLK01_OFFSETS_999 = ( 0 0 )\n"
        "SCLK01_OUTPUT_DELIM_999 = ( 2 )\nSCLK_PARTITION_START_999 = ( 0.0 )\n"
        "SCLK_PARTITION_END_999 = ( 2.8E14 )\n"
        f"SCLK01_COEFFICIENTS_999 = ( 0.0 {start:.1f} 1.000001 )\n\\begintext\n"
    )


def frames() -> str:
    """FK text: the bus of the CK, and the head at a fixed rotation from it."""
    # a text kernel has 132 characters a line, the matrix of head to bus column by column
    columns = "\n".join(f"{value:.17e}" for value in R_HB.as_matrix().ravel())
    return (
        f"KPL/FK\n\\begindata\nFRAME_SAT_BUS = {BUS}\nFRAME_{BUS}_NAME = 'SAT_BUS'\nFRAME_{BUS}_CLASS = 3\n"
        f"FRAME_{BUS}_CLASS_ID = {BUS}\nFRAME_{BUS}_CENTER = {SATELLITE}\nCK_{BUS}_SCLK = {SATELLITE}\n"
        f"CK_{BUS}_SPK = {SATELLITE}\nFRAME_SAT_STR1 = {HEAD}\nFRAME_{HEAD}_NAME = 'SAT_STR1'\n"
        f"FRAME_{HEAD}_CLASS = 4\nFRAME_{HEAD}_CLASS_ID = {HEAD}\nFRAME_{HEAD}_CENTER = {SATELLITE}\n"
        f"TKFRAME_{HEAD}_RELATIVE = 'SAT_BUS'\nTKFRAME_{HEAD}_SPEC = 'MATRIX'\n"
        f"TKFRAME_{HEAD}_MATRIX = ( {columns} )\n\\begintext\n"
    )


def write_texts(root: Path, time_system: int = 1) -> None:
    (root / "a.tls").write_text(leap_second_kernel())
    (root / "a.tsc").write_text(clock(time_system))
    (root / "a.tf").write_text(frames())


def ticks_of(root: Path, t_s: np.ndarray) -> np.ndarray:
    """Whole ticks of the clock near these instants."""
    with spiceypy.KernelPool([str(root / "a.tsc"), str(root / "a.tls")]):
        return np.array(
            [round(spiceypy.sce2c(SATELLITE, et)) for et in ephemeris_time(EPOCH, t_s)], dtype=float
        )


def instants_of(root: Path, ticks: np.ndarray) -> np.ndarray:
    with spiceypy.KernelPool([str(root / "a.tsc"), str(root / "a.tls")]):
        et = np.array([spiceypy.sct2e(SATELLITE, tick) for tick in ticks])
    return seconds_from_ephemeris_time(EPOCH, et)


def write_ck(path: Path, ticks: np.ndarray, R_bi: Rotation, frame: str = "J2000", kind: int = 3) -> None:
    """A CK of two segments with rotations (N,) from `frame` to the bus; NAIF's writer."""
    quaternions = np.array([spiceypy.m2q(matrix) for matrix in R_bi.as_matrix()])
    handle = spiceypy.ckopn(str(path), "test", 0)
    half = len(ticks) // 2
    for part in (slice(0, half), slice(half - 1, None)):  # one instant in both
        t, q = ticks[part], quaternions[part]
        rates = np.zeros((len(t), 3))
        if kind == 3:
            spiceypy.ckw03(handle, t[0], t[-1], BUS, frame, True, "s", len(t), t, q, rates, 1, t[:1])
        elif kind == 1:
            spiceypy.ckw01(handle, t[0], t[-1], BUS, frame, False, "s", len(t), t, q, rates)
        elif kind == 5:
            tick_s = 1.0 / TICKS_PER_S
            segment = (handle, 1, 3, t[0], t[-1], BUS, frame, False, "s", t, q, tick_s, 1, t[:1])
            spiceypy.ckw05(*segment)
        else:
            rate = np.full(len(t) - 1, 1.0 / TICKS_PER_S)
            spiceypy.ckw02(
                handle, t[0], t[-1], BUS, frame, "s", len(t) - 1, t[:-1], t[1:], q[:-1], rates[:-1], rate
            )
    spiceypy.ckcls(handle)


def kernels(root: Path, *files: str) -> Kernels:
    return Kernels(files=files, paths=tuple(root / file for file in files), spacecraft=None)


def bold(t_s: np.ndarray) -> Rotation:
    """A motion through all signs of the quaternion, with no axis near another's."""
    return Rotation.from_rotvec(np.outer(0.9 * t_s, [0.48, -0.6, 0.64])) * Rotation.from_euler(
        "zyx", [2.0, -0.7, 1.1]
    )


ALL = ("a.tls", "a.tsc", "a.tf")


@pytest.mark.parametrize(
    ("frame", "kind"), [("J2000", 3), ("J2000", 1), ("ECLIPJ2000", 3), ("J2000", 2), ("J2000", 5)]
)
def test_attitudes_are_those_that_the_toolkit_gives_at_the_same_instants(frame, kind, tmp_path):
    write_texts(tmp_path)
    ticks = ticks_of(tmp_path, np.arange(-2.0, 12.0, 0.125))
    write_ck(tmp_path / "a.bc", ticks, bold(instants_of(tmp_path, ticks)), frame, kind)
    rows = read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_STR1", kernels(tmp_path, *ALL))
    assert len(rows.t_s) == len(ticks) and rows.covariance_s is None
    # 0.2 us: two roundings of ephemeris time in a double
    assert rows.t_s == pytest.approx(instants_of(tmp_path, ticks), abs=2e-7)
    with spiceypy.KernelPool([str(tmp_path / file) for file in (*ALL, "a.bc")]):
        for n in range(1, len(ticks) - 1, 5):
            et = spiceypy.sct2e(SATELLITE, ticks[n])
            utc = spiceypy.et2utc(et, "ISOC", 7)
            assert EPOCH.seconds_from_utc([utc])[0] == pytest.approx(rows.t_s[n], abs=2e-7)
            # a double of ephemeris time resolves 1.2e-7 s, in which the bus turns by 1e-7 rad; between single
            # attitudes the toolkit needs a tolerance, so that the CK's own instant is asked for
            bus, _ = spiceypy.ckgp(BUS, ticks[n], 0, "J2000")
            expected = spiceypy.pxform("SAT_BUS", "SAT_STR1", et) @ bus
            assert np.abs(rows.R_si[n].as_matrix() - expected).max() < 1e-14
            if kind in (3, 5):
                whole = spiceypy.pxform("J2000", "SAT_STR1", et)
                assert np.abs(rows.R_si[n].as_matrix() - whole).max() < 3e-7


def test_clock_in_tdt_needs_the_leap_second_kernel(tmp_path: Path) -> None:
    write_texts(tmp_path, time_system=2)
    ticks = ticks_of(tmp_path, np.arange(0.0, 4.0, 0.5))
    write_ck(tmp_path / "a.bc", ticks, bold(np.arange(8.0)))
    with pytest.raises(RawDataError, match=r"a\.bc: SPICE: found .*expected a leap-second kernel \(LSK\)"):
        read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_STR1", kernels(tmp_path, "a.tsc", "a.tf"))
    rows = read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_STR1", kernels(tmp_path, *ALL))
    assert rows.t_s == pytest.approx(instants_of(tmp_path, ticks), abs=2e-7)


def test_kernels_of_the_program_are_loaded_again(tmp_path: Path) -> None:
    write_texts(tmp_path)
    ticks = ticks_of(tmp_path, np.arange(0.0, 4.0, 0.5))
    write_ck(tmp_path / "a.bc", ticks, bold(np.arange(8.0)))
    own = tmp_path / "own.tf"
    own.write_text("KPL/FK\n\\begindata\nFRAME_SAT_BUS = -7000\nFRAME_-7000_NAME = 'SAT_BUS'\n\\begintext\n")
    spiceypy.furnsh(str(own))
    try:
        read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_BUS", kernels(tmp_path, *ALL))
        with pytest.raises(RawDataError):
            read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_BUS", kernels(tmp_path, "a.tf"))
        assert [spiceypy.kdata(n, "ALL")[0] for n in range(spiceypy.ktotal("ALL"))] == [str(own)]
        assert spiceypy.gipool("FRAME_SAT_BUS", 0, 1)[0] == -7000
    finally:
        spiceypy.kclear()


# ------------------------------------------------------------------------------------------ a whole dump


@pytest.fixture
def dump(tmp_path: Path) -> Path:
    """The handmade dump with its orbit as SPK and nadir-pointing attitudes as CK, beside the plain files."""
    root = write_handmade_dump(tmp_path / "dump")
    plain = open_dump(root)
    write_texts(root)
    ticks = ticks_of(root, np.arange(18.0, 22.0, 0.1))
    t_s = instants_of(root, ticks)
    R_bi = R_HB.inv() * plain.R_cs0.inv() * plain.orbit.R_oi(t_s)
    write_ck(root / "str1.bc", ticks, R_bi)
    t = np.arange(0.0, 40.0)
    states = np.hstack([plain.orbit.positions_i(t), plain.orbit.states_i(t)[1]]) / 1e3
    write_spk(root / "sat.bsp", states, ephemeris_time(EPOCH, t))
    replaced(root / "dump.toml", "orbit.oem", "sat.bsp")
    give_heads(root, SPICE)
    return root


SPICE = """
[spice]
kernels = ["a.tls", "a.tsc", "a.tf"]

[[star_cameras]]
name = "STR1"
level = "attitudes"
installation = "installation.toml"
attitudes = "str1.bc"
spice_frame = "SAT_STR1"
aberration_removed = "annual and orbital"

[star_cameras.noise]
white_arcsec = [1, 1, 7]
"""


def write_spk(path: Path, states: np.ndarray, et: np.ndarray, bodies: tuple[int, ...] = (SATELLITE,)) -> None:
    handle = spiceypy.spkopn(str(path), "test", 0)
    for body in bodies:
        spiceypy.spkw13(handle, body, 399, "J2000", et[0], et[-1], "s", 7, len(et), states, et)
    spiceypy.spkcls(handle)


def test_a_dump_of_kernels_has_the_orbit_and_the_attitudes_of_the_toolkit(dump: Path) -> None:
    opened = open_dump(dump)
    source = opened.heads[0].source
    assert isinstance(source, SolvedAttitudes) and len(source.rows.t_s) == 40
    assert "sat.bsp covers 2024-11-20T03:40:00" in opened.orbit_covers
    t = np.random.default_rng(5).uniform(0.5, 38.5, 50)
    with spiceypy.KernelPool([str(dump / file) for file in (*ALL, "sat.bsp", "str1.bc")]):
        for one in t:
            et = float(ephemeris_time(opened.epoch, [one])[0])
            state, _ = spiceypy.spkezr(str(SATELLITE), et, "J2000", "NONE", "EARTH")
            # 1.2e-7 s by which a double of ephemeris time is rounded are 1 mm on the orbit
            assert np.abs(opened.orbit.positions_i([one])[0] - 1e3 * state[:3]).max() < 2e-3  # m
            assert np.abs(opened.orbit.states_i([one])[1][0] - 1e3 * state[3:]).max() < 1e-5  # m/s
        middle = source.rows.t_s[20] + float(EPOCH.tai_s - opened.epoch.tai_s)
        et = float(ephemeris_time(EPOCH, [middle])[0])
        expected = spiceypy.pxform("J2000", "SAT_STR1", et)
        assert np.abs(source.rows.R_si[20].as_matrix() - expected).max() < 1e-9  # 1e-3 rad/s x 1e-7 s


def changed(root: Path, old: str, new: str) -> Dump:
    replaced(root / "dump.toml", old, new)
    return open_dump(root)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('spice_frame = "SAT_STR1"\n', "", "spice_frame of STR1: found nothing, expected this key"),
        ("SAT_STR1", "SAT_STR2", "spice_frame: found SAT_STR2, expected .*SAT_BUS, SAT_STR1"),
        ("SAT_STR1", "ITRF93", "spice_frame: found ITRF93, of class 2"),
        ('"a.tf"', '"b.tf"', "b.tf: file: found no such file"),
        (', "a.tf"', "", "they have none, name the FK"),
        ('"a.tsc", ', "", r"str1\.bc: SPICE: found .*expected the clock kernel \(SCLK\)"),
        ('str1.bc"', 'str1.bc"\nframe = "GCRF"', r"frame of str1\.bc: found GCRF, expected no such key"),
        ('"str1.bc"', '"sat.bsp"', "sat.bsp: byte 0: found a SPICE SPK, expected a CK"),
        ('orbit = "sat.bsp"', 'orbit = "str1.bc"', "str1.bc: byte 0: found a SPICE CK, expected a SPK"),
        ('"str1.bc"', '"a.tf"', "a.tf: byte 0: found no SPICE CK, expected a CK, for spice_frame"),
        ("[spice]", "[spice]\nspacecraft = -5", "sat.bsp: objects: found -999, expected -5"),
        ('"a.tf"]', '"../a.tf"]', "spice.kernels.2: found ../a.tf"),
        ('"a.tf"]', '"orbit.oem"]', "orbit.oem: byte 0: found .*expected KPL/LSK"),
    ],
)
def test_what_is_missing_is_named_with_its_remedy(old: str, new: str, complaint: str, dump: Path) -> None:
    with pytest.raises(RawDataError, match=complaint):
        changed(dump, old, new)
    faults = dump_or_faults(dump)
    assert isinstance(faults, tuple) and re.search(complaint, "\n".join(map(str, faults)))


def test_a_kernel_that_names_others_is_refused(dump: Path) -> None:
    (dump / "a.tf").write_text(frames() + "\\begindata\nKERNELS_TO_LOAD = ( '/etc/passwd' )\n\\begintext\n")
    with pytest.raises(RawDataError, match=r"a\.tf: KERNELS_TO_LOAD: found a meta-kernel"):
        open_dump(dump)


def test_of_several_objects_one_is_stated(dump: Path) -> None:
    t = np.arange(0.0, 40.0)
    orbit = open_dump(dump).orbit
    states = np.hstack([orbit.positions_i(t), orbit.states_i(t)[1]]) / 1e3
    (dump / "sat.bsp").unlink()
    write_spk(dump / "sat.bsp", states, ephemeris_time(EPOCH, t), (SATELLITE, -998))
    with pytest.raises(RawDataError, match=r"objects: found -999, -998, expected one object, or `spacecraft"):
        open_dump(dump)
    changed(dump, "[spice]", "[spice]\nspacecraft = -998")


@pytest.mark.parametrize("count", [2, 101, 102, 303])
def test_intervals_of_constant_rates_are_counted_with_their_directories(count: int, tmp_path: Path) -> None:
    write_texts(tmp_path)
    ticks = ticks_of(tmp_path, 0.05 * np.arange(count + 1.0))
    handle = spiceypy.ckopn(str(tmp_path / "a.bc"), "test", 0)
    quaternions = np.array([spiceypy.m2q(matrix) for matrix in bold(np.arange(float(count))).as_matrix()])
    rates, tick_s = np.zeros((count, 3)), np.full(count, 1.0 / TICKS_PER_S)
    span = ticks[0], ticks[-1], BUS, "J2000", "s", count
    spiceypy.ckw02(handle, *span, ticks[:-1], ticks[1:], quaternions, rates, tick_s)
    spiceypy.ckcls(handle)
    rows = read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_BUS", kernels(tmp_path, *ALL))
    assert len(rows.t_s) == count + 1
    error = rows.R_si[:count] * bold(np.arange(float(count))).inv()
    assert error.magnitude().max() < 1e-14 and (rows.R_si[-1] * rows.R_si[-2].inv()).magnitude() < 1e-14


def fortran(name: str, *values: object) -> None:
    """Call a routine of NAIF's toolkit that spiceypy does not wrap: by reference, lengths of texts last."""
    texts = [value.encode() for value in values if isinstance(value, str)]
    lengths = [ctypes.c_long(len(text)) for text in texts]
    arguments = []
    for value in values:
        if isinstance(value, str):
            arguments.append(ctypes.c_char_p(value.encode()))
        elif isinstance(value, float):
            arguments.append(ctypes.byref(ctypes.c_double(value)))
        elif isinstance(value, int):
            arguments.append(ctypes.byref(ctypes.c_int(value)))
        else:
            kind = ctypes.c_double if value.dtype == float else ctypes.c_int
            arguments.append(value.ctypes.data_as(ctypes.POINTER(kind)))
    getattr(libspice, name)(*arguments, *lengths)
    spiceypy.check_for_spice_error(None)


def write_polynomials(path: Path, ticks: np.ndarray, kind: int) -> None:
    """A CK of type 4 (a cubic each interval) or 6 (Lagrange's polynomials in two mini-segments) through
    `bold`; a gap after the third interval, or between the mini-segments.
    """
    handle = spiceypy.ckopn(str(path), "test", 0)
    turns = bold(np.arange(float(len(ticks))))
    q = np.array([spiceypy.m2q(matrix) for matrix in turns.as_matrix()])
    q *= np.cumprod(np.concatenate([[1.0], np.sign(np.einsum("ni,ni->n", q[1:], q[:-1]))]))[:, None]
    if kind == 4:
        fortran("ckw04b_", handle, float(ticks[0]), BUS, "J2000", 0, "s")
        for n in range(len(ticks) - 1):
            radius = 0.5 * (ticks[n + 1] - ticks[n]) * (0.5 if n == 2 else 1.0)
            middle = ticks[n] + radius
            line = np.stack([0.5 * (q[n] + q[n + 1]), 0.5 * (q[n + 1] - q[n])], axis=1)  # Chebyshev, degree 1
            packet = np.concatenate([[middle, radius], [2.0] * 4, [0.0] * 3, line.ravel()])
            fortran("ckw04a_", handle, 1, np.array([len(packet)], dtype=np.int32), packet, ticks[n : n + 1])
        fortran("ckw04e_", handle, float(ticks[-1]))
    else:
        half = len(ticks) // 2
        packets = np.ascontiguousarray(np.hstack([q, np.zeros((len(q), 3))])[:, :4])
        bounds = np.array([ticks[0], ticks[half], ticks[-1]])
        whole = np.int32
        fortran(
            "ckw06_", handle, BUS, "J2000", 0, float(ticks[0]), float(ticks[-1]), "s", 2,
            np.array([half, len(ticks) - half], dtype=whole), np.array([1, 1], dtype=whole),
            np.array([3, 3], dtype=whole), packets, np.full(2, 1.0 / TICKS_PER_S), ticks, bounds, 1,
        )  # fmt: skip
    spiceypy.ckcls(handle)


@pytest.mark.parametrize("kind", [4, 6])
def test_polynomials_are_evaluated_at_equal_steps_over_what_they_cover(kind: int, tmp_path: Path) -> None:
    write_texts(tmp_path)
    ticks = ticks_of(tmp_path, 0.5 * np.arange(12.0))
    write_polynomials(tmp_path / "a.bc", ticks, kind)
    rows = read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_STR1", kernels(tmp_path, *ALL))
    step = np.diff(rows.t_s)
    assert np.median(step) == pytest.approx(0.125, abs=1e-5)  # s
    assert step.max() == pytest.approx({4: 0.25, 6: 0.5}[kind], abs=1e-5)  # the gap
    with spiceypy.KernelPool([str(tmp_path / file) for file in (*ALL, "a.bc")]):
        et = ephemeris_time(EPOCH, rows.t_s)
        for n in range(1, len(et) - 1, 3):
            expected = spiceypy.pxform("J2000", "SAT_STR1", et[n])
            # 0.9 rad/s in the rounding of 2e-7 s
            assert np.abs(rows.R_si[n].as_matrix() - expected).max() < 3e-7


@pytest.mark.parametrize("kind", [4, 6])
def test_mutated_polynomials_are_read_or_refused(kind: int, tmp_path: Path) -> None:
    """Single bytes; a packet that states more coefficients than it has makes the toolkit read beyond it."""
    write_texts(tmp_path)
    write_polynomials(tmp_path / "a.bc", ticks_of(tmp_path, 0.5 * np.arange(12.0)), kind)
    whole, rng, refused = (tmp_path / "a.bc").read_bytes(), np.random.default_rng(4), 0
    (first,) = np.frombuffer(whole[1096:1100], "<i4")  # where the only segment begins, in its summary
    codes = range(8 * (int(first) + 3), len(whole), 8 * 13) if kind == 4 else ()  # high bytes of codes
    for n in [*codes, *rng.integers(1024, len(whole), 200).tolist()]:
        raw = bytearray(whole)
        raw[n + 6 if n in codes and n + 6 < len(raw) else n] = 255
        (tmp_path / "b.bc").write_bytes(raw)
        try:
            read_ck(tmp_path / "b.bc", "b.bc", EPOCH, "SAT_STR1", kernels(tmp_path, *ALL))
        except RawDataError:
            refused += 1
    assert refused > 3


def test_a_packet_that_states_one_coefficient_more_than_it_has_is_refused(tmp_path: Path) -> None:
    write_texts(tmp_path)
    write_polynomials(tmp_path / "a.bc", ticks_of(tmp_path, 0.5 * np.arange(12.0)), 4)
    right, wrong = (np.float64(2 * (1 + 128 + 128**2 + 128**3) + n).tobytes() for n in (0, 1))  # degree 1
    (tmp_path / "b.bc").write_bytes((tmp_path / "a.bc").read_bytes().replace(right, wrong, 1))
    with pytest.raises(RawDataError, match="segment of type 4: found counts that do not fit"):
        read_ck(tmp_path / "b.bc", "b.bc", EPOCH, "SAT_STR1", kernels(tmp_path, *ALL))


def test_polynomials_over_too_many_hours_are_refused(tmp_path: Path) -> None:
    write_texts(tmp_path)
    ticks = ticks_of(tmp_path, np.array([0.0, 2e8, 4e8, 6e8]))
    write_polynomials(tmp_path / "a.bc", ticks, 4)
    with pytest.raises(
        RawDataError, match=r"segment: found \d+ hours, expected at most 28 hours; cut it with"
    ):
        read_ck(tmp_path / "a.bc", "a.bc", EPOCH, "SAT_STR1", kernels(tmp_path, *ALL))


def test_without_the_toolkit_the_extra_is_named(dump: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    with pytest.raises(RawDataError, match=r"sat\.bsp: SPICE kernel: .*pip install 'boresight\[spice\]'"):
        open_dump(dump)


def test_mutated_kernels_are_read_or_refused(dump: Path) -> None:
    """Bytes, cuts and insertions at the places of all parts of the files; `RawDataError` or rows."""
    rng = np.random.default_rng(9)
    whole = {name: (dump / name).read_bytes() for name in ("str1.bc", "sat.bsp")}
    refused = 0
    for n in range(80):
        name = ("str1.bc", "sat.bsp")[n % 2]
        raw = bytearray(whole[name])
        for _ in range(int(rng.integers(1, 4))):
            raw[int(rng.integers(0, len(raw)))] = int(rng.integers(0, 256))
        cut = raw[: int(rng.integers(0, len(raw)))] if n % 5 == 0 else raw
        (dump / name).write_bytes(bytes(cut))
        try:
            open_dump(dump)
        except RawDataError as error:
            refused += 1
            assert str(error)
        (dump / name).write_bytes(whole[name])
    assert refused > 8
