"""The shape of the ground, and where a line of sight meets it first.

A surface gives ellipsoidal heights at geodetic places, NaN where it knows none. `TerrainGrid` is a raster in
any map projection or in degrees, read by bilinear interpolation; heights above mean sea level are brought to
the ellipsoid once, at birth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer

from geometry.constants import WGS84
from geometry.geodesy import geodetic_from_ecef, ray_ellipsoid_intersection
from geometry.geoid import Geoid

__all__ = ["ConstantHeight", "Surface", "TerrainGrid", "intersect"]

Array = NDArray[np.float64]

_TOLERANCE_M = 1e-6


class Surface(Protocol):
    """Ground of any kind."""

    def height_m(self, lat_rad: Array, lon_rad: Array) -> Array:
        """Height above the ellipsoid, m, at geodetic places (N,); NaN where there is no data."""
        ...

    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest ground of the surface."""
        ...


@dataclass(frozen=True, slots=True)
class ConstantHeight:
    """Ground at one height above the ellipsoid everywhere, m."""

    height: float

    def height_m(self, lat_rad: Array, lon_rad: Array) -> Array:
        return np.full(np.broadcast_shapes(np.shape(lat_rad), np.shape(lon_rad)), self.height)

    def height_range_m(self) -> tuple[float, float]:
        return self.height, self.height


@dataclass(frozen=True, slots=True, eq=False)
class TerrainGrid:
    """A raster of ellipsoidal heights. Made by `TerrainGrid.from_raster`."""

    heights_m: NDArray[np.float32]  # (rows, columns) above the ellipsoid at pixel centres, NaN = no data
    transform: tuple[
        float, float, float, float, float, float
    ]  # a b c d e f: x = a col + b row + c of a pixel's corner
    crs: str

    @staticmethod
    def from_raster(
        heights_m: ArrayLike,
        transform: ArrayLike,
        crs: str,
        geoid: Geoid | None,
        *,
        no_data: float | None = None,
    ) -> TerrainGrid:
        """A surface from a raster of heights.

        Parameters
        ----------
        heights_m : (rows, columns) array
            Heights at the centres of pixels, m. NaN and `no_data` mean that there is none.
        transform : six numbers
            (a, b, c, d, e, f) of rasterio's Affine: corner of pixel (column, row) at x = a column + b row +
            c, y = d column + e row + f, in the CRS (x east, y north; degrees if geographic).
        crs : str
            Any horizontal CRS that PROJ understands, as WKT or "EPSG:32650".
        geoid : Geoid or None
            Geoid that the heights refer to (egm96() for SRTM); None if they are above the ellipsoid.
        """
        heights = np.array(heights_m, dtype=np.float32)
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise ValueError(f"terrain needs at least 2 x 2 heights, got shape {heights.shape}")
        if no_data is not None:
            heights[heights == np.float32(no_data)] = np.nan
        if not np.any(np.isfinite(heights)):
            raise ValueError("terrain has no height at all: every pixel is without data")
        a, b, c, d, e, f = (float(value) for value in np.ravel(np.asarray(transform, dtype=float))[:6])
        grid = TerrainGrid(heights, (a, b, c, d, e, f), crs)
        if geoid is not None:
            grid._add(geoid)
        return grid

    def height_m(self, lat_rad: Array, lon_rad: Array) -> Array:
        """Bilinear between the four pixel centres around; NaN if one of them has no data, or past the
        edge."""
        column, row = self.pixels_from_geodetic(lat_rad, lon_rad)
        return _bilinear(self.heights_m, column, row)

    def height_range_m(self) -> tuple[float, float]:
        return float(np.nanmin(self.heights_m)), float(np.nanmax(self.heights_m))

    def pixels_from_geodetic(self, lat_rad: ArrayLike, lon_rad: ArrayLike) -> tuple[Array, Array]:
        """Column and row, (0, 0) at the centre of the first pixel."""
        x, y = _to_map(self.crs).transform(np.degrees(lon_rad), np.degrees(lat_rad))
        a, b, c, d, e, f = self.transform
        determinant = a * e - b * d
        dx, dy = np.asarray(x) - c, np.asarray(y) - f
        return (e * dx - b * dy) / determinant - 0.5, (a * dy - d * dx) / determinant - 0.5

    def geodetic_from_pixels(self, column: ArrayLike, row: ArrayLike) -> tuple[Array, Array]:
        """Latitude and longitude, rad; the inverse of `pixels_from_geodetic`."""
        a, b, c, d, e, f = self.transform
        u, v = np.asarray(column, float) + 0.5, np.asarray(row, float) + 0.5
        lon, lat = _to_map(self.crs).transform(a * u + b * v + c, d * u + e * v + f, direction="INVERSE")
        return np.radians(lat), np.radians(lon)

    def _add(self, geoid: Geoid) -> None:
        """Raise heights above mean sea level to heights above the ellipsoid, some rows at a time."""
        rows, columns = self.heights_m.shape
        step = max(1, 2**20 // columns)
        for first in range(0, rows, step):
            row, column = np.mgrid[first : min(first + step, rows), :columns]
            lat, lon = self.geodetic_from_pixels(column, row)
            self.heights_m[first : first + step] += geoid.undulation_m(lat, lon)


def intersect(origin_e: Array, direction_e: Array, surface: Surface) -> Array:
    """First point where each ray meets the ground, (N, 3), frame e, m; NaN where it meets none.

    Each ray is followed from the highest ground downwards; where a first crossing is bracketed, it is
    narrowed to 1e-6 m.
    """
    low, high = surface.height_range_m()
    if high - low < _TOLERANCE_M:
        met = ray_ellipsoid_intersection(origin_e, direction_e, high, WGS84)
        lat, lon, _ = geodetic_from_ecef(met, WGS84)
        return np.where(np.isfinite(surface.height_m(lat, lon))[:, None], met, np.nan)
    return _march(origin_e, direction_e, surface, low - 1.0, high + 1.0)


def _march(origin_e: Array, direction_e: Array, surface: Surface, low: float, high: float) -> Array:
    start = ray_ellipsoid_intersection(origin_e, direction_e, high, WGS84)
    stop = ray_ellipsoid_intersection(origin_e, direction_e, low, WGS84)

    def above(fraction: Array) -> Array:
        lat, lon, height = geodetic_from_ecef(start + fraction[:, None] * (stop - start), WGS84)
        return height - surface.height_m(lat, lon)

    steps = 64
    left: Array = np.zeros(len(start))
    right: Array = np.full(len(start), np.nan)
    for k in range(1, steps + 1):
        here = np.full(len(start), k / steps)
        under = above(here) <= 0.0
        found = np.isnan(right) & under
        right[found] = here[found]
        left[np.isnan(right)] = k / steps
    for _ in range(50):
        middle = 0.5 * (left + right)
        under = above(middle) <= 0.0
        left, right = np.where(under, left, middle), np.where(under, middle, right)
    end = np.where(np.abs(above(right)) < 1e-3, right, np.nan)
    return np.asarray(start + end[:, None] * (stop - start))


def _bilinear(values: NDArray[np.float32], column: Array, row: Array) -> Array:
    rows, columns = values.shape
    inside = (column >= 0.0) & (column <= columns - 1.0) & (row >= 0.0) & (row <= rows - 1.0)
    x, y = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
    c = np.minimum(x.astype(np.int64), columns - 2)
    r = np.minimum(y.astype(np.int64), rows - 2)
    fx, fy = x - c, y - r
    upper = values[r, c] * (1.0 - fx) + values[r, c + 1] * fx
    lower = values[r + 1, c] * (1.0 - fx) + values[r + 1, c + 1] * fx
    return np.where(inside, upper * (1.0 - fy) + lower * fy, np.nan)


@lru_cache(maxsize=16)
def _to_map(crs: str) -> Transformer:
    return Transformer.from_crs(CRS.from_epsg(4326), CRS.from_user_input(crs), always_xy=True)
