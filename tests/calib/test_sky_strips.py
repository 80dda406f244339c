"""Strips that scan the sky: stars as targets without position; covariance honest, shared stars one star."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.calibration import calibrate
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import prepare_strip
from boresight.calib.verdict import assess
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import isotropic_covariance
from boresight.simulator.campaign import CameraPair, StripPlan
from boresight.simulator.sky_campaign import draw_sky_strips

BOLD = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
CAMERAS = CameraPair(BOLD)
R_CS0 = deviation_from_theta(np.array([0.003, 0.002, 0.001])).inv() * BOLD  # the paper's (28)
SKY = StripPlan(
    strips=2,
    sigma_c_px=0.05,
    sigma_position_m=2.0,  # of no consequence to stars
    sigma_clock_s=1e-4,
    sigma_vibration_rad=0.1 * ARCSEC,
    sigma_distortion_rad=3e-7,
)
NONE = CalibrationSettings(
    sigma_position_m=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0
)


def nees_of(estimate):
    error = theta_between(estimate.R_cs, BOLD)
    return error @ np.linalg.solve(estimate.cov_theta, error)


def test_stated_covariance_holds_from_the_sky_alone():
    rng, nees = np.random.default_rng(31), []
    for _ in range(120):
        estimate = calibrate(
            draw_sky_strips(SKY, CAMERAS, rng, sigma_star_rad=0.02 * ARCSEC), R_CS0, CalibrationSettings()
        )
        assert isinstance(estimate, InstallationEstimate) and estimate.converged
        nees.append(nees_of(estimate))
    low, high = chi2(df=3 * 120).ppf([0.0005, 0.9995]) / 120
    assert low < np.mean(nees) < high  # 2.32 to 3.79


def test_no_position_of_the_satellite_moves_a_star():
    strip = draw_sky_strips(SKY, CAMERAS, np.random.default_rng(1))[0]
    prepared = prepare_strip(strip, replace(NONE, sigma_position_m=2.0))
    first = prepared.unknowns.index("position/x")
    assert not prepared.shared_s[:, :, first : first + 3].any()


def test_the_row_clock_moves_a_star_by_the_rate_of_the_scan():
    still = replace(SKY, wave_rad=(0.0, 0.0), sigma_s_px=1e-4)
    strip = draw_sky_strips(still, CAMERAS, np.random.default_rng(2))[0]
    prepared = prepare_strip(strip, replace(NONE, sigma_clock_s=1e-3))
    column = prepared.shared_s[:, :, prepared.unknowns.index("clock")] @ BOLD.as_matrix().T
    # 1 ms of a scan at -14.5 mrad/s about y: 14.5 µrad along x, the field is too narrow for more
    np.testing.assert_allclose(column[:, 0], 14.5e-6, rtol=1e-3)
    assert np.abs(column[:, 1]).max() < 1e-10  # rad; the rate is that of stars of 1e-4 px


def copies(strip, n, sigma_star_rad, rng):
    """One scan n times: the noise is new each time, the errors of the star catalogue are the same."""
    known = strip.ground.u_i + sigma_star_rad * rng.standard_normal(strip.ground.u_i.shape)
    known /= np.linalg.norm(known, axis=1, keepdims=True)
    stated = isotropic_covariance(known, sigma_star_rad)
    for k in range(n):
        seen = strip.ground.u_c + 5e-8 * rng.standard_normal(strip.ground.u_c.shape)
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        ground = replace(strip.ground, u_i=known, u_c=seen, cov_target_i=stated)
        yield replace(strip, strip_id=f"copy{k}", ground=ground)


@pytest.mark.parametrize(("most", "honest"), [(100, True), (0, False)])
def test_a_star_in_several_strips_is_one_star(most, honest):
    exact = replace(SKY, sigma_c_px=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0)
    settings = replace(NONE, robust=False, most_shared_targets=most)
    rng, nees = np.random.default_rng(5), []
    for _ in range(60):
        (strip,) = draw_sky_strips(replace(exact, strips=1, sigma_s_px=0.001), CAMERAS, rng)
        ground = replace(strip.ground, cov_c=isotropic_covariance(strip.ground.u_c, 5e-8))
        strips = list(copies(replace(strip, ground=ground), 8, 2e-6, rng))
        nees.append(nees_of(calibrate(strips, BOLD, settings)))
    low, high = chi2(df=3 * 60).ppf([0.0005, 0.9995]) / 60
    assert (low < np.mean(nees) < high) == honest  # eight times as many stars as there are: far too sure


def test_the_verdict_on_stars_is_consistent():
    strips = draw_sky_strips(replace(SKY, strips=4), CAMERAS, np.random.default_rng(8))
    estimate = calibrate(strips, R_CS0, CalibrationSettings())
    assert not assess(estimate, strips).refuted_by
    assert (
        np.isnan(estimate.targets.detectable_m).all() and np.isfinite(estimate.targets.detectable_rad).all()
    )
