"""Place and time of an image of the sky, and the directions of catalogue stars as observed from there.

Of an image without time neither the stars' proper motion nor the Earth's velocity is known: their effects are
errors.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ABERRATION
from boresight.geometry.epoch import Epoch
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import Air, apparent_star_directions, catalogue_directions, refract_by_air
from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.identification.triangle_index import StarIndex

__all__ = ["ABERRATION_SCALE", "Observer", "proper_motion_covariance", "sky_directions", "star_directions"]

# Steps of inverting the refraction: each reduces the error by its change with altitude, 100 times and more.
REFRACTION_STEPS = 4
# Relative change of angles by aberration, root mean square over directions: the time of an image is unknown.
ABERRATION_SCALE = ABERRATION / np.sqrt(3.0)


@record
class Observer:
    """Place, velocity and time of an image, by which aberration and refraction are taken into account.

    If they are ignored, aberration changes the fitted focal length by 1e-4 and the attitude by up to 20
    arc-seconds; refraction, for a camera on the ground, changes angles by 3e-4.
    """

    epoch: Epoch = scalar("TAI second from which `t_s` counts")
    t_s: float = scalar("middle of the exposure, s after the epoch")
    p_i: Floats = array("3", "position, GCRS, m")
    v_i: Floats = array("3", "velocity, GCRS, m/s")
    air: Air | None = scalar("atmosphere above a camera on the ground; None in space", default=None)

    @property
    def tai_s(self) -> float:
        """TAI seconds since 2000-01-01T12:00:00, to a microsecond; compares observers of different epochs."""
        return self.epoch.tai_s + self.t_s


def star_directions(index: StarIndex, rows: Ints, observer: Observer | None) -> Floats:
    """Unit vectors (N, 3), GCRS axes, of the index's stars `rows` (N,): apparent for an observer, otherwise
    catalogue directions with proper motion to the index's epoch."""
    if observer is None:
        return index.u_i.take(rows, axis=0)
    u_i = apparent_star_directions(
        index.stars.take(rows), observer.epoch, observer.t_s, observer.p_i, observer.v_i
    )
    return u_i if observer.air is None else refract_by_air(u_i, observer.air)


def sky_directions(u_i: Floats, observer: Observer | None) -> Floats:
    """Unit vectors (N, 3), ICRS, of observed ones `u_i` (N, 3): inverse of `star_directions` but for proper
    motion and parallax. Without an observer they are taken for those of the catalogue.
    """
    if observer is None:
        return u_i
    if observer.air is not None:
        outside = u_i
        for _ in range(REFRACTION_STEPS):
            outside = outside + (u_i - refract_by_air(outside, observer.air))
            outside = outside / np.linalg.norm(outside, axis=1, keepdims=True)
        u_i = outside
    return catalogue_directions(u_i, observer.epoch, observer.t_s, observer.p_i, observer.v_i)


def proper_motion_covariance(
    index: StarIndex, rows: Ints, camera: StarCamera, R_si: Rotation, error_years: float
) -> Floats:
    """Covariances (N, 2, 2), px^2, of the images of the index's stars `rows` (N,) if the epoch of the index
    is wrong by `error_years`, 1 sigma."""
    if error_years == 0.0:
        return np.zeros((len(rows), 2, 2))
    moved = -R_si.apply(_motions(index).take(rows, axis=0))[:, :2]
    moved *= error_years * camera.focal_m / camera.pixel_m
    return np.asarray(moved[:, :, None] * moved[:, None, :])


@lru_cache(maxsize=2)  # every image asks
def _motions(index: StarIndex) -> Floats:
    """Proper motions (N, 3), rad/yr, GCRS axes, of the stars of an index."""
    return index.stars.motions()
