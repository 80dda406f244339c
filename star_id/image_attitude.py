"""Attitude of one image of a calibrated camera, from stars with covariances in pixels.

The estimate is that of `geometry.attitude_estimate.fit_attitudes` with the limit of rejection raised to the
stars' scatter: maximum likelihood with full covariances, outliers rejected. A single image takes a tenth of
the time here: residuals are whitened once in pixels, and the normal matrix is one product of (3, 2N) arrays.
"""

from __future__ import annotations

import math
from operator import itemgetter

import numpy as np
from scipy.linalg.lapack import dposv, dsyev
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from boresight.geometry.attitude_estimate import GROSS, SETTLED_RAD
from boresight.records.record import Bools, Floats, array, inner, record, scalar
from boresight.star_id.beyond_chance import LEAST_STARS, MEDIAN_CHI2, NEVER_SIGMA, SELDOM_SIGMA
from boresight.star_id.finding.background import median_of

__all__ = ["NEXT", "PREV", "ImageAttitude", "fit_image_attitude", "rotation_from_matrix", "rotation_matrix"]

# Smallest eigenvalue of the information over the largest, below which stars do not fix all three angles.
_SMALLEST_EIGENVALUE = 1e-10
# The components after and before each of three, cyclically: (a x b)_k = a[next] b[previous] - a[previous]
# b[next].
NEXT = np.array([1, 2, 0])
PREV = NEXT[NEXT]
# Rounds of least absolute residuals, then the limits, sigmas, of Geman-McClure weights, that start a fit to
# stars with gross outliers (set by hand).
_ABSOLUTE_ROUNDS, _LIMITS = 3, (NEVER_SIGMA, SELDOM_SIGMA)
# Most steps of Gauss-Newton of one fit, or rounds of rejection.
_ROUNDS = 12


@record
class ImageAttitude:
    """Attitude of one image, and what its stars leave."""

    R_si: Rotation = scalar("GCRS to star camera")
    scale: float = scalar("by which the focal length exceeds the camera's, relative; 0 if it was not fitted")
    covariance: Floats = array(
        "P, P",
        "of a small right-handed rotation about the axes of s, rad, and of the scale, if it was fitted",
    )
    chi2: float = scalar("sum of squared residuals over their variances, kept stars")
    dof: int = scalar("degrees of freedom of chi2")
    kept: Bools = array("N", "stars that were not rejected")
    residual_px: Floats = array("N, 2", "measured minus predicted pixels, to first order")
    cov_s = inner[Floats](
        "covariance",
        "(3, 3) rad², of a small right-handed rotation about axes s",
        of=itemgetter(np.s_[:3, :3]),
    )


def fit_image_attitude(
    slopes: Floats,
    cov_px: Floats,
    u_i: Floats,
    R_si: Rotation,
    false_alarm: float,
    *,
    by_scale: Floats | None = None,
) -> ImageAttitude:
    """Attitude of an image near `R_si`, and its scale with `by_scale`.

    Parameters
    ----------
    slopes : (N, 2, 3) array
        Derivatives of the pixels by direction, frame s, at the measured directions, to which they are normal.
    cov_px : (N, 2, 2) array
        Covariances of the centroids, px².
    u_i : (N, 3) array
        Directions of the stars, GCRS axes.
    R_si : Rotation
        Attitude good to some pixels.
    false_alarm : float
        Probability of rejecting a star whose covariance, times the scatter of all stars, holds.
    by_scale : (N, 2) array, optional
        Derivatives of the pixels by the logarithm of the focal length, which is then fitted, too.

    Returns
    -------
    ImageAttitude

    Raises
    ------
    ValueError
        If there are fewer than two stars or they are too close together to fix all three angles.
    """
    n = len(u_i)
    stars, kept, start = _Whitened.of(slopes, cov_px, u_i, by_scale), np.ones(n) > 0.0, R_si.as_matrix()
    R, scale, z, F = stars.refined(start)
    square = (z * z).sum(axis=0)
    scatter = max(1.0, median_of(square) / MEDIAN_CHI2) if n else 1.0
    limit = scatter * float(chdtri(2, false_alarm))
    if square.max(initial=0.0) > limit:
        gross = (square > GROSS * scatter).any()
        R_kept, scale_kept, found = stars.without_outliers(
            *(stars.robust(start) if gross else (R, scale)), limit
        )
        if np.count_nonzero(found) >= LEAST_STARS:  # else none is rejected
            R, scale, kept = R_kept, scale_kept, found
            z, D = stars.linear(R, scale)
            F, square = _normal(z, D, kept)[0], (z * z).sum(axis=0)
    values, _, _ = dsyev(F, compute_v=0)
    if n < 2 or not values[0] > _SMALLEST_EIGENVALUE * values[-1]:
        raise ValueError(f"{n} directions, too few or too close together to fix all three angles")
    return ImageAttitude(
        R_si=rotation_from_matrix(R),
        scale=scale,
        covariance=np.asarray(np.linalg.inv(F), dtype=np.float64),
        chi2=float(square @ kept),
        dof=2 * int(np.count_nonzero(kept)) - len(F),
        kept=kept,
        residual_px=stars.pixels(z),
    )


@record
class _Whitened:
    """Stars of one image with residuals in standard deviations."""

    B: Floats  # (2, 3, N) derivatives of the residuals by direction, frame s
    B_next: Floats  # (3, 2, N) the same, by the component after each in y, z, x
    B_prev: Floats  # (3, 2, N) and by the one before
    u_i: Floats  # (3, N) directions, GCRS axes
    first: Floats  # (N,) Cholesky factor of the covariances in pixels: (first, 0), (mixed, second)
    mixed: Floats  # (N,)
    second: Floats  # (N,)
    by_scale: Floats | None  # (2, N) derivatives of the residuals by the scale, signs reversed; None: fixed

    @classmethod
    def of(cls, slopes: Floats, cov_px: Floats, u_i: Floats, by_scale: Floats | None) -> _Whitened:
        """Of slopes (N, 2, 3), covariances (N, 2, 2), px², directions (N, 3), GCRS axes, and derivatives by
        scale (N, 2)."""
        first = np.sqrt(cov_px[:, 0, 0])
        mixed = cov_px[:, 0, 1] / first
        second = np.sqrt(cov_px[:, 1, 1] - mixed * mixed)
        B = slopes.transpose(1, 2, 0).copy("C")
        B[0] /= first
        B[1] -= mixed * B[0]
        B[1] /= second
        E = None
        if by_scale is not None:
            E = by_scale.T / first
            E[1] = (by_scale[:, 1] - mixed * E[0]) / second
        by_axis = B.transpose(1, 0, 2)
        B_next, B_prev = by_axis.take(NEXT, axis=0), by_axis.take(PREV, axis=0)
        return cls(B, B_next, B_prev, np.ascontiguousarray(u_i.T), first, mixed, second, E)

    def linear(self, R: Floats, scale: float) -> tuple[Floats, Floats]:
        """Residuals (2, N) at attitude R (3, 3) and a scale, and their derivatives (P, 2, N) by a rotation
        and the scale, signs reversed."""
        w, B, E = R @ self.u_i, self.B, self.by_scale
        z = -(B * w).sum(axis=1)  # slopes are normal to the measured direction: B (u_s - w)
        D = w.take(NEXT, axis=0)[:, None] * self.B_prev - w.take(PREV, axis=0)[:, None] * self.B_next
        if E is None:
            return z, D
        return z - scale * E, np.concatenate([D, E[None]])

    def refined(self, R: Floats) -> tuple[Floats, float, Floats, Floats]:
        """Attitude (3, 3) and scale of all stars by Gauss-Newton from R (3, 3), their residuals (2, N) and
        the normal matrix (P, P) there."""
        scale = 0.0
        for _ in range(_ROUNDS):
            z, D = self.linear(R, scale)
            F, right = _normal(z, D)
            R, scale, step = _stepped(R, scale, F, right)
            if max(map(abs, step)) < SETTLED_RAD:  # what the step does not remove is of second order
                return R, scale, z - (np.array(step) @ D.reshape(len(D), -1)).reshape(z.shape), F
        z, D = self.linear(R, scale)
        return R, scale, z, _normal(z, D)[0]

    def without_outliers(self, R: Floats, scale: float, limit: float) -> tuple[Floats, float, Bools]:
        """Attitude (3, 3) near R (3, 3), scale, and the stars (N,) whose squared residuals are below
        `limit`."""
        kept = None
        for _ in range(_ROUNDS):
            z, D = self.linear(R, scale)
            before, kept = kept, (z * z).sum(axis=0) <= limit
            R, scale, step = _stepped(R, scale, *_normal(z, D, kept))
            if max(map(abs, step)) < SETTLED_RAD and before is not None and (before == kept).all():
                break
        assert kept is not None
        return R, scale, kept

    def robust(self, R: Floats) -> tuple[Floats, float]:
        """Attitude (3, 3) and scale that gross outliers do not displace."""
        scale = 0.0
        for limit in (*(0.0,) * _ABSOLUTE_ROUNDS, *_LIMITS):
            z, D = self.linear(R, scale)
            square = (z * z).sum(axis=0)
            weight = (1.0 + square / limit**2) ** -2.0 if limit else 1.0 / np.sqrt(np.maximum(square, 1.0))
            R, scale, _ = _stepped(R, scale, *_normal(z, D, weight))
        return R, scale

    def pixels(self, z: Floats) -> Floats:
        """Residuals (N, 2), px, of (2, N) standard deviations."""
        return np.stack([self.first * z[0], self.mixed * z[0] + self.second * z[1]], axis=1)


def rotation_from_matrix(R: Floats) -> Rotation:
    """The rotation of a rotation matrix (3, 3); scipy's test for one takes three times as long.

    Each row of four times q qT, q the quaternion, is q up to a factor: the one of the largest component.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    rows = (
        (1.0 + xx - yy - zz, xy + yx, xz + zx, zy - yz),
        (xy + yx, 1.0 - xx + yy - zz, yz + zy, xz - zx),
        (xz + zx, yz + zy, 1.0 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1.0 + xx + yy + zz),
    )
    return Rotation.from_quat(rows[max(range(4), key=lambda k: rows[k][k])])


def _normal(z: Floats, D: Floats, weight: Floats | Bools | None = None) -> tuple[Floats, Floats]:
    """Normal matrix (P, P) and right-hand side (P,) of residuals (2, N), derivatives (P, 2, N) and weights
    (N,)."""
    flat = D.reshape(len(D), -1)
    weighted = flat if weight is None else (D * weight).reshape(len(D), -1)
    return weighted @ flat.T, weighted @ z.ravel()


def _stepped(R: Floats, scale: float, F: Floats, right: Floats) -> tuple[Floats, float, list[float]]:
    """Attitude and scale after the step of normal equations, and the step (P,); zeros where they do not fix
    it or it is beyond 0.1."""
    _, solved, info = dposv(F, right)
    step: list[float] = solved.tolist()
    if info != 0 or not math.hypot(*step) < 0.1:
        return R, scale, [0.0] * len(step)
    return rotation_matrix(step[:3]) @ R, scale + sum(step[3:]), step


def rotation_matrix(psi: list[float]) -> Floats:
    """Rotation matrix exp(psi) (3, 3) by Rodrigues' formula."""
    x, y, z = psi
    angle = math.hypot(x, y, z)
    a = math.sin(angle) / angle if angle else 1.0
    b = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle else 0.5
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )
