"""Ground errors along and across the track, and attitudes between exposures."""

import numpy as np
import pytest

from boresight.features.paper.geopositioning import ground_errors, smoothed_attitude
from boresight.geometry.constants import ARCSEC
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0)))
UP, AHEAD = (np.array([one]) for one in ((1.0, 0.0, 0.0), (0.0, 7.6e3, 0.0)))


def test_a_shifted_satellite_shifts_the_ground_point_by_as_much():
    to_ground = -530e3 * UP - np.array([[0.0, 2.0, -3.0]])
    errors = ground_errors(-UP, to_ground, UP, AHEAD)
    assert errors.along_m[0] == pytest.approx(2.0, abs=1e-6)
    assert errors.across_m[0] == pytest.approx(3.0, abs=1e-6)  # right of the track: ahead x up = y x x = -z
    assert errors.rms_m == pytest.approx((2.0, 3.0), abs=1e-6)


def test_an_arcsecond_of_pitch_is_its_lever_on_the_ground():
    look = np.array([[-1.0, ARCSEC, 0.0]])
    errors = ground_errors(look, -530e3 * UP, UP, AHEAD)
    assert errors.along_m[0] == pytest.approx(530e3 * ARCSEC, rel=1e-9)


@pytest.mark.parametrize("wave_s", [(3.0, 3.1), (6.0, 7.0)])
def test_smoothed_attitude_follows_the_waves_and_is_better_than_one_exposure(wave_s):
    plan = StripPlan(
        strips=20,
        stars=60,
        targets=20,
        exposures=20,
        exposure_margin_s=1.0,
        wave_s=wave_s,
        wave_rad=(6e-5, 6e-5),
    )
    strips, truth = draw_strips(plan, CAMERAS, np.random.default_rng(4))
    off = []
    for strip, R_ci in zip(strips, truth.R_ci):
        R_si = smoothed_attitude(strip)
        off.append((R_si * R_ci.inv() * truth.R_cs).as_rotvec())
    rms = np.sqrt(np.mean(np.concatenate(off) ** 2, axis=0)) / ARCSEC
    single = 0.06 * 6.4e-5 / np.sqrt(60) / ARCSEC  # across the boresight, of one exposure
    assert np.all(rms[:2] < 0.85 * single)
    assert rms[2] < 0.85 * single / 0.11  # about it: stars lie within 0.11 rad rms of it
