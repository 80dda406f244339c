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

from boresight.calib.attitudes import GROSS
from boresight.calib.estimate import (
    InstallationEstimate,
    Iteration,
    NoiseScale,
    NotObservable,
    Rejected,
    TargetResiduals,
)
from boresight.calib.gross_errors import down_to_the_noise, most_shared_matrix
from boresight.calib.information import InformationPairs, Solution
from boresight.calib.joint_solution import (
    Problem,
    Step,
    iteration_record,
    linear_solution,
    normalised_residuals,
)
from boresight.calib.rejection import left_out
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import PreparedStrip, prepare_strip
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import StripSightings

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
    problem = Problem.of(prepared, settings)
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
    problem = Problem.of([prepare_strip(strip, settings) for strip in strips], settings)
    if not problem.groups:
        raise ValueError(f"{len(strips)} strips, none with a target between usable star exposures")
    return linear_solution(problem, R_cs, problem.inside.astype(float), 1.0).pairs, problem.prior_shared


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    step: Step
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


def _solve(problem: Problem, R_cs0: Rotation) -> _Fit:
    settings = problem.settings
    iterations: list[Iteration] = []
    limit = float(chi2.isf(settings.probability_false_alarm, 2))
    kept, scale = problem.inside, (1.0, 0.0)
    step = _iterated(problem, R_cs0, kept, iterations, 1.0)
    for _ in range(5 if settings.estimate_noise else 1):
        if settings.robust and np.any(normalised_residuals(step)[problem.inside] > limit):
            R_cs, kept = step.R_cs, problem.inside & (normalised_residuals(step) <= limit)
            if np.any(normalised_residuals(step)[problem.inside] > GROSS):
                R_cs = most_shared_matrix(problem, R_cs0)
                R_cs, weight = down_to_the_noise(problem, R_cs, iterations, scale[0])
                kept = weight > 0.25
            for _ in range(settings.most_iterations):
                step = linear_solution(problem, R_cs, kept.astype(float), scale[0])
                iterations.append(iteration_record(step, kept.astype(float)))
                before, kept = kept, problem.inside & (normalised_residuals(step) <= limit)
                R_cs = deviation_from_theta(step.solution.theta) * R_cs
                if np.array_equal(before, kept):
                    break
        step = _iterated(problem, step.R_cs, kept, iterations, scale[0])
        if settings.estimate_noise:
            scale = _noise_scale(step, kept, scale[0], settings)
            step = _iterated(problem, step.R_cs, kept, iterations, scale[0])
    return _Fit(step, iterations, kept, normalised_residuals(step), *scale)


def _iterated(
    problem: Problem, R_cs: Rotation, kept: NDArray[np.bool_], iterations: list[Iteration], scale_c: float
) -> Step:
    """Gauss-Newton to M = I with given weights."""
    settings = problem.settings
    for _ in range(settings.most_iterations):
        step = linear_solution(problem, R_cs, kept.astype(float), scale_c)
        iterations.append(iteration_record(step, kept.astype(float)))
        if np.linalg.norm(step.solution.theta) <= settings.tolerance_rad:
            break
        R_cs = deviation_from_theta(step.solution.theta) * R_cs
    return step


def _noise_scale(
    step: Step, kept: NDArray[np.bool_], scale: float, settings: CalibrationSettings
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


def _residuals(prepared: list[PreparedStrip], problem: Problem, fit: _Fit) -> TargetResiduals:
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
    problem: Problem,
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
