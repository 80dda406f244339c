"""Fewer unknowns of a strip by itself give the estimate that all of them give."""

from collections.abc import Sequence
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from test_heads import R_A, SETTINGS, flown, three_heads

from boresight.calib import strips as strips_of
from boresight.calib.heads import aligned, carried, measured_alignment, unknown_heads
from boresight.calib.information import solve_total
from boresight.calib.joint_solution import Problem, linearised, solve_weighted
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import linearise, prepare_strips
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats

TURNED = deviation_from_theta(np.array([40.0, -25.0, 300.0]) * ARCSEC) * R_A


def both(
    strips: Sequence[StripSightings], settings: CalibrationSettings = SETTINGS
) -> tuple[Problem, list[tuple[Floats, int]]]:
    """The problem as it is solved; and, of each group of strips, all rows (S, R, n + N + 1) by the n unknowns
    of a strip, the N common ones and the residual, of unit variance: those of the targets, two each, then the
    prior of the own unknowns and what the heads tell of these; and n.
    """
    strips = aligned(strips, {head: measured_alignment(strips, head) for head in unknown_heads(strips)})
    prepared = prepare_strips([carried(strip) for strip in strips], settings)
    problem, told = Problem.of(prepared, settings), list[tuple[Floats, int]]()

    def none_eliminated(X: Floats, ties: Floats, n_phi: int) -> tuple[Floats, Floats, Floats]:
        told.append((ties, n_phi))
        heads = np.zeros((len(X), X.shape[2], ties.shape[2] - n_phi))
        return X, heads, heads[:, :0]

    with patch.object(strips_of, "condensed", none_eliminated):
        groups = strips_of.group_strips(prepared, problem.shared, settings)
    rows = []
    for group, (ties, n_phi) in zip(groups, told, strict=True):
        line = linearise(group, TURNED, settings)
        X = np.concatenate([line.X_q, line.along(np.eye(line.n_common)), line.r[:, :, None]], axis=2)
        (S, _, width), n = X.shape, line.X_q.shape[2]
        of_heads = np.zeros((S, ties.shape[1], width))
        of_heads[:, :, :n_phi] = ties[:, :, :n_phi]
        of_heads[:, :, n_phi - ties.shape[2] :] = ties[:, :, n_phi:]
        prior = np.broadcast_to(np.eye(n, width), (S, n, width))
        rows.append((np.concatenate([X, prior, of_heads], axis=1), n))
    return problem, rows


@pytest.mark.parametrize("heads", [1, 2, 3])
def test_estimate_and_residuals_are_those_with_all_unknowns(heads: int) -> None:
    problem, groups = both(three_heads(5) if heads == 3 else flown(4, heads))
    fewer = sum(group.shared_s.shape[3] for group in problem.groups)
    assert fewer < sum(n for _, n in groups) or heads == 3  # whose strips have few exposures
    rng = np.random.default_rng(8)
    weight = rng.random(len(problem.inside)) * (rng.random(len(problem.inside)) < 0.8)
    found = solve_weighted(problem, linearised(problem, TURNED), weight)
    steps, targets, first = [], [], 0
    for (rows, n), group in zip(groups, problem.groups):
        of_targets = rows[:, : 2 * group.inside.shape[1]]
        last = first + group.inside.size
        root = np.sqrt(np.repeat(weight[first:last].reshape(group.inside.shape), 2, axis=1))[:, :, None]
        first = last
        others = rows[:, of_targets.shape[1] :]
        R = np.linalg.qr(np.concatenate([root * of_targets, others], axis=1), mode="r")
        steps += [(one[:n, :n], one[:n, n:], one[n:, n:]) for one in R]
        targets += [(one, n) for one in of_targets]
    total = np.sum([left.T @ left for *_, left in steps], axis=0)
    limit = SETTINGS.sigma_observable_rad
    solution = solve_total(total[:-1, :-1], total[:-1, -1], problem.prior_shared, sigma_observable_rad=limit)
    x = np.append(solution.theta, solution.shared)
    whitened, leverage = [], []
    for (R, of_x, _), (rows, n) in zip(steps, targets):
        back = np.linalg.solve(R, of_x)  # of the own unknowns, the last column their best values
        after = rows[:, n:-1] - rows[:, :n] @ back[:, :-1]
        whitened.append(rows[:, -1] - rows[:, :n] @ back[:, -1] - after @ x)
        own = rows[:, :n] @ np.linalg.inv(R)
        fitted = own @ own.T + after @ solution.covariance_all @ after.T
        leverage += [fitted[k : k + 2, k : k + 2] for k in range(0, len(rows), 2)]
    scale = np.sqrt(np.diag(solution.covariance_all))
    apart = (found.solution.covariance_all - solution.covariance_all) / np.outer(scale, scale)
    assert np.abs(apart).max() < 1e-8  # of 1; rounding of normal equations
    # By rounding theta differs by 1e-10 to 1e-8 of its sigma, as kernel and draw happen to be (16 of them).
    np.testing.assert_allclose(found.solution.theta, solution.theta, rtol=0, atol=5e-8 * scale[:3].max())
    squares = sum(float(np.sum(rows[:, -1] ** 2)) for rows, _ in targets)  # 1e5 times what is left of them
    chi2 = total[-1, -1] - x @ total[:-1, -1] - problem.agreement.chi2
    np.testing.assert_allclose(found.chi2, chi2, rtol=0, atol=1e-13 * squares)
    left = np.concatenate(whitened)
    np.testing.assert_allclose(found.whitened.ravel(), left, rtol=0, atol=1e-7 * np.abs(left).max())
    np.testing.assert_allclose(found.leverage, leverage, rtol=0, atol=1e-8 * np.abs(leverage).max())


def test_points_a_hundred_times_as_sharp_as_the_attitudes_lose_no_digits() -> None:
    sharp = replace(SETTINGS, sigma_vibration_rad=0.0)
    drawn = flown(6, 2)
    sharper = [{"cov_c": s.ground.cov_c * 1e-4, "cov_target_i": 0.0 * s.ground.cov_target_i} for s in drawn]
    strips = [replace(s, ground=replace(s.ground, **errors)) for s, errors in zip(drawn, sharper)]
    problem, groups = both(strips, sharp)
    found = solve_weighted(problem, linearised(problem, TURNED), problem.inside.astype(float)).pairs.F
    parts, by_normal_equations = [], []
    for rows, n in groups:
        for one in rows:
            R, N = np.linalg.qr(one, mode="r")[n:, n:], one.T @ one
            parts.append((R.T @ R)[:-1, :-1])
            left = N[n:, n:] - N[n:, :n] @ np.linalg.inv(N[:n, :n]) @ N[:n, n:]
            by_normal_equations.append(left[:-1, :-1])
    expected = np.array(parts)
    scale = np.sqrt(np.einsum("sii->si", expected))
    apart, by_all = (
        np.abs((F - expected) / (scale[:, :, None] * scale[:, None, :])).max()
        for F in (found, np.array(by_normal_equations))
    )
    assert apart < 1e-6 < by_all  # of 1
