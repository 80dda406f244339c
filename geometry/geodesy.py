"""Geodetic coordinates (latitude, longitude, height above the ellipsoid) and Earth-fixed coordinates.

Frame e (ITRS/WGS84), metres, radians. Terrain is in `geometry.terrain`.
"""

from __future__ import annotations

import erfa
import numpy as np
from numpy.typing import ArrayLike, NDArray

from boresight.geometry.constants import Ellipsoid
from boresight.geometry.spherical import unit_vectors

__all__ = [
    "columns_at_height",
    "ecef_from_geodetic",
    "ellipsoid_normals",
    "geodetic_along_paths",
    "geodetic_from_ecef",
    "local_axes_e",
    "ray_ellipsoid_intersection",
    "ray_shell_intersection",
    "shell_depth_m",
    "vertical_at",
]

Array = NDArray[np.float64]


def geodetic_from_ecef(p_e: ArrayLike, ellipsoid: Ellipsoid) -> tuple[Array, Array, Array]:
    """Geodetic coordinates of Earth-fixed points (Fukushima 2006, by ERFA).

    Parameters
    ----------
    p_e : (..., 3) array
        Points in frame e, m. NaN gives NaN.
    ellipsoid : Ellipsoid
        Reference ellipsoid, usually `WGS84`.

    Returns
    -------
    lat_rad, lon_rad, height_m : (...) arrays
        Geodetic latitude, longitude (-pi to pi), and height above the ellipsoid.

    Examples
    --------
    >>> lat, lon, height = geodetic_from_ecef([6378237.0, 0.0, 0.0], WGS84)
    >>> round(float(height), 6)
    100.0
    """
    with np.errstate(invalid="ignore"):  # NaN gives NaN
        lon, lat, height = erfa.gc2gde(
            ellipsoid.semi_major_m, ellipsoid.flattening, np.asarray(p_e, dtype=float)
        )
    return lat, lon, height


def geodetic_along_paths(middle_e: Array, half_e: Array, ellipsoid: Ellipsoid) -> Array:
    """Geodetic coordinates of the points `middle_e + s half_e`, -1 <= s <= 1, of short straight paths.

    Cubic in s about the exact coordinates of the middle: the distance r + ds from the Earth's axis gives the
    longitude and the place in the meridian plane, whose radius of curvature gives latitude and height. Of the
    flattening only the second order is kept. Within 1e-6 m for paths of 2 km of ground and 4 km of height
    below 80 deg of latitude; at the poles longitude is no such series.

    Parameters
    ----------
    middle_e, half_e : (N, 3) arrays
        Middles of the paths and halves of their lengths, frame e, m.
    ellipsoid : Ellipsoid
        Reference ellipsoid, usually `WGS84`.

    Returns
    -------
    coefficients : (4, 3, N) array
        Of s^0 to s^3 in latitude and longitude, rad, and height above the ellipsoid, m.
    """
    lat, lon, height = geodetic_from_ecef(middle_e, ellipsoid)
    x, y, z = np.ascontiguousarray(half_e.T)
    x0, y0 = np.ascontiguousarray(middle_e.T[:2])
    r, sin = np.sqrt(x0 * x0 + y0 * y0), np.sin(lat)
    e2 = ellipsoid.eccentricity_squared
    square = 1.0 / (1.0 - e2 * sin * sin)
    normal = ellipsoid.semi_major_m * np.sqrt(square)
    cos, radius = r / (normal + height), normal * (1.0 - e2) * square + height
    east, outward = (x0 * y - y0 * x) / r, (x0 * x + y0 * y) / r
    north, up = z * cos - outward * sin, z * sin + outward * cos
    b, c, d, q, k = east / r, outward / r, 0.5 * east * east / r, north / radius, up / radius
    lift, sink = d * cos, d * sin / radius  # of the distance from the axis, in s^2 (1 - c s)
    second = sink + q * k
    evolute = 1.5 * e2 * sin * cos * square * q  # the radius of curvature changes with latitude
    coefficients = np.empty((4, 3, len(lat)))
    coefficients[0] = lat, lon, height
    coefficients[1] = q, b, up
    coefficients[2] = -second - evolute * q, -b * c, lift + 0.5 * north * q
    coefficients[3, 0] = sink * (c + k) + q * (k * k - q * q / 3.0 - lift / radius) + 2.0 * evolute * second
    coefficients[3, 1] = b * (c * c - b * b / 3.0)
    coefficients[3, 2] = -lift * c - north * (sink + 0.5 * q * k)
    return coefficients


def ecef_from_geodetic(
    lat_rad: ArrayLike, lon_rad: ArrayLike, height_m: ArrayLike, ellipsoid: Ellipsoid
) -> Array:
    """Earth-fixed coordinates (..., 3), m, of geodetic latitude, longitude and height above the ellipsoid.

    The arguments are broadcast. Inverse of `geodetic_from_ecef`.
    """
    lat, lon, height = np.broadcast_arrays(
        np.asarray(lat_rad, float), np.asarray(lon_rad, float), np.asarray(height_m, float)
    )
    return np.asarray(erfa.gd2gce(ellipsoid.semi_major_m, ellipsoid.flattening, lon, lat, height))


def ellipsoid_normals(lat_rad: ArrayLike, lon_rad: ArrayLike) -> Array:
    """Unit normals (..., 3) of the ellipsoid, upwards, frame e, at geodetic latitude and longitude."""
    return unit_vectors(lon_rad, lat_rad)


def local_axes_e(lat_rad: ArrayLike, lon_rad: ArrayLike) -> Array:
    """Matrices (..., 3, 3) whose columns are the unit vectors east, north and up, in frame e."""
    lat, lon = np.asarray(lat_rad, float), np.asarray(lon_rad, float)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon + lat)], axis=-1)
    up = ellipsoid_normals(lat, lon)
    return np.stack([east, np.cross(up, east), up], axis=-1)


def ray_ellipsoid_intersection(
    origin_e: Array, direction_e: Array, height_m: ArrayLike, ellipsoid: Ellipsoid
) -> Array:
    """First point of each ray at geodetic height `height_m`; rays that miss it, or start below, give NaN.

    Points of equal height do not form an ellipsoid, so the ray is first intersected with the ellipsoid of
    semi-axes a + h and b + h. That lies below height h by h (p - a cos^2 - b sin^2) / (p + h), with p^2 = a^2
    cos^2 + b^2 sin^2 of the latitude: 0.013 m at 9 km, corrected along the ray. Accurate to 1e-8 m.

    Parameters
    ----------
    origin_e, direction_e : (N, 3) arrays
        Rays in frame e, m; directions of any length.
    height_m : number or (N,) array
        Height above the ellipsoid, m.

    Returns
    -------
    p_e : (N, 3) array
        Points in frame e, m.
    """
    origin, direction = np.ascontiguousarray(origin_e.T), np.ascontiguousarray(direction_e.T)
    return np.ascontiguousarray(columns_at_height(origin, direction, height_m, ellipsoid)[0].T)


def columns_at_height(
    origin: Array, direction: Array, height_m: ArrayLike, ellipsoid: Ellipsoid
) -> tuple[Array, Array]:
    """Points of `ray_ellipsoid_intersection` and unit verticals there (to 3e-8 rad); vectors are (3, N)."""
    height = np.asarray(height_m, dtype=float)
    point = _columns_on_shell(origin, direction, height, ellipsoid)
    up = _vertical_columns(point, height, ellipsoid)
    if np.any(height):
        slope = up[0] * direction[0] + up[1] * direction[1] + up[2] * direction[2]
        lower = shell_depth_m(up[2] ** 2, height, ellipsoid)
        point += (lower / np.where(slope < 0.0, slope, np.nan)) * direction
    return point, up


def shell_depth_m(sin2_lat: Array, height_m: Array, ellipsoid: Ellipsoid) -> Array:
    """Depth (elementwise) of the ellipsoid of semi-axes a + h, b + h below height h, m; >= 0 for h >= 0."""
    a, b = ellipsoid.semi_major_m, ellipsoid.semi_minor_m
    tangent = np.sqrt(a * a - (a * a - b * b) * sin2_lat)
    return np.asarray(height_m * (tangent - a + (a - b) * sin2_lat) / (tangent + height_m))


def ray_shell_intersection(
    origin_e: Array, direction_e: Array, height_m: ArrayLike, ellipsoid: Ellipsoid
) -> Array:
    """First points (N, 3) of rays on the ellipsoid with semi-axes a + h, b + h; NaN as in
    `ray_ellipsoid_intersection`. It lies below height h by h f^2 sin^2(2 lat) / 8, 0.013 m at 9 km.
    """
    origin, direction = np.ascontiguousarray(origin_e.T), np.ascontiguousarray(direction_e.T)
    point = _columns_on_shell(origin, direction, np.asarray(height_m, dtype=float), ellipsoid)
    return np.ascontiguousarray(point.T)


def _columns_on_shell(origin: Array, direction: Array, height: Array, ellipsoid: Ellipsoid) -> Array:
    a2, b2 = (ellipsoid.semi_major_m + height) ** -2.0, (ellipsoid.semi_minor_m + height) ** -2.0
    dd, od, oo = (
        a2 * (left[0] * right[0] + left[1] * right[1]) + b2 * (left[2] * right[2])
        for left, right in ((direction, direction), (origin, direction), (origin, origin))
    )
    discriminant = od * od - dd * (oo - 1.0)
    meets = (discriminant >= 0.0) & (od < 0.0) & (oo >= 1.0)
    distance = (oo - 1.0) / np.where(meets, np.sqrt(np.maximum(discriminant, 0.0)) - od, np.nan)
    return np.asarray(origin + distance * direction)


def vertical_at(p_e: Array, height_m: ArrayLike, ellipsoid: Ellipsoid) -> Array:
    """Unit verticals (N, 3) at points (N, 3), frame e, of approximately known height; to 3e-8 rad up to 9 km.

    Faster than by latitude and longitude: x : z = (N + h) cos(lat) : (N (1 - e^2) + h) sin(lat), with the
    mean of the radius N, whose variation matters only by h / N.
    """
    return _vertical_columns(p_e.T, np.asarray(height_m, dtype=float), ellipsoid).T


def _vertical_columns(p: Array, height: Array, ellipsoid: Ellipsoid) -> Array:
    radius = ellipsoid.semi_major_m * (1.0 + 0.5 * ellipsoid.flattening)
    stretch = (radius + height) / (radius * (1.0 - ellipsoid.eccentricity_squared) + height)
    normal = np.empty(p.shape)
    normal[:2], normal[2] = p[:2], p[2] * stretch
    normal /= np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    return normal
