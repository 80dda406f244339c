"""Faults of inputs and what is reported of them: the cause with its size, its item, its file; or what the
result cannot show.

Measured points of three strips and two heads (`points`), in which nothing is searched in images, so that a
calibration is short; strips of the ground and scans of the sky as images. Each fault is another one than
those of `faults.py`.
"""

import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import fault_cases
import fault_dumps
import faults
import numpy as np
import pytest
import rasterio
from edits import repaint, rows_of, write_rows
from scipy.spatial.transform import Rotation

from boresight.calib.finding import MOST_WORDS
from boresight.calib.reliability import blind_spots
from boresight.calib.verdict import Outcome
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.results.folder import store_of

change, changed_rows, edited = faults.change, faults.changed_rows, faults.edited
files_exchanged, later, spread = faults.files_exchanged, faults.later, faults.spread
STRIPS = ("s01", "s02", "s03")
PITCH_MM = 0.12  # of a pixel of the remote-sensing camera
CONSISTENT, FINDINGS, REFUTED = Outcome.CONSISTENT, Outcome.FINDINGS, Outcome.REFUTED
REMOTE, POINTS = "remote_camera.toml", "points.csv"
Make = Callable[[Path], None]
Row = dict[str, str]


@pytest.fixture(scope="module")
def right(sound: Path) -> DumpCalibration:
    """The calibration of the points without a fault."""
    return calibrate_dump(open_dump(sound))


@pytest.fixture
def told(with_fault) -> Callable[[Make], DumpCalibration]:
    """What a calibration of the points with a fault gives."""
    return partial(with_fault, "points")


def number(file: str, key: str, edit: Callable[[float], float], which: int | None = None) -> Make:
    return partial(faults.toml_number, file, key, edit, which)


def one_point(name: str, column: str, new: Callable[[str], str]) -> Make:
    def edit(row: Row) -> None:
        if row["id"] == name:
            row[column] = new(row[column])

    return partial(edited, POINTS, edit)


def late(dump: Path, **ms: float) -> None:
    for strip, by in ms.items():
        faults.rows_late((strip,), 1e-3 * by, dump)


def second_ones_early(file: str, column: str, seconds: float, keep: int, dump: Path) -> None:
    """Rows of a table dated early in turn, of so many a strip, evenly over it; 0: of all."""

    def early(rows: list[Row]) -> list[Row]:
        left = spread(keep, rows) if keep else rows
        for row in left[1::2]:
            row[column] = later(row[column], -seconds)
        return left

    changed_rows(file, early, dump)


def rows_shifted(heads: tuple[str, ...], dump: Path) -> None:
    """Each attitude of some heads at the time of the one before."""
    for head in heads:
        rows = rows_of(dump / f"{head}.csv")
        write_rows(dump / f"{head}.csv", [row | {"utc": at["utc"]} for row, at in zip(rows[1:], rows)])


def one_row_turned(head: str, row: int, degrees: float, dump: Path) -> None:
    rows = rows_of(dump / f"{head}.csv")
    faults.turned_by(rows[row], Rotation.from_rotvec(np.radians(degrees) * np.array([0.62, -0.31, 0.72])))
    write_rows(dump / f"{head}.csv", rows)


def some_moved(every: int, strip: str, metres: float, dump: Path) -> None:
    """Every so many of the points of strips whose names begin so, moved to the north."""
    names = sorted({row["id"] for row in rows_of(dump / POINTS) if row["strip"].startswith(strip)})[::every]
    edited(POINTS, lambda row: row["id"] in names and faults.add("lat_deg", metres / 111_200.0, row), dump)


def measured_twice(dump: Path) -> None:
    """Every point once more under another id, 2 px aside."""

    def again(rows: list[Row]) -> list[Row]:
        aside = ({"id": f"{row['id']}x", "sample": repr(float(row["sample"]) + 2.0)} for row in rows)
        return [*rows, *(row | more for row, more in zip(rows, aside))]

    changed_rows(POINTS, again, dump)


def without_distortion(dump: Path) -> None:
    text = (dump / REMOTE).read_text()
    zero = lambda found: f"distortion_offsets_um = {[0.0] * (found[1].count(',') + 1)}"  # noqa: E731
    faults.write_text(dump / REMOTE, re.sub(r"distortion_offsets_um = \[(.*)\]", zero, text))


exposures_early = partial(partial, second_ones_early, "exposures.csv", "utc_mid", 0.04)


def numbers_exchanged(one: str, other: str, strips: tuple[str, ...] = STRIPS) -> Make:
    """The numbers of two CCDs exchanged in points of some strips."""

    def edit(row: Row) -> None:
        if row["strip"] in strips:
            row["ccd"] = {one: other, other: one}.get(row["ccd"], row["ccd"])

    return partial(edited, POINTS, edit)


def two_at_once(dump: Path) -> None:
    files_exchanged("exposures.csv", [(2, 9)], dump)
    number(REMOTE, "x_offset_mm", lambda v: 0.0)(dump)


def strips_exchanged(dump: Path) -> None:
    ids = [row["id"] for row in rows_of(dump / "strips.csv")]
    places = ([n for n, one in enumerate(ids) if one == strip] for strip in ("s01", "s02"))
    files_exchanged("strips.csv", zip(*places), dump)


def ccds_exchanged(dump: Path) -> None:
    """The files of CCDs 0 and 1 in one strip."""
    places = [(row["id"], row["ccd"]) for row in rows_of(dump / "strips.csv")]
    files_exchanged("strips.csv", [(places.index(("s02", "0")), places.index(("s02", "1")))], dump)


def strips_again(dump: Path) -> None:
    twice = lambda rows: [*rows, *(row | {"id": f"r-{row['id']}"} for row in rows)]  # noqa: E731
    changed_rows("strips.csv", twice, dump)


def painted(images: str, paint: Callable[[np.ndarray], np.ndarray], dump: Path) -> None:
    for image in (dump / "strips").glob(f"{images}.tif"):
        repaint(image, paint)


def lines_lost(image: np.ndarray) -> np.ndarray:
    """Eight lines; as many at the end are dark."""
    return np.concatenate([image[:1000], image[1008:], np.zeros_like(image[:8])])


def half_dark(image: np.ndarray) -> np.ndarray:
    half = image.copy()
    half[:, : half.shape[1] // 2] = np.median(image)
    return half


def noisy(image: np.ndarray) -> np.ndarray:
    """Noise of some six times the detector's."""
    noise = np.random.default_rng(5).normal(0.0, 18.0, image.shape)
    return (image + noise).clip(0, 65535).round().astype(image.dtype)


def every_second_line_twice(image: np.ndarray) -> np.ndarray:
    return np.repeat(image[::2], 2, axis=0)[: len(image)]


def grey(level: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda image: np.full_like(image, level)


def without_light_effect(dump: Path) -> None:
    change(dump / "dump.toml", r"(?m)^\[errors\]", "[light]\naberration = false\n\n[errors]")


def stages(count: int, label: str, dump: Path) -> None:
    """Images of one stage, stated as of several; the label of a row is that of their first or middle."""
    change(dump / REMOTE, "tdi_stages = 1\n", f"tdi_stages = {count}\n")
    change(dump / REMOTE, 'time_of_row = "middle"', f'time_of_row = "{label}"')


def chips_mapped(scale: float, turned_deg: float, dump: Path) -> None:
    """Chips whose geo-references are larger, or turned, about the corners from which they count."""
    for chip in (dump / "chips").glob("*.tif"):
        with rasterio.open(chip) as file:
            image, profile = file.read(1), dict(file.profile)
        a, b, c, d, e, f, *_ = profile["transform"]
        about = rasterio.Affine(scale * a, scale * b, 0.0, scale * d, scale * e, 0.0)
        moved = rasterio.Affine.rotation(turned_deg) @ about
        profile["transform"] = rasterio.Affine.translation(c, f) @ moved
        chip.unlink()
        with rasterio.open(chip, "w", **profile) as file:
            file.write(image, 1)


def another_distortion(dump: Path) -> None:
    """Offsets along every detector that are 0 in its middle and a pixel, with a cubic, at its ends."""
    text = (dump / REMOTE).read_text()

    def other(found: re.Match[str]) -> str:
        offsets = np.array([float(value) for value in found[1].split(",")])
        offsets += 1e3 * PITCH_MM * np.linspace(-1.0, 1.0, len(offsets)) ** 3
        return f"distortion_offsets_um = {offsets.tolist()}"

    faults.write_text(dump / REMOTE, re.sub(r"distortion_offsets_um = \[(.*)\]", other, text))


def few_digits(dump: Path) -> None:
    """An orbit of positions rounded to 100 m, and velocities to 1 m/s."""

    def edit(t_s: np.ndarray, p: np.ndarray, v: np.ndarray) -> None:
        p[:], v[:] = np.round(p, 1), np.round(v, 3)

    faults.states(edit, dump)


def turned_away(dump: Path) -> None:
    """Attitudes of the exposures of a strip, of both heads, with which the camera looks past the Earth."""
    begins = {row["id"]: row["utc_first_row"] for row in rows_of(dump / "strips.csv")}
    for head in ("STR1", "STR2"):
        stated = tomllib.loads((dump / f"installation_{head}.toml").read_text())["quaternion_cs"]
        turn = Rotation.from_rotvec(
            np.radians(80.0) * Rotation.from_quat(stated).inv().apply([1.0, 0.0, 0.0])
        )

        def edit(row: Row, turn: Rotation = turn) -> None:
            if later(begins["s02"], -4.0) < row["utc"] < later(begins["s02"], 6.0):
                q = Rotation.from_quat([float(row[key]) for key in ("qx", "qy", "qz", "qw")]) * turn
                row.update(zip(("qx", "qy", "qz", "qw"), map(repr, q.as_quat().tolist())))

        edited(f"{head}.csv", edit, dump)


def typo(dump: Path) -> None:
    """Two digits of a longitude exchanged: no strip shows that place."""
    rows = rows_of(dump / "targets.csv")
    assert rows[3]["lon_deg"].startswith("103.01")
    rows[3]["lon_deg"] = rows[3]["lon_deg"].replace("103.01", "103.10")
    write_rows(dump / "targets.csv", rows)


CLOCK, TIMES = "clock of the rows", "times of attitudes"
IN_TURN = ("clock of the exposures, every second one", "all exposures", "exposures.csv", -40.0, "")
ROWS = [
    # Dump and seed, fault, outcome, what is reported: (cause, item, file, size; None: not measured, words).
    ("points", partial(late, s02=-7.0), REFUTED, [(CLOCK, "strip s02", "strips.csv", -7.0, "")]),
    ("points", partial(faults.period, ("s01",), 0.0018), REFUTED,
        [("row period", "strip s01", "strips.csv", 0.18, "")]),
    ("points", number(REMOTE, "focal_length_m", lambda v: v * 1.0004), FINDINGS,
        [("focal length of the remote-sensing camera", "all CCDs", REMOTE, 0.04, "")]),  # or 212 m of height
    ("points", partial(faults.ground_moved, POINTS, ("s02",), "north", 80.0), REFUTED,
        [("datum of the targets, north", "strip s02", POINTS, 80.0, "")]),
    ("points", one_point("s01-t07", "lat_deg", lambda v: f"{float(v) + 2.5e-4:.10f}"), FINDINGS,
        [("coordinates", "target s01-t07 (strip s01)", POINTS, 27.8, "")]),
    ("points", partial(second_ones_early, "STR1.csv", "utc", 0.05, 0), REFUTED,
        [(TIMES, "head STR1", "STR1.csv", None, "")]),
    ("points", partial(rows_shifted, ("STR2",)), REFUTED,
        [(TIMES, "head STR2", "STR2.csv", None, "1 row early")]),
    ("points", partial(rows_shifted, ("STR1", "STR2")), REFUTED,
        [(TIMES, "head STR1", "STR1.csv", None, "1 row early"), (TIMES, "head STR2", "STR2.csv", None, "")]),
    ("points", partial(one_row_turned, "STR2", 30, 0.02), REFUTED,
        [("files or times of exposures", "exposure STR2-000031", "STR2.csv", None, "")]),
    ("points", partial(one_row_turned, "STR1", 30, 0.2), REFUTED,
        [("files or times of exposures", "exposure STR1-000031", "STR1.csv", None, "")]),
    ("points", partial(some_moved, 3, "s02", 30.0), FINDINGS,
        [("coordinates", "11 targets in strip s02", POINTS, 30.0, r"about [23]\d\S* m north of the")]),
    ("points", partial(some_moved, 3, "s", -30.0), FINDINGS,
        [("coordinates", "32 targets in strips s01, s02, s03", POINTS, 30.0, "south of the true place")]),
    ("points", measured_twice, REFUTED,
        [("targets listed more than once", "192 targets", POINTS, None, "s01-c01 and s01-c01x and 95 more")]),
    ("points", without_distortion, REFUTED,
        [(f"distortion of the remote-sensing camera, degree {n} over each CCD", "all CCDs", REMOTE, None, "")
         for n in (1, 3, 5)]),
    ("points", lambda dump: faults.paths_exchanged(dump / "STR1.csv", dump / "STR2.csv"), REFUTED,
        [("files of two heads", "heads STR1 and STR2", "dump.toml", None,
            "exchanged, 3 of 3 strips see.*as stated 0")]),
    ("points", partial(edited, "STR2.csv", faults.conjugate), REFUTED,
        [("attitudes of a head", "head STR2", "dump.toml", None, "")]),
    ("points", numbers_exchanged("2", "3", ("s02",)), FINDINGS,
        [("images of a CCD", "CCD 2 and CCD 3 in strip s02", POINTS, None,
            "ccd in points.csv, CCDs may be exchanged")]),
    ("points", numbers_exchanged("1", "2"), REFUTED,
        [("images or look directions of CCDs", "CCD 1 and CCD 2", REMOTE, None,
            "ccd in points.csv exchanged")]),
    ("points", one_point("s03-t02", "lon_deg", lambda v: f"-{v}"), FINDINGS,
        [("coordinates or chip", "target s03-t02", POINTS, None, r"beyond the horizon.*\(sign\) would fit")]),
    ("points", one_point("s02-t04", "lat_deg", lambda v: f"{float(v) + 17.0:.9f}"), FINDINGS,
        [("coordinates or chip", "target s02-t04", POINTS, None, "its refraction is not known")]),
    ("ground", typo, FINDINGS,
        [("coordinates or chip", "target s01-t04", "targets.csv", None,
            r"km from the nearest strip, s01.*lon_deg 103\.01 for 103\.10 \(digits exchanged\)")]),
    ("ground", number(REMOTE, "x_offset_mm", lambda v: v + PITCH_MM, 0), REFUTED,
        [("place of a CCD, along the track", "CCD 0", REMOTE, 1.0, "")]),
    ("ground", number(REMOTE, "y_first_mm", lambda v: v + 5 * PITCH_MM, 2), FINDINGS,
        [("place of a CCD, across the track", "CCD 2", REMOTE, 5.0, "")]),
    ("ground", partial(late, s03=15.0), FINDINGS, [(CLOCK, "strip s03", "strips.csv", 15.0, "")]),
    ("ground", partial(late, s01=10.0, s03=5.0), REFUTED,  # clocks show against the mean of s01 and s03
        [(CLOCK, "strip s02", "strips.csv", -8.0, ""), (CLOCK, "strip s01", "strips.csv", 5.0, "")]),
    ("ground", ccds_exchanged, FINDINGS,
        [("files of two CCDs", "CCD 0 and CCD 1 in strip s02", "strips.csv", None, "")]),
    ("ground", two_at_once, REFUTED,
        [("images or look directions of a CCD", "CCDs 0, 2", REMOTE, None, ""),
         ("files or times of exposures", "exposures e0003 and e0010", "exposures.csv", None, "")]),
    ("ground", partial(files_exchanged, "exposures.csv", [(2, 9)]), FINDINGS,
        [("files or times of exposures", "exposures e0003 and e0010", "exposures.csv", None, "")]),
    ("ground", partial(painted, "s02_*", np.flipud), FINDINGS,
        [("order of an image", "strip s02", "strips.csv", None, "rows reversed 12 of 12 targets are found")]),
    ("ground", number("star_camera.toml", "focal_length_mm", lambda v: 1.002 * v), REFUTED,
        [("focal length of the star camera", "all exposures", "star_camera.toml", 0.2, "")]),
    ("ground", number("star_camera.toml", "p1_per_mm", lambda v: v + 2e-5), REFUTED,  # p r², 20.5 mm from its
        [("decentring of the star camera, column", "all exposures", "star_camera.toml", 0.26, "")]),  # middle
    ("ground", partial(chips_mapped, 1.016, 0.0), REFUTED,
        [("pixel size of the chips", "all chips", "targets.csv", 1.6, "too large")]),
    ("ground", partial(chips_mapped, 1.0, 1.0), REFUTED,
        [("rotation of the chips", "all chips", "targets.csv", None, r"rotation by 0.99. ± 0.01[6-9]°")]),
    ("ground", lambda dump: repaint(dump / "terrain/dem.tif", lambda z: np.roll(z, 20, axis=1)), REFUTED,
        [("heights of targets or terrain", "all targets, or the terrain model", "terrain, targets.csv", None,
            "scatter about it")]),
    ("ground", partial(painted, "s02_*", every_second_line_twice), FINDINGS,
        [("repeated lines", "strip s02", "strips.csv", None, "5[01]% of their lines")]),
    ("points", another_distortion, FINDINGS,  # x³ = 0.6 P1 + 0.4 P3, of which a part is off the stated range
        [("distortion of the remote-sensing camera, degree 1 over each CCD", "all CCDs", REMOTE, -0.5, ""),
         ("distortion of the remote-sensing camera, degree 3 over each CCD", "all CCDs", REMOTE, -0.3, "")]),
    ("points", few_digits, REFUTED,
        [("rounded positions of the orbit", "all states", "orbit", 100.0, "of an error of 29 m")]),
    ("points", turned_away, FINDINGS,
        [("images, not a strip of the ground", "strip s02", "strips.csv", None, "looks past the Earth")]),
    ("ground", strips_again, CONSISTENT, []),
    ("ground", exposures_early(5), REFUTED, [IN_TURN]),
    ("ground", partial(painted, "s02_*", grey(17)), FINDINGS,
        [("empty images", "strip s02", "strips.csv", None, "grey")]),
    ("sky", number("star_camera.toml", "focal_length_mm", lambda v: 0.9999 * v), REFUTED,
        [("focal length of the star camera", "all exposures", "star_camera.toml", -0.01, "")]),
    ("sky", number(REMOTE, "x_offset_mm", lambda v: v - 9 * PITCH_MM, 2), FINDINGS,  # none of its three stars
        [("place of a CCD, along the track", "CCD 2", REMOTE, -9.0, "")]),  # is where it must be
    ("sky", exposures_early(0), REFUTED,
        [("times of exposures", "all exposures", "exposures.csv", 40.0, "")]),
    ("sky", exposures_early(4), FINDINGS, [IN_TURN]),  # as four rows are no record
    ("sky", partial(painted, "sky01_*", lines_lost), REFUTED,
        [("lines of a strip", "strip sky01 from line 1004 on", "strips.csv", 8.0, "")]),
    ("sky", partial(faults.period, ("sky01",), 0.01), REFUTED,
        [("row period", "strip sky01", "strips.csv", 1.0, "")]),
    ("sky", number(REMOTE, "rotation_mrad", lambda v: v + 7.0, 1), FINDINGS,
        [("rotation of a CCD", "CCD 1", REMOTE, 7.0, "")]),
    ("sky", number(REMOTE, "rotation_mrad", lambda v: v + 55.0, 3), FINDINGS,  # stars are looked for on it
        [("rotation of a CCD", "CCD 3", REMOTE, 55.0, "")]),
    ("scans 2", partial(painted, "sky01_*", grey(255)), FINDINGS,
        [("images, not identified", "strip sky01", "strips.csv", None, "grey.*saturated")]),
    ("scans 2", partial(painted, "*_ccd1", half_dark), FINDINGS,  # neither the CCD nor a strip is lost
        [("lost part of a CCD", "first half of CCD 1", "strips.csv", None, "")]),
    ("scans 2", partial(painted, "sky02_*", noisy), FINDINGS,
        [("lost faint stars", "strip sky02, fainter than V", "strips.csv", None, "")]),
    ("scans 2", partial(stages, 4, "start"), REFUTED,  # rows dated two periods wrong
        [("TDI stages", "strip sky02", REMOTE, None, "4 stages.*check tdi_stages and time_of_row")]),
    ("scans 2", partial(stages, 128, "middle"), FINDINGS,
        [("TDI stages", "strip sky02", REMOTE, None, "128 stages.*check tdi_stages and time_of_row")]),
    ("mixed", partial(faults.earth_turned, -faults.REVOLUTION_S), REFUTED,
        [("orbit, times or coordinates", "all targets", "targets.csv", None, "none of 24 comes into view")]),
    ("mixed", strips_exchanged, FINDINGS,
        [("files of two strips", "strip s01 and strip s02", "strips.csv", None, "as stated none")]),
    ("mixed", without_light_effect, REFUTED,
        [("orbit, or datum of the targets", "all ground strips", "orbit, targets.csv", None,
            "or light.aberration in dump.toml")]),
]  # fmt: skip


@pytest.mark.parametrize(("dump", "make", "outcome", "causes"), ROWS)
def test_a_fault_is_told_with_its_size_and_nothing_else_is_accused(with_fault, dump, make, outcome, causes):
    name, _, seed = dump.partition(" ")
    verdict = with_fault(name, make, int(seed or 1)).verdict
    found = [one for one in verdict.findings if one.is_fault]
    items = [re.sub(r" V [\d.]+$", " V", one.item) for one in found]
    assert [(one.cause, item, one.file) for one, item in zip(found, items)] == [row[:3] for row in causes]
    assert verdict.outcome is outcome
    for one, (*_, size, words) in zip(found, causes):
        assert len(f"{one.cause} {one.item} {one.text}".split()) <= MOST_WORDS
        assert re.search(words, one.text)
        if size is not None:  # the tenth is what θ and other strips take up
            assert one.value == pytest.approx(size, abs=max(4.0 * one.sigma, 0.1 * abs(size)))


def test_a_point_with_the_number_of_another_ccd_is_named_with_the_one_it_fits(told):
    other = one_point("s03-t02", "ccd", lambda value: str((int(value) + 1) % 4))
    (found,) = [one for one in told(other).verdict.findings if one.is_fault]
    assert (found.item, found.file) == ("target s03-t02 (strip s03)", POINTS)
    assert "it fits in CCD" in found.text and "correct its CCD" in found.text
    assert len(f"{found.cause} {found.item} {found.text}".split()) <= MOST_WORDS


def thinned(dump: Path) -> None:
    for name in ("STR1.csv", "STR2.csv"):
        changed_rows(name, lambda rows: rows[::14], dump)


def chips_shifted(dump: Path) -> None:
    for chip in (dump / "chips").glob("*.tif"):
        repaint(chip, lambda image: image, -350.0)


def geocentric(dump: Path) -> None:
    def edit(row: Row) -> None:
        lat = np.radians(float(row["lat_deg"]))
        row["lat_deg"] = f"{np.degrees(np.arctan((1.0 - 0.00669438) * np.tan(lat))):.9f}"

    edited("targets.csv", edit, dump)


REVERSED = r"^order of an image, strip s01: {} 12 of 12 targets are found, as stated none"


@pytest.mark.parametrize(
    ("dump", "make", "says"),
    [
        ("ground", partial(painted, "*", np.fliplr), REVERSED.format("with the order of columns reversed")),
        ("ground", partial(painted, "*", np.flipud), REVERSED.format("with the order of rows reversed")),
        ("ground", partial(painted, "*", partial(np.rot90, k=2)), REVERSED.format("rotated by 180°")),
        ("ground", partial(faults.redrawn, partial(np.rot90, k=2)),
            "^axes of the star images.* rotated by 180° 3 of 3 strips see their"),
        ("ground", geocentric, "36 of 36 targets: they lie 2.* m south of the middle of their chips"),
        ("points", one_point("s01-t07", "line", lambda v: repr(float(v) + 4000.0)),
            r"^points\.csv: line of s01-t07, strip s01: found \d+.*, expected a line of the strip, 0 to"),
        ("points", thinned, r"with run\.exposure_margin_s = \d+ those around it would"),
        ("points", number(REMOTE, "x_offset_mm", lambda v: 0.0),
            r"^place of a CCD, along the track, CCD \d:.*x_offset"),
        # No mistake of the attitudes explains it: each head by itself would be accused.
        ("points", partial(faults.orbit_mirrored, 2), r"^orbit\.oem: (?!.*STR)"),
        ("sky", partial(painted, "sky01_*", grey(255)),
            "^no strip can be used: strip sky01: grey level 255"),
        ("ground", chips_shifted, "36 of 36 targets: they lie 350 m east of the middle"),
    ],
)  # fmt: skip
def test_where_there_is_no_matrix_the_cause_is_told(with_fault, dump, make, says):
    with pytest.raises((DataNotSufficientError, RawDataError), match=says):
        with_fault(dump, make)


@pytest.mark.parametrize(("item", "strips"), [("strip s03", "s03"), ("all strips", "s01 s02 s03")])
def test_points_that_scatter_more_than_stated_are_one_finding_about_their_noise(told, item, strips):
    def scattered(dump: Path) -> None:
        rng = np.random.default_rng(11)

        def edit(row: Row) -> None:
            for column in ("sample", "line"):
                error = 8.0 * float(row[f"sigma_{column}_px"]) * rng.standard_normal()
                if row["strip"] in strips:
                    row[column] = repr(float(row[column]) + error)

        edited(POINTS, edit, dump)

    wrong = told(scattered)
    (first,) = [one for one in wrong.verdict.findings if one.is_fault]
    assert (first.cause, first.item) == ("noise of the image points or coordinates", item)
    assert 3.0 < first.value < 9.0  # times the stated of image, survey and vibration together
    assert first.refutes or item != "all strips"  # then the matrix is less certain than stated

    def stated(dump: Path) -> None:
        """Errors of the image points that are as many times larger as the finding says."""
        scattered(dump)

        def edit(row: Row) -> None:
            for column in ("sigma_sample_px", "sigma_line_px"):
                if row["strip"] in strips:
                    row[column] = repr(first.value * float(row[column]))

        edited(POINTS, edit, dump)

    better = told(stated)
    assert not better.verdict.findings
    moved = theta_between(better.estimate.R_cs, wrong.estimate.R_cs)
    # to a tenth: the finding has all parts of the errors larger, the survey's and the vibration's, too
    assert np.all(np.abs(first.effect_rad + moved) < 0.1 * np.abs(moved) + 0.15 * wrong.estimate.sigma_theta)


def test_sizes_of_single_points_scatter_by_their_sigma(told, sound):
    """Of 24 points, two of each strip at a time, each 27.8 m off; the rms of 24 normal deviates is 0.7 to 1.4
    in 99 of 100.
    """
    names = sorted({row["id"] for row in rows_of(sound / POINTS)})
    rng, errors = np.random.default_rng(3), []
    of_strips = [rng.permutation([one for one in names if one.startswith(s)]).tolist()[:8] for s in STRIPS]
    for k in range(4):
        moved = [name for of_strip in of_strips for name in of_strip[2 * k : 2 * k + 2]]

        def off(dump: Path, moved: list[str] = moved, off_deg: float = (-1) ** k * 2.5e-4) -> None:
            for name in moved:
                one_point(name, "lat_deg", lambda value: f"{float(value) + off_deg:.10f}")(dump)

        found = {one.item.split()[1]: one for one in told(off).verdict.findings if one.is_fault}
        assert set(found) == set(moved)
        errors += [(one.value - 27.8) / one.sigma for one in found.values()]
    assert len(errors) == 24 and 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_the_sound_dump_has_no_finding_and_names_what_it_cannot_show(right):
    assert right.verdict.outcome is CONSISTENT
    assert [one for one in right.verdict.findings if one.is_fault] == []
    unseen = {(one.cause, one.item) for one in blind_spots(right.verdict.tests) if one.is_unseen}
    assert {
        ("aberration of the attitudes, annual", "head STR1"),
        ("aberration of the attitudes, orbital", "head STR1"),
        ("clock of the exposures", "head STR1"),
        ("clock of the rows", "all strips"),
        ("light of the targets, aberration", "all targets"),
    } <= unseen


UNSEEN = {
    "aberration of the attitudes, annual": lambda dump: change(
        dump / "dump.toml", '"annual and orbital"', '"none"\nline_of_sight = [0.0, 0.0, 1.0]'
    ),
    "light of the targets, aberration": without_light_effect,
}


@pytest.mark.parametrize("cause", UNSEEN)
def test_an_error_that_leaves_no_residual_moves_the_matrix_as_its_blind_spot_says(told, right, cause):
    wrong = told(UNSEEN[cause])
    (spot,) = [one for one in blind_spots(wrong.verdict.tests) if one.cause == cause]
    moved = (wrong.estimate.R_cs * right.estimate.R_cs.inv()).as_rotvec()
    size = np.linalg.norm(spot.effect_rad)
    assert spot.is_unseen
    if cause.startswith("light"):  # alone; the label of a head is one effect of two
        assert np.linalg.norm(moved) == pytest.approx(size, rel=0.05)
    assert np.max(np.abs(moved) / right.estimate.sigma_theta) > 4.0


def test_attitudes_against_earth_fixed_axes_give_the_same_matrix(told, right, sound):
    """One and the same record in two frames: rounding of quaternions of 15 digits is 1e-9 of a sigma."""
    earth = open_dump(sound).orbit.earth

    def earth_fixed(dump: Path) -> None:
        for head in open_dump(sound).heads:
            rows = rows_of(dump / f"{head.name}.csv")
            R_hi = Rotation.from_quat([[float(row[key]) for key in faults.Q] for row in rows]).inv()
            q = (R_hi * earth.rotations_ie(head.source.rows.t_s)).inv().as_quat().tolist()
            turned = (row | dict(zip(faults.Q, map(repr, one))) for row, one in zip(rows, q))
            write_rows(dump / f"{head.name}.csv", turned)
        change(dump / "dump.toml", 'frame = "GCRF"', 'frame = "ITRF"')

    again = told(earth_fixed).estimate
    moved = (again.R_cs * right.estimate.R_cs.inv()).as_rotvec()
    assert np.max(np.abs(moved) / right.estimate.sigma_theta) < 1e-6
    assert again.sigma_theta == pytest.approx(right.estimate.sigma_theta, rel=1e-9)


def test_a_finding_that_leaves_the_choice_between_two_strips_lists_the_other(told):
    """With two strips, the clock of either explains what is between them: neither is accused."""

    def of_two(dump: Path) -> None:
        for name, column in (("strips.csv", "id"), (POINTS, "strip")):
            write_rows(dump / name, [row for row in rows_of(dump / name) if row[column] != "s03"])
        late(dump, s02=8.0)

    (found,) = [one for one in told(of_two).verdict.findings if one.is_fault]
    assert (found.item, found.rivals[0]) == ("strip s01", "clock of the rows, strip s02")
    assert "; or strip s02" in found.text
    as_written = {"rivals": list(found.rivals)}
    assert fault_cases.leaves_open(as_written, {"s02"}, ["s02", "clock"])
    assert not fault_cases.leaves_open(as_written, {"s03"}, ["s03", "clock"])
    assert not fault_cases.leaves_open({"rivals": None}, {"s02"}, ["s02"])


def test_the_same_points_under_other_ids_count_once(told, right):
    twice = lambda rows: [*rows, *(row | {"id": f"{row['id']}x"} for row in rows)]  # noqa: E731
    again = told(partial(changed_rows, POINTS, twice))
    assert again.estimate.cov_theta.tolist() == right.estimate.cov_theta.tolist()
    assert [one for one in again.verdict.findings if one.is_fault] == []
    assert {"given twice"} <= {entry.reason.value for entry in again.omissions}


def test_a_head_that_moves_between_two_scans_is_no_velocity_of_hundreds_of_kilometres_a_second(with_fault):
    """18 arc-seconds about x of the head, from the second scan on: the orbit's aberration is 5."""

    def moves(dump: Path) -> None:
        turn = Rotation.from_rotvec(np.radians([18.0 / 3600.0, 0.0, 0.0]))
        rows = rows_of(dump / "STR1.csv")
        half = rows[len(rows) // 2]["utc"]
        edited("STR1.csv", lambda row: row["utc"] >= half and faults.turned_by(row, turn), dump)

    try:
        text = str(with_fault("trackers", moves, seed=2).verdict.findings[0])
    except DataNotSufficientError as error:
        text = str(error)
    assert "attitude" in text and "STR1.csv" in text and "velocity" not in text


@pytest.fixture(scope="module")
def one_way(made_once) -> Path:
    """Two scans of the sky in the same direction."""

    def fill(folder: Path) -> None:
        scenario = fault_dumps.scenario_of("scans")
        scans = tuple(replace(one, rate=1.0) for one in scenario.sky_strips.scans)
        scenario = replace(scenario, sky_strips=replace(scenario.sky_strips, scans=scans))
        write_dump(fly(scenario, 1), folder / "sound", created_by="test_causes_told.py")
        (folder / "work").mkdir()

    return made_once("scans-one-way", fill) / "sound"


def test_what_scans_all_one_way_cannot_show_of_the_time_of_a_row_is_told(one_way, tmp_path):
    """Rows of 16 stages, of which the label is the first: each is dated 8 rows wrong."""
    fault_dumps.linked(one_way, tmp_path / "dump")
    stages(16, "start", tmp_path / "dump")
    store = store_of(one_way.parent)
    right, wrong = (calibrate_dump(open_dump(one), store=store) for one in (one_way, tmp_path / "dump"))
    (spot,) = [one for one in blind_spots(wrong.verdict.tests) if "time_of_row" in one.field]
    assert spot.is_unseen and spot.item == "all strips"
    moved = (wrong.estimate.R_cs * right.estimate.R_cs.inv()).as_rotvec()
    late_ms = -8e3 * wrong.sky.tasks[0].strip.row_period_s
    assert np.linalg.norm(moved - late_ms * spot.effect_rad) < 0.05 * np.linalg.norm(moved)  # it is linear
    assert np.max(np.abs(moved) / right.estimate.sigma_theta) > 100.0


def test_a_clock_that_two_scans_share_is_told_before_that_of_one_of_them(with_fault):
    """In scans to and fro, a clock of both by 60 ms turns the matrix as one of a single scan by 120 ms."""
    late = partial(edited, "exposures.csv", lambda row: row.update(utc_mid=later(row["utc_mid"], 0.06)))
    found = with_fault("scans", late, seed=2)
    first = found.verdict.findings[0]
    either = {"clock of the rows, all strips": -60.0, "clock of the exposures, all exposures": 60.0}  # ms
    named = f"{first.cause}, {first.item}"
    assert first.value == pytest.approx(either.pop(named), abs=5.0 * first.sigma)
    assert set(either) <= set(first.rivals)


def test_scans_in_one_direction_say_that_they_cannot_show_a_clock(with_fault):
    """The matrix takes 10 ms up whole: 14 arcsec."""
    found = with_fault("sky", partial(late, sky01=10.0))
    assert found.verdict.outcome is CONSISTENT
    spots = {(one.cause, one.item): one for one in blind_spots(found.verdict.tests)}
    clock = spots[CLOCK, "strip sky01"]
    assert clock.is_unseen and 10.0 * clock.effect_sigma > 50.0


def test_with_two_targets_nothing_can_be_checked(with_fault):
    two = partial(changed_rows, "targets.csv", lambda rows: rows[:2])
    assert with_fault("ground", two).verdict.outcome is Outcome.NOT_CHECKABLE
