"""Points on and about the Earth's ellipsoid: geodetic latitude, longitude and height, and Earth-fixed
coordinates.

Frame e (ITRS/WGS84), metres, radians; heights are above the ellipsoid. Terrain is left to `geometry.terrain`.
"""

from __future__ import annotations

import erfa
import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.constants import Ellipsoid

__all__ = [
    "ecef_from_geodetic",
    "ellipsoid_normals",
    "geodetic_from_ecef",
    "local_axes_e",
    "ray_ellipsoid_intersection",
]

Array = NDArray[np.float64]


def geodetic_from_ecef(p_e: ArrayLike, ellipsoid: Ellipsoid) -> tuple[Array, Array, Array]:
    """Geodetic latitude, longitude (rad, -pi to pi) and height (m) of points (..., 3) (Fukushima 2006, by
    ERFA)."""
    lon, lat, height = erfa.gc2gde(ellipsoid.semi_major_m, ellipsoid.flattening, np.asarray(p_e, dtype=float))
    return lat, lon, height


def ecef_from_geodetic(
    lat_rad: ArrayLike, lon_rad: ArrayLike, height_m: ArrayLike, ellipsoid: Ellipsoid
) -> Array:
    """Earth-fixed coordinates (..., 3), m, of geodetic latitude, longitude and height above the ellipsoid."""
    lat, lon, height = np.broadcast_arrays(
        np.asarray(lat_rad, float), np.asarray(lon_rad, float), np.asarray(height_m, float)
    )
    return np.asarray(erfa.gd2gce(ellipsoid.semi_major_m, ellipsoid.flattening, lon, lat, height))


def ellipsoid_normals(lat_rad: ArrayLike, lon_rad: ArrayLike) -> Array:
    """Unit vectors upwards, (..., 3), frame e."""
    lat, lon = np.asarray(lat_rad, float), np.asarray(lon_rad, float)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def local_axes_e(lat_rad: ArrayLike, lon_rad: ArrayLike) -> Array:
    """(..., 3, 3): columns are the unit vectors east, north and up at a place, in frame e."""
    lat, lon = np.asarray(lat_rad, float), np.asarray(lon_rad, float)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon + lat)], axis=-1)
    up = ellipsoid_normals(lat, lon)
    return np.stack([east, np.cross(up, east), up], axis=-1)


def ray_ellipsoid_intersection(
    origin_e: Array, direction_e: Array, height_m: ArrayLike, ellipsoid: Ellipsoid
) -> Array:
    """First point of each ray at geodetic height `height_m`; rays that miss it, or start below, give NaN.

    Points of equal height do not form an ellipsoid, so the one with semi-axes a + h and b + h is met first
    and the rest (millimetres) is taken off along the ray by Newton's method to 1e-9 m.

    Parameters
    ----------
    origin_e, direction_e : (N, 3) arrays
        Rays in frame e, m; directions of any length.
    height_m : number or (N,) array
        Height above the ellipsoid, m.

    Returns
    -------
    p_e : (N, 3) array
    """
    height = np.broadcast_to(np.asarray(height_m, dtype=float), (len(origin_e),))
    unit = direction_e / np.linalg.norm(direction_e, axis=1, keepdims=True)
    axes = np.stack([ellipsoid.semi_major_m + height] * 2 + [ellipsoid.semi_minor_m + height], axis=-1)
    o, d = origin_e / axes, unit / axes
    dd, od, oo = (np.einsum("ni,ni->n", left, right) for left, right in ((d, d), (o, d), (o, o)))
    discriminant = od * od - dd * (oo - 1.0)
    meets = (discriminant >= 0.0) & (od < 0.0) & (oo >= 1.0)
    distance = (oo - 1.0) / np.where(meets, -od + np.sqrt(np.where(meets, discriminant, 0.0)), np.nan)
    for _ in range(2):
        lat, lon, h = geodetic_from_ecef(origin_e + distance[:, None] * unit, ellipsoid)
        slope = np.einsum("ni,ni->n", ellipsoid_normals(lat, lon), unit)
        distance = distance + (height - h) / np.where(np.abs(slope) > 1e-6, slope, np.nan)
    return np.asarray(origin_e + distance[:, None] * unit)
