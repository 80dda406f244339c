"""The calibration: strips of sightings to the installation matrix (docs/estimation.md, section 3).

Gauss-Newton on theta about the matrix of the last step until M is the unit matrix (paper, end of section
2.3), all else that is unknown being eliminated strip by strip. Gross errors are looked for only where the
plain fit shows them: a sum of absolute residuals finds the matrix that most targets share, weights that
fall to zero bring it to the noise, and then each target is kept or left out for good by a chi-square test
of its own residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calib.attitudes import GROSS, cross_matrices
from calib.estimate import (
    InstallationEstimate,
    Iteration,
    NoiseScale,
    NotObservable,
    Rejected,
    TargetResiduals,
)
from calib.information import InformationPairs, Solution, solve_total
from calib.rejection import left_out
from calib.settings import CalibrationSettings
from calib.shared_unknowns import SharedUnknowns, find_shared
from calib.strips import LinearStrips, PreparedStrip, StripGroup, group_strips, linearise, prepare_strip
from geometry.installation import deviation_from_theta, theta_between
from geometry.sightings import StripSightings

__all__ = ["calibrate", "strip_pairs"]

Array = NDArray[np.float64]


def calibrate(
    strips: Sequence[StripSightings], R_cs0: Rotation, settings: CalibrationSettings
) -> InstallationEstimate | NotObservable:
    """The installation matrix from strips, starting from `R_cs0`, with a covariance that holds.

    The result is the same, bit for bit, for any order of the strips. Raises `ValueError` when two strips
    share one id.
    """
    strips = sorted(strips, key=lambda strip: strip.strip_id)
    ids = [strip.strip_id for strip in strips]
    if len(set(ids)) != len(ids):
        twice = next(a for a, b in pairwise(ids) if a == b)
        raise ValueError(f"two strips have the id {twice!r}")
    scale_s, prepared = _prepared(strips, settings)
    problem = _Problem.of(prepared, settings)
    if not problem.groups:
        reason = f"{len(strips)} strips, none with a target between usable star exposures"
        none = np.zeros((0, 3))
        return NotObservable(reason, np.eye(3), none, none[:, 0], none[:, 0], left_out(strips, prepared))
    fit = _solve(problem, R_cs0)
    residuals = _residuals(prepared, problem, fit)
    rejected = left_out(strips, prepared, residuals)
    R_cs = deviation_from_theta(fit.step.solution.theta) * fit.step.R_cs
    if len(fit.step.solution.unobservable):
        return _not_observable(fit.step.solution, theta_between(R_cs, R_cs0), rejected, settings)
    return _estimate(prepared, problem, fit, (R_cs, R_cs0), residuals, rejected, scale_s)


def strip_pairs(
    strips: Sequence[StripSightings], R_cs: Rotation, settings: CalibrationSettings
) -> tuple[InformationPairs, Array]:
    """One information pair a strip about `R_cs`, no strip or target left out but those that exposures do
    not cover, and the prior information of the unknowns that the strips share.
    """
    problem = _Problem.of([prepare_strip(strip, settings) for strip in strips], settings)
    if not problem.groups:
        raise ValueError(f"{len(strips)} strips, none with a target between usable star exposures")
    return _linear_solution(problem, R_cs, problem.inside.astype(float), 1.0).pairs, problem.prior_shared


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
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
    def of(cls, prepared: list[PreparedStrip], settings: CalibrationSettings) -> _Problem:
        shared = find_shared([strip.seen() for strip in prepared if strip.inside.any()], settings)
        groups = group_strips(prepared, shared, settings)
        none = np.zeros(0, dtype=bool)
        inside = np.concatenate([none, *(group.inside.ravel() for group in groups)])
        names = np.concatenate([[prepared[n].strip_id for n in group.place] for group in groups] or [[]])
        return cls(groups, names.astype(str), shared, shared.prior_information(), inside, settings)


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
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


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    step: _Step
    iterations: list[Iteration]
    kept: NDArray[np.bool_]  # (J,)
    normalised: Array  # (J,)
    scale_c: float
    scale_c_sigma: float


def _prepared(
    strips: Sequence[StripSightings], settings: CalibrationSettings
) -> tuple[tuple[float, float], list[PreparedStrip]]:
    """Strips prepared, and the scale of the stars' sigma with its own 1-sigma (1 and 0 unless asked for)."""
    prepared = [prepare_strip(strip, settings) for strip in strips]
    scale, sigma = 1.0, 0.0
    if not settings.estimate_noise or not strips:
        return (scale, sigma), prepared
    normalised = np.concatenate([strip.attitudes.normalised for strip in prepared])
    scale = float(np.sqrt(np.median(normalised) / chi2.median(2)))  # robust start
    for _ in range(4):
        prepared = [prepare_strip(strip, settings, scale) for strip in strips]
        total = float(sum(strip.attitudes.chi2[strip.used].sum() for strip in prepared))
        dof = int(sum(strip.attitudes.dof[strip.used].sum() for strip in prepared))
        scale *= float(np.sqrt(total / (dof * _trimmed_mean(settings))))
        sigma = scale / np.sqrt(2.0 * dof)
    return (scale, sigma), prepared


def _solve(problem: _Problem, R_cs0: Rotation) -> _Fit:
    settings = problem.settings
    iterations: list[Iteration] = []
    limit = float(chi2.isf(settings.probability_false_alarm, 2))
    kept, scale = problem.inside, (1.0, 0.0)
    step = _iterated(problem, R_cs0, kept, iterations, 1.0)
    for _ in range(5 if settings.estimate_noise else 1):
        if settings.robust and np.any(_normalised(step)[problem.inside] > limit):
            R_cs, kept = step.R_cs, problem.inside & (_normalised(step) <= limit)
            if np.any(_normalised(step)[problem.inside] > GROSS):
                R_cs = _most_shared(problem, R_cs0)
                R_cs, weight = _down_to_the_noise(problem, R_cs, iterations, scale[0])
                kept = weight > 0.25
            for _ in range(settings.most_iterations):
                step = _linear_solution(problem, R_cs, kept.astype(float), scale[0])
                iterations.append(_record(step, kept.astype(float)))
                before, kept = kept, problem.inside & (_normalised(step) <= limit)
                R_cs = deviation_from_theta(step.solution.theta) * R_cs
                if np.array_equal(before, kept):
                    break
        step = _iterated(problem, step.R_cs, kept, iterations, scale[0])
        if settings.estimate_noise:
            scale = _noise_scale(step, kept, scale[0], settings)
            step = _iterated(problem, step.R_cs, kept, iterations, scale[0])
    return _Fit(step, iterations, kept, _normalised(step), *scale)


def _iterated(
    problem: _Problem, R_cs: Rotation, kept: NDArray[np.bool_], iterations: list[Iteration], scale_c: float
) -> _Step:
    """Gauss-Newton to M = I with given weights."""
    settings = problem.settings
    for _ in range(settings.most_iterations):
        step = _linear_solution(problem, R_cs, kept.astype(float), scale_c)
        iterations.append(_record(step, kept.astype(float)))
        if np.linalg.norm(step.solution.theta) <= settings.tolerance_rad:
            break
        R_cs = deviation_from_theta(step.solution.theta) * R_cs
    return step


def _linear_solution(problem: _Problem, R_cs: Rotation, weight: Array, scale_c: float) -> _Step:
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
    return _Step(R_cs, pairs, solution, chi2_sum, whitened, variance, along, share)


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


def _normalised(step: _Step) -> Array:
    """Squared residual over its variance (J,). A residual that nothing checks gives zero."""
    v = step.variance
    det = v[:, 0, 0] * v[:, 1, 1] - v[:, 0, 1] ** 2
    e = step.whitened
    inside = v[:, 1, 1] * e[:, 0] ** 2 - 2.0 * v[:, 0, 1] * e[:, 0] * e[:, 1] + v[:, 0, 0] * e[:, 1] ** 2
    return np.divide(inside, det, out=np.zeros(len(det)), where=det > 1e-9)


def _most_shared(problem: _Problem, R_cs: Rotation) -> Rotation:
    """The matrix with the least sum of absolute residuals: what most targets share, whatever the others
    say.
    """
    u_c = np.concatenate([group.u_c[group.inside] for group in problem.groups])
    v_s = np.concatenate([group.v_s[group.inside] for group in problem.groups])
    for _ in range(50):
        w = R_cs.apply(v_s)
        difference = u_c - w
        weight = 1.0 / np.maximum(
            np.linalg.norm(difference, axis=1), 1e-6
        )  # 0.2 arcsec: below this all is equal
        turn = cross_matrices(w)
        N = np.einsum("n,nia,nib->ab", weight, turn, turn)
        right = np.einsum("n,nia,ni->a", weight, turn, difference)
        values, vectors = np.linalg.eigh(N)
        known = values > 1e-10 * values[-1]
        theta = (vectors[:, known] / values[known]) @ (vectors[:, known].T @ right)
        R_cs = deviation_from_theta(theta) * R_cs
        if np.linalg.norm(theta) < 1e-9:
            break
    return R_cs


def _down_to_the_noise(
    problem: _Problem, R_cs: Rotation, iterations: list[Iteration], scale_c: float
) -> tuple[Rotation, Array]:
    """Geman and McClure's weights with a limit that halves until it is three sigma."""
    weight = problem.inside.astype(float)
    limit = np.inf
    for _ in range(40):
        step = _linear_solution(problem, R_cs, weight, scale_c)
        if np.isinf(limit):  # nothing may move yet: residuals about the starting matrix
            distance = np.linalg.norm(_residuals_about(problem, R_cs, scale_c), axis=1)
            limit = max(3.0, 3.0 * float(np.median(distance[problem.inside])))
        else:
            iterations.append(_record(step, weight))
            R_cs = deviation_from_theta(step.solution.theta) * R_cs
            distance = np.linalg.norm(step.whitened, axis=1)
            limit = max(3.0, 0.5 * limit)
        before = weight
        weight = problem.inside * (1.0 + (distance / limit) ** 2) ** -2.0
        if limit == 3.0 and np.max(np.abs(weight - before)) < 1e-2:
            break
    return R_cs, weight


def _residuals_about(problem: _Problem, R_cs: Rotation, scale_c: float) -> Array:
    lines = [linearise(group, R_cs, problem.settings, scale_c) for group in problem.groups]
    return np.concatenate([line.r.reshape(-1, 2) for line in lines])


def _noise_scale(
    step: _Step, kept: NDArray[np.bool_], scale: float, settings: CalibrationSettings
) -> tuple[float, float]:
    """Scale of the placings' sigma by restricted maximum likelihood, one step, and its 1-sigma."""
    share = scale**2 * step.share[kept]
    e = step.whitened[kept]
    found = np.einsum("na,nab,nb->", e, share, e)
    expected = np.einsum("nab,nba->", step.variance[kept], share) * _trimmed_mean(settings)
    product = step.variance[kept] @ share
    information = 0.5 * np.einsum("nab,nba->", product, product)
    new = scale * float(np.sqrt(found / expected))
    return new, new * 0.5 / float(np.sqrt(information))


def _trimmed_mean(settings: CalibrationSettings) -> float:
    """Mean of a chi-square of two degrees of freedom, over 2, when its tail is left out."""
    p = settings.probability_false_alarm
    return 1.0 + p * np.log(p) / (1.0 - p) if settings.robust else 1.0


def _record(step: _Step, weight: Array) -> Iteration:
    return Iteration(step.solution.theta, step.sigma, step.chi2, float(np.sum(weight)))


def _residuals(prepared: list[PreparedStrip], problem: _Problem, fit: _Fit) -> TargetResiduals:
    """All targets of all strips in order of strip; those of strips in no group have no residual."""
    start = np.concatenate([[0], np.cumsum([len(strip.target_id) for strip in prepared])]).astype(np.int64)
    n = int(start[-1])
    kept, normalised, residual = np.zeros(n, dtype=bool), np.full(n, np.nan), np.full((n, 2), np.nan)
    place = [np.arange(start[s], start[s + 1]) for group in problem.groups for s in group.place]
    rows = np.concatenate(place)
    kept[rows], normalised[rows], residual[rows] = fit.kept, fit.normalised, fit.step.residual_c
    outside = rows[~problem.inside]
    normalised[outside], residual[outside] = np.nan, np.nan
    return TargetResiduals(
        np.repeat([strip.strip_id for strip in prepared], np.diff(start)),
        np.concatenate([strip.target_id for strip in prepared]),
        np.concatenate([strip.ccd for strip in prepared]),
        np.concatenate([strip.sample for strip in prepared]),
        residual,
        normalised,
        kept,
    )


def _not_observable(
    solution: Solution, theta: Array, rejected: tuple[Rejected, ...], settings: CalibrationSettings
) -> NotObservable:
    unseen = solution.unobservable
    values, vectors = np.linalg.eigh(solution.covariance)
    seen = vectors.T[len(unseen) :]
    limit = settings.sigma_observable_rad
    text = ", ".join(f"[{d[0]:+.3f} {d[1]:+.3f} {d[2]:+.3f}]" for d in unseen)
    reason = (
        f"the turn about {text} (frame c) is not observable: its 1-sigma would exceed {limit:.3g} rad; "
        f"targets spread wider over the field, or a star camera that looks another way, would show it"
    )
    sigma = np.sqrt(np.maximum(values[len(unseen) :], 0.0))
    return NotObservable(reason, unseen, seen, seen @ theta, sigma, rejected)


def _estimate(
    prepared: list[PreparedStrip],
    problem: _Problem,
    fit: _Fit,
    matrices: tuple[Rotation, Rotation],
    residuals: TargetResiduals,
    rejected: tuple[Rejected, ...],
    scale_s: tuple[float, float],
) -> InstallationEstimate:
    (R_cs, R_cs0), step, settings = matrices, fit.step, problem.settings
    carrying = [strip for strip in prepared if strip.inside.any()]
    exposures = [(strip.attitudes, strip.used) for strip in carrying]
    n_kept = int(fit.kept.sum())
    dof_stars = int(sum(attitudes.dof[used].sum() for attitudes, used in exposures))
    return InstallationEstimate(
        R_cs=R_cs,
        R_cs0=R_cs0,
        theta=theta_between(R_cs, R_cs0),
        cov_theta=step.solution.covariance,
        chi2=step.chi2,
        dof=2 * n_kept - 3,
        chi2_stars=float(sum(attitudes.chi2[used].sum() for attitudes, used in exposures)),
        dof_stars=dof_stars,
        n_strips=len(carrying),
        n_exposures=int(sum(used.sum() for _, used in exposures)),
        n_stars=(dof_stars + 3 * int(sum(used.sum() for _, used in exposures))) // 2,
        n_targets=n_kept,
        iterations=tuple(fit.iterations),
        converged_matrix=bool(np.linalg.norm(step.solution.theta) <= settings.tolerance_rad),
        converged_covariance=bool(
            np.all(np.abs(step.solution.theta) <= settings.tolerance_sigma * step.sigma)
        ),
        rejected=rejected,
        pairs=step.pairs,
        prior_shared=problem.prior_shared,
        targets_taken_apart=problem.shared.taken_apart,
        targets=residuals,
        noise=NoiseScale(*scale_s, fit.scale_c, fit.scale_c_sigma),
    )
