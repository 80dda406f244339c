"""Attitude of many star exposures at once, with covariance, gross errors found and left out.

`R_si` takes GCRS to the star camera. Its error is a small right-handed turn psi about the axes of s: true
R_si = exp(psi) R_si. Angles in radians. Where several exposures stand one after another, exposure k has the
rows start[k]:start[k+1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from boresight.calib.frames import sums_over
from boresight.geometry.sightings import information_of_directions

__all__ = ["GROSS", "ExposureAttitudes", "cross_matrices", "fit_attitudes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Squared residual over its variance beyond which a least-squares fit may have been pulled off. What lies
# between the chi-square limit and this is left out from where the fit stands.
GROSS = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class ExposureAttitudes:
    """Attitudes of K exposures. Where `usable` is False too few good stars were left, or all in one spot."""

    R_si: Array  # (K, 3, 3) i to s
    covariance_s: Array  # (K, 3, 3) rad², of psi
    usable: NDArray[np.bool_]  # (K,)
    kept: NDArray[np.bool_]  # (N,) stars taken as good
    normalised: Array  # (N,) squared residual over its variance, two degrees of freedom
    chi2: Array  # (K,)
    dof: Index  # (K,)


def fit_attitudes(
    u_s: Array,
    u_i: Array,
    cov_s: Array,
    start: Index,
    *,
    robust: bool = True,
    probability_false_alarm: float = 1e-3,
    fewest_stars: int = 3,
) -> ExposureAttitudes:
    """Maximum-likelihood attitude of each exposure from its stars (N, 3), their directions and covariances.

    Robust: a sum of absolute residuals finds the attitude that most stars share, whatever the others say;
    weights that fall to zero bring it to the noise; then stars beyond the chi-square limit are left out one
    and all, and the rest is fitted with its full weight, so that the covariance is that of least squares.
    """
    information = information_of_directions(u_s, cov_s)
    variance = 0.5 * np.trace(cov_s, axis1=1, axis2=2)
    limit = float(chi2.isf(probability_false_alarm, 2))
    group = np.repeat(np.arange(len(start) - 1), np.diff(start))
    plain = 1.0 / variance
    R_si = _refined(_wahba(u_s, u_i, plain, start), u_s, u_i, information, start, group)
    kept: NDArray[np.bool_] = np.ones(len(u_s), dtype=bool)
    normalised = _normalised(R_si, u_s, u_i, information, group)
    if robust and np.any(normalised > limit):
        gross = np.zeros(len(start) - 1, dtype=bool)
        gross[group[normalised > GROSS]] = True
        if gross.any():
            rows = gross[group]
            counts = np.diff(start)[gross]
            part = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
            inner = np.repeat(np.arange(len(counts)), counts)
            R_si[gross] = _robust_start(u_s[rows], u_i[rows], variance[rows], part, inner)
        for _ in range(10):
            before, kept = kept, _normalised(R_si, u_s, u_i, information, group) <= limit
            R_si = _refined(R_si, u_s, u_i, information * kept[:, None, None], start, group)
            if np.array_equal(before, kept):
                break
    normalised = _normalised(R_si, u_s, u_i, information, group)
    F_s = _normal(R_si, u_s, u_i, information * kept[:, None, None], start, group)[0]
    left = np.round(sums_over(start, kept.astype(float))).astype(np.int64)
    values = np.linalg.eigvalsh(F_s)
    usable = (left >= fewest_stars) & (values[:, 0] > 1e-10 * values[:, 2]) & (values[:, 2] > 0.0)
    covariance = np.zeros_like(F_s)
    covariance[usable] = np.linalg.inv(F_s[usable])
    return ExposureAttitudes(
        R_si, covariance, usable, kept, normalised, sums_over(start, normalised * kept), 2 * left - 3
    )


def cross_matrices(v: Array) -> Array:
    """[v]x with [v]x a = v x a, for vectors (..., 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _robust_start(u_s: Array, u_i: Array, variance: Array, start: Index, group: Index) -> Array:
    """Least absolute residuals, then Geman and McClure's weights with a limit that comes down to the
    noise.
    """
    sigma = np.sqrt(variance)
    weight = np.ones(len(u_s))
    for _ in range(25):
        R_si = _wahba(u_s, u_i, weight, start)
        distance = np.linalg.norm(u_s - _turned(R_si, u_i, group), axis=1)
        weight = 1.0 / np.maximum(distance, sigma)
    for limit in (100.0, 30.0, 10.0, 5.0, 4.0, 4.0, 4.0):
        R_si = _wahba(u_s, u_i, weight, start)
        distance = np.linalg.norm(u_s - _turned(R_si, u_i, group), axis=1) / sigma
        weight = np.maximum((1.0 + (distance / limit) ** 2) ** -2.0, 1e-12) / variance
    return _wahba(u_s, u_i, weight, start)


def _refined(R_si: Array, u_s: Array, u_i: Array, information: Array, start: Index, group: Index) -> Array:
    """Gauss-Newton with the full covariances. An exposure that its stars do not fix is left as it was."""
    for _ in range(3):
        N, right = _normal(R_si, u_s, u_i, information, start, group)
        size = np.trace(N, axis1=1, axis2=2) + 1e-300
        psi = np.linalg.solve(N + 1e-14 * size[:, None, None] * np.eye(3), right[:, :, None])[:, :, 0]
        psi[np.linalg.norm(psi, axis=1) > 0.1] = 0.0
        R_si = _turn(psi) @ R_si
    return R_si


def _normal(
    R_si: Array, u_s: Array, u_i: Array, information: Array, start: Index, group: Index
) -> tuple[Array, Array]:
    w_s = _turned(R_si, u_i, group)
    turn = -cross_matrices(w_s)  # u_s - w_s = psi x w_s
    weighted = np.swapaxes(turn, 1, 2) @ information
    N = sums_over(start, (weighted @ turn).reshape(-1, 9)).reshape(-1, 3, 3)
    return N, sums_over(start, (weighted @ (u_s - w_s)[:, :, None])[:, :, 0])


def _normalised(R_si: Array, u_s: Array, u_i: Array, information: Array, group: Index) -> Array:
    residual = u_s - _turned(R_si, u_i, group)
    inside = np.einsum("ni,nij,nj->n", residual, information, residual)
    return np.where(np.einsum("ni,ni->n", residual, residual) > 0.25, np.inf, inside)


def _turned(R_si: Array, u_i: Array, group: Index) -> Array:
    return np.einsum("nij,nj->ni", R_si[group], u_i)


def _turn(psi: Array) -> Array:
    """Rotation matrices exp(psi) of small right-handed turns (K, 3)."""
    angle = np.linalg.norm(psi, axis=1)[:, None, None]
    K = cross_matrices(psi)
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * K @ K
    )


def _wahba(u_s: Array, u_i: Array, weight: Array, start: Index) -> Array:
    profile = sums_over(start, ((weight[:, None] * u_s)[:, :, None] * u_i[:, None, :]).reshape(-1, 9))
    U, _, Vt = np.linalg.svd(profile.reshape(-1, 3, 3))
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return U @ Vt
