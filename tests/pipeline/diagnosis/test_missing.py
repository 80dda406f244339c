"""Dumps without a result: the cause comes first, with numbers and what to check."""

import re
from pathlib import Path

import cv2
import pytest
from command_line import ran
from edits import rows_of, write_rows

from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump


def reason(dump: Path) -> str:
    with pytest.raises(DataNotSufficientError) as told:
        calibrate_dump(open_dump(dump))
    return str(told.value)


def test_mirrored_images_are_recognised(one_strip: Path) -> None:
    for path in (one_strip / "exposures").iterdir():
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        path.unlink()  # it is a link to the fixture
        cv2.imwrite(str(path), image[:, ::-1])
    told = reason(one_strip)
    assert told.startswith("none of 14 exposures can be used (14 not identified)")
    assert "the images are mirrored" in told


def test_wrong_focal_length_is_among_the_hints(one_strip: Path) -> None:
    camera = (one_strip / "star_camera.toml").read_text()
    focal = next(line for line in camera.splitlines() if line.startswith("focal_length"))
    (one_strip / "star_camera.toml").write_text(
        camera.replace(focal, f"{focal.split('=')[0]}= {1.3 * float(focal.split('=')[1])}")
    )
    told = reason(one_strip)
    assert told.startswith("none of 14 exposures can be used (14 not identified)")
    assert "measures the focal length" in told and "mirrored left" not in told


def test_centroids_far_worse_than_stated_are_named_by_file_and_field(one_strip, tmp_path, monkeypatch):
    monkeypatch.chdir(one_strip)
    images = [f"exposures/{path.name}" for path in Path("exposures").iterdir()]
    ran("centroids", *images, "--out", "centroids.csv")
    rows = rows_of(Path("centroids.csv"))
    for row in rows:
        for key, factor in (("sigma_x_px", 1e-3), ("sigma_y_px", 1e-3), ("cov_xy_px2", 1e-6)):
            row[key] = repr(float(row[key]) * factor)
    write_rows(Path("centroids.csv"), rows)
    text = re.sub(r"(?m)^(star_camera|installation|exposures) = .*\n", "", Path("dump.toml").read_text())
    head = '[[star_cameras]]\nname = "STR"\nlevel = "centroids"\ninstallation = "installation.toml"\n'
    keys = 'camera = "star_camera.toml"\nexposures = "exposures.csv"\ncentroids = "centroids.csv"\n'
    Path("dump.toml").write_text(f"{text}\n{head}{keys}")
    told = str(ran("calibrate", ".", "--out", tmp_path / "result", status=1).exception)
    assert told.startswith("none of 14 exposures has an attitude: ")
    assert "check sigma_x_px, sigma_y_px and cov_xy_px2 of centroids.csv" in told
    assert "14 star exposures, 1 strips" in (tmp_path / "result" / "report.html").read_text()


def test_targets_that_a_strip_misses_are_told_by_distance_and_time(one_strip: Path) -> None:
    lines = (one_strip / "targets.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines]
    column = rows[0].index("lon_deg")
    for row in rows[1:]:
        row[column] = str(float(row[column]) + 1.0)
    (one_strip / "targets.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    told = reason(one_strip)
    assert told.startswith("common shift of coordinates or chips, 12 of 12 targets: they lie 9.02e+04 m east")
    assert "Otherwise: no target comes into view: the nearest, " in told
    assert "km across the track and " in told and "14 exposures identified" in told
