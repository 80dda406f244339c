"""Check points: `validate` keeps their errors beside the result, and its report shows them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import ran
from fixture_strips import FIXTURE
from pyproj import Geod
from pytest import approx

from boresight.pipeline.report.check_points import check_points_on_map
from boresight.pipeline.report.saved import read_saved
from boresight.pipeline.results.folder import begin_result


@pytest.fixture(scope="module")
def validated(finished, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("validated")
    shutil.copytree(finished[0], folder / "dump")
    shutil.copytree(FIXTURE / "truth", folder / "dump" / "truth", dirs_exist_ok=True)
    shutil.copytree(finished[1], folder / "result")
    ran("validate", folder / "result", "--dump", folder / "dump")
    return folder / "result"


def test_errors_on_the_map_are_those_along_and_across_the_track(validated):
    content = json.loads((validated / "validation.json").read_text())
    after = {name: np.array(values) for name, values in content["after"].items()}
    track, plane = (np.hypot(after[a], after[b]) for a, b in (("along_m", "across_m"), ("east_m", "north_m")))
    assert track == approx(plane, rel=1e-6)  # one horizontal vector in two pairs of axes
    # Motion is to the south-west or north-west, whatever the axes are called: one rotation for all points.
    turn = np.angle((after["along_m"] - 1j * after["across_m"]) / (after["east_m"] + 1j * after["north_m"]))
    assert np.ptp(np.unwrap(turn)) < np.radians(1.0)  # the direction of flight over 15 km


def test_the_report_shows_each_check_point_at_its_place(validated):
    saved = read_saved(validated)
    after = saved.validation["after"]
    points = check_points_on_map(saved)
    assert len(points) == len(after["strip_id"]) > 10
    scene = saved.context["scenes"][0]
    azimuth, _, metres = Geod(ellps="WGS84").inv(
        scene["lon_deg"], scene["lat_deg"], after["lon_deg"][0], after["lat_deg"][0]
    )
    east, north = metres * np.sin(np.radians(azimuth)), metres * np.cos(np.radians(azimuth))
    assert points[0].place_m == approx((east, north), abs=0.01)  # m
    assert points[0].error_m == approx((after["east_m"][0], after["north_m"][0]))
    page = (validated / "report.html").read_text()
    assert page.count('<g class="check"') == len(points)
    assert f"check point ({len(points)})" in page and points[0].words in page.replace("&#39;", "'")
    along, across = saved.validation["predicted"]
    assert (along["direction"], across["direction"]) == ("along", "across")
    assert along["allowed"] and across["allowed"] and along["points"] == len(points)
    assert "Check points against the prediction, m" in page and page.count("<td>allowed</td>") == 2
    assert "Errors at check points, m" in page and "Against the truth of the simulation" in page


def test_a_new_calibration_removes_them_and_no_report_needs_them(finished, validated, tmp_path):
    assert not (finished[1] / "validation.json").exists()
    assert "Errors at check points" not in (finished[1] / "report.html").read_text()
    shutil.copytree(validated, tmp_path / "result")
    begin_result(tmp_path / "result")
    assert not (tmp_path / "result" / "validation.json").exists()
