"""A star camera calibrated by the sky: focal length, principal point and distortion from named stars of many
images.

A wrong nominal camera is enough to begin with: the first identification takes it for an uncalibrated one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_fit import DRIFT, PARAMETERS, IdentifiedStars, fit_camera, visible_derivatives
from boresight.star_id.field import FieldSolution, solve_stars
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.observer import Observer, star_directions
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import select_for_calibration

__all__ = ["CameraCalibration", "ResidualMap", "SkyFrame", "calibrate_camera", "residual_map"]

Array = NDArray[np.float64]

_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class SkyFrame:
    """Stars found in one image, and its observer if known."""

    frame_id: str
    stars: StarList
    observer: Observer | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """What the sky says of a camera. Row n of the star arrays speaks of the same star."""

    camera: StarCamera
    covariance: Array  # (7, 7) of PARAMETERS, in their own units
    focal_drift_per_s: float  # relative; 0 when not asked for
    focal_drift_sigma_per_s: float
    chi2: float
    dof: int
    frame: NDArray[np.int64]  # (N,) which frame a star belongs to
    xy_px: Array  # (N, 2)
    residual_px: Array  # (N, 2) measured minus predicted
    sigma_px: Array  # (N,) the centroid's own error along one axis
    rotations: Rotation  # (K,) R_si of the identified frames
    frames_used: tuple[str, ...]
    frames_refused: tuple[tuple[str, str], ...]  # (frame, reason)
    outliers: int

    @property
    def rms_px(self) -> float:
        """Root mean square residual along one axis."""
        return float(np.sqrt((self.residual_px**2).mean()))

    def model_sigma_px(self, xy_px: Array) -> Array:
        """(N,) 1-sigma error of the model at points (N, 2), along one axis, a rotation of the camera taken
        out."""
        J = visible_derivatives(self.camera, xy_px)
        return np.asarray(np.sqrt(0.5 * np.einsum("nip,pq,niq->n", J, self.covariance, J)))


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMap:
    """Mean residual in the cells of a grid over the detector."""

    mean_px: Array  # (rows, columns, 2) weighted by the stars' errors; NaN where no star fell
    error_px: Array  # (rows, columns) standard error of the mean along one axis, infinite where no star fell
    count: NDArray[np.int64]  # (rows, columns)


def calibrate_camera(
    frames: Sequence[SkyFrame],
    nominal: StarCamera,
    index: StarIndex,
    settings: StarSettings,
    *,
    drift: bool = False,
) -> CameraCalibration | NotIdentified:
    """Calibrates a camera of which `nominal` is a first idea (focal length good to
    settings.fov_tolerance)."""
    camera, known = nominal, False
    for _ in range(_ROUNDS):
        named, refused = _named(frames, camera, index, settings, known=known)
        stars = sum(len(solution.hip) for _, solution in named)
        if stars < 20:
            reasons = "; ".join(reason for _, reason in refused[:3])
            found = f"{stars} stars identified in {len(named)} of {len(frames)} images"
            return NotIdentified(f"{found}, 20 are needed: {reasons}", stars)
        result = _adjusted(frames, named, camera, index, settings, drift=drift)
        camera, known = result.camera, True
    return replace(result, frames_refused=tuple(refused))


def residual_map(calibration: CameraCalibration, rows: int = 6, columns: int = 8) -> ResidualMap:
    """Residuals averaged over cells: what the model leaves unexplained, by place on the detector."""
    camera = calibration.camera
    size = np.array([camera.width_px, camera.height_px])
    cell = np.clip(
        ((calibration.xy_px + 0.5) / size * [columns, rows]).astype(int), 0, [columns - 1, rows - 1]
    )
    flat = cell[:, 1] * columns + cell[:, 0]
    count = np.bincount(flat, minlength=rows * columns)
    weight = calibration.sigma_px**-2.0
    larger = max(1.0, calibration.chi2 / max(calibration.dof, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = np.bincount(flat, weight, minlength=rows * columns)
        sums = [np.bincount(flat, weight * r, minlength=rows * columns) for r in calibration.residual_px.T]
        mean = np.stack(sums, axis=1) / whole[:, None]
        error = np.sqrt(larger / whole)
    return ResidualMap(
        mean.reshape(rows, columns, 2), error.reshape(rows, columns), count.reshape(rows, columns)
    )


def _named(
    frames: Sequence[SkyFrame], camera: StarCamera, index: StarIndex, settings: StarSettings, *, known: bool
) -> tuple[list[tuple[int, FieldSolution]], list[tuple[str, str]]]:
    named, refused = [], []
    for k, frame in enumerate(frames):
        solution = solve_stars(
            frame.stars.xy_px,
            (camera.width_px, camera.height_px),
            index,
            settings,
            camera=camera if known else None,
            fov_x_rad=None if known else camera.fov_x_rad,
        )
        if isinstance(solution, NotIdentified):
            refused.append((frame.frame_id, solution.reason))
        else:
            named.append((k, solution))
    return named, refused


def _adjusted(
    frames: Sequence[SkyFrame],
    named: list[tuple[int, FieldSolution]],
    camera: StarCamera,
    index: StarIndex,
    settings: StarSettings,
    *,
    drift: bool,
) -> CameraCalibration:
    """All named stars that are beyond doubt, and the camera and rotations that fit them."""
    xy, cov, u_i, frame, times, rotations = [], [], [], [], [], []
    for number, (k, solution) in enumerate(named):
        stars, rows = frames[k].stars, solution.rows
        safe = select_for_calibration(stars, solution.detections, rows, camera, index, settings)
        observer = frames[k].observer
        xy.append(solution.xy_px[safe])
        cov.append(stars.cov_px[solution.detections[safe]])
        u_i.append(star_directions(index, rows[safe], observer))
        frame.append(np.full(int(safe.sum()), number))
        times.append(0.0 if observer is None else observer.tai_s)
        rotations.append(solution.R_si)
    seen = IdentifiedStars(
        np.vstack(xy), np.concatenate(cov), np.vstack(u_i), np.concatenate(frame), np.array(times)
    )
    free = (*PARAMETERS, DRIFT) if drift else PARAMETERS
    fit = fit_camera(seen, _shape_of(camera, named), Rotation.concatenate(rotations), free)
    return CameraCalibration(
        camera=fit.camera,
        covariance=fit.covariance[:7, :7],
        focal_drift_per_s=fit.focal_drift_per_s,
        focal_drift_sigma_per_s=float(np.sqrt(fit.covariance[7, 7])) if drift else 0.0,
        chi2=fit.chi2,
        dof=fit.dof,
        frame=seen.frame[fit.keep],
        xy_px=seen.xy_px[fit.keep],
        residual_px=fit.residual_px[fit.keep],
        sigma_px=np.sqrt(0.5 * np.trace(seen.cov_px[fit.keep], axis1=1, axis2=2)),
        rotations=fit.rotations,
        frames_used=tuple(frames[k].frame_id for k, _ in named),
        frames_refused=(),
        outliers=int((~fit.keep).sum()),
    )


def _shape_of(camera: StarCamera, named: list[tuple[int, FieldSolution]]) -> StarCamera:
    """The camera with the focal length that the images were identified with; same pixel, same nominal
    scale."""
    scale = np.median([s.camera.focal_m / s.camera.pixel_m for _, s in named]) / (
        camera.focal_m / camera.pixel_m
    )
    return replace(camera, focal_m=float(camera.focal_m * scale))
