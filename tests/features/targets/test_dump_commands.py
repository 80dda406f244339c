"""dump init and dump check: a skeleton that is sound but empty; all errors at once; footprints and misses."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import invoked
from edits import replaced
from recorded_numbers import assert_recorded, flat, numbers_by_line

from boresight.features.targets.dump_check import DumpCheck, TargetCheck, _of_cameras
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import dump_or_faults
from boresight.pipeline.files.dump_schema import DumpFile, InstallationFile, StarCameraFile
from boresight.pipeline.files.remote_camera import read_remote_camera
from boresight.pipeline.files.text_files import read_toml


def run(*arguments: object, given: str | None = None) -> tuple[int, str]:
    done = invoked(*arguments, given=given)
    return done.exit_code, done.output


def files_with_faults(folder: Path) -> set[str]:
    faults = dump_or_faults(folder)
    assert isinstance(faults, tuple)
    return {fault.file for fault in faults}


def test_a_skeleton_lacks_only_what_is_to_be_filled_in(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    options = ("--mission", 'a "b" {c}', "--focal-m", 2.5, "--ccds", 3, "--ccd-px", 1000, "--pixel-um", 8)
    status, text = run("dump", "init", folder, *options)
    assert status == 0 and f"boresight dump check {folder}" in text
    assert read_toml(folder / "dump.toml", DumpFile, "dump.toml").mission == "a 'b' {c}"
    read_toml(folder / "star_camera.toml", StarCameraFile, "star_camera.toml")
    read_toml(folder / "installation.toml", InstallationFile, "installation.toml")
    camera, _ = read_remote_camera(folder, folder / "remote_camera.toml", "remote_camera.toml")
    files = sorted(path.read_text() for path in folder.iterdir() if path.is_file())
    assert_recorded("skeleton", numbers_by_line("".join(files)))
    # The middle of three lines of 8 mm lies on the axis.
    assert [ccd.principal_sample for ccd in camera.ccds] == [499.5, 499.5, 499.5]
    assert camera.directions_from_pixels(1, [499.5])[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert camera.directions_from_pixels(2, [-0.5])[0, 1] == pytest.approx(-4e-3 / 2.5, rel=1e-4)
    assert files_with_faults(folder) == {"orbit.oem", "exposures.csv", "strips.csv", "targets.csv"}
    again = invoked("dump", "init", folder).exception
    assert isinstance(again, RawDataError) and "not empty" in str(again)


def test_skeleton_of_attitudes_and_points_lacks_only_what_is_to_be_filled_in(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    status, _ = run("dump", "init", folder, "--attitudes", "--points")
    assert status == 0
    wanted = "dump.toml installation.toml orbit.oem points.csv remote_camera.toml str1.csv strips.csv"
    assert sorted(path.name for path in folder.iterdir()) == wanted.split()
    head = read_toml(folder / "dump.toml", DumpFile, "dump.toml")
    assert head.star_cameras[0].level == "attitudes" and head.files.points == "points.csv"
    assert files_with_faults(folder) == {"orbit.oem", "points.csv", "str1.csv", "strips.csv"}
    asked = ("dump", "init", tmp_path / "d", "--ask", "--attitudes", "--focal-m", 3)
    status, _ = run(*asked, given="Eos\n" + "\n" * 7)
    assert status == 0 and 'mission = "Eos"' in (tmp_path / "d/dump.toml").read_text()
    assert "focal_length_m = 3.0" in (tmp_path / "d/remote_camera.toml").read_text()


def test_all_errors_of_all_files_are_found_at_once(handmade: Path, tmp_path: Path) -> None:
    for file, before, after in (
        ("star_camera.toml", "bit_depth", "bitdepth"),
        ("star_camera.toml", "= 100.0", "= 0.1"),
        ("installation.toml", "0.003, 0.003, 0.003", "10, 20, 0.1"),
        ("orbit.oem", "GCRF", "GTOD"),
        ("exposures.csv", "2024-11-20T03:40:19", "20/11/2024"),
        ("targets.csv", "ellipsoidal", "msl"),
    ):
        replaced(handmade / file, before, after)
    (handmade / "strips.csv").unlink()
    page = tmp_path / "check.html"
    status, text = run("dump", "check", handmade, "--out", page)
    assert status == 1
    expected = {
        "star_camera.toml: bitdepth": 1,
        "star_camera.toml: focal_length_mm": 1,
        "installation.toml: sigma_rad": 2,
        "orbit.oem: line 9, REF_FRAME": 1,
        "exposures.csv: line": 1,  # two rows each, alike
        "targets.csv: line": 1,
        "strips.csv: file": 1,
    }
    assert {part: text.count(part) for part in expected} == expected
    assert text.count("(and 1 more like it)") == 2
    assert f"{sum(expected.values()) + 2} error(s) in the files" in text
    assert page.read_text().count("<li>") == sum(expected.values())


def test_a_sound_dump_shows_footprints_and_the_nearest_miss_of_every_target(one_strip, tmp_path):
    rows = (one_strip / "targets.csv").read_text().splitlines()
    moved = rows[5].split(",")
    moved[1] = f"{float(moved[1]) + 0.5:.6f}"  # 55 km north
    rows = [*rows[:5], ",".join(moved), *rows[6:]]
    (one_strip / "targets.csv").write_text("\n".join(rows) + "\n")
    page = tmp_path / "check.html"
    status, text = run("dump", "check", one_strip, "--out", page, "--json", "-q")
    assert status == 0, text
    found = json.loads(text)["result"]
    assert found["errors"] == [] and list(found["footprints"]) == ["s01"]
    # 32 um behind 100 mm are 66.0"; 1024 of them 18.6 degrees, a little more by the distortion
    assert "star camera star_camera: 18.62° wide, 66 arcsec a pixel" in found["facts"]
    far, *others = found["targets"]
    assert far["nearest"] == "s01" and far["seen_by"] == [] and far["target_id"] == moved[0]
    assert far["contradiction"].startswith("lat_deg 36.01 for 36.51 (one digit) would lie in its chip")
    # 55.5 km along the meridian, 10 degrees off the track; the strip is 13 km long
    assert 40e3 < far["along_m"] < 56e3 and far["along_s"] == pytest.approx(far["along_m"] / 7e3, rel=0.05)
    assert sum(one["seen_by"] == ["s01"] for one in others) >= 8
    body = page.read_text().partition("<body")[2].replace(str(one_strip), "")
    assert_recorded("dump_check", flat("", found) | numbers_by_line(body))
    assert "<svg" in page.read_text() and not re.search(r"https?://(?!www.w3.org)", page.read_text())
    next((one_strip / "exposures").glob("*.png")).unlink()
    status, text = run("dump", "check", one_strip)
    assert status == 1 and "no such file" in text


def test_of_several_cameras_each_target_is_that_of_the_one_that_sees_it_best() -> None:
    # m, by how far it misses the strips of either camera; 0: in view, None: there is no strip
    off_m = {"a": (0.0, 900.0), "b": (700.0, 0.0), "c": (300.0, 200.0), "d": (None, 5.0), "e": (0.0, 0.0)}
    views = []
    for n, camera in enumerate(("nadir", "aft")):
        targets = tuple(
            TargetCheck(
                target_id=name,
                lon_lat_deg=np.zeros(2),
                seen_by=(camera,) * (m[n] == 0.0),
                nearest=camera if m[n] else "",
                **dict(zip(("across_m", "along_m", "along_s"), np.array([0.6, -0.8, 1e-4]) * (m[n] or 0.0))),
            )
            for name, m in off_m.items()
        )
        facts = {"facts": ("both", camera), "sky_strips": n + 1, "footprints": {camera: np.zeros((4, 2))}}
        views.append(DumpCheck(root="", faults=(), omissions=(), targets=targets, **facts))
    both = _of_cameras(views)
    assert both.facts == ("both", "nadir", "aft") and both.sky_strips == 3 and len(both.footprints) == 2
    assert [(one.target_id, one.seen_by, one.nearest, one.along_m) for one in both.targets] == [
        ("c", (), "aft", -160.0),
        ("d", (), "aft", -4.0),
        ("a", ("nadir",), "", 0.0),
        ("b", ("aft",), "", 0.0),
        ("e", ("nadir", "aft"), "", 0.0),
    ]
