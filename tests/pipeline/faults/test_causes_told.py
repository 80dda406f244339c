"""Faults of inputs and what is reported of them: the cause with its size, its item, its file and field.

Measured points of three strips and two heads: nothing is searched in images, so a calibration is short. Each
fault is another one than those of `faults.py`.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import fault_cases
import fault_dumps
import faults
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.calib.finding import MOST_WORDS
from boresight.calib.reliability import blind_spots
from boresight.calib.verdict import Outcome
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.results.folder import store_of

change, edited, later = faults.change, faults.edited, faults.later
STRIPS = ("s01", "s02", "s03")
NO_ABERRATION = "[light]\naberration = false\n\n"
Make = Callable[[Path], None]


@pytest.fixture(scope="module")
def sound(made_once) -> Path:
    """The dump without a fault."""
    return (
        made_once("measured-points", lambda folder: fault_dumps.sound_dump("points", 1, folder)) / "points-1"
    )


@pytest.fixture(scope="module")
def right(sound: Path) -> DumpCalibration:
    """The calibration of the dump without a fault."""
    return calibrate_dump(open_dump(sound))


@pytest.fixture
def told(sound: Path, tmp_path: Path) -> Iterator[Callable[[Make], DumpCalibration]]:
    """What a calibration of the dump with a fault gives."""

    def calibrated(make: Make) -> DumpCalibration:
        fault_dumps.linked(sound, tmp_path / "dump")
        make(tmp_path / "dump")
        return calibrate_dump(open_dump(tmp_path / "dump"))

    return calibrated


def camera(key: str, ccd: int | None, add: float, dump: Path) -> None:
    faults.toml_number("remote_camera.toml", key, lambda value: value + add, ccd, dump)


def focal_length(dump: Path) -> None:
    faults.toml_number("remote_camera.toml", "focal_length_m", lambda value: value * 1.0004, None, dump)


def one_point(name: str, column: str, new: Callable[[str], str], dump: Path) -> None:
    def edit(row: dict[str, str]) -> None:
        if row["id"] == name:
            row[column] = new(row[column])

    edited("points.csv", edit, dump)


CAUSES = [  # others: `test_faults_of_images.py`
    # fault, cause, item, size (NaN: none is reported), file
    (partial(faults.rows_late, ("s02",), -7e-3), "clock of the rows", "strip s02", -7.0, "strips.csv"),
    (partial(faults.period, ("s01",), 0.0018), "row period", "strip s01", 0.18, "strips.csv"),
    (
        focal_length,
        "focal length of the remote-sensing camera",
        "all CCDs",
        0.04,
        "remote_camera.toml",
    ),  # 212 m of height would explain it, too
    (partial(faults.ground_moved, "points.csv", ("s02",), "north", 80.0), "datum of the targets, north",
        "strip s02", 80.0, "points.csv"),
    (partial(one_point, "s01-t07", "lat_deg", lambda v: f"{float(v) + 2.5e-4:.10f}"), "coordinates",
        "target s01-t07 (strip s01)", 27.8, "points.csv"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "cause", "item", "size", "file"), CAUSES)
def test_a_cause_is_told_first_with_its_size_and_accuses_nothing_else(told, make, cause, item, size, file):
    verdict = told(make).verdict
    first, *others = [one for one in verdict.findings if one.is_fault]
    assert (first.cause, first.item, first.file) == (cause, item, file), first
    assert first.value == pytest.approx(size, abs=max(5.0 * first.sigma, 0.15 * abs(size)))
    assert others == []
    assert verdict.outcome in (Outcome.REFUTED, Outcome.FINDINGS)
    assert len(f"{first.cause} {first.item} {first.text}".split()) <= MOST_WORDS


@pytest.mark.parametrize(("item", "strips"), [("strip s03", "s03"), ("all strips", "s01 s02 s03")])
def test_points_that_scatter_more_than_stated_are_one_finding_about_their_noise(told, item, strips):
    def scattered(dump: Path) -> None:
        rng = np.random.default_rng(11)

        def edit(row: dict[str, str]) -> None:
            for column in ("sample", "line"):
                error = 8.0 * float(row[f"sigma_{column}_px"]) * rng.standard_normal()
                if row["strip"] in strips:
                    row[column] = repr(float(row[column]) + error)

        edited("points.csv", edit, dump)

    (first,) = [one for one in told(scattered).verdict.findings if one.is_fault]
    assert (first.cause, first.item) == ("noise of the image points or coordinates", item)
    assert 3.0 < first.value < 9.0  # times the stated of image, survey and vibration together
    assert first.refutes or item != "all strips"  # then the matrix is less certain than stated


def test_sizes_of_single_points_scatter_by_their_sigma(told, sound):
    """Of 24 points, one of each strip at a time, each 27.8 m off; the rms of 24 normal deviates is 0.7 to 1.4
    in 99 of 100.
    """
    header, *rows = faults.table(sound / "points.csv")
    names = sorted({row[header.index("id")] for row in rows})
    rng, errors = np.random.default_rng(3), []
    of_strips = [rng.permutation([one for one in names if one.startswith(s)]).tolist()[:8] for s in STRIPS]
    for k, trio in enumerate(zip(*of_strips)):

        def off(dump: Path, trio: tuple[str, ...] = trio, off_deg: float = (-1) ** k * 2.5e-4) -> None:
            for name in trio:
                one_point(name, "lat_deg", lambda value: f"{float(value) + off_deg:.10f}", dump)

        found = {one.item.split()[1]: one for one in told(off).verdict.findings if one.is_fault}
        assert set(found) == set(trio)
        errors += [(one.value - 27.8) / one.sigma for one in found.values()]
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_the_sound_dump_has_no_finding_and_names_what_it_cannot_show(right):
    found = right
    assert found.verdict.outcome is Outcome.CONSISTENT
    assert [one for one in found.verdict.findings if one.is_fault] == []
    unseen = {(one.cause, one.item) for one in blind_spots(found.verdict.tests) if one.is_unseen}
    assert {
        ("aberration of the attitudes, annual", "head STR1"),
        ("aberration of the attitudes, orbital", "head STR1"),
        ("clock of the exposures", "head STR1"),
        ("clock of the rows", "all strips"),
        ("light of the targets, aberration", "all targets"),
    } <= unseen


@pytest.mark.parametrize(
    ("make", "cause"),
    [
        (
            lambda dump: change(
                dump / "dump.toml", '"annual and orbital"', '"none"\nline_of_sight = [0.0, 0.0, 1.0]'
            ),
            "aberration of the attitudes, annual",
        ),
        (
            lambda dump: change(
                dump / "dump.toml", r"(?m)^\[errors\]", "[light]\naberration = false\n\n[errors]"
            ),
            "light of the targets, aberration",
        ),
    ],
)
def test_an_error_that_leaves_no_residual_moves_the_matrix_as_its_blind_spot_says(told, right, make, cause):
    wrong = told(make)
    (spot,) = [one for one in blind_spots(wrong.verdict.tests) if one.cause == cause]
    moved = (wrong.estimate.R_cs * right.estimate.R_cs.inv()).as_rotvec()
    size = np.linalg.norm(spot.effect_rad)
    assert spot.is_unseen
    if cause.startswith("light"):  # alone; the label of a head is one effect of two
        assert np.linalg.norm(moved) == pytest.approx(size, rel=0.05)
    assert np.max(np.abs(moved) / right.estimate.sigma_theta) > 4.0


def test_every_second_attitude_dated_early_is_told_before_anything_that_follows_from_it(told):
    def early(dump: Path) -> None:
        header, *rows = faults.table(dump / "STR1.csv")
        at = header.index("utc")
        for row in rows[1::2]:
            row[at] = later(row[at], -0.05)
        faults.write(dump / "STR1.csv", [header, *rows])

    (first, *others) = [one for one in told(early).verdict.findings if one.is_fault]
    assert first.refutes and (first.cause, first.item, first.file) == (
        "times of attitudes",
        "head STR1",
        "STR1.csv",
    )
    assert others == [] and len(f"{first.cause} {first.item} {first.text}".split()) <= MOST_WORDS


def test_attitudes_against_earth_fixed_axes_give_the_same_matrix(told, right, sound):
    """One and the same record in two frames: rounding of quaternions of 15 digits is 1e-9 of a sigma."""
    earth = open_dump(sound).orbit.earth

    def earth_fixed(dump: Path) -> None:
        for head in open_dump(sound).heads:
            header, *rows = faults.table(dump / f"{head.name}.csv")
            R_hi = Rotation.from_quat([[float(v) for v in row[1:]] for row in rows]).inv()
            R_ie = earth.rotations_ie(head.source.rows.t_s)
            q = (R_hi * R_ie).inv().as_quat()
            new = [[row[0], *map(repr, one)] for row, one in zip(rows, q.tolist())]
            faults.write(dump / f"{head.name}.csv", [header, *new])
        change(dump / "dump.toml", 'frame = "GCRF"', 'frame = "ITRF"')

    again = told(earth_fixed).estimate
    moved = (again.R_cs * right.estimate.R_cs.inv()).as_rotvec()
    assert np.max(np.abs(moved) / right.estimate.sigma_theta) < 1e-6
    assert again.sigma_theta == pytest.approx(right.estimate.sigma_theta, rel=1e-9)


def test_trackers_that_are_slower_than_the_margin_are_told_with_the_margin_that_serves(told):
    def thinned(dump: Path) -> None:
        for name in ("STR1.csv", "STR2.csv"):
            header, *rows = faults.table(dump / name)
            faults.write(dump / name, [header, *rows[::14]])

    with pytest.raises(DataNotSufficientError) as refused:
        told(thinned)
    assert re.search(r"with run\.exposure_margin_s = \d+ those around it would", str(refused.value))


def exchanged_heads(dump: Path) -> None:
    faults.paths_exchanged(dump / "STR1.csv", dump / "STR2.csv")


def test_exchanged_heads_are_named_by_what_the_strips_then_see(told):
    (first, *_) = told(exchanged_heads).verdict.findings
    assert first.refutes and (first.cause, first.item) == ("files of two heads", "heads STR1 and STR2")
    assert "exchanged, 3 of 3 strips see" in first.text and "as stated 0" in first.text


def test_a_head_whose_attitudes_are_the_inverse_is_named_and_no_target_beside_it(told):
    verdict = told(partial(edited, "STR2.csv", faults.conjugate)).verdict
    (first,) = [one for one in verdict.findings if one.is_fault]
    assert verdict.outcome is Outcome.REFUTED and first.refutes
    assert (first.cause, first.item, first.file) == ("attitudes of a head", "head STR2", "dump.toml")


def test_exchanged_numbers_of_two_ccds_in_one_strip_are_one_finding_about_both(told):
    other = {"2": "3", "3": "2"}

    def exchanged(row: dict[str, str]) -> None:
        if row["strip"] == "s02":
            row["ccd"] = other.get(row["ccd"], row["ccd"])

    verdict = told(partial(edited, "points.csv", exchanged)).verdict
    (first,) = [one for one in verdict.findings if one.is_fault]
    assert first.item == "CCD 2 and CCD 3 in strip s02"
    assert (first.file, first.field) == ("points.csv", "ccd") and "exchanged" in first.text


def test_a_point_beyond_the_horizon_is_named_with_the_slip_that_fits(told):
    found = told(partial(one_point, "s03-t02", "lon_deg", lambda value: f"-{value}"))
    (first,) = [one for one in found.verdict.findings if one.is_fault]
    assert first.item == "target s03-t02" and first.file == "points.csv"
    assert "beyond the horizon" in first.text and "(sign) would fit" in first.text


def test_a_point_with_the_number_of_another_ccd_is_named_with_the_one_it_fits(told):
    found = told(partial(one_point, "s03-t02", "ccd", lambda value: str((int(value) + 1) % 4)))
    (first,) = [one for one in found.verdict.findings if one.is_fault]
    assert first.item == "target s03-t02 (strip s03)" and first.file == "points.csv"
    assert re.search(r"it fits in CCD (\d), not (?!\1)\d: files or numbers of CCDs are exchanged", first.text)


def test_a_point_that_is_seen_too_low_for_refraction_is_named(told):
    found = told(partial(one_point, "s02-t04", "lat_deg", lambda value: f"{float(value) + 17.0:.9f}"))
    (first,) = [one for one in found.verdict.findings if one.is_fault]
    assert first.item == "target s02-t04" and first.file == "points.csv"
    assert "its refraction is not known" in first.text


def test_offsets_of_all_ccds_that_are_zero_are_told_by_ccd_where_no_matrix_is_determined(told):
    def zero(dump: Path) -> None:
        faults.toml_number("remote_camera.toml", "x_offset_mm", lambda value: 0.0, None, dump)

    with pytest.raises(DataNotSufficientError, match=r"^place of a CCD, along the track, CCD \d:.*x_offset"):
        told(zero)


def test_a_finding_that_leaves_the_choice_between_two_strips_lists_the_other(told):
    """With two strips, the clock of either explains what is between them: neither is accused."""

    def of_two(dump: Path) -> None:
        for name, column in (("strips.csv", "id"), ("points.csv", "strip")):
            header, *rows = faults.table(dump / name)
            at = header.index(column)
            faults.write(dump / name, [header, *(row for row in rows if row[at] != "s03")])
        faults.rows_late(("s02",), 8e-3, dump)

    (found,) = [one for one in told(of_two).verdict.findings if one.is_fault]
    assert (found.item, found.rivals[0]) == ("strip s01", "clock of the rows, strip s02")
    assert "; or strip s02" in found.text
    as_written = {"rivals": list(found.rivals)}
    assert fault_cases.leaves_open(as_written, {"s02"}, ["s02", "clock"])
    assert not fault_cases.leaves_open(as_written, {"s03"}, ["s03", "clock"])
    assert not fault_cases.leaves_open({"rivals": None}, {"s02"}, ["s02"])


def test_an_orbit_that_contradicts_all_heads_alike_is_named_and_no_head(told):
    """As no mistake of the attitudes explains it: each head by itself would be accused."""

    def mirrored(dump: Path) -> None:
        def edit(t_s: np.ndarray, p: np.ndarray, v: np.ndarray) -> None:
            p[:, 2] *= -1.0
            v[:, 2] *= -1.0

        faults.states(edit, dump)

    with pytest.raises(RawDataError) as raised:
        told(mirrored)
    assert raised.value.file == "orbit.oem" and "STR" not in str(raised.value)


def test_the_same_points_under_other_ids_count_once(told, right):
    def twice(dump: Path) -> None:
        header, *rows = faults.table(dump / "points.csv")
        faults.write(dump / "points.csv", [header, *rows, *([f"{row[0]}x", *row[1:]] for row in rows)])

    again = told(twice)
    assert again.estimate.cov_theta.tolist() == right.estimate.cov_theta.tolist()
    assert [one for one in again.verdict.findings if one.is_fault] == []
    assert {"given twice"} <= {entry.reason.value for entry in again.omissions}


def test_numbers_of_two_ccds_exchanged_in_all_strips_are_one_finding_about_both(told):
    other = {"1": "2", "2": "1"}
    make = partial(edited, "points.csv", lambda row: row.update(ccd=other.get(row["ccd"], row["ccd"])))
    (first, *more) = [one for one in told(make).verdict.findings if one.is_fault]
    assert (first.item, more) == ("CCD 1 and CCD 2", []) and "ccd in points.csv exchanged" in first.text


def strips_exchanged(dump: Path) -> None:
    ids = [row[0] for row in faults.table(dump / "strips.csv")[1:]]
    places = ([n for n, one in enumerate(ids) if one == strip] for strip in ("s01", "s02"))
    faults.files_exchanged("strips.csv", zip(*places), dump)


def no_aberration(dump: Path) -> None:
    change(dump / "dump.toml", r"(?m)^\[errors\]", f"{NO_ABERRATION}[errors]")


@pytest.mark.parametrize(
    ("make", "cause", "words"),
    [
        (
            partial(faults.earth_turned, -faults.REVOLUTION_S),
            "orbit, times or coordinates",
            "none of 24 comes into view",
        ),
        (strips_exchanged, "files of two strips", "as stated none"),
        (no_aberration, "orbit, or datum of the targets", "or light.aberration in dump.toml"),
    ],
)
def test_a_cause_on_the_ground_is_told_first_beside_strips_of_the_sky(with_fault, make, cause, words):
    first = with_fault("mixed", make).verdict.findings[0]
    assert first.cause == cause and words in first.text, first
    assert len(f"{first.cause} {first.item} {first.text}".split()) <= MOST_WORDS


def painted(strip: str, level: int, dump: Path) -> None:
    for image in (dump / "strips").glob(f"{strip}_*.tif"):
        faults.repaint(image, lambda pixels: np.full_like(pixels, level))


@pytest.mark.parametrize(
    ("name", "strip", "level"),
    [("ground", "s02", 17), ("scans", "sky01", 255)],  # one grey value, saturated
)
def test_a_strip_that_gives_nothing_is_a_finding_with_its_reason(with_fault, name, strip, level):
    found = with_fault(name, partial(painted, strip, level)).verdict
    (told,) = [one for one in found.findings if one.is_fault]
    assert found.outcome is Outcome.FINDINGS and told.item == f"strip {strip}"
    assert "grey" in told.text and (level < 255 or "saturated" in told.text)


def test_where_no_strip_gives_anything_the_reason_comes_first(with_fault):
    with pytest.raises(DataNotSufficientError, match=r"^no strip can be used: strip sky01: grey level 255"):
        with_fault("sky", partial(painted, "sky01", 255))


def test_chips_that_all_lie_off_alike_are_told_with_the_common_shift(with_fault):
    def shifted(dump: Path) -> None:
        for chip in (dump / "chips").glob("*.tif"):
            faults.repaint(chip, lambda image: image, -350.0)

    with pytest.raises(DataNotSufficientError, match=r"36 of 36 targets: they lie 350 m east of the middle"):
        with_fault("ground", shifted)


def test_a_head_that_moves_between_two_scans_is_no_velocity_of_hundreds_of_kilometres_a_second(with_fault):
    """18 arc-seconds about x of the head, from the second scan on: the orbit's aberration is 5."""

    def moves(dump: Path) -> None:
        turn = Rotation.from_rotvec(np.radians([18.0 / 3600.0, 0.0, 0.0]))
        header, *rows = faults.table(dump / "STR1.csv")
        half = rows[len(rows) // 2][header.index("utc")]

        def edit(row: dict[str, str]) -> None:
            if row["utc"] >= half:
                q = Rotation.from_quat([float(row[key]) for key in ("qx", "qy", "qz", "qw")]) * turn
                row.update(zip(("qx", "qy", "qz", "qw"), map(repr, q.as_quat().tolist())))

        edited("STR1.csv", edit, dump)

    try:
        text = str(with_fault("trackers", moves).verdict.findings[0])
    except DataNotSufficientError as error:
        text = str(error)
    assert "attitude" in text and "STR1.csv" in text and "velocity" not in text


@pytest.mark.parametrize(("ccd", "mrad"), [(1, 7.0), (3, 55.0)])
def test_a_ccd_that_is_rotated_in_a_single_scan_is_told_with_its_angle(with_fault, ccd, mrad):
    """At 55 mrad its stars are not where a right matrix allows: they are looked for on the same CCD."""
    first = with_fault("sky", partial(camera, "rotation_mrad", ccd, mrad)).verdict.findings[0]
    assert (first.cause, first.item) == ("rotation of a CCD", f"CCD {ccd}")
    assert first.value == pytest.approx(mrad, abs=4.0 * first.sigma)


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
    change(tmp_path / "dump" / "remote_camera.toml", "tdi_stages = 1\n", "tdi_stages = 16\n")
    change(tmp_path / "dump" / "remote_camera.toml", 'time_of_row = "middle"', 'time_of_row = "start"')
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


def test_half_of_a_ccd_without_light_is_told(with_fault):
    """Its other half shows all its stars: neither the CCD nor a strip is lost."""

    def dark(image: np.ndarray) -> np.ndarray:
        half = image.copy()
        half[:, : half.shape[1] // 2] = np.median(image)
        return half

    def of_both(dump: Path) -> None:
        for strip in ("sky01", "sky02"):
            faults.repaint(dump / "strips" / f"{strip}_ccd1.tif", dark)

    (told,) = [one for one in with_fault("scans", of_both, seed=2).verdict.findings if one.is_fault]
    assert (told.cause, told.item) == ("lost part of a CCD", "first half of CCD 1")
    assert len(f"{told.cause} {told.item} {told.text}".split()) <= MOST_WORDS


def test_a_scan_whose_background_hides_faint_stars_is_told(with_fault):
    """Noise of some six times the detector's in one of two scans."""
    rng = np.random.default_rng(5)

    def noisy(image: np.ndarray) -> np.ndarray:
        return (image + rng.normal(0.0, 18.0, image.shape)).clip(0, 65535).round().astype(image.dtype)

    def of_one(dump: Path) -> None:
        for ccd in range(4):
            faults.repaint(dump / "strips" / f"sky02_ccd{ccd}.tif", noisy)

    (told,) = [one for one in with_fault("scans", of_one, seed=2).verdict.findings if one.is_fault]
    assert told.cause == "lost faint stars" and told.item.startswith("strip sky02, fainter than V")
    assert len(f"{told.cause} {told.item} {told.text}".split()) <= MOST_WORDS and not told.refutes


@pytest.mark.parametrize(("stages", "label", "refutes"), [(4, "start", True), (128, "middle", False)])
def test_stages_that_would_smear_a_scan_against_the_charge_are_told(with_fault, stages, label, refutes):
    """The images have one stage; a label at the start of four would date rows two periods wrong."""

    def stated(dump: Path) -> None:
        change(dump / "remote_camera.toml", "tdi_stages = 1\n", f"tdi_stages = {stages}\n")
        change(dump / "remote_camera.toml", 'time_of_row = "middle"', f'time_of_row = "{label}"')

    (told,) = [one for one in with_fault("scans", stated, seed=2).verdict.findings if one.is_fault]
    assert (told.cause, told.item, told.refutes) == ("TDI stages", "strip sky02", refutes)
    assert f"{stages} stages" in told.text and "check tdi_stages and time_of_row" in told.text
    assert len(f"{told.cause} {told.item} {told.text}".split()) <= MOST_WORDS
