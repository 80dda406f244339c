"""Every complaint names the file, the field, what was found and what was expected."""

import re
from pathlib import Path

import numpy as np
import pytest
from edits import replaced
from handmade import write_handmade_dump, write_strip
from wrong_dumps import OTHERWISE, WRONG

from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.remote_camera import read_remote_camera


def assert_file_and_field_named(dump: Path, file: str, field: str, says: str) -> None:
    with pytest.raises(RawDataError) as caught:
        open_dump(dump)
    error = caught.value
    assert (error.file, error.field) == (file, field), str(error)
    assert re.search(says, str(error)) and str(error).isprintable(), str(error)
    assert [part for part in (file, field, error.found, error.expected) if part not in str(error)] == []


@pytest.mark.parametrize(("file", "old", "new", "field", "says"), WRONG)
def test_wrong_text_is_named_with_field_found_and_expected(file, old, new, field, says, handmade):
    replaced(handmade / file, old, new, 1)
    assert_file_and_field_named(handmade, file, field, says)


@pytest.mark.parametrize("name", OTHERWISE)
def test_wrong_file_is_named_with_field_found_and_expected(name: str, handmade: Path) -> None:
    damage, *told = OTHERWISE[name]
    damage(handmade)
    assert_file_and_field_named(handmade, *told)


def test_orthometric_height_of_a_target_is_raised_by_the_geoid(handmade: Path) -> None:
    # Test point of NGA's EGM96 program F477: the geoid lies 43.575 m below the ellipsoid (its grid: 0.3 m).
    there = "t0,46.8743190,102.4487290,100,egm96"
    replaced(handmade / "targets.csv", "t0,0.00,103.0,100,ellipsoidal", there)
    _, _, height = geodetic_from_ecef(open_dump(handmade).targets[0].p_e, WGS84)
    assert height == pytest.approx(100.0 - 43.575, abs=0.3)


def test_hand_written_dump_is_read_without_complaint(handmade: Path) -> None:
    dump = open_dump(handmade)
    assert (len(dump.exposures), len(dump.strips), len(dump.targets), dump.omissions) == (4, 1, 2, ())
    # 19.6 s after the first state, which is the epoch; decimal seconds are exact to 1e-12 s.
    assert dump.exposures[0].t_s == pytest.approx(19.6, abs=1e-12)


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        (lambda values: 0.0 * values, "velocities are zero"),
        (lambda values: -values, "velocities are reversed"),
        (lambda values: 5.0 * values, r"multiplied by a factor: 5 \(units\?\)"),
        (lambda values: values[[1, 2, 0]], "not the rate of change"),
    ],
)
def test_orbit_that_contradicts_itself_is_refused_with_its_cause(wrong, cause, handmade):
    lines = (handmade / "orbit.oem").read_text().splitlines()
    first = lines.index("META_STOP") + 1
    for n in range(first, len(lines)):
        if words := lines[n].split():
            numbers = wrong(np.array(words[4:7], dtype=float))
            lines[n] = " ".join([*words[:4], *(f"{value:.12f}" for value in numbers)])
    (handmade / "orbit.oem").write_text("\n".join(lines) + "\n")
    with pytest.raises(RawDataError, match=cause) as caught:
        open_dump(handmade)
    assert caught.value.file == "orbit.oem"


@pytest.mark.parametrize(("day", "where"), [("1971-11-20", "1972"), ("2031-11-20", "2027|2026")])
def test_date_outside_the_earth_orientation_table_names_its_limit(tmp_path, day, where):
    with pytest.raises(RawDataError) as caught:
        open_dump(write_handmade_dump(tmp_path / "dump", day))
    assert caught.value.file == "orbit.oem"
    assert re.search(where, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda root: (root / "strips/0.tif").unlink(), "file: found no such file"),
        (lambda root: write_strip(root / "strips/0.tif", np.ones((100, 64), np.uint8)),
            "size: found 64 x 100 px, expected 64 x 200 px"),
    ],
)  # fmt: skip
def test_bad_strip_image_is_left_out_with_its_reason_and_the_rest_goes_on(damage, reason, handmade):
    damage(handmade)
    dump = open_dump(handmade)
    (omission,) = dump.omissions
    assert (omission.subject.kind, omission.subject.name, omission.file) == ("ccd", "s1/0", "strips/0.tif")
    assert re.search(reason, omission.text), omission.text
    assert dump.strips[0].images.ccds == (1,)


def test_strip_without_any_readable_image_is_left_out_as_a_whole(handmade: Path) -> None:
    for ccd in range(2):
        (handmade / f"strips/{ccd}.tif").unlink()
    dump = open_dump(handmade)
    assert dump.strips == ()
    told = [(o.subject.kind, o.subject.name) for o in dump.omissions]
    assert told == [("ccd", "s1/0"), ("ccd", "s1/1"), ("strip", "s1")]


@pytest.mark.parametrize(
    ("tan_y", "says"),
    [
        ((-0.004, -0.002, 0.0, 0.002, 0.004), ""),
        ((-0.004, 0.003, 0.0, 0.002, 0.004), "tan_y must be strictly monotone"),
        ((-0.004, -0.00399, 0.0039, 0.00395, 0.004), "reverses the order of the samples"),  # between its rows
    ],
)
def test_looks_that_run_to_and_fro_are_refused_with_their_file(tan_y, says: str, tmp_path: Path) -> None:
    path, head = tmp_path / "camera.toml", 'model = "look tables"\nlooks = "l.csv"\ndirections = "tangents"\n'
    path.write_text(f"{head}[[ccds]]\nn_px = 17\n")
    rows = [f"0,{4 * n},0.001,{y}" for n, y in enumerate(tan_y)]
    (tmp_path / "l.csv").write_text("\n".join(["ccd,sample,x,y", *rows]) + "\n")
    if not says:
        assert read_remote_camera(tmp_path, path, "camera.toml")[0].n_px(0) == 17
        return
    with pytest.raises(RawDataError, match=rf"l\.csv: .*{says}"):
        read_remote_camera(tmp_path, path, "camera.toml")
