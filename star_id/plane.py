"""An image's detections in the tangent plane of frame s, (x, y) = (u_x, u_y) / u_z, and what is known of the
camera there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["FieldOfView", "PlaneImage", "directions_of_plane", "plane_of_directions"]

Array = NDArray[np.float64]

_CALIBRATED = 2e-3  # relative error of angles below which a lens counts as known


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """What is known of the camera, as half sizes of the image in the tangent plane and errors to be
    expected."""

    half_x: float
    half_y: float
    equivalent_fov_rad: float
    pixel: float  # size of a pixel in the tangent plane
    scale_error: float  # the focal length is good to this fraction; 0: known
    shape_error: float  # ratios of a triangle's sides are good to this

    @property
    def known(self) -> bool:
        """The camera is calibrated: nothing about its lens is left to be found."""
        return self.scale_error == 0.0 and self.shape_error < _CALIBRATED


@dataclass(frozen=True, slots=True, eq=False)
class PlaneImage:
    """Detections, brightest first, and a tree to find them by place."""

    plane: Array  # (N, 2)
    tree: cKDTree
    field: FieldOfView

    @property
    def area(self) -> float:
        return 4.0 * self.field.half_x * self.field.half_y


def directions_of_plane(plane: Array) -> Array:
    """Unit vectors (..., 3) of points (..., 2)."""
    v = np.empty((*plane.shape[:-1], 3))
    v[..., :2] = plane
    v[..., 2] = 1.0
    v *= (1.0 / np.sqrt(1.0 + (plane * plane).sum(axis=-1)))[..., None]
    return v


def plane_of_directions(u: Array) -> Array:
    """Points (N, 2) of directions (N, 3); NaN at the horizon and beyond."""
    z = np.where(u[:, 2] > 0.05, u[:, 2], np.nan)
    return np.asarray(u[:, :2] / z[:, None])
