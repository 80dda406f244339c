"""Two exposures a strip while the satellite oscillates: with a gyro the stated covariance holds."""

import numpy as np
import pytest
from drawn_campaigns import squared
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.constants import ARCSEC
from boresight.geometry.gyro import GyroNoise
from boresight.geometry.installation import theta_between
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt
from boresight.simulator.drawn_gyro import with_gyro

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0), np.radians(37.0)))
R_CS0 = Rotation.from_rotvec([3e-3, 2e-3, 1e-3]) * CAMERAS.R_cs
GYRO = GyroNoise(
    random_walk_rad=0.02 * ARCSEC,
    bias_walk_rad_s=0.01 * ARCSEC,
    bias_rad_s=1.0 * ARCSEC,
    white_rad=0.01 * ARCSEC,
)
ASSUMED = 6.0 * ARCSEC  # of the motion between exposures, 1 sigma
SETTINGS = CalibrationSettings(sigma_motion_rad=ASSUMED)
RUNS = 18
WITHIN = 3.0 * np.sqrt(6.0 / RUNS)  # of the mean of so many


def nees(size: float, *, with_a_gyro: bool) -> float:
    """Mean normalised squared error of campaigns whose waves have `size` times the assumed motion."""
    total = 0.0
    for seed in range(RUNS):
        rng = np.random.default_rng([57, seed])
        plan = StripPlan(
            strips=2,  # they draw as many errors of the matrix as more would
            exposures=2,
            exposure_margin_s=0.3,
            wave_rad=(size * ASSUMED, size * ASSUMED),
            wave_s=(1.0, 2.0),
            stars=60,
            sigma_position_m=SETTINGS.sigma_position_m,
            sigma_clock_s=SETTINGS.sigma_clock_s,
            sigma_vibration_rad=SETTINGS.sigma_vibration_rad,
            sigma_distortion_rad=SETTINGS.sigma_distortion_rad,
            distortion_length_px=SETTINGS.distortion_length_px,
        )
        strips, truth = draw_strips(plan, CAMERAS, rng)
        if with_a_gyro:
            strips = with_gyro(strips, truth, CAMERAS.R_cs, GYRO, np.arange(-0.4, 2.25, 0.05), rng)
        found = calibrate_strips(strips, R_CS0, SETTINGS)
        error = theta_between(found.R_cs, CAMERAS.R_cs)
        total += squared(error, found.cov_theta)
    return total / RUNS


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_the_covariance_holds_whatever_the_motion(size: float) -> None:
    assert 3.0 - WITHIN < nees(size, with_a_gyro=True) < 3.0 + WITHIN


def test_without_a_gyro_such_a_motion_breaks_it() -> None:
    assert nees(1.0, with_a_gyro=False) > 3.0 + WITHIN
