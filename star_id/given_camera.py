"""Attitude of one image of a camera that was given, and whether the camera is as it was given.

A focal length that has changed, a rolling shutter, refraction or another lens displace stars smoothly, and
bias the attitude by much more than the stars' errors. Clean images are tested for that by four sums of the
residuals and keep their attitude. In the others a scale, a stretch and, where the evidence asks for it, a
smooth distortion are fitted with the attitude (`lens_misfit`), whose covariance states what they leave open.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from boresight.geometry.constants import ABERRATION
from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Bools, Floats, array, record, scalar
from boresight.star_id.beyond_chance import FEW_STARS, LOST_BY_CHANCE, MEDIAN_CHI2, SELDOM_SIGMA
from boresight.star_id.common_variance import share_by_evidence
from boresight.star_id.field_fit import FieldFit
from boresight.star_id.image_attitude import ImageAttitude, fit_image_attitude
from boresight.star_id.lens_misfit import (
    SIZES_PX,
    LensEquations,
    LensErrors,
    lens_errors,
    stretch_size,
    with_common_variance,
)

__all__ = ["ScaledFit", "fit_known_camera", "fit_scaled_camera", "focal_derivatives"]


# Log likelihood that scale and stretch gain, half their squares in their variances, from which the camera is
# not as given: 3 degrees of freedom, 2 % of clean images by chance. What is below it biases the roll by up to
# three times its error.
_LINEAR_SEEN = 5.0


def fit_known_camera(
    camera: StarCamera, xy_px: Floats, cov_px: Floats, u_i: Floats, R_si: Rotation
) -> FieldFit:
    """Attitude of a calibrated camera from centroids (N, 2), px, covariances (N, 2, 2) and directions (N, 3),
    GCRS; `R_si` is good to some pixels.

    Outliers are rejected; the covariance is scaled by the reduced chi2 if that exceeds 1. Where the stars
    show that the camera is not as given, the attitude is that of `_departing`, in between a mean of both.
    """
    attitude = fit_image_attitude(camera.pixel_slopes(xy_px), cov_px, u_i, R_si, LOST_BY_CHANCE)
    variance_factor = max(1.0, attitude.chi2 / max(attitude.dof, 1))
    fit = FieldFit(attitude.R_si, variance_factor * attitude.cov_s, camera, 0.0, 0.0)
    share = _share_that_departs(xy_px, cov_px, attitude)
    departing = _departing(camera, xy_px, cov_px, u_i, attitude) if share else None
    return fit if departing is None else _mean_of(fit, departing, share)


def _mean_of(fit: FieldFit, departing: FieldFit, share: float) -> FieldFit:
    """Mean of two attitudes of one image, the second of which has this share; their difference is in the
    covariance."""
    turn = (departing.R_si * fit.R_si.inv()).as_rotvec()
    cov_s = (1.0 - share) * fit.cov_s + share * departing.cov_s + share * (1.0 - share) * np.outer(turn, turn)
    R_si = Rotation.from_rotvec(share * turn) * fit.R_si
    return FieldFit(R_si, cov_s, fit.camera, 0.0, share * departing.misfit_px)


@record
class ScaledFit:
    """Attitude of one image and the scale of its camera."""

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    log_scale: float = scalar("logarithm of the focal length over the camera's; 0 if it was not measured")
    covariance: Floats = array(
        "P, P", "of a small rotation about the axes of s, rad, and of log_scale, if it was measured"
    )
    misfit_px: float = scalar("rms displacement of stars from the camera's model, an axis, px; 0: none seen")


def fit_scaled_camera(
    camera: StarCamera, xy_px: Floats, cov_px: Floats, u_i: Floats, R_si: Rotation
) -> ScaledFit:
    """Attitude and scale of a calibrated camera from N stars; arguments (N, ...) as in `fit_known_camera`.

    Where the stars show more than another focal length, the attitude is that of `_departing`, and the scale
    is not measured.
    """
    slopes = camera.pixel_slopes(xy_px)
    by_scale = focal_derivatives(camera, slopes, R_si.apply(u_i))
    fit = fit_image_attitude(slopes, cov_px, u_i, R_si, LOST_BY_CHANCE, by_scale=by_scale)
    if _share_that_departs(xy_px, cov_px, fit) >= 0.5:
        departing = _departing(camera, xy_px, cov_px, u_i, fit)
        if departing is not None and departing.misfit_px > 0.0:
            return ScaledFit(departing.R_si, 0.0, departing.cov_s, departing.misfit_px)
    variance_factor = max(1.0, fit.chi2 / max(fit.dof, 1))
    return ScaledFit(fit.R_si, fit.scale, variance_factor * fit.covariance, 0.0)


def focal_derivatives(camera: StarCamera, slopes: Floats, u_s: Floats) -> Floats:
    """Derivatives (N, 2) of the pixels of directions (N, 3), frame s, by the logarithm of the focal length,
    from those by direction, `slopes` (N, 2, 3).

    An image point at r(t) from the axis, t its angle, has the derivatives r by the former and -sin(t) r'(t)
    by the z of the direction: r = f tan t, f t or 2 f tan(t/2).
    """
    z = u_s[:, 2]
    if camera.projection == "tangent":
        factor = z
    elif camera.projection == "stereographic":
        factor = np.ones_like(z)
    else:
        angle = np.maximum(np.arccos(np.minimum(z, 1.0)), 1e-9)
        factor = angle / np.sin(angle)
    return np.asarray(-slopes[:, :, 2] * factor[:, None])


def _share_that_departs(xy_px: Floats, cov_px: Floats, attitude: ImageAttitude) -> float:
    """How sure it is, from 0 to 1, that chi-square, or a scale (unless it is fitted) and stretch in the
    residuals of pixels (N, 2), are beyond chance.

    With z the star's place from the mean, r its residual, both as complex numbers, and v its variance, the
    estimate of a scale is  sum Re(conj(z) r) / v  over  sum |z|^2 / v,  that of a stretch  sum z r / v.
    """
    if len(xy_px) < FEW_STARS:
        return 0.0
    excess = (attitude.chi2 - attitude.dof) / math.sqrt(2.0 * attitude.dof)
    weight = attitude.kept / (0.5 * (cov_px[:, 0, 0] + cov_px[:, 1, 1]))
    r = attitude.residual_px.view(np.complex128)[:, 0] * weight
    z = np.ascontiguousarray(xy_px).view(np.complex128)[:, 0]
    z = z - weight @ z / weight.sum()
    scale, stretch = np.vdot(z, r).real, z @ r
    gained = 0.5 * float((scale**2 + abs(stretch) ** 2) / np.vdot(z, weight * z).real)
    return max(share_by_evidence(excess, SELDOM_SIGMA), share_by_evidence(gained, _LINEAR_SEEN))


def _departing(
    camera: StarCamera, xy_px: Floats, cov_px: Floats, u_i: Floats, attitude: ImageAttitude
) -> FieldFit | None:
    """Attitude of the image's centre with what displaces the stars fitted, too; None where it cannot be."""
    R_si, kept = attitude.R_si, attitude.kept
    for _ in range(4):  # rejecting outliers and fitting again
        if kept.sum() < FEW_STARS:
            return None
        u_s = R_si.apply(u_i)
        try:
            errors = _errors(LensEquations.of_given(camera, u_s[kept], xy_px[kept], cov_px[kept]))
        except np.linalg.LinAlgError:  # the camera does not reach its edges
            return None
        before, kept = kept, _agreeing(errors, u_s, xy_px, cov_px)
        if np.array_equal(before, kept):
            break
    turn, cov_s = errors.turned()
    scale = errors.mean[3] / camera.focal_m
    # the Earth's velocity changes angles by half of that
    linear_only = len(errors.mean) == 4 and abs(scale) < 2.0 * ABERRATION
    misfit_px = 0.0 if linear_only else errors.displaced_px()
    return FieldFit(Rotation.from_rotvec(turn) * R_si, cov_s, camera, 0.0, misfit_px)


def _errors(equations: LensEquations) -> LensErrors:
    """Errors with a variance common to all stars, as the residuals of a scale and any stretch show it."""
    linear = equations.stretched(float(SIZES_PX[-1]))  # no prior
    common = with_common_variance(linear, 0.0)
    residual = linear.residual_px - linear.columns @ linear.solved(common).mean
    square = np.einsum(
        "ki,kij,kj->", residual, np.linalg.inv(equations.cov_px + common * np.eye(2)), residual
    )
    factor = max(1.0, float(square) / max(residual.size - linear.columns.shape[2], 1))
    scattered = replace(equations, variance_factor=factor)
    return lens_errors(scattered, common, stretch_size(scattered, common))


def _agreeing(errors: LensErrors, u_s: Floats, xy_px: Floats, cov_px: Floats) -> Bools:
    """(N,) stars within the limit of `LOST_BY_CHANCE` of the places that are predicted."""
    predicted, _ = errors.predict(u_s, errors.camera.pixels_from_directions(u_s))
    off = xy_px - predicted
    inverse = np.linalg.inv(cov_px + errors.common_px2 * np.eye(2))
    square = np.nan_to_num(np.einsum("ni,nij,nj->n", off, inverse, off), nan=np.inf)
    scatter = max(1.0, float(np.median(square) / MEDIAN_CHI2))
    return square <= scatter * float(chdtri(2, LOST_BY_CHANCE))
