"""Calibration of a star camera: focal length, principal point and distortion from identified stars of many
images.

An approximate nominal camera is enough: the first identification treats it as uncalibrated. The lens model is
chosen by evidence (`lens_model`); a lens that none explains is refused, with the size of the misfit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import LEAST_FORWARD, StarCamera
from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.camera_fit import (
    DRIFT,
    IdentifiedStars,
    detector_grid,
    fit_camera,
    visible_derivatives,
)
from boresight.star_id.field import FieldSolution, solve_list, solve_stars
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.fisheye import FISHEYE_RAD
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.lens_model import LARGEST_UNMODELLED_PX, LensModel, choose_lens, unmodelled_px
from boresight.star_id.observer import ABERRATION_SCALE, Observer, proper_motion_covariance, star_directions
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import select_for_calibration

__all__ = ["CameraCalibration", "ResidualMap", "SkyFrame", "calibrate_camera", "residual_map"]


# Random pixel maps drawn from the covariance for the error that holds anywhere on the detector with 95 %;
# with 2000 the quantile's probability is good to 0.5 %, sqrt(0.95 * 0.05 / 2000).
_DRAWN_MAPS = 2000
# Reduced chi-square up to which Brown's model predicts stars well enough to name them; above it the lens
# model is chosen by evidence first (set by hand).
_ROUGHLY = 1.5


@record
class SkyFrame:
    """Stars found in one image, and its observer if known."""

    frame_id: str = scalar("name of the image")
    stars: StarList = scalar("stars found")
    observer: Observer | None = scalar("place and time of the image", default=None)


@record(kw_only=True)
class CameraCalibration:
    """Calibrated camera, with residuals. Row n of the (N,) arrays is the same star."""

    camera: StarCamera = scalar("calibrated camera")
    parameters: tuple[str, ...] = scalar("names of the fitted ones: f, x0, y0, p1, p2, q1, q2, perhaps q3")
    covariance: Floats = array(
        "P, P", "of `parameters`, in their own units, and of the smooth distortion's coefficients, px"
    )
    smooth_size_px: float = scalar("1-sigma size of the smooth distortion before the fit; 0 without one")
    unmodelled_px: float = scalar("what no lens model explains, rms along one axis; 0 if not significant")
    focal_drift_per_s: float = scalar("relative drift of the focal length, 1/s; 0 if not fitted")
    focal_drift_sigma_per_s: float = scalar("its 1-sigma error, 1/s")
    chi2: float = scalar("sum of squared normalised residuals")
    dof: int = scalar("degrees of freedom of chi2")
    frame: Ints = array("N", "identified image of each star, 0 to K - 1")
    xy_px: Floats = array("N, 2", "centroids as (column, row)")
    residual_px: Floats = array("N, 2", "measured minus predicted, px")
    sigma_px: Floats = array("N", "1-sigma error of the centroid along one axis, px")
    rotations: Rotation = array("K", "R_si of the identified images")
    frames_used: tuple[str, ...] = array("K", "names of the identified images")
    frames_refused: tuple[tuple[str, str], ...] = scalar("(name, reason) of each other image")
    outliers: int = scalar("stars rejected")

    @property
    def explained(self) -> bool:
        """Whether the lens model explains the lens: to `LARGEST_UNMODELLED_PX`."""
        return self.unmodelled_px <= LARGEST_UNMODELLED_PX

    @property
    def rms_px(self) -> float:
        """Root mean square residual along one axis."""
        return float(np.sqrt((self.residual_px**2).mean()))

    def model_sigma_px(self, xy_px: Floats) -> Floats:
        """1-sigma error (N,) of the pixel map at pixels (N, 2), px along one axis, apart from a rotation.
        What no lens model explains is part of it."""
        J = self._visible(xy_px)
        variance = 0.5 * np.einsum("nip,pq,niq->n", J, self.covariance, J, optimize=True)
        return np.asarray(np.sqrt(variance + self.unmodelled_px**2))

    def band_factor(self, probability: float = 0.95) -> float:
        """Multiple of `model_sigma_px` that the error of the pixel map exceeds nowhere on the detector, with
        this probability: by maps drawn from the covariance."""
        xy = detector_grid(self.camera)
        J, sigma = self._visible(xy), self.model_sigma_px(xy)
        value, vector = np.linalg.eigh(self.covariance / np.outer(*2 * [np.sqrt(np.diag(self.covariance))]))
        root = np.sqrt(np.diag(self.covariance))[:, None] * vector * np.sqrt(value.clip(0.0))
        drawn = np.random.default_rng(1).normal(size=(_DRAWN_MAPS, len(root)))  # the same for all: no chance
        maps = drawn @ (J @ root).reshape(-1, len(root)).T
        square = 0.5 * (maps.reshape(len(drawn), -1, 2) ** 2).sum(axis=2) + self.unmodelled_px**2
        return float(np.quantile(np.sqrt((square / sigma**2).max(axis=1)), probability))

    def map_error_px(self, xy_px: Floats) -> Floats:
        """Error (N,) at pixels (N, 2), px along one axis, that the pixel map exceeds nowhere on the detector
        with 95 %, apart from a rotation: `band_factor` times `model_sigma_px`."""
        return self.band_factor() * self.model_sigma_px(xy_px)

    def _visible(self, xy_px: Floats) -> Floats:
        degree = 0 if self.camera.smooth is None else self.camera.smooth.degree
        return visible_derivatives(self.camera, xy_px, self.parameters, degree)


@record
class ResidualMap:
    """Mean residuals in R x C cells of the detector."""

    mean_px: Floats = array("R, C, 2", "weighted mean (column, row), px; NaN in a cell without stars")
    error_px: Floats = array("R, C", "standard error of the mean along one axis, px; inf without stars")
    count: Ints = array("R, C", "number of stars")


def calibrate_camera(
    frames: Sequence[SkyFrame],
    nominal: StarCamera,
    index: StarIndex,
    settings: StarSettings,
    *,
    drift: bool = False,
) -> CameraCalibration | NotIdentified:
    """Camera parameters and their covariance from images of the sky.

    Parameters
    ----------
    frames : sequence of SkyFrame
        Stars found in images of the same camera; any pointing.
    nominal : StarCamera
        Approximate camera, focal length good to `settings.fov_tolerance`.
    index : StarIndex
        Star index that covers its field of view (`build_index`).
    settings : StarSettings
        Identification and limits of reliable stars.
    drift : bool
        Fit a drift of the focal length too; needs observers of different times.

    Returns
    -------
    CameraCalibration or NotIdentified
        The latter if fewer than 20 stars are identified in all images together, or no lens model can be
        fitted to them. A lens that no model explains has `explained` false: its errors may be larger than
        stated, and its residuals show where.
    """
    camera, known, before = nominal, False, None
    for _ in range(3):  # fitting the camera, naming more stars with it
        identified, refused = _identify_frames(frames, camera, index, settings, known=known)
        stars = sum(len(solution.hip) for _, solution in identified)
        if stars < 20:
            reasons = "; ".join(reason for _, reason in refused[:3])
            found = f"{stars} stars identified in {len(identified)} of {len(frames)} images"
            return NotIdentified(f"{found}, 20 are needed: {reasons}", stars)
        names = [(k, solution.detections.tolist(), solution.rows.tolist()) for k, solution in identified]
        if names == before:  # the camera would be the same
            break
        used = _reliable(frames, identified, camera, index, settings)
        start = camera if known else _with_identified_focal(camera, identified)
        rotations = Rotation.concatenate([solution.R_si for _, solution in identified])
        try:
            rough = None if known else fit_camera(used, start, rotations)
            if rough and rough.variance_factor < _ROUGHLY:
                camera, known = rough.camera, True
                continue
            lens = choose_lens(used, start, rotations)
        except np.linalg.LinAlgError:  # fisheye lenses of 70 deg and more
            return NotIdentified(f"{stars} stars identified, but no lens model can be fitted to them", stars)
        camera, before, known = lens.camera, names if known else None, True
    result = _calibration(frames, identified, used, lens, settings, drift=drift)
    return replace(result, frames_refused=tuple(refused))


def residual_map(calibration: CameraCalibration) -> ResidualMap:
    """Weighted mean residuals in 6 x 8 cells of the detector: what the camera model leaves unexplained."""
    camera, grid = calibration.camera, (6, 8)
    rows, columns = grid
    size = np.array([camera.width_px, camera.height_px])
    cell = np.clip(
        ((calibration.xy_px + 0.5) / size * [columns, rows]).astype(int), 0, [columns - 1, rows - 1]
    )
    flat = cell[:, 1] * columns + cell[:, 0]
    count = np.bincount(flat, minlength=rows * columns)
    weight = calibration.sigma_px**-2.0
    variance_factor = max(1.0, calibration.chi2 / max(calibration.dof, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = np.bincount(flat, weight, minlength=rows * columns)
        sums = [np.bincount(flat, weight * r, minlength=rows * columns) for r in calibration.residual_px.T]
        mean = np.stack(sums, axis=1) / whole[:, None]
        error = np.sqrt(variance_factor / whole)
    return ResidualMap(mean.reshape(*grid, 2), error.reshape(grid), count.reshape(grid))


def _identify_frames(
    frames: Sequence[SkyFrame], camera: StarCamera, index: StarIndex, settings: StarSettings, *, known: bool
) -> tuple[list[tuple[int, FieldSolution]], list[tuple[str, str]]]:
    identified, refused, size = [], [], (camera.width_px, camera.height_px)
    for k, frame in enumerate(frames):
        if not known and camera.fov_x_rad >= FISHEYE_RAD:
            solution = solve_list(frame.stars, size, index, settings, fov_x_rad=camera.fov_x_rad)
        else:
            solution = solve_stars(
                frame.stars.xy_px,
                size,
                index,
                settings,
                camera=camera if known else None,
                fov_x_rad=None if known else camera.fov_x_rad,
            )
        if isinstance(solution, NotIdentified):
            refused.append((frame.frame_id, solution.reason))
        elif solution.mirrored:
            refused.append((frame.frame_id, "a mirror image: reverse the order of its columns"))
        else:
            identified.append((k, solution))
    return identified, refused


def _reliable(
    frames: Sequence[SkyFrame],
    identified: list[tuple[int, FieldSolution]],
    camera: StarCamera,
    index: StarIndex,
    settings: StarSettings,
) -> IdentifiedStars:
    """The reliable ones of the identified stars."""
    xy, cov, u_i, frame, times = [], [], [], [], []
    for number, (k, solution) in enumerate(identified):
        stars, rows = frames[k].stars, solution.rows
        reliable = select_for_calibration(stars.centroids, solution.detections, rows, camera, index, settings)
        observer = frames[k].observer
        # others may lie behind the camera
        reliable &= solution.R_si.apply(index.u_i[rows])[:, 2] > LEAST_FORWARD
        xy.append(solution.xy_px[reliable])
        years = settings.epoch_error_years if observer is None else 0.0
        moved = proper_motion_covariance(index, rows[reliable], solution.camera, solution.R_si, years)
        cov.append(stars.cov_px[solution.detections[reliable]] + moved)
        u_i.append(star_directions(index, rows[reliable], observer))
        frame.append(np.full(int(reliable.sum()), number))
        times.append(0.0 if observer is None else observer.tai_s)
    return IdentifiedStars(
        np.vstack(xy), np.concatenate(cov), np.vstack(u_i), np.concatenate(frame), np.array(times)
    )


def _calibration(
    frames: Sequence[SkyFrame],
    identified: list[tuple[int, FieldSolution]],
    used: IdentifiedStars,
    lens: LensModel,
    settings: StarSettings,
    *,
    drift: bool,
) -> CameraCalibration:
    """The calibration by a lens model of the reliable identified stars."""
    fit = lens.fit
    if drift:
        fit = fit_camera(used, lens.camera, fit.rotations, (*lens.fitted, DRIFT))
    keep = fit.keep
    sigma = np.sqrt(0.5 * np.trace(used.cov_px[keep], axis1=1, axis2=2))
    left = unmodelled_px(
        used.xy_px[keep], fit.residual_px[keep], sigma, used.frame[keep], fit.camera.width_px
    )
    covariance = lens.covariance.copy()
    if settings.epoch_error_years:  # images without time: each has another aberration, unknown
        timeless = sum(frames[k].observer is None for k, _ in identified)
        covariance[0, 0] += timeless * (fit.camera.focal_m * ABERRATION_SCALE / len(identified)) ** 2
    comatic = np.mean([frames[k].stars.psf.scale_sigma ** 2 for k, _ in identified])
    covariance[0, 0] += fit.camera.focal_m**2 * comatic  # of one lens: no smaller with more images
    return CameraCalibration(
        camera=fit.camera,
        parameters=lens.parameters,
        covariance=covariance,
        smooth_size_px=lens.size_px,
        unmodelled_px=left,
        focal_drift_per_s=fit.focal_drift_per_s,
        focal_drift_sigma_per_s=float(np.sqrt(fit.covariance[-1, -1])) if drift else 0.0,
        chi2=fit.chi2,
        dof=max(fit.dof - round(lens.used), 1),
        frame=used.frame[fit.keep],
        xy_px=used.xy_px[fit.keep],
        residual_px=fit.residual_px[fit.keep],
        sigma_px=sigma,
        rotations=fit.rotations,
        frames_used=tuple(frames[k].frame_id for k, _ in identified),
        frames_refused=(),
        outliers=int((~fit.keep).sum()),
    )


def _with_identified_focal(camera: StarCamera, identified: list[tuple[int, FieldSolution]]) -> StarCamera:
    """The camera with the median focal length of the identifications; of fisheyes that of the one with most
    stars, with its distortion."""
    if camera.fov_x_rad >= FISHEYE_RAD:
        most = max((one for _, one in identified), key=lambda one: one.matches).camera
        return replace(most, pixel_m=camera.pixel_m, focal_m=most.focal_m * camera.pixel_m / most.pixel_m)
    scale = np.median([s.camera.focal_m / s.camera.pixel_m for _, s in identified]) / (
        camera.focal_m / camera.pixel_m
    )
    return replace(camera, focal_m=float(camera.focal_m * scale))
