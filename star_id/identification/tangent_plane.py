"""Detections in the tangent plane of frame s, as complex numbers x + iy = (u_x + i u_y) / u_z, and the
camera's field of view there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats, Ints, record, scalar
from boresight.star_id.identification.triangle_index import concatenated_ranges

__all__ = ["Complex", "FieldOfView", "PlaneDetections", "directions_of_tangents", "tangents_of_directions"]

Complex = NDArray[np.complex128]

# Relative error of angles below which a camera's distortion counts as known: 1 px at 500 px from the
# middle.
_CALIBRATED = 2e-3


@record(kw_only=True)
class FieldOfView:
    """Size of an image in the tangent plane, and the errors to expect of the camera's model."""

    half_x: float = scalar("half width of the image, tangent-plane units")
    half_y: float = scalar("half height of the image, tangent-plane units")
    equivalent_fov_rad: float = scalar("width of a 4:3 field of the same area (`equivalent_fov`), rad")
    pixel: float = scalar("size of a pixel, tangent-plane units")
    scale_error: float = scalar("relative error of the focal length; 0: known")
    shape_error: float = scalar("relative error of the side ratios of a triangle, due to distortion")

    @property
    def is_calibrated(self) -> bool:
        """True if neither the focal length nor the distortion has to be fitted."""
        return self.scale_error == 0.0 and self.shape_error < _CALIBRATED

    def contains(self, points: Complex) -> Bools:
        """(N,) whether tangent-plane points (N,) lie in the image."""
        return np.asarray((np.abs(points.real) < self.half_x) & (np.abs(points.imag) < self.half_y))


@record
class PlaneDetections:
    """Detections of one image in the tangent plane, brightest first, with a search index along x."""

    points: Complex  # (N,)
    field: FieldOfView
    along_x: Ints  # (N,) rows of `points`, ascending in x

    @classmethod
    def from_xy(cls, xy: Floats, field: FieldOfView) -> PlaneDetections:
        """Detections at tangent-plane coordinates (N, 2). Raises `ValueError` for NaN or infinite ones."""
        if not math.isfinite(xy.sum()):
            raise ValueError("detections must have finite tangent-plane coordinates, got NaN or infinity")
        return cls(np.ascontiguousarray(xy).view(np.complex128)[:, 0], field, xy[:, 0].argsort(kind="stable"))

    @property
    def area(self) -> float:
        """Area of the image, squared tangent-plane units."""
        return 4.0 * self.field.half_x * self.field.half_y

    def within(self, points: Complex, radius: Floats) -> tuple[Ints, Ints]:
        """Rows (K,) of `points` (M,) and rows (K,) of the detections closer to them than `radius` (M,)."""
        x = points.real
        window = self.points.real.take(self.along_x).searchsorted([x - radius, x + radius])
        point, position = concatenated_ranges(*window)
        detection = self.along_x.take(position)
        distance = np.abs(points.take(point) - self.points.take(detection))
        close = (distance < radius.take(point)).nonzero()[0]
        return point.take(close), detection.take(close)


def directions_of_tangents(points: Complex) -> Floats:
    """Unit vectors (..., 3), frame s, of tangent-plane points (...)."""
    u = np.empty((*points.shape, 3))
    u[..., 2] = z = 1.0 / np.sqrt(1.0 + np.abs(points) ** 2)
    u[..., 0], u[..., 1] = points.real * z, points.imag * z
    return u


def tangents_of_directions(u_s: Floats) -> Complex:
    """Tangent-plane points (N,) of directions (N, 3), frame s, in front of the camera."""
    return np.asarray((u_s[:, 0] + 1j * u_s[:, 1]) / u_s[:, 2])
