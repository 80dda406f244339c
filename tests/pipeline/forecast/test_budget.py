"""The uncertainty budget: its parts sum to the covariance, and one is that of the estimator's gain."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.forecast.budget import uncertainty_budget
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

BOLD = Rotation.from_euler("xyz", [-70, 25, 140], degrees=True)
CAMERAS = CameraPair(BOLD, n_ccds=3, ccd_px=9000)
STATED = {"sigma_position_m": 3.0, "sigma_clock_s": 3e-4, "sigma_distortion_rad": 5e-7}
STATED |= {"sigma_vibration_rad": 0.2 * ARCSEC}
PLAN = StripPlan(strips=3, exposures=6, stars=12, targets=7, sigma_target_m=0.7, **STATED)
OF_CCDS = {"sigma_ccd_shift_rad": 2e-7, "sigma_ccd_slope_rad": 1e-7, "sigma_ccd_bend_rad": 1e-7}
SETTINGS = CalibrationSettings(robust=False, ccd_px=(9000,) * 3, **STATED, **OF_CCDS)
STRIPS = with_attitudes(draw_strips(PLAN, CAMERAS, np.random.default_rng(11))[0], SETTINGS.attitudes)
ESTIMATE = calibrate_strips(STRIPS, BOLD, SETTINGS)
BUDGET = {one.source: one.covariance for one in uncertainty_budget(STRIPS, ESTIMATE.R_cs, SETTINGS)}


def test_the_parts_sum_to_the_covariance():
    total = sum(BUDGET.values())
    largest = np.sqrt(np.outer(np.diag(ESTIMATE.cov_theta), np.diag(ESTIMATE.cov_theta)))
    # Each part may miss a thousandth of itself, the relative step of the derivative.
    np.testing.assert_allclose(total / largest, ESTIMATE.cov_theta / largest, atol=2e-3)


def test_sources_of_error_are_those_that_the_settings_and_strips_state():
    assert "image points of stars in strips" not in BUDGET and "motion between exposures" not in BUDGET
    still = replace(SETTINGS, sigma_clock_s=0.0, sigma_vibration_rad=0.0)
    named = {one.source for one in uncertainty_budget(STRIPS, ESTIMATE.R_cs, still)}
    assert set(BUDGET) - named == {"clock", "vibration"}


def test_the_part_of_image_points_is_their_covariance_through_the_gain_of_the_estimator():
    moved_rad = 1e-7
    part = np.zeros((3, 3))
    for n, strip in enumerate(STRIPS):
        ground = strip.ground
        for j in range(len(ground.ccd)):
            values, axes = np.linalg.eigh(ground.cov_c[j])
            for variance, axis in zip(values[1:], axes.T[1:]):  # the first is along the line of sight: zero
                theta = []
                for way in (1.0, -1.0):
                    u_c = ground.u_c.copy()
                    u_c[j] += way * moved_rad * axis
                    u_c[j] /= np.linalg.norm(u_c[j])
                    changed = [*STRIPS[:n], replace(strip, ground=replace(ground, u_c=u_c)), *STRIPS[n + 1 :]]
                    found = calibrate_strips(changed, ESTIMATE.R_cs, SETTINGS)
                    theta.append(theta_between(found.R_cs, ESTIMATE.R_cs))
                gain = (theta[0] - theta[1]) / (2.0 * moved_rad)
                part += variance * np.outer(gain, gain)
    stated = BUDGET["image points of the targets"]
    largest = np.sqrt(np.outer(np.diag(part), np.diag(part)))
    # Beside the thousandth of the derivative: the estimator stops at a hundredth of its predicted sigma.
    np.testing.assert_allclose(stated / largest, part / largest, atol=0.02)
