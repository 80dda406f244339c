"""Attitude of a camera from named stars: the rotation that brings catalogue directions to the measured ones.

The perturbation is a small right-handed turn in the axes of s: R_si = exp(delta_s) R0_si; its covariance is
the inverse of the Fisher information  F = sum -[u x] C^-1 [u x], each star with its own covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dsyev
from scipy.spatial.transform import Rotation

from boresight.geometry.sightings import information_of_directions

__all__ = ["Attitude", "attitude_of_most", "solve_attitude", "wahba"]

Array = NDArray[np.float64]

_OUTLIER_CHI2 = 18.4  # two degrees of freedom, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Attitude:
    """Orientation of a star camera at one instant."""

    R_si: Rotation
    cov_s: Array  # (3, 3) rad^2, of a right-handed turn about the axes of s
    chi2: float
    dof: int
    residuals_s: Array  # (N, 3) measured minus predicted direction


def solve_attitude(u_s: Array, u_i: Array, cov_s: Array) -> Attitude:
    """Maximum-likelihood attitude from measured `u_s` (N, 3) with covariances (N, 3, 3), and true `u_i` (N,
    3).

    Raises `ValueError` for fewer than two directions, or directions that fix no rotation.
    """
    return _solved(u_s, u_i, information_of_directions(u_s, cov_s), 2.0 / np.trace(cov_s, axis1=1, axis2=2))


def attitude_of_most(u_s: Array, u_i: Array, cov_s: Array) -> tuple[NDArray[np.int64], Attitude]:
    """The same with rows left out that do not agree with the others, and the rows that do.

    The worst go first; the fit's own scatter is the measure where it is larger than the covariances say.
    """
    information = information_of_directions(u_s, cov_s)
    weight = 2.0 / np.trace(cov_s, axis1=1, axis2=2)
    keep = np.arange(len(u_s))
    attitude = _solved(u_s, u_i, information, weight)
    for _ in range(10):
        chi2 = (attitude.residuals_s**2).sum(axis=1) * weight[keep]
        limit = _OUTLIER_CHI2 * max(1.0, float(np.median(chi2)) / 1.386)
        bad = chi2 > limit
        if not bad.any() or len(keep) - bad.sum() < 3:
            break
        keep = keep[chi2 < max(limit, 0.5 * chi2.max())]
        attitude = _solved(u_s[keep], u_i[keep], information[keep], weight[keep])
    return keep, attitude


def _solved(u_s: Array, u_i: Array, information: Array, weight: Array) -> Attitude:
    """`weight` (N,) is the reciprocal variance along one axis."""
    if len(u_s) < 2:
        raise ValueError(f"two directions at least are needed to fix an attitude, got {len(u_s)}")
    R_si = wahba(u_s, u_i, weight)
    for _ in range(3):
        predicted = u_i @ R_si.as_matrix().T
        A = -_cross_matrices(predicted)  # d(exp(delta) u) = delta x u = -[u x] delta
        AtI = A.transpose(0, 2, 1) @ information
        cov = np.linalg.inv((AtI @ A).sum(axis=0))
        delta = cov @ (AtI @ (u_s - predicted)[:, :, None]).sum(axis=0)[:, 0]
        R_si = Rotation.from_rotvec(delta) * R_si
        if np.abs(delta).max() < 1e-11:
            break
    if np.linalg.cond(cov) > 1e12:
        raise ValueError(f"{len(u_s)} directions too close together to fix all three angles")
    residual = u_s - u_i @ R_si.as_matrix().T
    chi2 = float(np.einsum("ni,nij,nj->", residual, information, residual))
    return Attitude(R_si, cov, chi2, 2 * len(u_s) - 3, residual)


def wahba(u_s: Array, u_i: Array, weight: Array) -> Rotation:
    """Rotation R_si that minimises sum weight |u_s - R u_i|^2: Davenport's q-method
    (Wertz 1978, sec. 12.2.3).

    Its quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix of B = sum w u_s u_i^T;
    scipy's quaternion is the conjugate of Davenport's, which turns axes and not vectors.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = ((u_s * weight[:, None]).T @ u_i).tolist()
    K = [
        [xx - yy - zz, xy + yx, xz + zx, zy - yz],
        [xy + yx, yy - xx - zz, yz + zy, xz - zx],
        [xz + zx, yz + zy, zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ]
    _, vectors, _ = dsyev(K)  # ascending; numpy's eigh takes twice the time for so small a matrix
    return Rotation.from_quat(vectors[:, 3])


def _cross_matrices(u: Array) -> Array:
    """[u x], (N, 3, 3)."""
    matrices = np.zeros((len(u), 3, 3))
    x, y, z = u.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices
