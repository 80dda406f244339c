"""Months of simulated strips of one camera with one distortion: one unknown for all of them, and no drift."""

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs
from boresight.calib.settings import CalibrationSettings
from boresight.features.drift.matrix_drift import DriftSettings, MountingSeries, estimate_drift
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

BOLD = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
SETTINGS = CalibrationSettings(robust=False)  # the same targets in months and in all
MONTHS, STRIPS = 6, 4
PLAN = StripPlan(
    strips=MONTHS * STRIPS,
    sigma_position_m=2.0,
    sigma_clock_s=1e-4,
    sigma_vibration_rad=0.1 * ARCSEC,
    sigma_distortion_rad=3e-7,
)


DATES = 30 * DAY_S * np.arange(MONTHS)


def series_of(months):
    """A calibration each month, then the series of what they say."""
    found = [calibrate_strips(strips, BOLD, SETTINGS) for strips in months]
    none = np.zeros((0, 0))
    pairs = reduce(
        InformationPairs.merged, [one.pairs.as_one(f"m{k}", (), none) for k, one in enumerate(found)]
    )
    return MountingSeries.of(pairs, prior_information(pairs.shared), DATES)


def series_taken_as_independent(months):
    """The same from each month's own matrix and covariance."""
    found = [calibrate_strips(strips, BOLD, SETTINGS) for strips in months]
    F = np.linalg.inv(np.array([one.cov_theta for one in found]))
    right = np.einsum("kij,kj->ki", F, [one.theta for one in found])
    pairs = InformationPairs(np.array([f"m{k}" for k in range(MONTHS)]), F, right, BOLD)
    return MountingSeries.of(pairs, np.zeros((0, 0)), DATES)


@pytest.fixture(scope="module")
def strips():
    return draw_strips(PLAN, CameraPair(BOLD), np.random.default_rng(31))[0]


def in_months(strips):
    return [strips[STRIPS * k : STRIPS * (k + 1)] for k in range(MONTHS)]


def test_months_merge_to_the_calibration_of_all_their_strips(strips):
    whole = calibrate_strips(strips, BOLD, SETTINGS)
    merged = series_of(in_months(strips)).merged()
    # Months are linearised about matrices of their own, some arcseconds away: second order, 4e-5 of sigma and
    # 3e-4 of the covariance here.
    assert np.all(np.abs(theta_between(merged.R_cs, whole.R_cs)) < 1e-3 * whole.sigma_theta)
    assert_allclose(merged.covariance, whole.cov_theta, rtol=0, atol=2e-3 * np.diag(whole.cov_theta).min())


def test_averaging_months_as_independent_makes_the_covariance_too_small(strips):
    shared = series_of(in_months(strips)).merged().covariance
    averaged = series_taken_as_independent(in_months(strips)).merged().covariance
    assert np.linalg.eigvalsh(shared - averaged)[0] > -1e-3 * np.linalg.eigvalsh(averaged)[0]
    # The rotation about Z depends on the distortion: 24 strips are near its floor; months do not lower it.
    assert shared[2, 2] > 2.0 * averaged[2, 2]


def remounted(strips, R_before, R_after):
    """Strips as seen by a star camera with the mounting `R_after` instead of `R_before`."""
    turn = R_after.inv() * R_before
    T = turn.as_matrix()

    def seen(exposure):
        return replace(exposure, u_s=turn.apply(exposure.u_s), cov_s=T @ exposure.cov_s @ T.T)

    return [replace(strip, exposures=tuple(map(seen, strip.exposures))) for strip in strips]


def test_what_is_shared_hides_no_step(strips):
    # 14" about Z, where each month's own 1 sigma is 4", most of it shared by all: 6 sigma of what is not.
    after = deviation_from_theta(np.array([0.0, 0.0, 14.0]) * ARCSEC) * BOLD
    months = in_months(strips)
    moved = months[:3] + [remounted(month, BOLD, after) for month in months[3:]]
    settings = DriftSettings(density_rad2_s=0.0)
    assert not estimate_drift(series_of(months), settings).moved
    drift = estimate_drift(series_of(moved), settings)
    assert drift.moved and (drift.step.after, drift.step.before) == ("m2", "m3")
    sigma = np.sqrt(np.diag(drift.step.covariance))
    assert np.all(np.abs(drift.step.theta_step - [0.0, 0.0, 14.0 * ARCSEC]) < 4.0 * sigma)
    alone = estimate_drift(series_taken_as_independent(moved), settings)
    assert drift.step.p_value < 0.01 * alone.step.p_value


def test_shared_unknowns_are_eliminated_as_the_whole_normal_matrix_says():
    # Against the dense inverse of all unknowns together: K times theta, then what is shared.
    rng, K, n = np.random.default_rng(32), 4, 5
    root = rng.normal(size=(K, 3 + n, 12)) * 1e6
    F, F_theta = root @ np.swapaxes(root, 1, 2), rng.normal(size=(K, 3 + n)) * 1e4
    prior = 1e12 * np.eye(n)
    pairs = InformationPairs(np.array(list("abcd")), F, F_theta, BOLD, tuple("vwxyz"))
    series = MountingSeries.of(pairs, prior, np.arange(4.0))
    whole = block_diag(*F[:, :3, :3], prior + F[:, 3:, 3:].sum(axis=0))
    whole[: 3 * K, 3 * K :] = F[:, :3, 3:].reshape(3 * K, n)
    whole[3 * K :, : 3 * K] = whole[: 3 * K, 3 * K :].T
    covariance = np.linalg.inv(whole)
    theta = covariance[: 3 * K] @ np.concatenate([F_theta[:, :3].ravel(), F_theta[:, 3:].sum(axis=0)])
    assert_allclose(series.theta.ravel(), theta, rtol=1e-9)
    assert_allclose(np.linalg.inv(series.information), covariance[: 3 * K, : 3 * K], rtol=1e-8)
