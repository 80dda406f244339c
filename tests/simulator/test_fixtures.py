"""The missions of `fixtures`, flown again: all that was drawn, and pixels, are those that are committed.

They were made when the distortion along the detectors was drawn without its mean; places in strips may differ
by 0.1 px for that, and grey values by what so small a shift does.
"""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from scipy.spatial.transform import Rotation

from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario

FIXTURES = Path(__file__).parents[2] / "fixtures"
SHIFT_PX = {"targets": 2.0, "check_points": 0.1, "stars": 0.1}  # targets lie on a lattice on the ground


@pytest.fixture(scope="module", params=["mini", "sky"])
def both(request):
    """A mission, its folder and the dump in it."""
    folder = FIXTURES / request.param
    mission = fly(named_scenario(request.param, ()), 1)
    return mission, folder, open_dump(folder, sky_alone=True)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_orbit_and_times_are_those_of_the_tables(both):
    mission, folder, _ = both

    def utc(text: str) -> float:
        return float(mission.epoch.seconds_from_utc([text])[0])

    text = (folder / "orbit.oem").read_text().partition("META_STOP")[2].strip().splitlines()
    states = 1e3 * np.array([line.split()[1:] for line in text], dtype=float)  # km
    assert np.allclose(mission.orbit.positions_m, states[:, :3], atol=1e-5, rtol=0.0)
    assert np.allclose(mission.orbit.velocities_m_s, states[:, 3:], atol=1e-8, rtol=0.0)
    assert np.allclose(mission.orbit.t_s, [utc(line.split()[0]) for line in text], atol=1e-9, rtol=0.0)
    for ours, row in zip(mission.strips, rows_of(folder / "strips.csv"), strict=True):
        assert (ours.strip_id, str(ours.ccd), str(ours.lines)) == (row["id"], row["ccd"], row["lines"])
        assert ours.t_first_row_s == pytest.approx(utc(row["utc_first_row"]), abs=1e-9)
        assert ours.row_period_s == pytest.approx(float(row["row_period_s"]), rel=1e-12)
    for shot, row in zip(mission.exposures, rows_of(folder / "exposures.csv"), strict=True):
        assert shot.exposure_id == row["id"] and shot.exposure_s == float(row["exposure_s"])
        assert shot.t_s == pytest.approx(utc(row["utc_mid"]), abs=1e-9)


def test_cameras_matrix_and_stated_errors_are_those_of_the_files(both):
    mission, folder, dump = both
    assert (mission.installation.R_cs * dump.R_cs0.inv()).magnitude() < 1e-12
    stated = tomllib.loads((folder / "installation.toml").read_text())
    assert np.allclose(mission.installation.sigma_rad, stated["sigma_rad"])
    true = tomllib.loads((folder / "truth" / "installation.toml").read_text())
    assert (mission.truth.R_cs * Rotation.from_quat(true["quaternion_cs"]).inv()).magnitude() < 1e-12
    for ccd in range(dump.line_camera.n_ccds):
        sample = np.linspace(0.0, dump.line_camera.n_px(ccd) - 1.0, 7)
        ours, theirs = (
            one.directions_from_pixels(ccd, sample) for one in (mission.line_camera, dump.line_camera)
        )
        assert np.allclose(ours, theirs, atol=1e-11)  # rad
    xy = np.array([[10.0, 300.0], [400.0, 20.0], [500.5, 380.25]])
    ours, theirs = (one.directions_from_pixels(xy) for one in (mission.star_camera, dump.star_camera))
    assert np.allclose(ours, theirs, atol=1e-11)
    errors = tomllib.loads((folder / "dump.toml").read_text())["errors"]
    for name, value in errors.items():
        if name == "look_distortion_length_px":  # not drawn
            continue
        assert np.allclose(getattr(mission.errors, name), value), name
    for one, row in zip(mission.truth.strips, rows_of(folder / "truth" / "strips.csv"), strict=True):
        error = [float(row[f"error_{axis}_m"]) for axis in "xyz"]
        assert np.allclose(one.position_error_m, error, rtol=1e-12)
        assert one.clock_offset_s == pytest.approx(float(row["clock_offset_s"]), rel=1e-12)


def test_star_images_are_the_same_bytes(both):
    mission, folder, _ = both
    for shot, row in list(zip(mission.exposures, rows_of(folder / "exposures.csv")))[::5]:
        assert np.array_equal(shot.image(), pixels(folder / row["file"])), row["id"]


def test_targets_chips_and_heights_are_those_of_the_files(both):
    mission, folder, _ = both
    if not mission.targets:
        pytest.skip("a mission of the sky alone")
    same = 0
    for ours, chip, row in zip(mission.targets, mission.chips, rows_of(folder / "targets.csv"), strict=True):
        place = np.array([float(row[key]) for key in ("lat_deg", "lon_deg", "height_m")])
        off = np.abs(place - [ours.lat_deg, ours.lon_deg, ours.height_m])
        assert np.all(off < [5e-5, 5e-5, 1.0])  # chips lie on a lattice of some metres
        sigma = [float(row[f"sigma_{axis}_m"]) for axis in ("east", "north", "up")]
        assert ours.sigma_m == pytest.approx(sigma)
        with rasterio.open(folder / row["chip"]) as image:
            assert image.crs.to_epsg() == chip.epsg
            if np.all(off < [6e-11, 6e-11, 6e-5]):  # the digits of the file
                assert np.array_equal(chip.image, image.read(1))
                assert np.allclose(tuple(image.transform)[:6], chip.affine)
                same += 1
    assert same > 0.5 * len(mission.targets)
    with rasterio.open(next((folder / "terrain").glob("*.tif"))) as image:
        assert np.allclose(mission.terrain.heights_m, image.read(1), atol=6e-3, rtol=0.0, equal_nan=True)
        assert np.allclose(tuple(image.transform)[:6], mission.terrain.affine, rtol=1e-12)


@pytest.mark.parametrize("kind", ["targets", "check_points"])
def test_true_places_in_the_strips_are_those_of_the_tables(both, kind):
    mission, folder, _ = both
    points = getattr(mission.truth, kind)
    for ours, row in zip(points, rows_of(folder / "truth" / f"{kind}.csv"), strict=True):
        assert (ours.point_id, ours.strip_id, str(ours.ccd)) == (row["id"], row["strip"], row["ccd"])
        at = np.array([float(row["sample"]), float(row["line"])])
        assert np.all(np.abs([ours.sample, ours.line] - at) < SHIFT_PX[kind])
        assert np.allclose(
            [ours.lat_deg, ours.lon_deg], [float(row["lat_deg"]), float(row["lon_deg"])], atol=5e-5
        )


def test_true_stars_of_a_scan_are_those_of_the_table(both):
    mission, folder, _ = both
    path = folder / "truth" / "sky_stars.csv"
    rows = rows_of(path) if path.is_file() else []
    for ours, row in zip(mission.truth.sky_stars, rows, strict=True):
        assert (str(ours.ccd), str(ours.hip), f"{ours.v_mag:.2f}") == (row["ccd"], row["hip"], row["v_mag"])
        assert abs(ours.sample - float(row["sample"])) < SHIFT_PX["stars"]
        assert abs(ours.line - float(row["line"])) < SHIFT_PX["stars"]
        assert ours.charge_e == pytest.approx(float(row["charge_e"]), abs=0.051)


def test_strips_show_what_the_files_show(both):
    mission, _, dump = both
    strips = {one.strip_id: one for one in (*dump.strips, *dump.sky_strips)}
    for ours in mission.strips[::3]:
        block = next(ours.blocks(48)).astype(float)
        file = strips[ours.strip_id].images.read(ours.ccd, 0, 48, 0, ours.samples).astype(float)
        # A hundredth of a pixel changes a slope of some 10 DN a pixel by 0.1 DN; noise is the same.
        assert np.abs(block - file).mean() < 0.4
        assert abs(block.mean() - file.mean()) < 0.02
        assert np.corrcoef(block.ravel(), file.ravel())[0, 1] > (0.9995 if ours.kind == "ground" else 0.99)
