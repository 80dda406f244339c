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
    "ray_shell_intersection",
    "vertical_at",
]

Array = NDArray[np.float64]


def geodetic_from_ecef(p_e: ArrayLike, ellipsoid: Ellipsoid) -> tuple[Array, Array, Array]:
    """Geodetic latitude, longitude (rad, -pi to pi) and height (m) of points (..., 3) (Fukushima 2006, by
    ERFA)."""
    with np.errstate(invalid="ignore"):  # NaN gives NaN
        lon, lat, height = erfa.gc2gde(
            ellipsoid.semi_major_m, ellipsoid.flattening, np.asarray(p_e, dtype=float)
        )
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
    and the rest (a centimetre at most) is taken off along the ray by one step of Newton's method, to 1e-8 m.

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
    met = ray_shell_intersection(origin_e, direction_e, height_m, ellipsoid)
    height = np.asarray(height_m, dtype=float)
    if np.any(height):
        along = direction_e / np.sqrt(np.einsum("ni,ni->n", direction_e, direction_e))[:, None]
        h = geodetic_from_ecef(met, ellipsoid)[2]
        slope = np.einsum("ni,ni->n", vertical_at(met, height, ellipsoid), along)
        met = met + ((height - h) / np.where(np.abs(slope) > 1e-6, slope, np.nan))[:, None] * along
    return met


def ray_shell_intersection(
    origin_e: Array, direction_e: Array, height_m: ArrayLike, ellipsoid: Ellipsoid
) -> Array:
    """The same for the ellipsoid with semi-axes a + h, b + h: it lies under height h by h f^2 sin^2(2 lat) /
    8, 0.013 m at 9 km.
    """
    height = np.asarray(height_m, dtype=float)
    origin, unit = np.ascontiguousarray(origin_e.T), np.ascontiguousarray(direction_e.T)
    a2, b2 = (ellipsoid.semi_major_m + height) ** -2.0, (ellipsoid.semi_minor_m + height) ** -2.0
    dd, od, oo = (
        a2 * (left[0] * right[0] + left[1] * right[1]) + b2 * (left[2] * right[2])
        for left, right in ((unit, unit), (origin, unit), (origin, origin))
    )
    discriminant = od * od - dd * (oo - 1.0)
    meets = (discriminant >= 0.0) & (od < 0.0) & (oo >= 1.0)
    distance = (oo - 1.0) / np.where(meets, -od + np.sqrt(np.where(meets, discriminant, 0.0)), np.nan)
    return np.ascontiguousarray((origin + distance * unit).T)


def vertical_at(p_e: Array, height_m: ArrayLike, ellipsoid: Ellipsoid) -> Array:
    """Unit vectors upwards, (N, 3), at points (N, 3) whose height is known to some metres; good to 3e-8 rad
    up to 9 km.

    Quicker than going through latitude and longitude: x : z = (N + h) cos(lat) : (N (1 - e^2) + h) sin(lat),
    where the mean of the radius N serves, as it matters only by h / N.
    """
    height = np.asarray(height_m, dtype=float)
    radius = ellipsoid.semi_major_m * (1.0 + 0.5 * ellipsoid.flattening)
    normal = np.empty(p_e.shape)
    normal[:, :2] = p_e[:, :2]
    normal[:, 2] = p_e[:, 2] * (
        (radius + height) / (radius * (1.0 - ellipsoid.eccentricity_squared) + height)
    )
    return np.asarray(normal / np.sqrt(np.einsum("ni,ni->n", normal, normal))[:, None])
