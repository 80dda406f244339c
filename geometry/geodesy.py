"""Geodetic coordinates (latitude, longitude, height above the ellipsoid) and Earth-fixed coordinates.

Frame e (ITRS/WGS84: the ellipsoid, unless another is given), metres, radians.
"""

from __future__ import annotations

import erfa
import numpy as np
from numpy.typing import ArrayLike

from boresight.geometry.constants import WGS84, Ellipsoid
from boresight.records.record import Floats

__all__ = [
    "columns_at_height",
    "distances_to_shell",
    "ecef_from_geodetic",
    "geodetic_from_ecef",
    "local_axes_e",
    "ray_ellipsoid_intersection",
    "unit_vectors",
    "verticals",
]


def geodetic_from_ecef(p_e: ArrayLike, ellipsoid: Ellipsoid = WGS84) -> tuple[Floats, Floats, Floats]:
    """Geodetic latitude, longitude (-pi to pi), rad, and height above the ellipsoid, m, (...) each, of points
    (..., 3) in frame e, m (Fukushima 2006, by ERFA). NaN gives NaN.

    Examples
    --------
    >>> lat, lon, height = geodetic_from_ecef([6378237.0, 0.0, 0.0])
    >>> round(float(height), 6)
    100.0
    """
    with np.errstate(invalid="ignore"):  # NaN gives NaN
        lon, lat, height = erfa.gc2gde(
            ellipsoid.semi_major_m, ellipsoid.flattening, np.asarray(p_e, dtype=float)
        )
    return lat, lon, height


def ecef_from_geodetic(
    lat_rad: ArrayLike, lon_rad: ArrayLike, height_m: ArrayLike, ellipsoid: Ellipsoid = WGS84
) -> Floats:
    """Earth-fixed coordinates (..., 3), m, of geodetic latitude, longitude and height above the ellipsoid.

    The arguments are broadcast. Inverse of `geodetic_from_ecef`.
    """
    lat, lon, height = np.broadcast_arrays(
        np.asarray(lat_rad, float), np.asarray(lon_rad, float), np.asarray(height_m, float)
    )
    return np.asarray(erfa.gd2gce(ellipsoid.semi_major_m, ellipsoid.flattening, lon, lat, height))


def unit_vectors(longitude_rad: ArrayLike, latitude_rad: ArrayLike) -> Floats:
    """Unit vectors (..., 3) at longitude and latitude (...), or at right ascension and declination. At
    geodetic latitude they are the ellipsoid's normals, upwards, frame e.
    """
    lon, lat = np.asarray(longitude_rad, float), np.asarray(latitude_rad, float)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def local_axes_e(lat_rad: ArrayLike, lon_rad: ArrayLike) -> Floats:
    """Matrices (..., 3, 3) whose columns are the unit vectors east, north and up, in frame e."""
    lat, lon = np.asarray(lat_rad, float), np.asarray(lon_rad, float)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon + lat)], axis=-1)
    up = unit_vectors(lon, lat)
    return np.stack([east, np.cross(up, east), up], axis=-1)


def ray_ellipsoid_intersection(
    origin_e: Floats, direction_e: Floats, height_m: ArrayLike, ellipsoid: Ellipsoid = WGS84
) -> Floats:
    """First points (N, 3), frame e, m, of rays at geodetic height `height_m`, a number or (N,); rays that
    miss it, or start below, give NaN. Origins, m, and directions of any length, (N, 3), are in frame e.

    Points of equal height do not form an ellipsoid, so the ray is first intersected with the ellipsoid of
    semi-axes a + h and b + h. That lies below height h by h (p - a cos^2 - b sin^2) / (p + h), with p^2 = a^2
    cos^2 + b^2 sin^2 of the latitude: 0.013 m at 9 km, corrected along the ray. Accurate to 1e-8 m.
    """
    origin, direction = np.ascontiguousarray(origin_e.T), np.ascontiguousarray(direction_e.T)
    return np.ascontiguousarray(columns_at_height(origin, direction, height_m, ellipsoid)[0].T)


def columns_at_height(
    origin: Floats, direction: Floats, height_m: ArrayLike, ellipsoid: Ellipsoid = WGS84
) -> tuple[Floats, Floats]:
    """Points of `ray_ellipsoid_intersection` and unit verticals there (to 3e-8 rad); vectors are (3, N)."""
    height = np.asarray(height_m, dtype=float)
    point = origin + distances_to_shell(origin, direction, height, ellipsoid) * direction
    up = verticals(point, height, ellipsoid)
    if np.any(height):
        slope = up[0] * direction[0] + up[1] * direction[1] + up[2] * direction[2]
        a, b, sin2_lat = ellipsoid.semi_major_m, ellipsoid.semi_minor_m, up[2] ** 2
        tangent = np.sqrt(a * a - (a * a - b * b) * sin2_lat)
        lower = height * (tangent - a + (a - b) * sin2_lat) / (tangent + height)
        point += (lower / np.where(slope < 0.0, slope, np.nan)) * direction
    return point, up


def distances_to_shell(
    origin: Floats, direction: Floats, height_m: ArrayLike, ellipsoid: Ellipsoid = WGS84
) -> Floats:
    """Distances (N,) from origins (3, N), in lengths of the directions (3, N), to the first points of rays on
    the ellipsoid with semi-axes a + h, b + h; NaN as in `ray_ellipsoid_intersection`.

    That ellipsoid lies below height h by h f^2 sin^2(2 lat) / 8, 0.013 m at 9 km.
    """
    height = np.asarray(height_m, dtype=float)
    a, b = ellipsoid.semi_major_m + height, ellipsoid.semi_minor_m + height
    stretch = (a / b) ** 2  # of z^2: the ellipsoid becomes a sphere
    oz, dz = stretch * origin[2], stretch * direction[2]
    dd = direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * dz
    od = origin[0] * direction[0] + origin[1] * direction[1] + origin[2] * dz
    above = origin[0] * origin[0] + origin[1] * origin[1] + origin[2] * oz - a * a
    discriminant = od * od - dd * above
    meets = (discriminant >= 0.0) & (od < 0.0) & (above >= 0.0)
    if not meets.all():
        discriminant, od = np.where(meets, discriminant, np.nan), np.where(meets, od, np.nan)
    return np.asarray(above / (np.sqrt(discriminant) - od))


def verticals(p: Floats, height: Floats, ellipsoid: Ellipsoid = WGS84) -> Floats:
    """Unit verticals (3, N) at points (3, N), frame e, of approximately known height; to 3e-8 rad up to 9 km.

    Faster than by latitude and longitude: x : z = (N + h) cos(lat) : (N (1 - e^2) + h) sin(lat), with the
    mean of the radius N, whose variation matters only by h / N.
    """
    radius = ellipsoid.semi_major_m * (1.0 + 0.5 * ellipsoid.flattening)
    stretch = (radius + height) / (radius * (1.0 - ellipsoid.eccentricity_squared) + height)
    normal = np.empty(p.shape)
    z = p[2] * stretch
    scale = 1.0 / np.sqrt(p[0] * p[0] + p[1] * p[1] + z * z)
    np.multiply(p[:2], scale, out=normal[:2])
    np.multiply(z, scale, out=normal[2])
    return normal
