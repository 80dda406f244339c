"""Least squares of a camera, and of one rotation for each image, to named stars.

Unknowns are those of the camera's seven numbers (eqs. 3-6: f, x0, y0, p1, p2, q1, q2) that are set free, if
wanted a drift of the focal length with time, and a small turn of each image, which is eliminated (its three
columns see one image only). Each star weighs by the covariance of its centroid; stars that do not fit are
left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera

__all__ = [
    "DRIFT",
    "PARAMETERS",
    "CameraFit",
    "IdentifiedStars",
    "detector_grid",
    "fit_camera",
    "perturbed",
    "pixel_derivatives",
    "rotation_derivatives",
    "visible_derivatives",
]

Array = NDArray[np.float64]

PARAMETERS = ("focal_m", "x0_px", "y0_px", "p1", "p2", "q1", "q2")
DRIFT = "focal_drift_per_s"
_NOTHING: Mapping[str, float] = MappingProxyType({})
_OUTLIER_CHI2 = 16.0
_STEPS = 12
_FIRST_STEPS = 2  # taken before any star is left out
_SMALL_STEP = 1e-3  # of a number's own error


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedStars:
    """Stars of K images. Row n of the star arrays speaks of the same star."""

    xy_px: Array  # (N, 2)
    cov_px: Array  # (N, 2, 2)
    u_i: Array  # (N, 3) where they stand
    frame: NDArray[np.int64]  # (N,) which image each belongs to
    t_s: Array  # (K,) of the images; matters for a drift only


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A camera and the rotations of its images."""

    camera: StarCamera
    focal_drift_per_s: float  # relative; the camera's own focal length being that of the mean time
    rotations: Rotation  # (K,) R_si
    covariance: Array  # (F, F) of the free numbers, in their own units
    larger: float  # by which factor it is larger than the stars' own covariances make it
    residual_px: Array  # (N, 2) measured minus predicted, of all stars
    keep: NDArray[np.bool_]  # (N,) those that fit
    chi2: float  # of these
    dof: int


def fit_camera(
    stars: IdentifiedStars,
    camera: StarCamera,
    rotations: Rotation,
    free: tuple[str, ...] = PARAMETERS,
    prior: Mapping[str, float] = _NOTHING,
) -> CameraFit:
    """The camera with the numbers `free` (of PARAMETERS and DRIFT) fitted, from one near enough for
    Gauss-Newton steps.

    `prior` tells how far (1 sigma, in their own units) numbers may be believed to be from those of `camera`.
    Covariances are those that the stars' own covariances make, and larger where residuals are larger than
    these.
    """
    columns = [(*PARAMETERS, DRIFT).index(name) for name in free]
    units = _units(camera)[columns]
    belief = np.array([unit / prior.get(name, np.inf) for name, unit in zip(free, units)]) ** 2
    first = _vector(camera)[columns]
    stars = replace(stars, t_s=stars.t_s - stars.t_s.mean())
    theta, R = _vector(camera), rotations
    keep = np.ones(len(stars.xy_px), dtype=bool)
    variance = 0.5 * np.trace(stars.cov_px, axis1=1, axis2=2)
    for k in range(_STEPS):
        step = _step(theta, R, camera, stars, keep, columns, belief, belief * (first - theta[columns]))
        theta = theta.copy()
        theta[columns] += step.d_camera
        R = Rotation.from_rotvec(step.d_turn) * R
        chi2 = 0.5 * (step.residual**2).sum(axis=1) / variance
        if k < _FIRST_STEPS:
            continue
        fits = chi2 < _OUTLIER_CHI2 * max(1.0, float(np.median(chi2[keep])) / 0.693)
        if 2 * fits.sum() <= len(free) + 3 * len(stars.t_s):  # too few would be left to tell
            fits = keep
        if np.array_equal(fits, keep) and step.in_sigmas < _SMALL_STEP:
            break
        keep = fits
    residual = step.residual[keep]
    total = float(np.einsum("ni,nij,nj->", residual, np.linalg.inv(stars.cov_px[keep]), residual))
    dof = 2 * int(keep.sum()) - len(free) - 3 * len(stars.t_s)
    larger = max(1.0, total / max(dof, 1))
    return CameraFit(
        camera=_camera(theta, camera),
        focal_drift_per_s=float(theta[7]),
        rotations=R,
        covariance=np.asarray(larger * step.cov_camera * units[:, None] * units),
        larger=larger,
        residual_px=step.residual,
        keep=keep,
        chi2=total,
        dof=dof,
    )


def perturbed(camera: StarCamera, name: str, step: float) -> StarCamera:
    """The camera with one of PARAMETERS changed by `step`."""
    if name in ("x0_px", "y0_px"):
        x0, y0 = camera.principal_px
        return replace(camera, principal_px=(x0 + step, y0) if name == "x0_px" else (x0, y0 + step))
    return replace(camera, **{name: getattr(camera, name) + step})


def pixel_derivatives(camera: StarCamera, u_s: Array) -> Array:
    """(N, 2, 7) derivatives of the pixels of directions (N, 3) by PARAMETERS, in their own units."""
    seen = _imaged(_vector(camera), camera, u_s, 0.0)
    return _camera_columns(seen, camera, 0.0, range(len(PARAMETERS))) / _units(camera)[: len(PARAMETERS)]


def rotation_derivatives(camera: StarCamera, u_s: Array) -> Array:
    """(N, 2, 3) derivatives of the pixels of directions (N, 3) by a right-handed turn about the axes of s."""
    return _turn_columns(_imaged(_vector(camera), camera, u_s, 0.0))


def visible_derivatives(camera: StarCamera, xy_px: Array) -> Array:
    """(N, 2, 7) derivatives of the pixel map at points (N, 2) by PARAMETERS, less the turn of the whole
    detector that is most like them: attitude is found anew in every image, so such a part does no harm."""
    u_s = camera.directions_from_pixels(np.vstack([xy_px, detector_grid(camera)]))
    J, A = pixel_derivatives(camera, u_s), rotation_derivatives(camera, u_s)
    grid = slice(len(xy_px), None)
    absorbed = np.linalg.lstsq(A[grid].reshape(-1, 3), J[grid].reshape(-1, len(PARAMETERS)), rcond=None)[0]
    return np.asarray((J - A @ absorbed)[: len(xy_px)])


def detector_grid(camera: StarCamera) -> Array:
    """(63, 2) points from corner to corner."""
    x, y = np.meshgrid(np.linspace(0, camera.width_px - 1, 9), np.linspace(0, camera.height_px - 1, 7))
    return np.column_stack([x.ravel(), y.ravel()])


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """One step of Gauss and Newton, the rotations eliminated, and where it started from."""

    d_camera: Array  # (F,)
    d_turn: Array  # (K, 3)
    cov_camera: Array  # (F, F)
    cov_turn: Array  # (K, 3, 3)
    residual: Array  # (N, 2)

    @property
    def in_sigmas(self) -> float:
        """The largest component of the step, in units of its standard error."""
        sigma = np.sqrt(np.append(np.diag(self.cov_camera), np.einsum("kii->ki", self.cov_turn)))
        return float(np.abs(np.append(self.d_camera, self.d_turn) / sigma).max())


def _step(
    theta: Array,
    R: Rotation,
    camera: StarCamera,
    stars: IdentifiedStars,
    keep: NDArray[np.bool_],
    columns: list[int],
    belief: Array,
    pull: Array,
) -> _Step:
    """`belief` (F,) and `pull` (F,) are what the prior adds to the camera's normal equations."""
    u_s = np.einsum("nij,nj->ni", R.as_matrix()[stars.frame], stars.u_i)
    time = stars.t_s[stars.frame]
    seen = _imaged(theta, camera, u_s, time)
    residual = stars.xy_px - seen.pixels
    J, A = _camera_columns(seen, camera, time, columns), _turn_columns(seen)
    W = np.linalg.inv(stars.cov_px) * keep[:, None, None]
    JW, AW = J.transpose(0, 2, 1) @ W, A.transpose(0, 2, 1) @ W
    images = len(stars.t_s)
    Naa = _summed(AW @ A, stars.frame, images)
    Nca = _summed(JW @ A, stars.frame, images)
    ga = _summed((AW @ residual[:, :, None])[:, :, 0], stars.frame, images)
    gain = np.linalg.solve(Naa, Nca.transpose(0, 2, 1))  # (K, 3, F)
    normal = (JW @ J).sum(axis=0) - (Nca @ gain).sum(axis=0) + np.diag(belief)
    g = (JW @ residual[:, :, None]).sum(axis=0)[:, 0] - np.einsum("kap,ka->p", gain, ga) + pull
    d_camera = np.linalg.solve(normal, g)
    d_turn = np.linalg.solve(Naa, (ga - np.einsum("kpa,p->ka", Nca, d_camera))[:, :, None])[:, :, 0]
    cov_camera = np.linalg.inv(normal)
    cov_camera = 0.5 * (cov_camera + cov_camera.T)  # one image hardly tells x0 from p1: rounding is seen
    cov_turn = np.asarray(np.linalg.inv(Naa) + gain @ cov_camera @ gain.transpose(0, 2, 1))
    return _Step(d_camera, d_turn, cov_camera, cov_turn, residual)


def _summed(values: Array, group: NDArray[np.int64], groups: int) -> Array:
    total = np.zeros((groups, *values.shape[1:]))
    np.add.at(total, group, values)
    return total


@dataclass(frozen=True, slots=True, eq=False)
class _Imaged:
    """Directions as a lens with numbers theta shows them: log f, x0, y0 (px), then p1 f, p2 f, q1 f^2,
    q2 f^4, log-f drift (1/s). Distortion is that of coordinates divided by the nominal focal length, all of
    order one."""

    pixels: Array  # (N, 2)
    t: Array  # (2, N) ideal coordinates, those of the tangent plane times the relative focal length
    scale: Array  # (N,) this factor
    stretch: Array  # (2, 2, N) d(pixels) / d(t)


def _imaged(theta: Array, camera: StarCamera, u_s: Array, time: Array | float) -> _Imaged:
    f0 = camera.focal_m / camera.pixel_m
    scale = np.broadcast_to(np.exp(theta[0] + theta[7] * np.asarray(time)), len(u_s))
    x, y = t = -u_s[:, :2].T / u_s[:, 2] * scale
    r2 = x * x + y * y
    p1, p2, q1, q2 = theta[3:7]
    radial, steep = r2 * (q1 + r2 * q2), 2.0 * (q1 + 2.0 * r2 * q2)
    dx = x * radial + p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y
    dy = y * radial + p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y
    across = steep * x * y + 2.0 * (p1 * y + p2 * x)
    along_x = 1.0 + radial + steep * x * x + 6.0 * p1 * x + 2.0 * p2 * y
    along_y = 1.0 + radial + steep * y * y + 6.0 * p2 * y + 2.0 * p1 * x
    stretch = f0 * np.array([[along_x, across], [across, along_y]])
    return _Imaged(theta[1:3] + f0 * (t + np.array([dx, dy])).T, t, scale, stretch)


def _camera_columns(
    seen: _Imaged, camera: StarCamera, time: Array | float, columns: list[int] | range
) -> Array:
    """(N, 2, F) derivatives of the pixels by theta."""
    f0 = camera.focal_m / camera.pixel_m
    x, y = seen.t
    r2, one, zero = x * x + y * y, np.ones_like(x), np.zeros_like(x)
    by_scale = np.einsum("ijn,jn->in", seen.stretch, seen.t)
    by_all = (
        by_scale,
        (one, zero),
        (zero, one),
        f0 * np.array([r2 + 2.0 * x * x, 2.0 * x * y]),
        f0 * np.array([2.0 * x * y, r2 + 2.0 * y * y]),
        f0 * r2 * seen.t,
        f0 * r2 * r2 * seen.t,
        by_scale * time,
    )
    return (
        np.stack([np.asarray(by_all[k]).T for k in columns], axis=2) if columns else np.empty((len(x), 2, 0))
    )


def _turn_columns(seen: _Imaged) -> Array:
    """(N, 2, 3) derivatives of the pixels by a right-handed turn about the axes of s: du = e x u."""
    (x, y), s = seen.t, seen.scale
    by_t = np.array([[x * y / s, s + y * y / s], [-s - x * x / s, -x * y / s], [-y, x]])  # (3, 2, N)
    return np.einsum("ijn,kjn->nik", seen.stretch, by_t)


def _vector(camera: StarCamera) -> Array:
    """(8,) theta of the camera itself."""
    numbers = np.array([0.0, *camera.principal_px, camera.p1, camera.p2, camera.q1, camera.q2, 0.0])
    return np.asarray(numbers / np.append(1.0, _units(camera)[1:]))


def _camera(theta: Array, nominal: StarCamera) -> StarCamera:
    numbers = theta * _units(nominal)
    x0, y0, p1, p2, q1, q2 = (float(number) for number in numbers[1:7])
    return replace(
        nominal,
        focal_m=float(nominal.focal_m * np.exp(theta[0])),
        principal_px=(x0, y0),
        p1=p1,
        p2=p2,
        q1=q1,
        q2=q2,
    )


def _units(camera: StarCamera) -> Array:
    """(8,) of theta: PARAMETERS and DRIFT in their own units."""
    f_mm = camera.focal_m * 1e3
    return np.array([camera.focal_m, 1.0, 1.0, 1 / f_mm, 1 / f_mm, 1 / f_mm**2, 1 / f_mm**4, 1.0])
