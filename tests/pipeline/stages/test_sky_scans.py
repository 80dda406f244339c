"""Scans of the sky: clear of Sun, Moon and Earth by astropy's places; the choice is better than chance."""

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import get_body
from astropy.time import Time
from typer.testing import CliRunner

from boresight.calib.settings import CalibrationSettings
from boresight.pipeline.cli import app
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.stages.sky_scans import (
    ScanCameras,
    ScanSettings,
    angles_to_bodies,
    choose_scans,
)
from boresight.star_id.whole_catalogue import all_hipparcos

MINI = Path(__file__).parents[3] / "fixtures" / "mini"
DUMP = open_dump(MINI)
CAMERAS = ScanCameras(line=DUMP.line_camera, star=DUMP.star_camera, R_cs=DUMP.R_cs0, orbit=DUMP.orbit)


def chosen(**asked):
    settings = ScanSettings(**({"candidates": 40, "count": 2} | asked))
    return choose_scans(CAMERAS, all_hipparcos(), 0.0, CalibrationSettings(), settings)


def test_angles_to_sun_moon_and_limb_are_those_of_astropy():
    p_i, _ = DUMP.orbit.states_i(np.array([0.0]))
    axis = np.array([0.6, -0.64, 0.48])
    found = angles_to_bodies(DUMP.epoch, 0.0, p_i[0], axis)
    when = Time(DUMP.epoch.utc_from_seconds(np.array([0.0]))[0].removesuffix("Z"), scale="utc")
    for n, name in enumerate(("sun", "moon")):
        v = get_body(name, when).cartesian.xyz.to_value(u.m) - p_i[0]
        expected = np.arccos(axis @ v / np.linalg.norm(v))
        assert found[n] == pytest.approx(expected, abs=2e-4)  # rad; light time and the series of the Moon
    depression = np.arccos(6378137.0 / np.linalg.norm(p_i[0]))
    above_horizon = np.arcsin(axis @ p_i[0] / np.linalg.norm(p_i[0]))
    assert found[2] == pytest.approx(above_horizon + depression, abs=1e-9)


def test_scans_keep_both_cameras_away_and_beat_chance():
    found = chosen(sun_deg=70.0, moon_deg=30.0, earth_deg=12.0)
    for scan in found.scans:
        assert np.all(scan.away_deg >= [70.0, 30.0, 12.0])
    assert np.all(np.diff(found.sigma_rad, axis=0) < 0.0)  # another scan never takes information away
    look = np.array([1.0, 1.0, 0.01])
    assert look @ found.sigma_rad[-1] ** 2 < 0.8 * look @ found.random_sigma_rad**2


def test_too_narrow_limits_are_an_error_that_says_so():
    with pytest.raises(ValueError, match="candidates hold stars"):
        chosen(sun_deg=179.0)


def test_the_command_writes_its_table_and_picture(tmp_path):
    asked = ["sky-strip-plan", str(MINI), "--candidates", "30", "--hours", "3", "--out", str(tmp_path)]
    told = CliRunner().invoke(app, asked)
    assert told.exit_code == 0, told.output
    header, *rows = (tmp_path / "scans.csv").read_text().splitlines()
    assert header.startswith("scan,utc,ra_deg,dec_deg") and len(rows) == 2
    assert (tmp_path / "scans.png").stat().st_size > 10_000
    assert CliRunner().invoke(app, [*asked[:2], "--utc", "tonight"]).exit_code != 0
