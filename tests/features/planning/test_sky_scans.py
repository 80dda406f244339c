"""Scans of the sky: clear of Sun, Moon and Earth by astropy's places; the choice is better than chance."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import astropy.units as u
import erfa
import numpy as np
import pandas as pd
import pytest
from astropy.coordinates import SkyCoord, get_body
from astropy.time import Time
from command_line import invoked, ran
from drawn_pictures import SERIES_COLOURS, kept_figures, numbers, shows_curves
from handmade import ATTITUDE_HEAD, give_heads
from recorded_numbers import assert_recorded, columns_of, numbers_by_line
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from boresight.calib.settings import CalibrationSettings
from boresight.features.planning import scan_files, scan_plan
from boresight.features.planning.scan_plan import ScanCameras, ScanSettings, angles_to_bodies, choose_scans
from boresight.geometry.attitude_noise import NO_NOISE
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.report.panels import OURS
from boresight.star_id.whole_catalogue import all_hipparcos

MINI = Path(__file__).parents[3] / "fixtures" / "mini"
DUMP = open_dump(MINI)
CAMERAS = ScanCameras(line=DUMP.line_camera, star=DUMP.star_camera, R_cs=DUMP.R_cs0, orbit=DUMP.orbit)


def chosen(*progress, first_s=0.0, **asked):
    settings = ScanSettings(**({"candidates": 40, "count": 2} | asked))
    return choose_scans(CAMERAS, all_hipparcos(), first_s, CalibrationSettings(), settings, *progress)


@pytest.mark.parametrize(
    ("days", "hours", "is_covered"),
    [
        *((-4.5, 24.0, False), (3.2, 24.0, False), (731.0, 24.0, False)),
        *((-3.1, 72.0, False), (2.7, 8.0, False), (-2.9, 6.0, True), (2.7, 6.0, True)),
    ],
)
def test_an_orbit_is_not_continued_further_than_stated(days, hours, is_covered):
    settings = ScanSettings(hours=hours, candidates=2, sun_deg=180.0)  # none of two is clear of the Sun
    stated = r"the orbit covers 2024-11-20T03:39 .* continued by 3 days at most"
    with pytest.raises(ValueError, match="0 of 2 candidates hold stars" if is_covered else stated):
        choose_scans(CAMERAS, all_hipparcos(), days * 86400.0, CalibrationSettings(), settings)


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


def position_i(t_s: float) -> np.ndarray:
    """Position (3,) beyond the nodes of the orbit, under GM and J2."""

    def change(_: float, state: np.ndarray) -> np.ndarray:
        p, r = state[:3], np.linalg.norm(state[:3])
        flat = 1.5 * 1.08263e-3 * 6378137.0**2 / r**2 * (5.0 * p[2] ** 2 / r**2 - np.array([1.0, 1.0, 3.0]))
        return np.concatenate([state[3:], 3.986004418e14 / r**3 * p * (flat - 1.0)])

    begin = np.concatenate([one[0] for one in DUMP.orbit.states_i(np.array([0.0]))])
    return solve_ivp(change, (0.0, t_s), begin, "DOP853", rtol=1e-10, atol=1e-3).y[:3, -1]


def least_angles_deg(scan) -> np.ndarray:
    """Of both cameras' axes at the beginning and the end of a scan to Sun, Moon (astropy) and limb."""
    p_i = position_i(scan.t_s)[None]
    when = Time(DUMP.epoch.utc_from_seconds(np.array([scan.t_s]))[0].removesuffix("Z"), scale="utc")
    turned = Rotation.from_rotvec([0.0, -scan.rate_rad_s * ScanSettings().duration_s, 0.0])
    axes = []
    for R_ci in (scan.R_ci, turned * scan.R_ci):
        of_camera = R_ci.as_matrix()
        axes += [of_camera[2], (DUMP.R_cs0.as_matrix().T @ of_camera)[2]]  # third rows: z of c, z of s
    bodies = [get_body(name, when).cartesian.xyz.to_value(u.m) - p_i[0] for name in ("sun", "moon")]
    away = [[np.degrees(np.arccos(axis @ v / np.linalg.norm(v))) for v in bodies] for axis in axes]
    depression = np.arccos(6378137.0 / np.linalg.norm(p_i[0]))
    limb = [np.degrees(np.arcsin(axis @ p_i[0] / np.linalg.norm(p_i[0])) + depression) for axis in axes]
    return np.array([*np.min(away, axis=0), min(limb)])


def test_scans_keep_both_cameras_away_and_beat_chance():
    told = []
    away = {"sun_deg": 70.0, "moon_deg": 30.0, "earth_deg": 12.0}
    found = chosen(lambda *one: told.append(one), first_s=-55000.0, **away)
    assert told == [(n, 40) for n in range(1, 41)]
    assert {scan.t_s < 0.0 for scan in found.scans} == {True, False}  # before the orbit and after it
    for scan in found.scans:
        assert np.all(scan.away_deg >= [70.0, 30.0, 12.0])
        assert np.allclose(scan.away_deg, least_angles_deg(scan), atol=0.02)  # light time, series of the Moon
    assert np.all(np.diff(found.sigma_rad, axis=0) < 0.0)  # another scan never takes information away
    look = np.array([1.0, 1.0, 0.01])
    assert look @ found.sigma_rad[-1] ** 2 < 0.8 * look @ found.random_sigma_rad**2
    told = scan_files.scan_lines(found, DUMP.epoch)[-1]  # as many at random
    assert np.radians(np.array(numbers(told)) / 3600.0) == pytest.approx(found.random_sigma_rad, abs=2.6e-9)


def test_an_axis_that_nothing_tells_has_the_limit_as_its_sigma():
    found = scan_plan._covariance(np.diag([4e10, 1e10, 0.0]), np.zeros((0, 0)), CalibrationSettings())
    np.testing.assert_allclose(found, np.diag([2.5e-11, 1e-10, 1e-6]), rtol=1e-12)  # rad²; 1e-3 rad


def test_a_head_that_delivers_attitudes_counts_by_their_covariance():
    worse = replace(CAMERAS, star=np.diag([5e-6, 5e-6, 5e-5]) ** 2)  # rad: 1 and 10 arcsec an attitude
    asked = ScanSettings(candidates=30, count=2)
    better = replace(CAMERAS, star=np.diag([2e-6, 2e-6, 2e-5]) ** 2)
    a, b = (choose_scans(one, all_hipparcos(), 0.0, CalibrationSettings(), asked) for one in (better, worse))
    assert all(scan.head_stars == 0 and scan.stars > 1 for scan in b.scans)
    assert np.all(b.sigma_rad[-1] > a.sigma_rad[-1])
    shaken = replace(worse, noise=replace(NO_NOISE, constant_rad=np.full(3, 2e-5)))
    c = choose_scans(shaken, all_hipparcos(), 0.0, CalibrationSettings(), asked)
    assert c.sigma_rad[-1, 0] > 0.5 * 2e-5  # an error of its own in each of two strips


def test_every_second_candidate_scans_the_other_way(monkeypatch):
    tried = []
    monkeypatch.setattr(scan_plan, "_candidate", lambda *given: tried.append((given[3][0], given[4])))
    with pytest.raises(ValueError, match="0 of 6 candidates"):
        chosen(candidates=6, hours=3.0, rate_mrad_s=0.7)
    assert np.allclose(tried, [(1800.0 * n, 7e-4 * (-1.0) ** n) for n in range(6)])


def test_stars_have_moved_as_erfa_says():
    sky = scan_plan._Sky.of(all_hipparcos(), 2051.25)
    p = sky.stars.places
    begun, asked = erfa.epj2jd(p.epoch_jyear), erfa.epj2jd(2051.25)
    ra, dec, *_ = erfa.pmsafe(p.ra_rad, p.dec_rad, p.pm_ra_rad_yr, p.pm_dec_rad_yr, 0, 0, *begun, *asked)
    off = sky.u_i - erfa.s2c(ra, dec)
    assert np.quantile(np.linalg.norm(off, axis=1), 0.999) < 1e-7  # rad; at a pole the motion is no arc


def test_too_narrow_limits_are_an_error_that_says_so():
    with pytest.raises(ValueError, match="candidates hold stars"):
        chosen(sun_deg=179.0)


def test_the_command_writes_its_table_and_picture(tmp_path):
    with kept_figures(scan_files) as figures:
        told = ran("sky-strip-plan", MINI, "--candidates", 30, "--hours", 3, "--out", tmp_path)
    header, *rows = (tmp_path / "scans.csv").read_text().splitlines()
    assert header.startswith("scan,utc,ra_deg,dec_deg") and len(rows) == 2
    table = pd.read_csv(tmp_path / "scans.csv")
    assert_recorded("scans", columns_of(table) | numbers_by_line(told.output.replace(str(tmp_path), "")))
    sky, steps = figures[0].axes
    drawn = np.ravel([line.get_data() for line in sky.lines[:2]])
    assert np.allclose(drawn, table[["ra_deg", "dec_deg"]].to_numpy().ravel())
    when = Time(table["utc"][0].rstrip("Z"), scale="utc")
    for line, name in zip(sky.lines[2:], ("sun", "moon"), strict=True):
        seen = SkyCoord(*np.ravel(line.get_data()) * u.deg)
        x = get_body(name, when).cartesian.xyz.value
        assert seen.separation(SkyCoord(*x, representation_type="cartesian")).deg < 0.02
    lines = [line for line in told.output.splitlines() if re.match(r" +\d+  20\d\d-", line)]
    for n, axis in enumerate("xyz"):
        sigma = table[f"sigma_{axis}_arcsec"]
        assert np.allclose(steps.lines[n].get_data(), [[1, 2], sigma])
    further = [line for line in told.output.splitlines() if re.match(r" +\d+ +\d+ +\d+ +\d+ +", line)]
    for row, line, other in zip(table.itertuples(), lines, further, strict=True):
        stated = [row.ra_deg, row.dec_deg, row.scan_angle_deg, row.rate_mrad_s, row.stars]
        assert numbers(line)[-5:] == pytest.approx(stated, abs=0.051)
        printed = numbers(other)
        assert printed[1:4] == pytest.approx([row.sun_deg, row.moon_deg, row.limb_deg], abs=0.51)
        sigma = [row.sigma_x_arcsec, row.sigma_y_arcsec, row.sigma_z_arcsec]
        assert printed[4:] == pytest.approx(sigma, abs=5.1e-5)
        # The attitude beside them: z of frame c to its right ascension, x turned from north to east.
        R_ci = Rotation.from_quat([row.qx_ci, row.qy_ci, row.qz_ci, row.qw_ci]).as_matrix()
        z, x = (SkyCoord(*one, representation_type="cartesian") for one in (R_ci[2], R_ci[0]))
        middle = SkyCoord(row.ra_deg * u.deg, row.dec_deg * u.deg)
        assert middle.separation(z).deg < 1e-6
        assert middle.position_angle(x).deg == pytest.approx(row.scan_angle_deg, abs=1e-6)
    assert shows_curves(tmp_path / "scans.png", OURS, *SERIES_COLOURS[:3])
    assert invoked("sky-strip-plan", MINI, "--utc", "tonight").exit_code != 0


def test_the_command_plans_for_a_dump_of_attitudes(tmp_path):
    root = shutil.copytree(MINI, tmp_path / "dump")
    t_s = np.arange(0.0, 2.0, 0.2)
    quaternions = (DUMP.R_cs0.inv() * DUMP.orbit.R_oi(t_s)).inv().as_quat().tolist()
    utc = [one.rstrip("Z") for one in DUMP.epoch.utc_from_seconds(t_s)]
    rows = [f"{when},{','.join(map(repr, q))}" for when, q in zip(utc, quaternions)]
    (root / "str1.csv").write_text("\n".join(["utc,qx,qy,qz,qw", *rows]) + "\n")
    head = ATTITUDE_HEAD.format(rotation="head to inertial", removed="annual")
    give_heads(root, head + "[star_cameras.noise]\nwhite_arcsec = [1, 1, 7]\n")
    told = ran("sky-strip-plan", root, "--candidates", 20, "--hours", 2)
    assert "1 sigma with it: X       Y        Z, arcsec" in told.output
