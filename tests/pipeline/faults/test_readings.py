"""Tables that mean something else than they say: read as meant, they are those of the sound dump again, and a
calibration that has no matrix names the reading.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import fault_dumps
import faults
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.calib.verdict import Outcome
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.diagnosis.missing import _agreeing_strips
from boresight.pipeline.diagnosis.readings import Reading, best_reading, readings_of_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.files.text_files import toml_tables
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.stages.head import Basis, sight_head

GPS_MINUS_UTC_S, TAI_MINUS_UTC_S = 18.0, 37.0  # since 2017, IERS Bulletin C 52
LAST_LINE, LAST_SAMPLE, LAST_CCD = 1999, 511, 3  # of the CCDs of the dump, from 0
Row = dict[str, str]


def late(seconds: float, row: Row) -> None:
    row["utc_first_row"] = faults.later(row["utc_first_row"], seconds)


def from_the_other_end(column: str, last: int, row: Row) -> None:
    row[column] = repr(last - float(row[column]))


def exchanged(one: str, other: str, row: Row) -> None:
    row[one], row[other] = row[other], row[one]


def negative(column: str, row: Row) -> None:
    row[column] = repr(-float(row[column]))


def other_strip(row: Row) -> None:
    row["strip"] = {"s01": "s03", "s03": "s01"}.get(row["strip"], row["strip"])


def from_the_other_ccd(row: Row) -> None:
    row["ccd"] = str(LAST_CCD - int(row["ccd"]))


def geocentric(row: Row) -> None:
    """The angle of the direction from the centre of the Earth to the ellipsoid, for a latitude."""
    lat = np.radians(float(row["lat_deg"]))
    a, b = 6_378_137.0, 6_356_752.314245  # m, WGS84
    normal = a**2 / np.hypot(a * np.cos(lat), b * np.sin(lat))
    x, z = normal * np.cos(lat), normal * (b / a) ** 2 * np.sin(lat)
    row["lat_deg"] = repr(float(np.degrees(np.arctan2(z, x))))


READINGS: list[tuple[str, Callable[[Row], None], str, str]] = [
    ("strips.csv", partial(late, GPS_MINUS_UTC_S), "scale of times", "GPS (-18 s)"),
    ("strips.csv", partial(late, TAI_MINUS_UTC_S), "scale of times", "TAI (-37 s)"),
    ("points.csv", partial(from_the_other_end, "line", LAST_LINE), "origin of the lines", "the last"),
    ("points.csv", partial(from_the_other_end, "sample", LAST_SAMPLE), "origin of the samples", "other end"),
    ("points.csv", partial(negative, "lat_deg"), "sign of the latitudes", "sign"),
    ("points.csv", partial(negative, "lon_deg"), "sign of the longitudes", "sign"),
    ("points.csv", other_strip, "points of two strips", "exchanged"),
    ("points.csv", from_the_other_ccd, "order of the CCDs", "the other end"),
    ("points.csv", geocentric, "kind of latitude", "geocentric"),
]


def numbers(dump: Dump) -> np.ndarray:
    """All that a reading changes: rotations of the heads, times of the strips and of the orbit, and every
    measurement with its CCD, image point (px) and place on the ground (m), in the order of strips, points and
    CCDs.
    """
    rotations = [head.R_cs0 for head in dump.heads]
    for head in dump.heads:
        rotations += [*head.source.rows.R_si] if isinstance(head.source, SolvedAttitudes) else []
    times = [dump.orbit.t_s[0], *(strip.t_first_row_s for strip in dump.strips)]
    of_points = [
        (one.strip_id, target.target_id, ccd, *xy_px, *target.p_e)
        for one in dump.points
        for target, ccd, xy_px in zip(one.targets, one.ccd.tolist(), one.xy_px.tolist())
    ]
    places = np.array([row[2:] for row in sorted(of_points, key=lambda row: row[:3])])
    return np.concatenate([times, *(R.as_matrix().ravel() for R in rotations), places.ravel()])


def alike(one: Dump, other: Dump) -> bool:
    """To the digits of the tables: 1 um on the ground, 1 us, 1e-6 px, and 1e-9 of a rotation."""
    a, b = numbers(one), numbers(other)
    return a.shape == b.shape and np.allclose(a, b, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(("file", "change", "cause", "words"), READINGS)
def test_one_reading_alone_makes_the_sound_dump(sound, tmp_path, file, change, cause, words):
    fault_dumps.linked(sound, tmp_path / "dump")
    faults.edited(file, change, tmp_path / "dump")
    meant, found = open_dump(sound), open_dump(tmp_path / "dump")
    (right,) = [one for one in readings_of_dump(found) if alike(one.apply(found), meant)]
    assert (right.cause, right.file) == (cause, file)
    assert words in right.changed


@pytest.fixture(scope="module")
def narrow(sound) -> Basis:
    """The dump with few points of two strips, and mountings as they truly are within 0.3 mrad: 25 px."""
    dump = open_dump(sound)
    truth = Rotation.from_quat(toml_tables(sound / "truth" / "installation.toml", "")["quaternion_cs"])
    turn = truth * dump.R_cs0.inv()
    heads = tuple(
        replace(one, R_cs0=turn * one.R_cs0, sigma_installation_rad=0.1 * one.sigma_installation_rad)
        for one in dump.heads
    )
    of_one_ccd = tuple(one.of([0]) for one in dump.points[:2])
    dump = replace(dump, heads=heads, strips=dump.strips[:2], points=of_one_ccd)
    settings, runner = Settings(), StageRunner(None, InOrder())
    errors = calibration_settings(settings, dump.errors, dump.line_camera)
    heads = tuple(sight_head(dump, head, settings, runner) for head in dump.heads)
    return Basis(dump, heads, settings, errors, runner, surface_of(dump.terrain))


def nearer(one: object, meant: object, now: object, name: str) -> object:
    """A record, of which one field moves as it has to for what is now made of it to be what is meant."""
    return replace(one, **{name: getattr(one, name) + getattr(meant, name) - getattr(now, name)})


def misread(reading: Reading[Dump], dump: Dump) -> Dump:
    """What a reading makes `dump` of, found by the reading itself: it is its own inverse, or returns after
    four times, or moves times and places almost alike wherever they are.
    """
    wrong = dump
    for _ in range(3):
        wrong = reading.apply(wrong)
        if alike(reading.apply(wrong), dump):
            return wrong
    wrong = dump
    for _ in range(5):
        made = reading.apply(wrong)
        orbit = nearer(wrong.orbit, dump.orbit, made.orbit, "t_s")
        earth = replace(wrong.orbit.earth, t_start_s=orbit.t_s[0], t_stop_s=orbit.t_s[-1])
        strips = zip(wrong.strips, dump.strips, made.strips)
        points = []
        for one, *others in zip(wrong.points, dump.points, made.points):
            targets = zip(one.targets, *(other.targets for other in others))
            points.append(replace(one, targets=tuple(nearer(*three, "p_e") for three in targets)))
        wrong = replace(
            wrong,
            orbit=replace(orbit, earth=earth),
            strips=tuple(nearer(*three, "t_first_row_s") for three in strips),
            points=tuple(points),
        )
    assert alike(reading.apply(wrong), dump), reading
    return wrong


def test_every_row_of_the_table_names_first_the_mistake_that_it_puts_right(narrow):
    """Each makes its own mistake in the sound dump. What the second head states no strip rests on."""
    dump = narrow.dump
    assert _agreeing_strips(narrow, dump) == 2
    for reading in readings_of_dump(dump):
        wrong = misread(reading, dump)
        agrees = lambda read: int(alike(read, dump))  # noqa: E731
        named, strips = best_reading(wrong, readings_of_dump(wrong), agrees, fewest=1, enough=1)
        assert (named.cause, named.changed) == (reading.cause, reading.changed)
        assert set(named.subjects) == set(reading.subjects)
        assert strips == 1 and (named.file, named.field) == (reading.file, reading.field)
        seen = _agreeing_strips(narrow, wrong)
        assert seen == (2 if reading.item == "head STR2" else 0), reading


def test_two_points_that_are_seen_by_chance_judge_no_reading(narrow):
    """Of each strip one: two in all, where three are needed."""
    one_each = tuple(one.take(np.arange(len(one.ccd)) == 0) for one in narrow.dump.points)
    assert _agreeing_strips(narrow, replace(narrow.dump, points=one_each)) == 0


def test_an_orbit_dated_in_another_time_system_than_stated_is_named(sound, tmp_path):
    fault_dumps.linked(sound, tmp_path / "dump")
    faults.change(tmp_path / "dump" / "orbit.oem", r"(?m)^TIME_SYSTEM = .*$", "TIME_SYSTEM = GPS")
    with pytest.raises(DataNotSufficientError, match=r"^time system of the orbit, .* dated in UTC .*3 of 3"):
        calibrate_dump(open_dump(tmp_path / "dump"))


@pytest.mark.parametrize("number", [0, 8])
def test_a_calibration_without_a_matrix_names_the_reading(sound, tmp_path, number):
    """Not those within the pre-launch uncertainty: 0.003 rad are 250 px of an image of 512 x 2000 px. A
    matrix from three points that happen to agree is refuted by it.
    """
    file, change, cause, _ = READINGS[number]
    fault_dumps.linked(sound, tmp_path / "dump")
    faults.edited(file, change, tmp_path / "dump")
    try:
        found = calibrate_dump(open_dump(tmp_path / "dump"))
    except DataNotSufficientError as error:
        told = str(error)
    else:
        first = found.verdict.findings[0]
        assert found.verdict.outcome is Outcome.REFUTED and found.estimate.n_targets < 6
        assert len([one for one in found.verdict.findings if one.is_fault]) == 1
        told = f"{first.cause}, {first.item}: {first.text}"
    assert re.match(f"{cause}, .*3 of 3 strips see .* in {file}", told)
