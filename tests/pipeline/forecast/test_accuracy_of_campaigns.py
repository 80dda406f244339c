"""A plan's accuracy, told before any data, is what the data then give."""

from dataclasses import replace

import numpy as np
import pytest

from boresight.calib.calibration import calibrate_strips
from boresight.features.paper.vector_experiments import TABLE_1
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.forecast.accuracy import Forecast
from boresight.pipeline.forecast.campaigns import forecast_of_plan, settings_of_plan
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0)))


@pytest.mark.parametrize("pixel_rad", [0.0, CAMERAS.pixel_rad])
def test_forecast_is_the_covariance_that_the_calibration_states(pixel_rad):
    plan = replace(TABLE_1, distortion_pixel_rad=pixel_rad)
    found = forecast_of_plan(plan, CAMERAS, draws=60)
    rng, settings = np.random.default_rng(1), settings_of_plan(plan)
    drawn = [draw_strips(plan, CAMERAS, rng)[0] for _ in range(10)]
    stated = [np.diag(calibrate_strips(strips, CAMERAS.R_cs, settings).cov_theta) for strips in drawn]
    sigma = np.sqrt(np.mean(stated, axis=0))
    np.testing.assert_allclose(found.sigma(plan.strips), sigma, rtol=0.12)  # where targets fall: 96 of them


def test_strips_needed_is_the_least_number_that_reaches_the_target():
    found = forecast_of_plan(replace(TABLE_1, sigma_distortion_rad=0.0), CAMERAS, draws=30)
    target = 1.0 * ARCSEC
    n = found.strips_for(target)
    assert n is not None
    assert np.all(found.sigma(n) <= target) and not np.all(found.sigma(n - 1) <= target)
    np.testing.assert_array_equal(found.floor(), 0.0)


@pytest.mark.parametrize("needed", range(1, 41))
def test_strips_needed_for_independent_axes_are_the_largest_ratio_of_variances(needed):
    sigma_one = np.array([0.4, 1.7, 0.9]) * ARCSEC
    found = Forecast(np.diag(sigma_one**-2.0), np.zeros((0, 0)), sigma_observable_rad=1.0)
    # Between the 1-sigmas after `needed` and one strip fewer, sigma_one / sqrt(n), of the worst axis.
    assert found.strips_for(sigma_one[1] / np.sqrt(needed - 0.5)) == needed
    assert found.strips_for(sigma_one[1] / np.sqrt(needed - 0.01)) == needed


def test_what_the_strips_share_sets_a_floor_that_no_number_of_strips_breaks():
    found = forecast_of_plan(TABLE_1, CAMERAS, draws=30)
    assert found.floor()[2] > 0.3 * ARCSEC
    assert found.strips_for(0.1 * ARCSEC) is None
    # Angles that share an error: variance 1 / n + shared². Less than 0.1 % of one strip's sigma is none.
    shared = np.array([0.85e-3, 1.2e-3, 0.1])
    found = Forecast(np.kron(np.ones((2, 2)), np.eye(3)), np.diag(shared**-2.0), sigma_observable_rad=1e3)
    assert found.floor() == pytest.approx([0.0, *shared[1:]], rel=1e-3)  # of 1e9 strips


def test_targets_in_one_spot_give_no_number_about_the_line_of_sight():
    found = forecast_of_plan(replace(StripPlan(), across=(0.3, 0.3), along=(0.5, 0.5)), CAMERAS, draws=5)
    sigma = found.sigma(8)
    assert np.isnan(sigma[2])
    assert len(found.after(8).unobservable) == 1
    assert found.strips_for(ARCSEC) is None
