"""`dimap` against an operator's location grid, and `virtual-ccd` against the raw images."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from command_line import invoked, ran
from drawn_pictures import kept_figures, shows_curves
from four_ccds import map_difference_px
from recorded_numbers import assert_recorded, flat

from boresight.features.exports.virtual_ccd import VirtualStrip
from boresight.features.interior import interior_files, remote_camera_calibrate_command
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.report.panels import OURS
from boresight.pipeline.results.strip_model import open_calibrated, strip_model

REAL = Path(__file__).parents[3] / ".." / "shared" / "data" / "pleiades"
DIMAP = REAL / "PHRDIMAP_P1BP--2018122638935449CP.XML"
GRID = REAL / "GRID_P1BP--2018122638935449CP.tif"
needs_real_data = pytest.mark.skipif(not GRID.exists(), reason=f"no real Pleiades metadata: {REAL}")


@needs_real_data
def test_dimap_agrees_with_the_operator_s_grid():
    *altitudes, verdict = ran("dimap", DIMAP, "--grid", GRID).stdout.splitlines()
    rms = [float(line.split("rms")[1].split()[0]) for line in altitudes]
    assert len(rms) == 9 and max(rms) < 1e-3  # m; the metadata round positions to 1 mm
    assert verdict.startswith("the model agrees with the grid")
    strict = ran("dimap", DIMAP, "--grid", GRID, "--limit-m", 1e-5, status=4)
    assert "does not agree" in strict.stdout


@needs_real_data
def test_dimap_gives_places_and_refuses_pixels_outside_the_image(tmp_path):
    pixels = tmp_path / "pixels.csv"
    pixels.write_text("ccd,sample,line\n0,10,20\n")
    told = invoked("dimap", DIMAP, "--pixels", pixels, "--height-m", 100)
    latitude, longitude, height = (float(cell) for cell in told.stdout.splitlines()[1].split(",")[3:])
    assert 31.0 < latitude < 31.3 and 2.0 < longitude < 2.3 and height == 100.0  # Ouargla, the name's E002N31
    pixels.write_text("ccd,sample,line\n0,10,20\n0,40000,20\n")
    told = invoked("dimap", DIMAP, "--pixels", pixels)
    assert told.exit_code != 0 and "line 3" in str(told.exception or told.output)


def test_the_virtual_strip_shows_what_the_raw_images_show(finished, tmp_path):
    dump, result = finished
    calibrated = open_calibrated(result, dump)
    model = strip_model(calibrated, calibrated.dump.strips[0].strip_id)
    out = tmp_path / "strip.tif"
    ran("virtual-ccd", result, "--strip", model.strip.strip_id, "--dump", dump, "--out", out)
    with rasterio.open(out) as image:
        stitched, (places, crs) = image.read(1), image.gcps
    smooth = -0.5, model.strip.lines - 0.5
    virtual = VirtualStrip(model.pushbroom, surface_of(calibrated.dump.terrain), smooth_rows=smooth)
    assert crs.to_epsg() == 4979 and len(places) > 100
    for place in places[:: len(places) // 4]:
        pixel = np.array([place.col - 0.5]), np.array([place.row - 0.5])  # GDAL counts from the corner
        expected = virtual.virtual.ground_points(0, *pixel, virtual.surface)[0]
        lat, lon = np.radians([place.y]), np.radians([place.x])
        off = ecef_from_geodetic(lat, lon, np.array([place.z]), WGS84)[0] - expected
        assert np.linalg.norm(off) < 1e-6  # m
    grid = [[place.col, place.row, place.x, place.y, place.z] for place in places]
    assert_recorded("virtual_ccd", {"image": stitched, "places": grid})
    assert stitched.shape == (model.strip.lines, virtual.width_px)
    assert np.isnan(stitched).mean() < 0.1  # lines at both ends that staggered CCDs did not see
    middle = model.strip.lines // 2
    for ccd, begin, end in virtual.seams(middle):
        sample = np.round(0.5 * (begin + end)) + np.arange(-20.0, 21.0)
        column, row = virtual.source_pixels(ccd, sample, np.full(41, float(middle)))
        raw = model.strip.images.read(ccd, 0, model.strip.lines, 0, model.strip.images.shape(ccd)[1])
        nearest = raw[np.round(row).astype(int), np.round(column).astype(int)]
        ours = stitched[middle, sample.astype(int)]
        assert np.corrcoef(ours, nearest)[0, 1] > 0.8  # the nearest pixel is up to half a pixel off


def test_the_remote_cameras_interior_is_calibrated_from_a_result(finished, tmp_path):
    dump, result = finished
    result = shutil.copytree(result, tmp_path / "result")
    out = result / "interior"
    with kept_figures(interior_files) as figures:
        ran("remote-camera-calibrate", result, "--out", out, "--curve-length-px", 400, "--json")
    content = json.loads((out / "interior.json").read_text())
    assert_recorded("interior", flat("", content))
    parameters = {one["name"]: one for one in content["parameters"]}
    assert abs(parameters["focal"]["value"]) < 4.0 * parameters["focal"]["sigma"]  # nothing is wrong with it
    assert any("installation matrix" in one["not_told_from"] for one in content["gauge"])
    assert shows_curves(out / "interior.png", OURS)
    ran("report", result)
    page = (result / "report.html").read_text()
    assert 'id="interior"' in page and page.count('data-source="interior/interior.json"') == 3
    changed = shutil.copytree(dump, tmp_path / "dump")
    shutil.copy(out / "remote_camera.toml", changed / "remote_camera.toml")
    before, after = (open_dump(place).line_camera for place in (dump, changed))
    difference, _ = map_difference_px(after, before)
    assert np.sqrt(np.mean(difference**2)) == pytest.approx(content["map_change_rms_px"], rel=0.02)
    assert_drawn(figures[0].axes, before, after, content["map_sigma_rms_px"])


def test_options_of_the_interior_calibration_are_its_priors(tmp_path, monkeypatch):
    asked = []

    def kept(sources, settings, priors, *rest):
        asked.append(priors)
        raise DataNotSufficientError("enough is known")

    monkeypatch.setattr(remote_camera_calibrate_command, "calibrate_remote_camera", kept)
    (tmp_path / "result").mkdir()
    command = ("remote-camera-calibrate", tmp_path / "result", "--out", tmp_path / "out")
    options = ("--curve-px", "1.5", "--curve-length-px", "700", "--shift-px", "2.5", "--stagger-us", "40")
    invoked(*command, *options)
    invoked(*command)
    given, usual = ((p.curve_px, p.curve_length_px, p.shift_px, p.stagger_s) for p in asked)
    assert given == pytest.approx((1.5, 700.0, 2.5, 40e-6)) and usual == (3.0, 5000.0, 5.0, 0.0)


def assert_drawn(panels, before, after, sigma_rms):
    """The change of the looks, CCD after CCD, above the residuals that it takes out, with its 1-sigma."""
    upper, lower = np.reshape(panels, (2, 2))
    first = np.cumsum([0, *(ccd.n_px for ccd in before.ccds)])
    n, variances = before.n_ccds, []
    for axis in (0, 1):
        marks = [panel.lines[0].get_data() for panel in (upper[axis], lower[axis])]
        assert np.array_equal(marks[0][0], marks[1][0])  # the same targets
        for c in range(n):
            x, change = upper[axis].lines[1 + 2 * c].get_data()
            sample = x - first[c]
            assert sample.min() == 0.0 and sample.max() == before.ccds[c].n_px - 1
            looks = [one.directions_from_pixels(c, sample) for one in (before, after)]
            moved = np.subtract(*(u_c[:, :2] / u_c[:, 2:] for u_c in looks)) / before.pixel_rad
            assert np.allclose(change, moved[:, axis], atol=0.02)  # px; the looks are of other lengths
            own = (marks[0][0] >= first[c]) & (marks[0][0] < first[c + 1])
            taken = (marks[0][1] - marks[1][1])[own]
            assert np.allclose(taken, np.interp(marks[0][0][own], x, change), atol=0.02)
            assert not np.any(lower[axis].lines[1 + 2 * c].get_ydata())
            edge = lower[axis].collections[c].get_paths()[0].vertices
            variances.append([np.ptp(edge[np.isclose(edge[:, 0], at), 1]) ** 2 / 4.0 for at in x])
    assert np.sqrt(np.mean(variances)) == pytest.approx(sigma_rms, rel=1e-6)
