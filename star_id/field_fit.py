"""Attitude, focal length and distortion of an uncalibrated camera from the identified stars of one image,
each weighted by its own covariance.

Identification weights all stars equally; a bright star has the information of a hundred faint ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Floats, array, record, scalar
from boresight.star_id.beyond_chance import MEDIAN_CHI2
from boresight.star_id.camera_fit import CameraFit, IdentifiedStars, fit_camera
from boresight.star_id.lens_misfit import LensEquations, LensErrors, lens_errors, stretch_size

__all__ = ["FieldFit", "LensFit", "fit_attitude_and_lens"]


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

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    errors: LensErrors = scalar("of attitude, camera and unmodelled distortion")

    @property
    def field(self) -> FieldFit:
        """Attitude and camera, with the errors of the image's centre."""
        cov_s, fov_x_sigma = self.errors.of_centre()
        return FieldFit(self.R_si, cov_s, self.errors.camera, fov_x_sigma, self.errors.displaced_px())

    def predict(self, u_i: Floats) -> tuple[Floats, Floats]:
        """Pixels (N, 2) of directions (N, 3), GCRS, and their covariances (N, 2, 2), px^2."""
        u_s = self.R_si.apply(u_i)
        return self.errors.predict(u_s, self.errors.camera.pixels_from_directions(u_s))


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
    fit, equations = _fit(camera, R_si, xy_px, cov_px, u_i, expected, np.zeros_like(xy_px))
    stretch_px = stretch_size(equations, fit.common_px2)
    for _ in range(2 if stretch_px else 0):  # each to places without the stretch seen before
        moved_px = equations.stretched(stretch_px).displaced_px(xy_px, fit.common_px2)
        fit, equations = _fit(camera, R_si, xy_px, cov_px, u_i, expected, moved_px)
    return LensFit(fit.rotations[0], lens_errors(equations, fit.common_px2, stretch_px))


def _fit(
    camera: StarCamera,
    R_si: Rotation,
    xy_px: Floats,
    cov_px: Floats,
    u_i: Floats,
    expected: StarCamera | None,
    moved_px: Floats,
) -> tuple[CameraFit, LensEquations]:
    """Camera and attitude of centroids that a stretch moved by `moved_px` (N, 2), and equations for what else
    displaces them; other arguments as in `fit_attitude_and_lens`."""
    image = np.zeros(len(xy_px), dtype=np.int64)
    stars = IdentifiedStars(xy_px=xy_px - moved_px, cov_px=cov_px, u_i=u_i, frame=image, t_s=np.zeros(1))
    R = Rotation.concatenate([R_si])
    middle = (0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1))
    ideal = expected or replace(camera, principal_px=middle, p1=0.0, p2=0.0, q1=0.0, q2=0.0)
    prior = _prior_sigmas(camera, 0.0 if expected else 1.0)
    off = xy_px - moved_px - camera.pixels_from_directions(R_si.apply(u_i))
    common = float(np.median((off**2).sum(axis=1))) / MEDIAN_CHI2
    fit = fit_camera(stars, camera, R, prior=prior, expected=ideal, common_px2=common)
    equations = LensEquations.of(fit, fit.rotations[0].apply(u_i), cov_px, prior)
    return fit, replace(equations, residual_px=equations.residual_px + moved_px[fit.keep])


def _prior_sigmas(camera: StarCamera, between: float) -> dict[str, float]:
    """1-sigma deviations of lenses from ideal ones, by parameter: principal point 1 % of the width;
    displacement of the corners 3 % (q1), 1 % (q2) and 0.2 % (decentring) of their radius, and that by which
    projections differ, arctan t = t - t^3 / 3 + t^5 / 5, times `between` (0: the lens is of one kind)."""
    f_mm, off = 1e3 * camera.focal_m, 0.01 * camera.width_px
    corner = 0.5 * np.hypot(camera.width_px, camera.height_px) * camera.pixel_m / camera.focal_m
    decentred = 0.002 / (corner * f_mm)
    return {
        "x0_px": off,
        "y0_px": off,
        "p1": decentred,
        "p2": decentred,
        "q1": float(np.hypot(0.03 / corner**2, between / 3.0)) / f_mm**2,
        "q2": float(np.hypot(0.01 / corner**4, between / 5.0)) / f_mm**4,
    }
