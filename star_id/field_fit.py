"""Attitude of one image from identified stars, each weighted by its own covariance, and, for an uncalibrated
camera, its focal length and distortion.

Identification weights all stars equally; a bright star has the information of a hundred faint ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_estimate import AttitudeSettings, fit_attitude
from boresight.geometry.record import Floats, array, record, scalar
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_fit import (
    PARAMETERS,
    CameraFit,
    IdentifiedStars,
    fit_camera,
    perturbed,
    pixel_derivatives,
    rotation_derivatives,
)

__all__ = ["FieldFit", "fit_attitude_and_lens", "fit_known_camera"]


_LARGEST_VARIANCE = 1e12  # px^2: no degree of freedom is left
# Stars of an image are many and its camera is only roughly known: see `limit_from_scatter`.
_REJECTION = AttitudeSettings(probability_false_alarm=1e-4, limit_from_scatter=True)
_ROUNDS = 8  # of camera and common variance in turn


@record
class FieldFit:
    """Attitude of one image and the camera that it holds for."""

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    cov_s: Floats = array("3, 3", "of a right-handed rotation of the image's centre about axes s, rad^2")
    camera: StarCamera = scalar("as given, or fitted")
    fov_x_sigma_rad: float = scalar("1-sigma error of the field of view, rad; 0 for a camera that was given")


def fit_known_camera(camera: StarCamera, xy_px: Floats, cov_px: Floats, u_i: Floats) -> FieldFit:
    """Attitude of a calibrated camera from centroids (N, 2), px, covariances (N, 2, 2) and directions (N, 3),
    GCRS.

    Outliers are rejected; the covariance is scaled by the reduced chi2 if that exceeds 1.
    """
    J = camera.pixel_jacobian(xy_px)
    cov_s = J @ cov_px @ J.transpose(0, 2, 1)
    attitude = fit_attitude(camera.directions_from_pixels(xy_px), u_i, cov_s, _REJECTION)
    variance_factor = max(1.0, attitude.chi2 / max(attitude.dof, 1))
    return FieldFit(attitude.R_si, variance_factor * attitude.cov_s, camera, 0.0)


def fit_attitude_and_lens(
    camera: StarCamera, R_si: Rotation, xy_px: Floats, cov_px: Floats, u_i: Floats
) -> FieldFit:
    """Attitude and camera from centroids (N, 2), px, covariances (N, 2, 2) and directions (N, 3), GCRS.

    `camera` and `R_si` are approximate. All seven camera parameters are fitted. One image does not separate
    them: a shifted detector looks like a rotated and decentred one. So a Gaussian prior regularises them
    (`_prior_sigmas`), and the covariance is that of the well-determined direction of the image's centre. What
    the camera model cannot explain, such as refraction, is a position error common to all stars
    (`_common_variance`); without it the few brightest stars would determine the distortion.
    """
    image = np.zeros(len(xy_px), dtype=np.int64)
    stars = IdentifiedStars(xy_px=xy_px, cov_px=cov_px, u_i=u_i, frame=image, t_s=np.zeros(1))
    plain, R = replace(camera, p1=0.0, p2=0.0, q1=0.0), Rotation.concatenate([R_si])
    residual = xy_px - camera.pixels_from_directions(R_si.apply(u_i))
    common = float(np.median((residual**2).sum(axis=1))) / 1.386  # median of chi2 with two degrees of freedom
    for _ in range(_ROUNDS):
        cov = cov_px + common * np.eye(2)
        fit = fit_camera(replace(stars, cov_px=cov), plain, R, prior=_prior_sigmas(plain))
        centre = _CentreSensitivity.of(fit, stars, cov)
        common, before = _common_variance(fit, centre.leverage, cov_px, common), common
        if abs(common - before) <= 0.1 * before:
            break
    fov_x = float(np.sqrt(centre.d_fov_x @ fit.covariance @ centre.d_fov_x))
    cov_s = fit.variance_factor * centre.cov_known_camera
    cov_s = cov_s + centre.d_rotation @ fit.covariance @ centre.d_rotation.T
    return FieldFit(fit.rotations[0], cov_s, fit.camera, fov_x)


def _prior_sigmas(camera: StarCamera) -> dict[str, float]:
    """1-sigma deviations of lenses from ideal ones, by parameter: principal point 1 % of the width;
    displacement of the corners 3 % (q1), 1 % (q2) and 0.2 % (decentring) of their radius."""
    f_mm, off = 1e3 * camera.focal_m, 0.01 * camera.width_px
    corner = 0.5 * np.hypot(camera.width_px, camera.height_px) * camera.pixel_m / camera.focal_m
    decentred = 0.002 / (corner * f_mm)
    return {
        "x0_px": off,
        "y0_px": off,
        "p1": decentred,
        "p2": decentred,
        "q1": 0.03 / (corner * f_mm) ** 2,
        "q2": 0.01 / (corner * f_mm) ** 4,
    }


@dataclass(frozen=True, slots=True, eq=False)
class _CentreSensitivity:
    """Errors of the image's centre and width, as functions of the errors of stars and camera parameters.

    A rotation about the image's centre is nearly independent of all parameters; a rotation about the optical
    axis, which may lie anywhere, would be a small difference of large terms.
    """

    cov_known_camera: Floats  # (3, 3) rad^2, of a rotation of the centre if the camera were known
    d_rotation: Floats  # (3, 7) derivatives of that rotation by the camera's parameters
    leverage: Floats  # (N,) trace of each kept star's part in the fit
    d_fov_x: Floats  # (7,) derivatives of the field of view, rad

    @staticmethod
    def of(fit: CameraFit, stars: IdentifiedStars, cov_px: Floats) -> _CentreSensitivity:
        rows = fit.keep.nonzero()[0]
        u_s = fit.rotations[0].apply(stars.u_i[rows])
        sigmas = np.sqrt(np.diag(fit.covariance))
        slopes = np.array([_centre_slope(fit.camera, name, sigma) for name, sigma in zip(PARAMETERS, sigmas)])
        A = rotation_derivatives(fit.camera, u_s)
        J = pixel_derivatives(fit.camera, u_s) + A @ slopes[:, :3].T
        W = np.linalg.inv(cov_px[rows])
        AW = A.transpose(0, 2, 1) @ W
        cov = np.linalg.inv((AW @ A).sum(axis=0))
        d_rotation = cov @ (AW @ J).sum(axis=0)
        left = J - A @ d_rotation
        unscaled = fit.covariance / fit.variance_factor
        leverage = np.einsum("nij,nip,pq,njq->n", W, A, cov, A, optimize=True)
        leverage += np.einsum("nij,nip,pq,njq->n", W, left, unscaled, left, optimize=True)
        return _CentreSensitivity(cov, d_rotation, leverage, slopes[:, 3])


def _centre_slope(camera: StarCamera, name: str, step: float) -> Floats:
    """(4,) derivatives by a camera parameter: rotation of the image's centre about the axes of s (3), and
    field of view, rad."""
    more, less = perturbed(camera, name, 0.5 * step), perturbed(camera, name, -0.5 * step)
    rotation = Rotation.from_matrix(more.middle_axes() @ less.middle_axes().T).as_rotvec()
    return np.append(rotation, more.fov_x_rad - less.fov_x_rad) / step


def _common_variance(fit: CameraFit, leverage: Floats, cov_px: Floats, before: float) -> float:
    """Variance, px^2 along one axis, of a position error common to all stars, by restricted maximum
    likelihood.

    At the maximum  sum (2 - h) / v = sum r^2 / v^2,  v the total variance of a star along one axis, r its
    residual, h its `leverage` (N,), computed with the variance `before`.
    """
    own = 0.5 * np.trace(cov_px[fit.keep], axis1=1, axis2=2)
    square = (fit.residual_px[fit.keep] ** 2).sum(axis=1)

    def excess(variance: float) -> float:
        v = own + variance
        return float((square / v**2).sum() - ((2.0 - leverage) / v).sum())

    if excess(0.0) <= 0.0:
        return 0.0
    most = float(square.sum() + own.max())
    while excess(most) > 0.0 and most < _LARGEST_VARIANCE:  # from somewhere on it falls as -dof / variance
        most *= 2.0
    return float(brentq(excess, 0.0, most)) if most < _LARGEST_VARIANCE else before
