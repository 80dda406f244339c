"""Fewer unknowns of a strip by itself give the estimate that all of them give."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from test_heads import R_A, SETTINGS, flown, three_heads

from boresight.calib.heads import aligned, carried, measured_alignment, unknown_heads
from boresight.calib.joint_solution import Problem, linearised, solve_weighted
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import LinearStrips, group_strips, linearise, prepare_strips
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.sightings import StripSightings

TURNED = deviation_from_theta(np.array([40.0, -25.0, 300.0]) * ARCSEC) * R_A


def both(
    strips: Sequence[StripSightings], settings: CalibrationSettings = SETTINGS
) -> tuple[Problem, Problem]:
    """The problem as it is solved, and with all unknowns of its strips."""
    strips = aligned(strips, {head: measured_alignment(strips, head) for head in unknown_heads(strips)})
    prepared = prepare_strips([carried(strip) for strip in strips], settings)
    problem = Problem.of(prepared, settings)
    return problem, replace(problem, groups=group_strips(prepared, problem.shared, settings))


@pytest.mark.parametrize("heads", [1, 2, 3])
def test_estimate_and_residuals_are_those_with_all_unknowns(heads: int) -> None:
    fewer, plain = both(three_heads(5) if heads == 3 else flown(4, heads))
    n = [sum(group.shared_s.shape[3] for group in problem.groups) for problem in (fewer, plain)]
    assert n[0] < n[1] or heads == 3  # whose strips have few exposures
    rng = np.random.default_rng(8)
    weight = rng.random(len(plain.inside)) * (rng.random(len(plain.inside)) < 0.8)
    about = [linearised(one, TURNED) for one in (fewer, plain)]
    a, b = (solve_weighted(one, line, weight) for one, line in zip((fewer, plain), about))
    scale = np.sqrt(np.diag(b.solution.covariance_all))
    apart = (a.solution.covariance_all - b.solution.covariance_all) / np.outer(scale, scale)
    assert np.abs(apart).max() < 1e-8  # of 1; rounding of normal equations
    # By rounding theta differs by 1e-10 to 1e-8 of its sigma, as kernel and draw happen to be (16 of them).
    np.testing.assert_allclose(a.solution.theta, b.solution.theta, rtol=0, atol=5e-8 * scale[:3].max())
    squares = sum(float(np.sum(line.r**2)) for line in about[1].strips)  # 1e5 times what is left of them
    np.testing.assert_allclose(a.chi2, b.chi2, rtol=0, atol=1e-13 * squares)
    np.testing.assert_allclose(a.whitened, b.whitened, rtol=0, atol=1e-7 * np.abs(b.whitened).max())
    np.testing.assert_allclose(a.leverage, b.leverage, rtol=0, atol=1e-8 * np.abs(b.leverage).max())


def by_orthogonal_steps(line: LinearStrips) -> np.ndarray:
    """Normal matrices (S, n + 1, n + 1) of theta, shared unknowns and residual, all targets in the fit: the
    own unknowns eliminated by the QR of all rows, their prior first.
    """
    of_targets = np.concatenate([line.X_q, line.along(np.eye(line.n_common)), line.r[:, :, None]], axis=2)
    of_heads = np.concatenate([line.tie_q, line.tie_common, line.tie_r[:, :, None]], axis=2)
    S, n = len(line.r), line.X_q.shape[2]
    prior = np.broadcast_to(np.eye(n, of_targets.shape[2]), (S, n, of_targets.shape[2]))
    R = np.linalg.qr(np.concatenate([prior, of_targets, of_heads], axis=1), mode="r")[:, n:, n:]
    return np.asarray(np.swapaxes(R, 1, 2) @ R)


def test_points_a_hundred_times_as_sharp_as_the_attitudes_lose_no_digits() -> None:
    sharp = replace(SETTINGS, sigma_vibration_rad=0.0)
    strips = [
        replace(
            strip,
            ground=replace(
                strip.ground,
                cov_c=strip.ground.cov_c * 1e-4,
                cov_target_i=np.zeros_like(strip.ground.cov_target_i),
            ),
        )
        for strip in flown(6, 2)
    ]
    fewer, plain = both(strips, sharp)
    steps = [solve_weighted(one, linearised(one, TURNED), one.inside.astype(float)) for one in (fewer, plain)]
    parts = [by_orthogonal_steps(linearise(group, TURNED, sharp)) for group in plain.groups]
    expected = np.concatenate(parts)[:, :-1, :-1]
    scale = np.sqrt(np.einsum("sii->si", expected))
    apart, by_all = (
        np.abs((one.pairs.F - expected) / (scale[:, :, None] * scale[:, None, :])).max() for one in steps
    )
    assert apart < 1e-6 < by_all  # of 1
