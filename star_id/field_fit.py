"""Attitude, focal length and distortion of an uncalibrated camera from the identified stars of one image,
each weighted by its own covariance.

Identification weights all stars equally; a bright star has the information of a hundred faint ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.record import Floats, array, record, scalar
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_fit import CameraFit, IdentifiedStars, fit_camera
from boresight.star_id.lens_misfit import LensEquations, LensErrors, lens_errors

__all__ = ["FieldFit", "LensFit", "common_variance", "fit_attitude_and_lens"]


# Common variance, px^2, at which the search for it ends: so large only where no degree of freedom is left.
_LARGEST_VARIANCE = 1e12
# Halvings of the interval of the common variance: to the last digits. `scipy.optimize.brentq` takes 0.1 s
# to load.
_HALVINGS = 50
# Most rounds of fitting the camera and the common variance in turn (set by hand).
_ROUNDS = 8
# Further fits of the camera, each to places without the stretch that was seen before.
_STRETCH_ROUNDS = 2
# Gain of log likelihood by a variance common to all stars for it to be stated: one, for its one parameter
# (Akaike 1974).
_COMMON_LOG_LIKELIHOOD = 1.0


@record
class FieldFit:
    """Attitude of one image and the camera that it holds for."""

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    cov_s: Floats = array("3, 3", "of a right-handed rotation of the image's centre about axes s, rad^2")
    camera: StarCamera = scalar("as given, or fitted")
    fov_x_sigma_rad: float = scalar("1-sigma error of the field of view, rad; 0 for a camera that was given")
    misfit_px: float = scalar("rms displacement of stars from the camera's model, an axis, px; 0: none seen")


@record
class LensFit:
    """Attitude and fitted camera of one image, and the places of stars that they predict."""

    field: FieldFit = scalar("attitude and camera")
    errors: LensErrors = scalar("of attitude, camera and unmodelled distortion")

    def predict(self, u_i: Floats) -> tuple[Floats, Floats]:
        """Pixels (N, 2) of directions (N, 3), GCRS, and their covariances (N, 2, 2), px^2."""
        u_s = self.field.R_si.apply(u_i)
        xy = self.field.camera.pixels_from_directions(u_s)
        return self.errors.predict(u_s, xy)


def fit_attitude_and_lens(
    camera: StarCamera,
    R_si: Rotation,
    xy_px: Floats,
    cov_px: Floats,
    u_i: Floats,
    expected: StarCamera | None = None,
) -> LensFit:
    """Attitude and camera from centroids (N, 2), px, covariances (N, 2, 2) and directions (N, 3), GCRS.

    `camera` and `R_si` are approximate; `expected` is the lens that the prior is about; else one without
    distortion. All seven camera parameters are fitted. One image does not separate them: a shifted detector
    looks like a rotated and decentred one. So a Gaussian prior regularises them (`_prior_sigmas`), and the
    covariance is that of the well-determined direction of the image's centre. What the camera model cannot
    explain is a position error of each star (`common_variance`; without it the few brightest stars would
    determine the distortion), a stretch and a smooth distortion (`lens_misfit`). A stretch that is seen is
    taken off the centroids and all is fitted again: distortion and decentring absorb a part of it, by terms
    that are not linear.
    """
    fit, errors = _fit(camera, R_si, xy_px, cov_px, u_i, expected, np.zeros_like(xy_px))
    for _ in range(_STRETCH_ROUNDS):
        if not errors.stretch_px:
            break
        without = _fit(camera, R_si, xy_px, cov_px, u_i, expected, errors.stretched_px(xy_px))
        if not without[1].stretch_px:  # at the limit of being seen
            break
        fit, errors = without
    cov_s, fov_x_sigma = errors.of_centre()
    return LensFit(FieldFit(fit.rotations[0], cov_s, fit.camera, fov_x_sigma, errors.displaced_px()), errors)


def _fit(
    camera: StarCamera,
    R_si: Rotation,
    xy_px: Floats,
    cov_px: Floats,
    u_i: Floats,
    expected: StarCamera | None,
    moved_px: Floats,
) -> tuple[CameraFit, LensErrors]:
    """Camera and attitude of centroids that a stretch moved by `moved_px` (N, 2), and the errors of both;
    other arguments as in `fit_attitude_and_lens`."""
    image = np.zeros(len(xy_px), dtype=np.int64)
    stars = IdentifiedStars(xy_px=xy_px - moved_px, cov_px=cov_px, u_i=u_i, frame=image, t_s=np.zeros(1))
    R = Rotation.concatenate([R_si])
    middle = (0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1))
    ideal = expected or replace(camera, principal_px=middle, p1=0.0, p2=0.0, q1=0.0, q2=0.0)
    prior = _prior_sigmas(camera)
    residual = xy_px - moved_px - camera.pixels_from_directions(R_si.apply(u_i))
    common = float(np.median((residual**2).sum(axis=1))) / 1.386  # median of chi2 with two degrees of freedom
    for _ in range(_ROUNDS):
        cov = cov_px + common * np.eye(2)
        fit = fit_camera(replace(stars, cov_px=cov), camera, R, prior=prior, expected=ideal)
        equations = LensEquations.of(fit, fit.rotations[0].apply(u_i), cov_px, prior)
        own = 0.5 * np.trace(cov_px[fit.keep], axis1=1, axis2=2)
        leverage, before = equations.leverage(common), common
        common = common_variance(fit.residual_px[fit.keep], leverage, own, before)
        if abs(common - before) <= 0.1 * before:
            break
    whole = replace(equations, residual_px=equations.residual_px + moved_px[fit.keep])
    return fit, lens_errors(whole, common)


def common_variance(residual_px: Floats, leverage: Floats, own_px2: Floats, before: float) -> float:
    """Variance, px^2 along one axis, of a position error common to all stars, by restricted maximum
    likelihood, from residuals (N, 2), px, of stars with variances (N,) of their own.

    At the maximum  sum (2 - h) / v = sum r^2 / v^2,  v the total variance of a star along one axis, r its
    residual, h its `leverage` (N,), computed with the variance `before`. It is zero where the likelihood does
    not ask for it: of stars as good as stated half show some by chance, of which errors would be overstated.
    """
    square = (residual_px**2).sum(axis=1)

    def excess(variance: float) -> float:
        v = own_px2 + variance
        return float((square / v**2).sum() - ((2.0 - leverage) / v).sum())

    if excess(0.0) <= 0.0:
        return 0.0
    most = float(square.sum() + own_px2.max())
    while excess(most) > 0.0 and most < _LARGEST_VARIANCE:  # from somewhere on it falls as -dof / variance
        most *= 2.0
    if most >= _LARGEST_VARIANCE:
        return before
    least = 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (least + most)
        least, most = (middle, most) if excess(middle) > 0.0 else (least, middle)

    def log_likelihood(variance: float) -> float:
        v = own_px2 + variance
        return -0.5 * float((square / v + (2.0 - leverage) * np.log(v)).sum())

    found = 0.5 * (least + most)
    gained = log_likelihood(found) - log_likelihood(0.0)
    return found if gained > _COMMON_LOG_LIKELIHOOD else 0.0


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
