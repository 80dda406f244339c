"""Targets chosen for the smallest covariance, against the covariance of a calibration with these targets."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import strip_pairs
from boresight.calib.information import solve_total
from boresight.calib.settings import CalibrationSettings
from boresight.features.targets.target_choice import choose_targets
from boresight.pipeline.forecast.campaigns import settings_of_plan
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

R_CS = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
LOOSE = np.full(3, 1.0)  # rad: no information before the targets
PLAN = StripPlan(strips=2, targets=20, sigma_position_m=2.0, sigma_target_m=1.0, sigma_distortion_rad=3e-7)


@pytest.fixture(scope="module")
def strips():
    return draw_strips(PLAN, CameraPair(R_CS), np.random.default_rng(5))[0]


def settings() -> CalibrationSettings:
    return replace(settings_of_plan(PLAN), robust=False)


def only(strip, names):
    """The strip with some of its targets."""
    ground = strip.ground
    rows = np.flatnonzero(np.isin(ground.target_id, names))
    return replace(strip, ground=ground.take(rows), R_oi_targets=strip.R_oi_targets[rows])


def sigma_with(strips, names):
    """By the estimator's information of each strip, whose distortion is its own."""
    information = np.zeros((3, 3))
    for strip in [strip for strip in strips if np.isin(strip.ground.target_id, names).any()]:
        pairs, prior = strip_pairs([only(strip, names)], R_CS, settings())
        information += solve_total(*pairs.total(), prior, sigma_observable_rad=1.0).information
    return np.sqrt(np.diag(np.linalg.inv(information)))


def test_forecast_is_the_covariance_by_the_information_of_strips_with_the_chosen_targets(strips):
    ones = [np.ones(20)] * 2
    choice = choose_targets(strips, ones, R_CS, LOOSE, settings(), 8)
    assert len(set(choice.target_id)) == 8
    # 1e-7: rounding of normal equations, 3e-9 along the weak axis
    np.testing.assert_allclose(choice.sigma_rad[-1], sigma_with(strips, choice.target_id), rtol=1e-7)
    assert np.all(np.diff((choice.sigma_rad**2).sum(axis=1)) <= 0.0)


def test_choice_is_better_than_random_ones_of_the_same_number(strips):
    choice = choose_targets(strips, [np.ones(20)] * 2, R_CS, LOOSE, settings(), 6)
    names = np.concatenate([strip.ground.target_id for strip in strips])
    rng = np.random.default_rng(1)
    random = [sigma_with(strips, rng.choice(names, 6, replace=False))[2] for _ in range(15)]
    assert choice.sigma_rad[-1, 2] < 0.8 * np.median(random)


def test_targets_that_will_not_be_seen_are_not_chosen(strips):
    unseen = np.ones(20)
    unseen[::2] = 0.0
    choice = choose_targets(strips, [unseen, unseen], R_CS, LOOSE, settings(), 10)
    even = {name for strip in strips for name in strip.ground.target_id[::2]}
    assert even.isdisjoint(choice.target_id)
