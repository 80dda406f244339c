"""The missions of `fixtures`, flown again: orbit, times, cameras, matrix and stars are those of the committed
files; images and places on the ground are those last recorded.

The files were made when the distortion along the detectors was drawn without its mean; places of stars in
strips may differ by 0.1 px for that.
"""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from edits import rows_of
from recorded_numbers import assert_recorded
from scipy.spatial.transform import Rotation

from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario

FIXTURES = Path(__file__).parents[2] / "fixtures"
SHIFT_PX = 0.1


@pytest.fixture(scope="module", params=["mini", "sky"])
def both(request):
    """A mission, its folder and the dump in it."""
    folder = FIXTURES / request.param
    mission = fly(named_scenario(request.param, ()), 1)
    return mission, folder, open_dump(folder, sky_alone=True)


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
        cameras = mission.line_camera, dump.line_camera
        ours, theirs = (one.directions_from_pixels(ccd, sample) for one in cameras)
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


def test_images_chips_and_places_are_those_recorded(both):
    mission, folder, _ = both
    shown = [shot.image() for shot in mission.exposures[::5]]
    blocks = [next(strip.blocks(48)) for strip in mission.strips[::3]]
    points = (*mission.truth.targets, *mission.truth.check_points)
    found = {
        "exposures": np.concatenate([image.ravel() for image in shown]),
        "strips": np.concatenate([block.ravel() for block in blocks]),
        "chips": np.concatenate([chip.image.ravel() for chip in mission.chips] or [[]]),
        "places": [[one.sample, one.line, one.lat_deg, one.lon_deg, *one.p_e] for one in points],
        "surveyed": [[one.lat_deg, one.lon_deg, one.height_m, *one.sigma_m] for one in mission.targets],
        "terrain": [] if mission.terrain is None else mission.terrain.heights_m,
    }
    assert_recorded(f"mission_{folder.name}", found, relative=2e-5)


def test_true_stars_of_a_scan_are_those_of_the_table(both):
    mission, folder, _ = both
    path = folder / "truth" / "sky_stars.csv"
    rows = rows_of(path) if path.is_file() else []
    for ours, row in zip(mission.truth.sky_stars, rows, strict=True):
        assert (str(ours.ccd), str(ours.hip), f"{ours.v_mag:.2f}") == (row["ccd"], row["hip"], row["v_mag"])
        assert abs(ours.sample - float(row["sample"])) < SHIFT_PX
        assert abs(ours.line - float(row["line"])) < SHIFT_PX
        assert ours.charge_e == pytest.approx(float(row["charge_e"]), abs=0.051)
