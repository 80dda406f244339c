"""Motion of the satellite between star exposures: what interpolation misses, and how much of it is shown."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_campaigns import BOLD, nees_of_estimate
from scipy.spatial.transform import Rotation

from boresight.calib import slow_motion
from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.calib.slow_motion import AT_REST, SlowMotion, missed_covariance, motion_is_shown, motion_of
from boresight.calib.strips import prepare_strips
from boresight.geometry.attitude import interpolation_weights
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import StripSightings
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

WITHOUT = CalibrationSettings(sigma_distortion_rad=0.0)
STATED = replace(WITHOUT, sigma_motion_rad=6.0 * ARCSEC, motion_time_s=0.8)
STILL = (0.0, 0.0)


def strips_of(exposures: int, seed: int = 1, **changes: object) -> list[StripSightings]:
    plan = StripPlan(strips=3, exposures=exposures, exposure_margin_s=0.3, **changes)  # type: ignore[arg-type]
    strips, _ = draw_strips(plan, CameraPair(BOLD), np.random.default_rng(seed))
    return with_attitudes(strips, WITHOUT.attitudes)


def test_what_interpolation_misses_scatters_as_stated() -> None:
    nodes, t = np.array([0.0, 0.7, 1.4, 2.1]), np.array([0.35, 0.9, 1.9])
    motion = SlowMotion(time_s=np.array([0.5, 1.0]), variance=np.array([4.0, 9.0]))
    weights, both = interpolation_weights(nodes, t), np.concatenate([nodes, t])
    covariance = motion.covariance(both, both)
    draws = np.random.default_rng(3).multivariate_normal(np.zeros(7), covariance, 40_000)
    missed = draws[:, 4:] - draws[:, :4] @ weights.T
    expected = missed_covariance(motion, t, nodes, weights)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(missed.T @ missed / 40_000 - expected).max() < 0.03 * scale.max()  # 4 standard errors
    assert missed_covariance(motion, nodes, nodes, np.eye(4)) == pytest.approx(np.zeros((4, 4)), abs=1e-12)


@pytest.mark.parametrize("arcsec", [1.0, 8.0, 60.0])
def test_exposures_show_how_far_the_satellite_moves(arcsec: float) -> None:
    # A wave of amplitude A has the rms 0.7 A. Of nine, a third of a period to a whole one is seen: the prior
    # about 6 arcsec still counts.
    strips = strips_of(7, wave_rad=(arcsec * ARCSEC, arcsec * ARCSEC))
    rms = np.sqrt(motion_of(strips, STATED).variance.sum()) / ARCSEC
    assert 0.3 * arcsec < rms < 3.0 * arcsec


def test_the_motion_is_the_mean_over_the_posterior_of_the_plain_normal_distribution() -> None:
    """Of rotations about all axes at once, constant and rate integrated out, for every noise, size and time;
    the errors of attitudes are lopsided and turned, another way in each strip.
    """
    rng, strips, C = np.random.default_rng(8), strips_of(7, wave_rad=(20.0 * ARCSEC, 30.0 * ARCSEC)), []
    for turn in Rotation.random(3, rng=rng).as_matrix():
        C.append(turn @ np.diag(np.square([2.0, 9.0, 30.0])) @ turn.T * ARCSEC**2)
    own = [np.broadcast_to(one, (7, 3, 3)) for one in C]
    strips = [replace(one, attitudes=replace(one.fitted, covariance_s=C_s)) for one, C_s in zip(strips, own)]
    noise, size, time = np.meshgrid(slow_motion.NOISES, slow_motion.AMPLITUDES, slow_motion.TIMES)
    logs = [np.log(part).ravel() for part in (size, time, noise)]
    posterior = sum(-0.5 * (part / spread) ** 2 for part, spread in zip(logs, slow_motion.SPREAD))
    amplitude, T = 6.0 * ARCSEC * size.ravel(), 0.8 * time.ravel()
    for strip, C_s in zip(strips, C):
        t = strip.times_s
        off = Rotation.from_matrix(strip.fitted.R_si) * strip.R_oi_exposures.inv()
        y = (off * off[3].inv()).as_rotvec().ravel() / ARCSEC
        X = np.kron(np.column_stack([np.ones(7), t]), np.eye(3))
        shape = np.exp(-0.5 * np.subtract.outer(t, t) ** 2 / T[:, None, None] ** 2)
        V = np.kron(np.eye(7), C_s) * noise.ravel()[:, None, None] ** 2
        V = (V + np.kron(shape, np.eye(3)) * amplitude[:, None, None] ** 2) / ARCSEC**2
        of_trend = X.T @ np.linalg.solve(V, np.broadcast_to(X, (len(V), *X.shape)))
        of_y = np.linalg.solve(V, np.broadcast_to(y[:, None], (len(V), 21, 1)))
        left = y - (X @ np.linalg.solve(of_trend, X.T @ of_y))[:, :, 0]
        square = np.einsum("nk,nk->n", left, np.linalg.solve(V, left[:, :, None])[:, :, 0])
        posterior -= 0.5 * (np.linalg.slogdet(V)[1] + np.linalg.slogdet(of_trend)[1] + square)
    weight = np.exp(posterior - posterior.max()) * amplitude**2 / np.exp(posterior - posterior.max()).sum()
    expected = [weight[T == one].sum() for one in 0.8 * slow_motion.TIMES]
    found = motion_of(strips, STATED)
    np.testing.assert_allclose(found.time_s, 0.8 * slow_motion.TIMES, rtol=1e-12)
    np.testing.assert_allclose(found.variance, expected, rtol=1e-6)


def test_attitudes_with_understated_noise_are_not_taken_for_motion() -> None:
    strips = strips_of(7, wave_rad=STILL, sigma_s_px=0.5)
    sure = [
        replace(strip, attitudes=replace(strip.attitudes, covariance_s=1e-3 * strip.attitudes.covariance_s))
        for strip in strips
        if strip.attitudes is not None
    ]
    noise = np.sqrt(np.median([strip.attitudes.covariance_s[:, 0, 0] for strip in strips if strip.attitudes]))
    assert np.sqrt(motion_of(sure, STATED).variance.sum()) < 3.0 * noise


def test_two_exposures_show_nothing_and_the_stated_motion_holds() -> None:
    two, three = strips_of(2), strips_of(3)
    assert not motion_is_shown(two) and motion_is_shown(three)
    motion = motion_of(two, STATED)
    assert np.sqrt(motion.variance.sum()) == pytest.approx(6.0 * ARCSEC, rel=1e-12)
    assert np.average(np.log(motion.time_s), weights=motion.variance) == pytest.approx(np.log(0.8), abs=1e-9)
    assert motion_of(two, WITHOUT) is AT_REST


def test_many_exposures_leave_no_motion_unknown() -> None:
    few = [replace(strip, strip_id=f"few {n}") for n, strip in enumerate(strips_of(7))]
    for strips in (strips_of(8), [*strips_of(8), *few]):
        for strip in prepare_strips(strips, STATED):
            assert (strip.attitude_s.shape[2] > strip.n_phi) == strip.strip_id.startswith("few")


def test_with_two_exposures_the_covariance_holds_the_motion() -> None:
    nees: dict[float, list[float]] = {0.0: [], STATED.sigma_motion_rad: []}
    for seed in range(5):
        strips = strips_of(2, seed)
        for sigma, found in nees.items():
            one = calibrate_strips(strips, BOLD, replace(STATED, sigma_motion_rad=sigma))
            assert isinstance(one, InstallationEstimate)
            found.append(nees_of_estimate(one))
    without, stated = (np.mean(found) for found in nees.values())
    assert without > 20.0 and stated < 6.9  # 99.9 % of the mean of five chi-squares of three
