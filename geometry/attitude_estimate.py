"""Attitude of star exposures: Wahba's problem, weighted least squares, rejection of outlying stars.

`R_si` takes GCRS to the star camera s. Its error is a small right-handed rotation psi about the axes of s:
true R_si = exp(psi) R_si; the covariance is the inverse of the Fisher information
sum -[u x] C^-1 [u x], each star with its own covariance C (Shuster & Oh 1981). Angles in radians. Arrays of
several exposures are concatenated: exposure k has the rows start[k]:start[k+1].

A star is rejected when its squared residual over its variance
(chi-square, two degrees of freedom) exceeds the limit of the stated false-alarm probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from boresight.geometry import sightings
from boresight.records.record import Bools, Floats, Ints

__all__ = [
    "GROSS",
    "AttitudeSettings",
    "cross_matrices",
    "fit_attitudes",
    "fit_exposures",
    "sums_over",
    "wahba_matrices",
    "with_attitudes",
]

# Squared residual of a star over its variance that may bias a least-squares fit: 6.3 sigma, a robust start
# is needed then (set by hand).
GROSS = 40.0
# A step of Gauss-Newton after which the next is below 1e-13 rad, residuals being some 1e-4.
SETTLED_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class AttitudeSettings:
    """Rejection of outlying stars, the same for all exposures."""

    robust: bool = True  # reject outliers at all
    probability_false_alarm: float = 1e-3  # of rejecting a star whose stated covariance holds
    fewest_stars: int = 3  # an exposure with fewer kept stars is not usable: nothing checks its attitude


def fit_exposures(
    exposures: Sequence[sightings.StarSightings], settings: AttitudeSettings = AttitudeSettings()
) -> sightings.ExposureAttitudes:
    """Attitudes of K exposures from their stars, `u_s` and `cov_s` in star-camera axes, `u_i` in GCRS axes.

    An exposure whose stars do not fix its attitude has `usable` False; nothing is raised.
    """
    start = np.cumsum([0, *(len(exposure.hip) for exposure in exposures)])
    none = np.zeros((0, 3))
    u_s = np.concatenate([none, *(exposure.u_s for exposure in exposures)])
    u_i = np.concatenate([none, *(exposure.u_i for exposure in exposures)])
    cov_s = np.concatenate([np.zeros((0, 3, 3)), *(exposure.cov_s for exposure in exposures)])
    return fit_attitudes(u_s, u_i, cov_s, start, settings)


def with_attitudes(
    strips: Sequence[sightings.StripSightings], settings: AttitudeSettings = AttitudeSettings()
) -> list[sightings.StripSightings]:
    """The strips, with attitudes fitted for those that have none (`attitudes` is None), all in one fit, to
    which an exposure that several strips list contributes once.
    """
    bare = [n for n, strip in enumerate(strips) if strip.attitudes is None]
    if not bare:
        return list(strips)
    keys = {n: [(one.t_s, one.u_s.tobytes()) for one in strips[n].exposures] for n in bare}
    once = {key: one for n in bare for key, one in zip(keys[n], strips[n].exposures)}
    row = {key: k for k, key in enumerate(once)}
    fit, out = fit_exposures(list(once.values()), settings), list(strips)
    for n in bare:
        here = np.array([row[key] for key in keys[n]], dtype=np.int64)
        out[n] = replace(strips[n], attitudes=fit.take(here))
    return out


def fit_attitudes(
    u_s: Floats, u_i: Floats, cov_s: Floats, start: Ints, settings: AttitudeSettings = AttitudeSettings()
) -> sightings.ExposureAttitudes:
    """Maximum-likelihood attitude of each exposure, outlying stars rejected.

    Exposures with gross outliers start from least absolute residuals and then Geman-McClure weights. Stars
    beyond the chi-square limit are rejected, and the others are fitted with their full weight until the set
    of kept stars no longer changes, so that the covariance is that of least squares.

    `u_s` (N, 3) are measured unit vectors, star-camera axes, with covariances `cov_s` (N, 3, 3), rad², `u_i`
    (N, 3) apparent catalogue directions, GCRS axes; exposure k has the rows start[k]:start[k+1], perhaps
    none. One whose kept stars do not fix its attitude has `usable` False; nothing is raised.
    """
    information = sightings.information_of_directions(u_s, cov_s)
    variance = 0.5 * np.trace(cov_s, axis1=1, axis2=2)
    group = np.repeat(np.arange(len(start) - 1), np.diff(start))
    R_si = _refined(_wahba(u_s, u_i, 1.0 / variance, start), u_s, u_i, information, start, group)
    kept: Bools = np.ones(len(u_s), dtype=bool)
    squared = _squared_mahalanobis(R_si, u_s, u_i, information, group)
    limit = float(chdtri(2, settings.probability_false_alarm))
    if settings.robust and np.any(squared > limit):
        gross = np.zeros(len(start) - 1, dtype=bool)
        gross[group[squared > GROSS]] = True
        if gross.any():
            rows = gross[group]
            part = np.concatenate([[0], np.cumsum(np.diff(start)[gross])]).astype(np.int64)
            R_si[gross] = _robust_start(u_s[rows], u_i[rows], variance[rows], part)
        for _ in range(10):
            before, kept = kept, _squared_mahalanobis(R_si, u_s, u_i, information, group) <= limit
            R_si = _refined(R_si, u_s, u_i, information * kept[:, None, None], start, group)
            if np.array_equal(before, kept):
                break
    squared = _squared_mahalanobis(R_si, u_s, u_i, information, group)
    F_s = _normal(R_si, u_s, u_i, information * kept[:, None, None], start, group)[0]
    n_kept = np.round(sums_over(start, kept.astype(float))).astype(np.int64)
    values = np.linalg.eigvalsh(F_s)
    usable = (n_kept >= settings.fewest_stars) & (values[:, 0] > 1e-10 * values[:, 2]) & (values[:, 2] > 0.0)
    covariance = np.zeros_like(F_s)
    covariance[usable] = np.linalg.inv(F_s[usable])
    return sightings.ExposureAttitudes(
        start=np.asarray(start, dtype=np.int64),
        R_si=R_si,
        covariance_s=covariance,
        usable=usable,
        kept=kept,
        squared_mahalanobis=squared,
        chi2=sums_over(start, np.where(kept, squared, 0.0)),  # a rejected one may be infinite
        dof=2 * n_kept - 3,
    )


def wahba_matrices(profile: Floats) -> Floats:
    """Rotation matrices R (K, 3, 3) that maximise tr(Rᵀ profile), profile = sum w a bᵀ: a = R b (Markley
    1988).
    """
    U, _, Vt = np.linalg.svd(profile)
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return U @ Vt


def cross_matrices(v: Floats) -> Floats:
    """Matrices [v]x (..., 3, 3) with [v]x a = v x a, for vectors (..., 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def sums_over(start: Ints, values: NDArray[Any]) -> NDArray[Any]:
    """Sums (K, ...) of `values` (N, ...) over the groups start[k]:start[k+1]; an empty group gives 0."""
    full = np.flatnonzero(np.diff(start))
    if len(full) == len(start) - 1:
        return np.add.reduceat(values, start[:-1], axis=0)
    out = np.zeros((len(start) - 1, *values.shape[1:]))
    if len(full):
        out[full] = np.add.reduceat(values, start[full], axis=0)
    return out


def _robust_start(u_s: Floats, u_i: Floats, variance: Floats, start: Ints) -> Floats:
    """Least absolute residuals, then Geman-McClure weights whose limit decreases to 4 sigma: (K, 3, 3)."""
    sigma = np.sqrt(variance)
    weight = np.ones(len(u_s))
    group = np.repeat(np.arange(len(start) - 1), np.diff(start))
    for _ in range(25):
        R_si = _wahba(u_s, u_i, weight, start)
        distance = np.linalg.norm(u_s - _rotated(R_si, u_i, group), axis=1)
        weight = 1.0 / np.maximum(distance, sigma)
    for limit in (100.0, 30.0, 10.0, 5.0, 4.0, 4.0, 4.0):
        R_si = _wahba(u_s, u_i, weight, start)
        distance = np.linalg.norm(u_s - _rotated(R_si, u_i, group), axis=1) / sigma
        weight = np.maximum((1.0 + (distance / limit) ** 2) ** -2.0, 1e-12) / variance
    return _wahba(u_s, u_i, weight, start)


def _refined(R_si: Floats, u_s: Floats, u_i: Floats, information: Floats, start: Ints, group: Ints) -> Floats:
    """Gauss-Newton with the full covariances; an exposure that its stars do not fix is not changed."""
    for _ in range(3):
        N, right = _normal(R_si, u_s, u_i, information, start, group)
        size = np.trace(N, axis1=1, axis2=2) + 1e-300
        psi = np.linalg.solve(N + 1e-14 * size[:, None, None] * np.eye(3), right[:, :, None])[:, :, 0]
        psi[np.linalg.norm(psi, axis=1) > 0.1] = 0.0
        R_si = Rotation.from_rotvec(psi).as_matrix() @ R_si
        if np.abs(psi).max(initial=0.0) < SETTLED_RAD:
            break
    return R_si


def _normal(
    R_si: Floats, u_s: Floats, u_i: Floats, information: Floats, start: Ints, group: Ints
) -> tuple[Floats, Floats]:
    """Normal matrices (K, 3, 3) and right-hand sides (K, 3) of psi."""
    w_s = _rotated(R_si, u_i, group)
    A = -cross_matrices(w_s)  # u_s - w_s = psi x w_s
    weighted = np.swapaxes(A, 1, 2) @ information
    N = sums_over(start, (weighted @ A).reshape(-1, 9)).reshape(-1, 3, 3)
    return N, sums_over(start, (weighted @ (u_s - w_s)[:, :, None])[:, :, 0])


def _squared_mahalanobis(R_si: Floats, u_s: Floats, u_i: Floats, information: Floats, group: Ints) -> Floats:
    """Squared residual over its variance (N,); infinite beyond 0.5 rad, where the linear measure fails."""
    residual = u_s - _rotated(R_si, u_i, group)
    squared = np.einsum("ni,nij,nj->n", residual, information, residual)
    return np.where(np.einsum("ni,ni->n", residual, residual) > 0.25, np.inf, squared)


def _rotated(R_si: Floats, u_i: Floats, group: Ints) -> Floats:
    return np.einsum("nij,nj->ni", R_si[group], u_i)


def _wahba(u_s: Floats, u_i: Floats, weight: Floats, start: Ints) -> Floats:
    profile = sums_over(start, ((weight[:, None] * u_s)[:, :, None] * u_i[:, None, :]).reshape(-1, 9))
    return wahba_matrices(profile.reshape(-1, 3, 3))
