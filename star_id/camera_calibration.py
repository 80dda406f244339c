"""A star camera calibrated by the sky: focal length, principal point and distortion from named stars of many
images.

Unknowns are the camera's seven numbers (eqs. 3-6: f, x0, y0, p1, p2, q1, q2), if wanted a drift of the focal
length with time, and a small rotation for each image, which is eliminated (its three columns see one image
only). Each star weighs by the covariance of its centroid; stars that do not fit are left out. A wrong nominal
camera is enough to begin with: the first identification takes it for an uncalibrated one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.epoch import Epoch
from geometry.star_camera import StarCamera
from geometry.starlight import apparent_star_directions
from star_id.field import FieldSolution, solve_stars
from star_id.finding.star_list import StarList
from star_id.naming.identify import NotIdentified
from star_id.naming.triangles import StarIndex
from star_id.settings import StarSettings
from star_id.sight import fit_for_calibration

__all__ = ["CameraCalibration", "Observer", "ResidualMap", "SkyFrame", "calibrate_camera", "residual_map"]

Array = NDArray[np.float64]

PARAMETERS = ("focal_m", "x0_px", "y0_px", "p1", "p2", "q1", "q2")
_OUTLIER_CHI2 = 16.0
_ROUNDS = 3
_STEPS = 12


@dataclass(frozen=True, slots=True, eq=False)
class Observer:
    """Where and when an image was taken: without it aberration (1e-4 of every angle) goes into the focal
    length."""

    epoch: Epoch
    t_s: float
    p_i: Array  # (3,) m, GCRS
    v_i: Array  # (3,) m/s, GCRS


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
        out.

        Attitude is found anew in every image, so a part of the error that looks like a rotation does no harm.
        """
        camera = self.camera
        points = np.vstack([xy_px, _grid(camera)])
        theta = _vector(camera)
        u_s = camera.directions_from_pixels(points)
        J, A = _camera_columns(theta, camera, u_s, 0.0)[:, :, :7], _turn_columns(theta, camera, u_s)
        grid = slice(len(xy_px), None)
        absorbed = np.linalg.lstsq(A[grid].reshape(-1, 3), J[grid].reshape(-1, 7), rcond=None)[0]
        J = J - A @ absorbed
        variance = np.einsum("nip,pq,niq->ni", J, _scaled(self.covariance, camera), J)
        return np.asarray(np.sqrt(0.5 * variance[: len(xy_px)].sum(axis=1)))


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMap:
    """Mean residual in the cells of a grid over the detector."""

    mean_px: Array  # (rows, columns, 2) NaN where no star fell
    error_px: Array  # (rows, columns) standard error of the mean along one axis
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
            return NotIdentified(
                f"{stars} stars identified in {len(named)} of {len(frames)} images, 20 are needed: {reasons}",
                {"stars": float(stars), "frames": float(len(named))},
            )
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
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack(
            [np.bincount(flat, r, minlength=rows * columns) / count for r in calibration.residual_px.T],
            axis=1,
        )
        square = np.bincount(flat, 0.5 * (calibration.residual_px**2).sum(axis=1), minlength=rows * columns)
        error = np.sqrt(square / count / count)
    return ResidualMap(
        mean.reshape(rows, columns, 2), error.reshape(rows, columns), count.reshape(rows, columns)
    )


def _named(
    frames: Sequence[SkyFrame], camera: StarCamera, index: StarIndex, settings: StarSettings, *, known: bool
) -> tuple[list[tuple[int, FieldSolution]], list[tuple[str, str]]]:
    fov = 2.0 * np.arctan(0.5 * camera.width_px * camera.pixel_m / camera.focal_m)
    named, refused = [], []
    for k, frame in enumerate(frames):
        solution = solve_stars(
            frame.stars.xy_px,
            (camera.width_px, camera.height_px),
            index,
            settings,
            camera=camera if known else None,
            fov_x_rad=None if known else float(fov),
            stars=frame.stars,
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
    """Weighted least squares over all named stars, from a camera near enough for Gauss-Newton steps."""
    row_of = {int(hip): row for row, hip in enumerate(index.stars.hip)}
    xy, cov, u_i, frame, times, rotations = [], [], [], [], [], []
    for number, (k, solution) in enumerate(named):
        rows = np.array([row_of[int(h)] for h in solution.hip], dtype=np.int64)
        safe = fit_for_calibration(frames[k].stars, solution.detections, rows, camera, index, settings)
        rows = rows[safe]
        observer = frames[k].observer
        xy.append(solution.xy_px[safe])
        cov.append(frames[k].stars.cov_px[solution.detections[safe]])
        u_i.append(_directions(index, rows, observer))
        frame.append(np.full(len(rows), number))
        times.append(0.0 if observer is None else observer.t_s)
        rotations.append(solution.R_si)
    data = _Data(
        np.vstack(xy),
        np.concatenate(cov),
        np.vstack(u_i),
        np.concatenate(frame),
        np.array(times) - np.mean(times),
    )
    theta = np.append(_vector(_shape_of(camera, named), camera), 0.0)
    R = Rotation.concatenate(rotations)
    keep = np.ones(len(data.xy), dtype=bool)
    for k in range(_STEPS):
        theta, R, normal, residual = _step(theta, R, camera, data, keep, drift=drift)
        variance = 0.5 * np.trace(data.cov, axis1=1, axis2=2)
        chi2 = 0.5 * (residual**2).sum(axis=1) / variance
        if k >= 2:
            scale = max(1.0, float(np.median(chi2[keep])) / 0.693)
            keep = chi2 < _OUTLIER_CHI2 * scale
    information = np.linalg.inv(data.cov[keep])
    total = float(np.einsum("ni,nij,nj->", residual[keep], information, residual[keep]))
    free = 8 if drift else 7
    dof = 2 * int(keep.sum()) - free - 3 * len(named)
    covariance = np.linalg.inv(normal) * max(1.0, total / max(dof, 1))
    return CameraCalibration(
        camera=_camera(theta[:7], camera),
        covariance=_unscaled(covariance[:7, :7], camera),
        focal_drift_per_s=float(theta[7]),
        focal_drift_sigma_per_s=float(np.sqrt(covariance[7, 7])) if drift else 0.0,
        chi2=total,
        dof=dof,
        frame=data.frame[keep],
        xy_px=data.xy[keep],
        residual_px=residual[keep],
        rotations=R,
        frames_used=tuple(frames[k].frame_id for k, _ in named),
        frames_refused=(),
        outliers=int((~keep).sum()),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Data:
    xy: Array  # (N, 2)
    cov: Array  # (N, 2, 2)
    u_i: Array  # (N, 3)
    frame: NDArray[np.int64]  # (N,)
    time: Array  # (K,) s from the mean


def _step(
    theta: Array, R: Rotation, camera: StarCamera, data: _Data, keep: NDArray[np.bool_], *, drift: bool
) -> tuple[Array, Rotation, Array, Array]:
    """One Gauss-Newton step with the rotations eliminated; also the camera's normal matrix and the
    residuals."""
    u_s = np.einsum("nij,nj->ni", R.as_matrix()[data.frame], data.u_i)
    time = data.time[data.frame]
    residual = data.xy - _project(theta, camera, u_s, time)
    J = _camera_columns(theta, camera, u_s, time)[:, :, : 8 if drift else 7]
    A = _turn_columns(theta, camera, u_s)
    W = np.linalg.inv(data.cov) * keep[:, None, None]
    JW = J.transpose(0, 2, 1) @ W
    AW = A.transpose(0, 2, 1) @ W
    k = len(data.time)
    Naa = _summed(AW @ A, data.frame, k)
    Nca = _summed(JW @ A, data.frame, k)
    ga = _summed((AW @ residual[:, :, None])[:, :, 0], data.frame, k)
    gain = np.linalg.solve(Naa, Nca.transpose(0, 2, 1))  # (K, 3, P)
    normal = (JW @ J).sum(axis=0) - (Nca @ gain).sum(axis=0)
    g = (JW @ residual[:, :, None]).sum(axis=0)[:, 0] - np.einsum("kap,ka->p", gain, ga)
    d_camera = np.linalg.solve(normal, g)
    d_turn = np.linalg.solve(Naa, (ga - np.einsum("kpa,p->ka", Nca, d_camera))[:, :, None])[:, :, 0]
    theta = theta.copy()
    theta[: len(d_camera)] += d_camera
    return theta, Rotation.from_rotvec(d_turn) * R, normal, residual


def _summed(values: Array, group: NDArray[np.int64], groups: int) -> Array:
    total = np.zeros((groups, *values.shape[1:]))
    np.add.at(total, group, values)
    return total


def _project(theta: Array, camera: StarCamera, u_s: Array, time: Array | float) -> Array:
    """Pixels (N, 2) of directions; theta: log f, x0, y0 (px), then p1 f, p2 f, q1 f^2, q2 f^4, log-f drift
    (1/s).

    Distortion numbers are those for coordinates divided by the nominal focal length: all of order one.
    """
    f0 = camera.focal_m / camera.pixel_m
    drift = theta[7] if len(theta) > 7 else 0.0
    scale = np.exp(theta[0] + drift * np.asarray(time))
    t = -u_s[:, :2] / u_s[:, 2:] * np.reshape(scale, (-1, 1))
    x, y = t.T
    r2 = x * x + y * y
    p1, p2, q1, q2 = theta[3:7]
    radial = r2 * (q1 + r2 * q2)
    dx = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    dy = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return np.asarray(theta[1:3] + f0 * (t + np.column_stack([dx, dy])))


def _camera_columns(theta: Array, camera: StarCamera, u_s: Array, time: Array | float) -> Array:
    """(N, 2, 8) derivatives of the pixels by theta: central differences, exact to 1e-9 for so smooth a
    model."""
    theta = np.append(theta, np.zeros(8 - len(theta)))
    columns = []
    for k in range(8):
        h = 1e-4 if k < 7 else 1e-4 / max(float(np.max(np.abs(time))), 1.0)
        up, down = theta.copy(), theta.copy()
        up[k] += h
        down[k] -= h
        columns.append((_project(up, camera, u_s, time) - _project(down, camera, u_s, time)) / (2 * h))
    return np.stack(columns, axis=2)


def _turn_columns(theta: Array, camera: StarCamera, u_s: Array) -> Array:
    """(N, 2, 3) derivatives by a right-handed turn about the axes of s."""
    h = 1e-5
    turned = [(Rotation.from_rotvec(s * h * e).apply(u_s), s) for e in np.eye(3) for s in (1.0, -1.0)]
    points = [_project(theta, camera, u, 0.0) for u, _ in turned]
    return np.stack([(points[2 * k] - points[2 * k + 1]) / (2 * h) for k in range(3)], axis=2)


def _vector(camera: StarCamera, nominal: StarCamera | None = None) -> Array:
    f_mm = (nominal or camera).focal_m * 1e3
    return np.array(
        [
            np.log(camera.focal_m / (nominal or camera).focal_m),
            *camera.principal_px,
            camera.p1 * f_mm,
            camera.p2 * f_mm,
            camera.q1 * f_mm**2,
            camera.q2 * f_mm**4,
        ]
    )


def _camera(theta: Array, nominal: StarCamera) -> StarCamera:
    f_mm = nominal.focal_m * 1e3
    return replace(
        nominal,
        focal_m=float(nominal.focal_m * np.exp(theta[0])),
        principal_px=(float(theta[1]), float(theta[2])),
        p1=float(theta[3] / f_mm),
        p2=float(theta[4] / f_mm),
        q1=float(theta[5] / f_mm**2),
        q2=float(theta[6] / f_mm**4),
    )


def _units(camera: StarCamera) -> Array:
    f_mm = camera.focal_m * 1e3
    return np.array([camera.focal_m, 1.0, 1.0, 1 / f_mm, 1 / f_mm, 1 / f_mm**2, 1 / f_mm**4])


def _unscaled(covariance: NDArray, camera: StarCamera) -> Array:
    units = _units(camera)
    return np.asarray(covariance * units[:, None] * units)


def _scaled(covariance: Array, camera: StarCamera) -> Array:
    units = _units(camera)
    return np.asarray(covariance / units[:, None] / units)


def _shape_of(camera: StarCamera, named: list[tuple[int, FieldSolution]]) -> StarCamera:
    """The camera with the focal length that the images were identified with; same pixel, same nominal
    scale."""
    scale = np.median([s.camera.focal_m / s.camera.pixel_m for _, s in named]) / (
        camera.focal_m / camera.pixel_m
    )
    return replace(camera, focal_m=float(camera.focal_m * scale))


def _directions(index: StarIndex, rows: NDArray[np.int64], observer: Observer | None) -> Array:
    if observer is None:
        return index.u_i[rows]
    return apparent_star_directions(
        index.stars.take(rows), observer.epoch, observer.t_s, observer.p_i, observer.v_i
    )


def _grid(camera: StarCamera) -> Array:
    x, y = np.meshgrid(np.linspace(0, camera.width_px - 1, 9), np.linspace(0, camera.height_px - 1, 7))
    return np.column_stack([x.ravel(), y.ravel()])
