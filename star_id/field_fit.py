"""What named stars say of one image, each weighing by its own covariance: where the camera looks, and, of a
camera that is not calibrated, its lens.

Naming treats all stars alike; a bright star is worth a hundred faint ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_estimate import AttitudeSettings, fit_attitude
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

Array = NDArray[np.float64]

_ENDLESS = 1e12  # px^2: no degree of freedom is left
# Stars of an image are many and its camera is only roughly known: see `limit_from_scatter`.
_REJECTION = AttitudeSettings(probability_false_alarm=1e-4, limit_from_scatter=True)
_ROUNDS = 8  # of the lens and of what it leaves unexplained


@dataclass(frozen=True, slots=True, eq=False)
class FieldFit:
    """The attitude of one image and the camera it holds for."""

    R_si: Rotation
    cov_s: Array  # (3, 3) rad^2, of a right-handed turn of the image's middle about the axes of s
    camera: StarCamera
    fov_x_sigma_rad: float  # 0 for a camera that was given


def fit_known_camera(camera: StarCamera, xy_px: Array, cov_px: Array, u_i: Array) -> FieldFit:
    """Attitude of a calibrated camera from centroids (N, 2), their covariances and the stars' directions."""
    J = camera.pixel_jacobian(xy_px)
    cov_s = J @ cov_px @ J.transpose(0, 2, 1)
    attitude = fit_attitude(camera.directions_from_pixels(xy_px), u_i, cov_s, _REJECTION)
    larger = max(1.0, attitude.chi2 / max(attitude.dof, 1))
    return FieldFit(attitude.R_si, larger * attitude.cov_s, camera, 0.0)


def fit_attitude_and_lens(
    camera: StarCamera, R_si: Rotation, xy_px: Array, cov_px: Array, u_i: Array
) -> FieldFit:
    """Attitude and lens of a camera that is not calibrated, from a first idea of both.

    Fitted are all seven numbers, which one image does not tell apart: a shifted detector looks like a turned
    and decentred one. So they are believed to be such as lenses have (`_usual`), the firmer the fewer stars
    there are, and the error is stated of what can be seen, the direction of the image's middle.
    What the lens cannot explain, such as the air, is an error of all stars alike (`_unexplained`): otherwise
    the brightest few would bend the lens their way.
    """
    one = np.zeros(len(xy_px), dtype=np.int64)
    stars = IdentifiedStars(xy_px, cov_px, u_i, one, np.zeros(1))
    plain, R = replace(camera, p1=0.0, p2=0.0, q1=0.0), Rotation.concatenate([R_si])
    miss = xy_px - camera.pixels_from_directions(R_si.apply(u_i))
    unexplained = float(np.median((miss**2).sum(axis=1))) / 1.386  # of two axes
    for _ in range(_ROUNDS):
        cov = cov_px + unexplained * np.eye(2)
        fit = fit_camera(replace(stars, cov_px=cov), plain, R, prior=_usual(plain))
        seen = _Seen.of(fit, stars, cov)
        unexplained, before = _unexplained(fit, seen, cov_px, unexplained), unexplained
        if abs(unexplained - before) <= 0.1 * before:
            break
    fov_x = float(np.sqrt(seen.widening @ fit.covariance @ seen.widening))
    cov_s = fit.larger * seen.cov_turn + seen.share @ fit.covariance @ seen.share.T
    return FieldFit(fit.rotations[0], cov_s, fit.camera, fov_x)


def _usual(camera: StarCamera) -> dict[str, float]:
    """How far from ideal lenses are, 1 sigma: the axis from the detector's middle, and in corners the shares
    of the radius by which q1, q2 and decentring displace a star."""
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
class _Seen:
    """How the pixels of the stars that fit follow the camera's numbers, the image's middle held where it
    is, and turns of the image about it.

    Seen from the middle a turn is nearly independent of all numbers; seen from the axis, which may lie
    anywhere, it is the small difference of large ones.
    """

    cov_turn: Array  # (3, 3) rad^2, of a turn of the middle, were the camera known
    share: Array  # (3, 7) what it takes of an error of the camera's numbers
    leverage: Array  # (N,) trace of a star's part in the fit
    widening: Array  # (7,) derivatives of the field's width, rad

    @staticmethod
    def of(fit: CameraFit, stars: IdentifiedStars, cov_px: Array) -> _Seen:
        rows = fit.keep.nonzero()[0]
        u_s = fit.rotations[0].apply(stars.u_i[rows])
        slopes = np.array(
            [
                _slope(fit.camera, name, step)
                for name, step in zip(PARAMETERS, np.sqrt(np.diag(fit.covariance)))
            ]
        )
        A = rotation_derivatives(fit.camera, u_s)
        J = pixel_derivatives(fit.camera, u_s) + A @ slopes[:, :3].T
        W = np.linalg.inv(cov_px[rows])
        AW = A.transpose(0, 2, 1) @ W
        cov_turn = np.linalg.inv((AW @ A).sum(axis=0))
        share = cov_turn @ (AW @ J).sum(axis=0)
        left = J - A @ share
        known = fit.covariance / fit.larger
        leverage = np.einsum("nij,nip,pq,njq->n", W, A, cov_turn, A, optimize=True)
        leverage += np.einsum("nij,nip,pq,njq->n", W, left, known, left, optimize=True)
        return _Seen(cov_turn, share, leverage, slopes[:, 3])


def _slope(camera: StarCamera, name: str, step: float) -> Array:
    """(4,) how far one of the camera's numbers turns the image's middle, about the axes of s, and widens the
    field."""
    more, less = perturbed(camera, name, 0.5 * step), perturbed(camera, name, -0.5 * step)
    turn = Rotation.from_matrix(more.middle_axes() @ less.middle_axes().T).as_rotvec()
    return np.append(turn, more.fov_x_rad - less.fov_x_rad) / step


def _unexplained(fit: CameraFit, seen: _Seen, cov_px: Array, before: float) -> float:
    """Variance, px^2, that each star has beside its own, where likelihood restricted to the residuals is
    largest: the bright stars tell it, whose own is small.

    At the maximum  sum (2 - h) / v = sum r^2 / v^2,  v the variance of a star along one axis, r its residual,
    h its leverage (with the variance `before`).
    """
    own = 0.5 * np.trace(cov_px[fit.keep], axis1=1, axis2=2)
    square = (fit.residual_px[fit.keep] ** 2).sum(axis=1)

    def excess(variance: float) -> float:
        v = own + variance
        return float((square / v**2).sum() - ((2.0 - seen.leverage) / v).sum())

    if excess(0.0) <= 0.0:
        return 0.0
    most = float(square.sum() + own.max())
    while excess(most) > 0.0 and most < _ENDLESS:  # from somewhere on it falls as -dof / variance
        most *= 2.0
    return float(brentq(excess, 0.0, most)) if most < _ENDLESS else before
