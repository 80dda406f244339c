"""All strips together: one linear solution for theta, with every strip's own unknowns eliminated and put
back.

What `strips` says of one strip is added here, exactly, and solved; every target then gets its residual with
that residual's own variance, by which a gross error is told from noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.estimate import Iteration
from boresight.calib.information import InformationPairs, Solution, solve_total
from boresight.calib.settings import CalibrationSettings
from boresight.calib.shared_unknowns import SharedUnknowns, find_shared
from boresight.calib.strips import LinearStrips, PreparedStrip, StripGroup, group_strips, linearise

__all__ = [
    "Problem",
    "Step",
    "iteration_record",
    "linear_solution",
    "normalised_residuals",
    "residuals_about",
]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All strips in groups of equal shape. Targets of all groups stand one after another: group, strip,
    target.
    """

    groups: list[StripGroup]
    names: NDArray[np.str_]  # (S,) strip ids, group after group
    shared: SharedUnknowns
    prior_shared: Array
    inside: NDArray[np.bool_]  # (J,)
    settings: CalibrationSettings

    @classmethod
    def of(cls, prepared: list[PreparedStrip], settings: CalibrationSettings) -> Problem:
        shared = find_shared([strip.seen() for strip in prepared if strip.inside.any()], settings)
        groups = group_strips(prepared, shared, settings)
        none = np.zeros(0, dtype=bool)
        inside = np.concatenate([none, *(group.inside.ravel() for group in groups)])
        names = np.concatenate([[prepared[n].strip_id for n in group.place] for group in groups] or [[]])
        return cls(groups, names.astype(str), shared, shared.prior_information(), inside, settings)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One linear solution about `R_cs`, all weights given."""

    R_cs: Rotation
    pairs: InformationPairs
    solution: Solution
    chi2: float
    whitened: Array  # (J, 2) residuals after all unknowns were taken out
    variance: Array  # (J, 2, 2) of `whitened` of a good target: I - leverage, or I + it if left out
    residual_c: Array  # (J, 2) rad, along x and y of frame c
    share: Array  # (J, 2, 2) the placing's part of the whitened noise

    @property
    def sigma(self) -> Array:
        return np.sqrt(np.diag(self.solution.covariance))


def linear_solution(problem: Problem, R_cs: Rotation, weight: Array, scale_c: float) -> Step:
    """Reduce every strip, add, solve, and put the solution back into every strip."""
    lines, reduced, at = [], [], 0
    for group in problem.groups:
        line = linearise(group, R_cs, problem.settings, scale_c)
        J = group.inside.size
        reduced.append(_reduced(line, weight[at : at + J].reshape(group.inside.shape)))
        lines.append(line)
        at += J
    N = np.concatenate([part.N for part in reduced])
    pairs = InformationPairs(problem.names, N[:, :-1, :-1], N[:, :-1, -1], R_cs, problem.shared.names)
    total = pairs.total()
    solution = solve_total(
        total.F,
        total.F_theta,
        problem.prior_shared,
        sigma_observable_rad=problem.settings.sigma_observable_rad,
    )
    x = np.concatenate([solution.theta, solution.shared])
    fitted = [_fitted(line, part, x, solution.covariance_all) for line, part in zip(lines, reduced)]
    whitened, variance, along = (np.concatenate(part) for part in zip(*fitted))
    used = (weight > 0.0)[:, None, None]
    variance = np.where(used, np.eye(2) - variance, np.eye(2) + variance)
    share = np.concatenate([line.share.reshape(-1, 2, 2) for line in lines])
    chi2_sum = float(np.sum(N[:, -1, -1]) - x @ total.F_theta)
    return Step(R_cs, pairs, solution, chi2_sum, whitened, variance, along, share)


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """A group with its strips' own unknowns eliminated."""

    N: Array  # (S, n + 1, n + 1) normal matrix of theta, the shared unknowns and, last, the residual
    back: Array  # (S, n_q, n + 1) what each of those puts into the strip's own unknowns
    cov_q: Array  # (S, n_q, n_q) of the strip's own unknowns, the others given


def _reduced(line: LinearStrips, weight: Array) -> _Reduced:
    root: Array = np.repeat(np.sqrt(weight), 2, axis=1)[:, :, None]
    X_q = root * line.X_q
    Y = root * np.concatenate([line.X_theta, line.X_shared, line.r[:, :, None]], axis=2)
    X_qT = np.swapaxes(X_q, 1, 2)
    cov_q = np.asarray(np.linalg.inv(np.eye(X_q.shape[2]) + X_qT @ X_q), dtype=np.float64)
    G = X_qT @ Y
    back = cov_q @ G
    N = np.swapaxes(Y, 1, 2) @ Y - np.swapaxes(G, 1, 2) @ back
    return _Reduced(np.asarray(0.5 * (N + np.swapaxes(N, 1, 2))), back, cov_q)


def _fitted(line: LinearStrips, part: _Reduced, x: Array, cov_x: Array) -> tuple[Array, Array, Array]:
    """Residuals (J, 2) after all unknowns, their leverage (J, 2, 2), and the residuals in rad along x and
    y of c.
    """
    S, rows, _ = line.X_theta.shape
    X = np.concatenate([line.X_theta, line.X_shared], axis=2)
    q = part.back[:, :, -1] - part.back[:, :, :-1] @ x
    e = line.r - X @ x - (line.X_q @ q[:, :, None])[:, :, 0]
    Z = X - line.X_q @ part.back[:, :, :-1]
    J = S * rows // 2

    def blocks(left: Array, middle: Array) -> Array:
        root = left.reshape(S, rows // 2, 2, -1)
        return ((root @ middle) @ np.swapaxes(root, 2, 3)).reshape(J, 2, 2)

    leverage = blocks(line.X_q, part.cov_q[:, None]) + blocks(Z, cov_x)
    along = np.linalg.solve(line.whitener.reshape(-1, 2, 2), e.reshape(-1, 2, 1))[:, :, 0]
    return e.reshape(J, 2), leverage, np.asarray(along, dtype=np.float64)


def normalised_residuals(step: Step) -> Array:
    """Squared residual over its variance (J,). A residual that nothing checks gives zero."""
    v = step.variance
    det = v[:, 0, 0] * v[:, 1, 1] - v[:, 0, 1] ** 2
    e = step.whitened
    inside = v[:, 1, 1] * e[:, 0] ** 2 - 2.0 * v[:, 0, 1] * e[:, 0] * e[:, 1] + v[:, 0, 0] * e[:, 1] ** 2
    return np.divide(inside, det, out=np.zeros(len(det)), where=det > 1e-9)


def residuals_about(problem: Problem, R_cs: Rotation, scale_c: float) -> Array:
    lines = [linearise(group, R_cs, problem.settings, scale_c) for group in problem.groups]
    return np.concatenate([line.r.reshape(-1, 2) for line in lines])


def iteration_record(step: Step, weight: Array) -> Iteration:
    return Iteration(step.solution.theta, step.sigma, step.chi2, float(np.sum(weight)))
