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

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import Complex, StarCamera, legendre_terms, pairs_of
from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import MEDIAN_CHI2, SELDOM_SIGMA
from boresight.star_id.common_variance import SMALL_CHANGE, common_variance

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
    frame: Ints = array("N", "image of each star, 0 to K - 1")
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
    stars = replace(stars, t_s=stars.t_s - stars.t_s.mean())
    theta, R, keep = _vector(camera), rotations, np.ones(len(stars.xy_px), dtype=bool)
    own, common, settled = 0.5 * np.trace(stars.cov_px, axis1=1, axis2=2), common_px2 or 0.0, True
    variance, weight = own + common, _weights(stars.cov_px, common)
    for k in range(12):
        pull = prior_weight * (first - theta[columns])
        with np.errstate(over="ignore", invalid="ignore"):  # of a fit that diverges
            step = _step(theta, R, camera, stars, weight * keep[:, None, None], columns, prior_weight, pull)
        theta = theta.copy()
        theta[columns] += step.d_camera
        if not np.isfinite(theta).all() or abs(theta[0]) > _LARGEST_LOG_SCALE:
            raise np.linalg.LinAlgError("the fitted camera cannot image all of the stars")
        R = Rotation.from_rotvec(step.d_rotation) * R
        if k and common_px2 is not None:
            leverage, used = step.leverage(weight, stars.frame), keep & step.in_front
            before, common = common, common_variance(step.residual[used], leverage[used], own[used], common)
            settled = abs(common - before) <= SMALL_CHANGE * before
            variance, weight = own + common, _weights(stars.cov_px, common)
        chi2 = 0.5 * (step.residual**2).sum(axis=1) / variance  # a degree of freedom
        if k < 2:  # from a nominal camera all stars look like outliers
            continue
        inlier = chi2 < SELDOM_SIGMA**2 * max(1.0, 2.0 * float(np.median(chi2[keep])) / MEDIAN_CHI2)
        if 2 * inlier.sum() <= len(free) + 3 * len(stars.t_s):  # too few would be left
            inlier = keep
        if np.array_equal(inlier, keep) and settled and step.in_sigmas < SMALL_STEP:
            break
        keep = inlier
    residual = step.residual[keep]
    total = float(np.einsum("ni,nij,nj->", residual, weight[keep], residual))
    dof = 2 * int(keep.sum()) - len(free) - 3 * len(stars.t_s)
    variance_factor = max(1.0, total / max(dof, 1))
    return CameraFit(
        camera=_camera(theta, camera),
        focal_drift_per_s=float(theta[7]),
        rotations=R,
        covariance=np.asarray(variance_factor * step.cov_camera * units[:, None] * units),
        variance_factor=variance_factor,
        common_px2=common,
        residual_px=step.residual,
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
    by_camera = _camera_columns(projected, camera, 0.0, columns) / _units(camera)[columns]
    return by_camera, _rotation_columns(projected)


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


def _weights(cov_px: Floats, common_px2: float) -> Floats:
    """(N, 2, 2) inverse covariances, a variance common to all stars included."""
    return np.asarray(np.linalg.inv(cov_px + common_px2 * np.eye(2)))


@record
class _Step:
    """One Gauss-Newton step with the rotations eliminated, and the residuals before it."""

    d_camera: Floats  # (F,)
    d_rotation: Floats  # (K, 3)
    cov_camera: Floats  # (F, F)
    residual: Floats  # (N, 2)
    in_front: Bools  # (N,) a step may carry a star at 90 degrees from the axis behind the camera
    J: Floats  # (N, 2, F) derivatives of the pixels by the camera
    A: Floats  # (N, 2, 3) and by the rotation of the image
    gain: Floats  # (K, 3, F) rotations that explain a part of J
    cov_held: Floats  # (K, 3, 3) of rotations, by a camera without error

    @property
    def in_sigmas(self) -> float:
        """The largest component of the step, in units of its standard error."""
        cov_rotation = self.cov_held + self.gain @ self.cov_camera @ self.gain.transpose(0, 2, 1)
        sigma = np.sqrt(np.append(np.diag(self.cov_camera), np.einsum("kii->ki", cov_rotation)))
        return float(np.abs(np.append(self.d_camera, self.d_rotation) / sigma).max())

    def leverage(self, W: Floats, frame: Ints) -> Floats:
        """(N,) trace of each star's part in the fit, by the weights (N, 2, 2) and images (N,)."""
        J = self.J - self.A @ self.gain[frame]
        fitted = J @ self.cov_camera @ J.transpose(0, 2, 1)
        fitted += self.A @ self.cov_held[frame] @ self.A.transpose(0, 2, 1)
        return np.einsum("nij,nji->n", fitted, W)


def _step(
    theta: Floats,
    R: Rotation,
    camera: StarCamera,
    stars: IdentifiedStars,
    W: Floats,
    columns: list[int],
    prior_weight: Floats,
    pull: Floats,
) -> _Step:
    """`W` (N, 2, 2) are the stars' weights, zero of those left out; `prior_weight` (F,) and `pull` (F,) the
    prior's terms in the camera's normal equations."""
    u_s = np.einsum("nij,nj->ni", R.as_matrix()[stars.frame], stars.u_i)
    time, in_front = stars.t_s[stars.frame], u_s[:, 2] > 0.0
    projected = _project(theta, camera, u_s, time)
    residual = stars.xy_px - projected.pixels
    J, A = _camera_columns(projected, camera, time, columns), _rotation_columns(projected)
    weight = W * in_front[:, None, None]
    products = _products_by_image(np.concatenate([J, A, residual[:, :, None]], axis=2), weight, stars)
    F = len(columns)
    Naa, Nca, ga = products[:, F:-1, F:-1], products[:, :F, F:-1], products[:, F:-1, -1]
    cov_held = np.asarray(np.linalg.inv(Naa))
    gain = cov_held @ Nca.transpose(0, 2, 1)  # (K, 3, F)
    normal = products[:, :F, :F].sum(axis=0) - (Nca @ gain).sum(axis=0) + np.diag(prior_weight)
    g = products[:, :F, -1].sum(axis=0) - np.einsum("kap,ka->p", gain, ga) + pull
    d_camera = np.linalg.solve(normal, g)
    d_rotation = (cov_held @ ga[:, :, None])[:, :, 0] - gain @ d_camera
    cov_camera = np.linalg.inv(normal)
    cov_camera = 0.5 * (cov_camera + cov_camera.T)  # one image hardly separates x0 and p1: rounding matters
    return _Step(d_camera, d_rotation, cov_camera, residual, in_front, J, A, np.asarray(gain), cov_held)


def _products_by_image(X: Floats, W: Floats, stars: IdentifiedStars) -> Floats:
    """Sums (K, M, M) of Xᵀ W X over the stars of each image, of X (N, 2, M) and weights W (N, 2, 2)."""
    order = np.argsort(stars.frame, kind="stable")
    ends = 2 * np.searchsorted(stars.frame, np.arange(len(stars.t_s) + 1), sorter=order)
    X = X[order]
    flat, weighted = (part.reshape(-1, X.shape[2]) for part in (X, W[order] @ X))
    return np.array([flat[a:b].T @ weighted[a:b] for a, b in pairwise(ends.tolist())])


@record
class _Projected:
    """Directions projected by a camera with parameters theta: log f, x0, y0 (px), p1 f, p2 f, q1 f^2, q2 f^4,
    log-f drift (1/s), q3 f^6. Distortion acts on coordinates divided by the nominal focal length, so all are
    of order one. Points and displacements are x + iy, as in `StarCamera`."""

    pixels: Floats  # (N, 2)
    tangent: Complex  # (N,) tangent plane
    t: Complex  # (N,) undistorted coordinates: projected, times relative focal length
    own: Complex  # (N,) d(pixels) / d(t)
    other: Complex  # (N,) and by the conjugate of t
    own_tangent: Complex  # (N,) d(pixels) / d(tangent)
    other_tangent: Complex  # (N,) and by the conjugate of the tangent


def _project(theta: Floats, camera: StarCamera, u_s: Floats, time: Floats | float) -> _Projected:
    f0, p = camera.focal_m / camera.pixel_m, complex(theta[3], theta[4])
    q1, q2, q3 = theta[[5, 6, 8]].tolist()
    scale = np.exp(theta[0] + theta[7] * np.asarray(time))
    tangent = np.ascontiguousarray(u_s[:, :2] / -u_s[:, 2:]).view(np.complex128)[:, 0]
    projected, own_t, other_t = _projected_tangents(camera, tangent)
    t = projected * scale
    r2, sideways = t.real * t.real + t.imag * t.imag, 2.0 * (p.real * t.real + p.imag * t.imag)
    s = r2 * (q1 + r2 * (q2 + r2 * q3)) + (sideways + 1.0)
    slope = q1 + r2 * (2.0 * q2 + 3.0 * r2 * q3)
    own, other = f0 * (s + r2 * slope + sideways), f0 * t * (slope * t + 2.0 * p)
    pixels = theta[1:3] + pairs_of(f0 * (s * t + r2 * p))
    if camera.smooth is not None:
        pixels = camera.smooth.applied(pixels)
    by_tangent = scale * (own * own_t + other * np.conj(other_t)), scale * (own * other_t + other * own_t)
    return _Projected(pixels, tangent, t, own, other, *by_tangent)


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


def _camera_columns(
    projected: _Projected, camera: StarCamera, time: Floats | float, columns: list[int] | range
) -> Floats:
    """(N, 2, F) derivatives of the pixels by theta."""
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
    return _as_columns([by_all[k] for k in columns], len(t))


def _rotation_columns(projected: _Projected) -> Floats:
    """(N, 2, 3) derivatives of the pixels by a right-handed rotation about the axes of s: du = e x u."""
    t = projected.tangent
    by_rotation = 1.0j + t.imag * t, -1.0 - t.real * t, 1.0j * t
    moved = (projected.own_tangent * dt + projected.other_tangent * np.conj(dt) for dt in by_rotation)
    return _as_columns(list(moved), len(t))


def _as_columns(moved: Sequence[Complex | complex], count: int) -> Floats:
    """(N, 2, F) derivatives from displacements x + iy, each (N,) or common to all N points."""
    rows = np.empty((count, len(moved)), dtype=np.complex128)
    for k, column in enumerate(moved):
        rows[:, k] = column
    return np.stack([rows.real, rows.imag], axis=1)


def _vector(camera: StarCamera, nominal: StarCamera | None = None) -> Floats:
    """(9,) theta of the camera by the focal length of another, or of itself, without a drift."""
    c, nominal = camera, nominal or camera
    scale = np.log(c.focal_m / nominal.focal_m)
    numbers = np.array([0.0, *c.principal_px, c.p1, c.p2, c.q1, c.q2, 0.0, c.q3]) / _units(nominal)
    return np.append(scale, numbers[1:])


def _camera(theta: Floats, nominal: StarCamera) -> StarCamera:
    numbers = theta * _units(nominal)
    x0, y0, p1, p2, q1, q2, _, q3 = (float(number) for number in numbers[1:])
    return replace(
        nominal,
        focal_m=float(nominal.focal_m * np.exp(theta[0])),
        principal_px=(x0, y0),
        p1=p1,
        p2=p2,
        q1=q1,
        q2=q2,
        q3=q3,
    )


def _units(camera: StarCamera) -> Floats:
    """(9,) of theta: PARAMETERS, DRIFT and Q3 in their own units."""
    f = camera.focal_m * 1e3  # mm
    return np.array([camera.focal_m, 1.0, 1.0, 1 / f, 1 / f, 1 / f**2, 1 / f**4, 1.0, 1 / f**6])
