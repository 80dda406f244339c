"""Errors that a campaign is drawn with are where they are stated to be, with their signs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from boresight.simulator.campaign import CameraPair, DistortionCurve, StripPlan, draw_sky_strips, draw_strips

CAMERAS = CameraPair(Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True))
EXACT = StripPlan(strips=2, targets=30, exposures=40, exposure_margin_s=0.2, sigma_s_px=1e-7, sigma_c_px=1e-7)
BIAS_S = 0.003


def camera_at(strip, t_s: np.ndarray) -> Rotation:
    """R_ci by the stars of the exposures, between which the motion is followed."""
    times = np.array([one.t_s for one in strip.exposures])
    R_si = Rotation.concatenate([Rotation.align_vectors(one.u_s, one.u_i)[0] for one in strip.exposures])
    return CAMERAS.R_cs * Slerp(times, R_si)(t_s)


@pytest.mark.parametrize("bias_s", [0.0, BIAS_S, -BIAS_S])
def test_rows_of_a_scan_are_stated_late_by_the_clocks_bias(bias_s):
    plan = replace(EXACT, clock_bias_s=bias_s, wave_rad=(0.0, 0.0))
    for strip in draw_sky_strips(plan, CAMERAS, np.random.default_rng(4)):
        ground = strip.ground
        seen = camera_at(strip, ground.t_s - bias_s).apply(ground.u_i)
        # 0.0145 rad/s: a bias of 3 ms of the other sign is 87 microradians
        assert np.linalg.norm(seen - ground.u_c, axis=1).max() < 1e-9


@pytest.mark.parametrize("bias_s", [0.0, BIAS_S, -BIAS_S])
def test_rows_of_a_strip_are_stated_late_by_the_clocks_bias(bias_s):
    plan = replace(EXACT, clock_bias_s=bias_s, wave_rad=(0.0, 0.0))
    strips, _ = draw_strips(plan, CAMERAS, np.random.default_rng(4))
    for strip in strips:
        ground = strip.ground
        off = camera_at(strip, ground.t_s).apply(ground.u_i) - ground.u_c
        # The ground passes backwards: 3.986e14 m³/s² at 6908 km is 7.60 km/s, of which 6378 / 6908 below,
        # seen from 530 km. At the stated, later instant it has moved on.
        speed_rad_s = np.sqrt(3.986004e14 / 6.9081e6) * 6378.1 / 6908.1 / 530e3
        expected = [-speed_rad_s * bias_s, 0.0, 0.0]
        assert off.mean(axis=0) == pytest.approx(expected, rel=2e-3, abs=2e-9)


def test_shift_slope_and_bend_of_a_ccd_are_orthonormal_over_its_samples():
    modes = np.zeros((2, 3, 3))
    modes[0, 0, 0] = modes[0, 1, 1] = modes[0, 2, 2] = 1.0  # one mode on each of three CCDs
    none = np.zeros((2, 3, 1))
    curve = DistortionCurve(none, none, 0.0, 1000, modes)
    sample = np.arange(1000) + 0.5
    drawn = np.array([curve.at(np.full(1000, ccd), sample)[:, 0] for ccd in range(3)])
    # sums over 1000 samples stand for integrals to 1e-5
    np.testing.assert_allclose(drawn @ drawn.T / 1000.0, np.eye(3), atol=1e-5)
    assert np.all(np.diff(drawn[1]) > 0.0) and drawn[2, 0] > 0.0 > drawn[2, 500]
