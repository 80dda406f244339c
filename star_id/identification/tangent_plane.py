"""An image's detections in the tangent plane of frame s, x + iy = (u_x + i u_y) / u_z, and what is known of
the camera there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.identification.ranges import ranges

__all__ = [
    "FieldOfView",
    "PlaneImage",
    "directions_of_plane",
    "plane_of_directions",
]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

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

    def contains(self, plane: Complex) -> NDArray[np.bool_]:
        """(N,) whether points (N,) of the tangent plane are in the image."""
        return np.asarray((np.abs(plane.real) < self.half_x) & (np.abs(plane.imag) < self.half_y))


@dataclass(frozen=True, slots=True, eq=False)
class PlaneImage:
    """Detections, brightest first, and their order along x to find them by place."""

    plane: Complex  # (N,)
    field: FieldOfView
    along_x: NDArray[np.int64]  # (N,) rows of `plane`, ascending in x

    @classmethod
    def of(cls, plane: Array, field: FieldOfView) -> PlaneImage:
        """Detections from their coordinates (N, 2). Raises `ValueError` for places that are not known."""
        if not math.isfinite(plane.sum()):
            raise ValueError("detections must have finite places in the tangent plane, got NaN or infinity")
        return cls(np.ascontiguousarray(plane).view(np.complex128)[:, 0], field, plane[:, 0].argsort())

    @property
    def area(self) -> float:
        return 4.0 * self.field.half_x * self.field.half_y

    def within(self, points: Complex, reach: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """All pairs of points (M,) and detections nearer to them than `reach` (M,): rows of both."""
        x = points.real
        window = self.plane.real.take(self.along_x).searchsorted([x - reach, x + reach])
        point, place = ranges(*window)
        detection = self.along_x.take(place)
        distance = np.abs(points.take(point) - self.plane.take(detection))
        close = (distance < reach.take(point)).nonzero()[0]
        return point.take(close), detection.take(close)


def directions_of_plane(plane: Complex) -> Array:
    """Unit vectors (..., 3) of points (...)."""
    u = np.empty((*plane.shape, 3))
    u[..., 2] = z = 1.0 / np.sqrt(1.0 + np.abs(plane) ** 2)
    u[..., 0], u[..., 1] = plane.real * z, plane.imag * z
    return u


def plane_of_directions(u: Array) -> Complex:
    """Points (N,) of directions (N, 3) ahead of the camera."""
    return np.asarray((u[:, 0] + 1j * u[:, 1]) / u[:, 2])
