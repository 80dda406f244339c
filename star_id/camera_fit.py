"""Least-squares fit of a camera, and of one rotation for each image, to identified stars.

Unknowns are the free ones of the camera's seven parameters (eqs. 3-6: f, x0, y0, p1, p2, q1, q2), optionally
a third radial term q3 and a drift of the focal length with time, and a small rotation of each image, which
is eliminated (its three columns belong to one image only). Each star is weighted by the covariance of its
centroid; outliers are rejected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import Complex, StarCamera, complex_of, legendre_terms, pairs_of
from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import MEDIAN_CHI2, SELDOM_SIGMA
from boresight.star_id.common_variance import SMALL_CHANGE, common_variance
from boresight.star_id.finding.background import median_of

__all__ = [
    "DRIFT",
    "PARAMETERS",
    "Q3",
    "SMALL_STEP",
    "CameraFit",
    "IdentifiedStars",
    "detector_grid",
    "fit_camera",
    "pixel_derivatives",
    "smooth_derivatives",
    "visible_derivatives",
]


# Names of the fitted camera parameters, as in `StarCamera`: focal length (m), principal point (px),
# decentring p1, p2 and radial q1, q2 of Brown's model.
PARAMETERS = ("focal_m", "x0_px", "y0_px", "p1", "p2", "q1", "q2")
# Name of the third radial coefficient of Brown's model, 1/mm^6; fitted where the evidence asks for it.
Q3 = "q3"
# Name of the relative change of the focal length with time, 1/s (a lens that warms up).
DRIFT = "focal_drift_per_s"
# All names that may be fitted, in the order of the columns of `pixel_derivatives`.
_ALL = (*PARAMETERS, DRIFT, Q3)
# The prior of a camera of which nothing is known: no parameter has one.
_NOTHING: Mapping[str, float] = MappingProxyType({})
# Change of the logarithm of the focal length at which a fit has diverged: 20 times (set by hand).
_LARGEST_LOG_SCALE = 3.0
# Step, in standard errors of the parameters or logarithms of sizes, at which a fit has converged.
SMALL_STEP = 1e-3


@record
class IdentifiedStars:
    """Identified stars of K images. Row n of the (N,) arrays is the same star."""

    xy_px: Floats = array("N, 2", "centroids as (column, row)")
    cov_px: Floats = array("N, 2, 2", "covariances of the centroids, px^2")
    u_i: Floats = array("N, 3", "directions, GCRS axes")
    frame: Ints = array("N", "image of each star, 0 to K - 1, ascending")
    t_s: Floats = array("K", "times of the images, s; used for a drift only")


@record(kw_only=True)
class CameraFit:
    """Fitted camera, with the attitudes of its K images. Row n of the (N,) arrays is the same star."""

    camera: StarCamera = scalar("with the fitted parameters")
    focal_drift_per_s: float = scalar("relative drift of the focal length, 1/s, about the images' mean time")
    rotations: Rotation = array("K", "R_si of the images")
    covariance: Floats = array("F, F", "of the free parameters, own units, scaled by variance_factor")
    variance_factor: float = scalar("reduced chi2, at least 1")
    common_px2: float = scalar("variance of an error of each star's own, along one axis, px^2")
    residual_px: Floats = array("N, 2", "measured minus predicted, all stars")
    keep: Bools = array("N", "whether the star is no outlier")
    chi2: float = scalar("of the kept stars")
    dof: int = scalar("degrees of freedom of chi2")


def fit_camera(
    stars: IdentifiedStars,
    camera: StarCamera,
    rotations: Rotation,
    free: tuple[str, ...] = PARAMETERS,
    prior: Mapping[str, float] = _NOTHING,
    expected: StarCamera | None = None,
    common_px2: float | None = None,
) -> CameraFit:
    """Camera with the parameters `free` (of PARAMETERS, DRIFT and Q3) fitted by Gauss-Newton steps.

    `camera` and `rotations` (K,) are the start. `prior` holds 1-sigma deviations from the parameters of
    `expected`, or of `camera`, in their own units. With `common_px2`, px^2 along one axis, stars have an
    error of their own of a variance that all share (`common_variance`), and that is where its search begins.
    The covariance is scaled by the reduced chi2 if that exceeds 1.

    `numpy.linalg.LinAlgError` where the steps lead to a camera that cannot image all of the stars.
    """
    columns = [_ALL.index(name) for name in free]
    units = _units(camera)[columns]
    prior_weight = np.array([unit / prior.get(name, np.inf) for name, unit in zip(free, units)]) ** 2
    first = _vector(expected or camera, camera)[columns]
    images = _Images.of(stars)
    theta, R, keep = _vector(camera), rotations, np.ones(stars.u_i.shape[:1], dtype=bool)
    common, settled, weights = common_px2 or 0.0, True, images.weights(common_px2 or 0.0)
    for k in range(12):
        pull = prior_weight * (first - theta[columns])
        with np.errstate(over="ignore", invalid="ignore"):  # of a fit that diverges
            step = _step(theta, R, camera, images, [w * keep for w in weights], columns, prior_weight, pull)
        theta = theta.copy()
        theta[columns] += step.change[0, :-3]
        if not np.isfinite(theta).all() or abs(theta[0]) > _LARGEST_LOG_SCALE:
            raise np.linalg.LinAlgError("the fitted camera cannot image all of the stars")
        R = Rotation.from_rotvec(step.change[:, -3:]) * R
        if k < 2 and step.in_sigmas > 1.0:  # from a nominal camera all stars look like outliers
            continue
        square = step.squares(images)
        if common_px2 is not None:
            used, before = keep & step.in_front, common
            common = common_variance(square[used], step.leverage(images)[used], images.own[used], common)
            settled = abs(common - before) <= SMALL_CHANGE * before
            weights = images.weights(common)
        chi2 = 0.5 * square / (images.own + common)  # a degree of freedom
        inlier = chi2 < SELDOM_SIGMA**2 * max(1.0, 2.0 * median_of(chi2[keep]) / MEDIAN_CHI2)
        if 2 * inlier.sum() <= len(free) + 3 * len(stars.t_s):  # too few would be left
            inlier = keep
        if np.array_equal(inlier, keep) and settled and step.in_sigmas < SMALL_STEP:
            break
        keep = inlier
    own, other = weights
    square = np.abs(step.residual) ** 2
    total = float((own * square + (other.conj() * step.residual**2).real) @ keep)
    dof = 2 * int(keep.sum()) - len(free) - 3 * len(stars.t_s)
    variance_factor = max(1.0, total / max(dof, 1))
    return CameraFit(
        camera=_camera(theta, camera),
        focal_drift_per_s=float(theta[7]),
        rotations=R,
        covariance=np.asarray(variance_factor * step.covariance[0, :-3, :-3] * units[:, None] * units),
        variance_factor=variance_factor,
        common_px2=common,
        residual_px=pairs_of(step.residual),
        keep=keep,
        chi2=total,
        dof=dof,
    )


def pixel_derivatives(
    camera: StarCamera, u_s: Floats, free: tuple[str, ...] = PARAMETERS
) -> tuple[Floats, Floats]:
    """Derivatives (N, 2, F) of the pixels of directions (N, 3), frame s, by the parameters `free`, px per
    their own units, and (N, 2, 3), px/rad, by a right-handed rotation about axes s. (Those of a smooth
    distortion's own slope, a thousandth, are left out.)"""
    columns = [_ALL.index(name) for name in free]
    projected = _project(_vector(camera), camera, u_s, 0.0)
    rows = np.concatenate([_camera_rows(projected, camera, 0.0, columns), _rotation_rows(projected)])
    both = np.stack([rows.real.T, rows.imag.T], axis=1)
    return both[:, :, :-3] / _units(camera)[columns], both[:, :, -3:]


def visible_derivatives(
    camera: StarCamera, xy_px: Floats, free: tuple[str, ...] = PARAMETERS, degree: int = 0
) -> Floats:
    """Derivatives (N, 2, F) of the pixel map at pixels (N, 2) by the parameters `free` and by the
    coefficients of a smooth distortion of `degree` (columns, then rows), less the best-fitting rotation of
    the whole detector: each image's attitude is fitted, so that part of a parameter's error has no effect."""
    both = np.vstack([xy_px, detector_grid(camera)])
    u_s = camera.directions_from_pixels(both)
    J, A = pixel_derivatives(camera, u_s, free)
    if degree:
        J = np.concatenate([J, smooth_derivatives(camera, both, degree)], axis=2)
    grid = slice(len(xy_px), None)
    absorbed = np.linalg.lstsq(A[grid].reshape(-1, 3), J[grid].reshape(-1, J.shape[2]), rcond=None)[0]
    return np.asarray((J - A @ absorbed)[: len(xy_px)])


def smooth_derivatives(camera: StarCamera, xy_px: Floats, degree: int) -> Floats:
    """Displacements (N, 2, C) of pixels (N, 2) by each coefficient of a smooth distortion: those of the
    columns, then those of the rows."""
    terms = legendre_terms(xy_px, camera.width_px, camera.height_px, degree)
    (n, count), axis = terms.shape, np.arange(2)
    by_axis = np.zeros((n, 2, 2, count))
    by_axis[:, axis, axis] = terms[:, None]
    return by_axis.reshape(n, 2, 2 * count)


def detector_grid(camera: StarCamera) -> Floats:
    """Pixels (63, 2) of a regular grid over the detector, of a fisheye those with a direction."""
    x, y = np.meshgrid(np.linspace(0, camera.width_px - 1, 9), np.linspace(0, camera.height_px - 1, 7))
    xy = np.column_stack([x.ravel(), y.ravel()])
    return xy[np.isfinite(camera.directions_from_pixels(xy)[:, 2])]


@record(kw_only=True)
class _Images:
    """Stars of K images. Points are x + iy, and symmetric matrices (own, other): they take a point d to
    own d + other conj(d)."""

    xy: Complex  # (N,) centroids
    u_i: Floats  # (N, 3)
    own: Floats  # (N,) of the centroids' covariances: mean of both variances
    other: Complex  # (N,) and half of their difference, plus i times the covariance
    parts: list[slice]  # rows of each image
    time: Floats | float  # (N,) from the mean of the images', s

    @classmethod
    def of(cls, stars: IdentifiedStars) -> _Images:
        ends = np.searchsorted(stars.frame, np.arange(len(stars.t_s) + 1)).tolist()
        (x2, xy, _, y2), from_mean_s = stars.cov_px.reshape(-1, 4).T, stars.t_s - stars.t_s.mean()
        return cls(
            xy=complex_of(stars.xy_px),
            u_i=stars.u_i,
            own=0.5 * (x2 + y2),
            other=0.5 * (x2 - y2) + 1j * xy,
            parts=[slice(*part) for part in pairwise(ends)],
            time=from_mean_s[stars.frame] if len(stars.t_s) > 1 else 0.0,
        )

    def weights(self, common_px2: float) -> tuple[Floats, Complex]:
        """Inverse covariances, a variance common to all stars included."""
        own = self.own + common_px2
        determinant = own * own - self.other.real**2 - self.other.imag**2
        return own / determinant, -self.other / determinant


@record
class _Step:
    """One Gauss-Newton step with the rotations eliminated, and the residuals before it."""

    change: Floats  # (K, F + 3) of the camera, the same for each image, and of its rotation
    covariance: Floats  # (K, F + 3, F + 3) of the same
    in_sigmas: float  # the largest component of the change, in units of its standard error
    residual: Complex  # (N,)
    in_front: Bools  # (N,) a step may carry a star at 90 degrees from the axis behind the camera
    design: Complex  # (F + 3, N) derivatives of the pixels by the camera and by the rotation of the image
    weighted: Complex  # (F + 3, N) the same, times the weights

    def squares(self, images: _Images) -> Floats:
        """(N,) squared residuals that are left after it, to first order."""
        moved = [change @ self.design[:, part] for change, part in zip(self.change, images.parts)]
        left = self.residual - np.concatenate(moved)
        return left.real**2 + left.imag**2

    def leverage(self, images: _Images) -> Floats:
        """(N,) trace of each star's part in the fit."""
        fitted = [cov @ self.design[:, part].view(float) for cov, part in zip(self.covariance, images.parts)]
        by_axis = np.einsum("pn,pn->n", np.concatenate(fitted, axis=1), self.weighted.view(float))
        return by_axis[::2] + by_axis[1::2]


def _step(
    theta: Floats,
    R: Rotation,
    camera: StarCamera,
    images: _Images,
    weights: Sequence[Any],
    columns: list[int],
    prior_weight: Floats,
    pull: Floats,
) -> _Step:
    """`weights` are the stars', zero of those left out; `prior_weight` (F,) and `pull` (F,) the prior's terms
    in the camera's normal equations."""
    u_s = np.concatenate([images.u_i[part] @ turn.T for part, turn in zip(images.parts, R.as_matrix())])
    in_front, F = u_s[:, 2] > 0.0, len(columns)
    projected = _project(theta, camera, u_s, images.time)
    moved = *_camera_rows(projected, camera, images.time, columns), *_rotation_rows(projected)
    X = _filled([*moved, images.xy - projected.pixels], len(u_s))
    own, other = (weight * in_front for weight in weights)
    WX = own * X + other * X.conj()
    products = np.array([X[:, part].view(float) @ WX[:, part].view(float).T for part in images.parts])
    by_rotation = products[:, F:-1]
    held = np.linalg.inv(by_rotation[:, :, F:-1])  # covariances of rotations, by a camera without error
    gain = held @ by_rotation[:, :, :F]  # (K, 3, F) rotations that explain a part of the camera's rows
    free = np.concatenate([np.broadcast_to(np.eye(F), (len(gain), F, F)), -gain], axis=1)
    normal = (free.transpose(0, 2, 1) @ products[:, :-1]).sum(axis=0)  # rotations eliminated
    cov_camera = np.linalg.inv(normal[:, :F] + np.diag(prior_weight))
    cov_camera = 0.5 * (cov_camera + cov_camera.T)  # one image hardly separates x0 and p1: rounding matters
    change = free @ (cov_camera @ (normal[:, -1] + pull))
    change[:, F:] += (held @ by_rotation[:, :, -1:])[:, :, 0]
    covariance = free @ cov_camera @ free.transpose(0, 2, 1)
    covariance[:, F:, F:] += held
    in_sigmas = float((np.abs(change) / np.sqrt(np.einsum("kpp->kp", covariance))).max())
    return _Step(change, covariance, in_sigmas, X[-1], in_front, X[:-1], WX[:-1])


@record
class _Projected:
    """Directions projected by a camera with parameters theta: log f, x0, y0 (px), p1 f, p2 f, q1 f^2, q2 f^4,
    log-f drift (1/s), q3 f^6. Distortion acts on coordinates divided by the nominal focal length, so all are
    of order one. Points and displacements are x + iy, as in `StarCamera`."""

    pixels: Complex  # (N,)
    tangent: Complex  # (N,) tangent plane
    t: Complex  # (N,) undistorted coordinates: projected, times relative focal length
    own: Complex  # (N,) d(pixels) / d(t)
    other: Complex  # (N,) and by the conjugate of t
    own_tangent: Complex  # (N,) d(pixels) / d(tangent)
    other_tangent: Complex  # (N,) and by the conjugate of the tangent


def _project(theta: Floats, camera: StarCamera, u_s: Floats, time: Floats | float) -> _Projected:
    f0, p = camera.focal_m / camera.pixel_m, complex(theta[3], theta[4])
    q1, q2, q3 = theta[[5, 6, 8]].tolist()
    scale = np.exp(theta[0] + theta[7] * time)
    tangent = complex_of(u_s[:, :2] / -u_s[:, 2:])
    projected, own_t, other_t = _projected_tangents(camera, tangent)
    t = projected * scale
    r2, sideways = t.real * t.real + t.imag * t.imag, 2.0 * (p.real * t.real + p.imag * t.imag)
    s = r2 * (q1 + r2 * (q2 + r2 * q3)) + (sideways + 1.0)
    slope = q1 + r2 * (2.0 * q2 + 3.0 * r2 * q3)
    own, other = f0 * (s + r2 * slope + sideways), f0 * t * (slope * t + 2.0 * p)
    pixels = f0 * (s * t + r2 * p) + complex(theta[1], theta[2])
    if camera.smooth is not None:
        pixels = complex_of(camera.smooth.applied(pairs_of(pixels)))
    by_tangent = own, other
    if camera.projection != "tangent":
        by_tangent = own * own_t + other * np.conj(other_t), own * other_t + other * own_t
    return _Projected(pixels, tangent, t, own, other, *(scale * by for by in by_tangent))


def _projected_tangents(
    camera: StarCamera, tangent: Complex
) -> tuple[Complex, Floats | float, Complex | float]:
    """Points (N,) of the tangent plane as the camera projects them, derivatives by these and by their
    conjugates; the former are real."""
    if camera.projection == "tangent":
        return tangent, 1.0, 0.0
    r2 = np.maximum(tangent.real**2 + tangent.imag**2, 1e-18)
    if camera.projection == "stereographic":
        secant = np.sqrt(1.0 + r2)
        ratio = 2.0 / (1.0 + secant)
        slope = -0.5 * ratio * ratio / secant
    else:
        ratio = np.arctan(np.sqrt(r2)) / np.sqrt(r2)
        slope = (1.0 / (1.0 + r2) - ratio) / r2
    return tangent * ratio, ratio + 0.5 * slope * r2, 0.5 * slope * tangent * tangent


def _camera_rows(
    projected: _Projected, camera: StarCamera, time: Floats | float, columns: list[int] | range
) -> Complex:
    """(F, N) derivatives of the pixels by theta."""
    t, f0 = projected.t, camera.focal_m / camera.pixel_m
    r2, square = t.real * t.real + t.imag * t.imag, t * t
    by_scale = projected.own * t + projected.other * np.conj(t)
    radial = f0 * r2 * t
    by_all = (
        by_scale,
        1.0,
        1.0j,
        f0 * (2.0 * r2 + square),
        1.0j * f0 * (2.0 * r2 - square),
        radial,
        r2 * radial,
        by_scale * time,
        r2 * r2 * radial,
    )
    return _filled([by_all[k] for k in columns], len(t))


def _rotation_rows(projected: _Projected) -> Complex:
    """(3, N) derivatives of the pixels by a right-handed rotation about the axes of s: du = e x u."""
    t = projected.tangent
    dt = _filled([1.0j + t.imag * t, -1.0 - t.real * t, 1.0j * t], len(t))
    return np.asarray(projected.own_tangent * dt + projected.other_tangent * np.conj(dt))


def _filled(moved: Sequence[Complex | complex], count: int) -> Complex:
    """(F, N) displacements x + iy, each (N,) or common to all N points."""
    rows = np.empty((len(moved), count), dtype=np.complex128)
    for row, points in zip(rows, moved):
        row[:] = points
    return rows


def _vector(camera: StarCamera, nominal: StarCamera | None = None) -> Floats:
    """(9,) theta of the camera by the focal length of another, or of itself, without a drift."""
    c, nominal = camera, nominal or camera
    scale = np.log(c.focal_m / nominal.focal_m)
    numbers = np.array([0.0, *c.principal_px, c.p1, c.p2, c.q1, c.q2, 0.0, c.q3]) / _units(nominal)
    return np.append(scale, numbers[1:])


def _camera(theta: Floats, nominal: StarCamera) -> StarCamera:
    x0, y0, p1, p2, q1, q2, _, q3 = (theta * _units(nominal))[1:].tolist()
    distortion = {"p1": p1, "p2": p2, "q1": q1, "q2": q2, "q3": q3}
    focal_m = float(nominal.focal_m * np.exp(theta[0]))
    return replace(nominal, focal_m=focal_m, principal_px=(x0, y0), **distortion)


def _units(camera: StarCamera) -> Floats:
    """(9,) of theta: PARAMETERS, DRIFT and Q3 in their own units."""
    f = camera.focal_m * 1e3  # mm
    return np.array([camera.focal_m, 1.0, 1.0, 1 / f, 1 / f, 1 / f**2, 1 / f**4, 1.0, 1 / f**6])
