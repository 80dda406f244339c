"""Ground surfaces with heights above the ellipsoid, and the first intersection of a line of sight with them.

`TerrainGrid` is a raster in any map projection or in degrees, bilinear between pixel centres; heights above
mean sea level are converted to ellipsoidal heights when it is built. `geometry.terrain_rays` holds the
intersection of rays with a grid. Tiles of one raster (equal pixels on one lattice, side by side or
overlapping) are `joined` to one, so that heights are interpolated across their edges; rasters that do not fit
stay apart (`TerrainTiles`).

In place of a map projection stands a polynomial (`LocalMap`): over a raster of about a degree one of degree
five to nine agrees with it to less than a micrometre at a tenth of its cost. The fit is verified; there is
none where no degree is accurate enough.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer

from boresight.geometry import terrain_rays
from boresight.geometry.geodesy import distances_to_shell, geodetic_from_ecef, ray_ellipsoid_intersection
from boresight.geometry.geoid import Geoid
from boresight.records.record import Bools, Floats, Ints, array, record, scalar

__all__ = [
    "ConstantHeight",
    "LocalMap",
    "Raster",
    "Surface",
    "TerrainGrid",
    "TerrainTiles",
    "fit_local_map",
    "intersect",
    "joined",
]

Map = Callable[[Floats, Floats], tuple[Floats, Floats]]

_FLAT_M = 1e-6  # relief below this is a constant height
_CHUNK = 32_768  # rays at a time: their arrays stay in the cache
_MARGIN_M = 0.1  # deviation of a shell from equal height, at most
_LOCAL_MAP_PX = 1e-7  # error of a polynomial in place of a map projection
_ON_GROUND_M = 1e-4  # an intersection is accurate to 1e-6 m
_STEPS = 64  # between the highest and the lowest height of a surface that is not a grid
_LONGEST_PATH_M = (200.0, 2e3, 1e4, 2.5e4)  # on the map, for degree 2, 3, ...: error L^(n+1) / R^n
_DEGREES = (3, 5, 7, 9)  # of polynomials for the local map, tried until the error is small enough
_ON_LATTICE_PX = 0.01  # by which tiles of one raster may be off, as coordinates are rounded


class Surface(Protocol):
    """A ground surface."""

    def height_m(self, lat_rad: Floats, lon_rad: Floats) -> Floats:
        """Height above the ellipsoid, m, at geodetic latitudes and longitudes (N,); NaN without data."""
        ...

    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest height of the surface, m."""
        ...


@record
class ConstantHeight:
    """Ground of one height above the ellipsoid everywhere."""

    height: float = scalar("above the ellipsoid, m")

    def height_m(self, lat_rad: Floats, lon_rad: Floats) -> Floats:
        """Height above the ellipsoid, m, in the broadcast shape of the arguments."""
        return np.full(np.broadcast_shapes(np.shape(lat_rad), np.shape(lon_rad)), self.height)

    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest height of the surface, m."""
        return self.height, self.height


@record
class LocalMap:
    """Polynomials of total degree D in (u - u0) / u_half, (v - v0) / v_half; built by `fit_local_map`."""

    middle: tuple[float, float] = array("2", "(u0, v0), rad")
    half: tuple[float, float] = array("2", "half widths of the region, rad")
    coefficients: Floats = array("2, D + 1, D + 1", "by power of u and of v; zero above the total degree")

    def covers(self, u: Floats, v: Floats) -> Bools:
        """Mask (N,) of the points (u, v), rad, inside the region of the fit."""
        inside = np.abs(u - self.middle[0]) <= self.half[0]
        inside &= np.abs(v - self.middle[1]) <= self.half[1]
        return np.asarray(inside)

    def at(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Both coordinates (N,) of points (u, v), rad."""
        x = (u - self.middle[0]) * (1.0 / self.half[0])
        y = (v - self.middle[1]) * (1.0 / self.half[1])
        first, second = (_horner(coefficients, x, y) for coefficients in self.coefficients)
        return first, second


@record
class TerrainGrid:
    """A raster of heights above the ellipsoid; built by `TerrainGrid.from_raster`."""

    heights_m: NDArray[np.float32] = array("R, C", "above the ellipsoid at pixel centres, NaN = no data")
    transform: tuple[float, float, float, float, float, float] = array(
        "6", "(a, b, c, d, e, f): x = a column + b row + c, y = d column + e row + f, pixel corners"
    )
    crs: str = scalar("horizontal CRS of x and y, as PROJ understands it")
    bounds: terrain_rays.HeightBounds = scalar("lowest and highest ground by tiles")
    local_map: LocalMap | None = scalar("latitude and longitude to column and row, 1e-7 px, if one exists")

    @staticmethod
    def from_raster(heights_m: ArrayLike, transform: ArrayLike, crs: str, geoid: Geoid | None) -> TerrainGrid:
        """Surface from a raster of heights (rows, columns) at the centres of pixels, m; NaN marks pixels
        without data. Contiguous single precision above the ellipsoid is not copied.

        `transform` are the six numbers (a, b, c, d, e, f) of rasterio's Affine: the corner of pixel (column,
        row) is at x = a column + b row + c, y = d column + e row + f, in the horizontal CRS `crs` that PROJ
        understands, as WKT or "EPSG:32650" (x east, y north; degrees if geographic). `geoid` is that which
        the heights refer to (`egm96()` for SRTM); None if they are above the ellipsoid. Raises `ValueError`
        for less than 2 x 2 heights, no height at all, or a transform that cannot be inverted.
        """
        heights = np.ascontiguousarray(heights_m, dtype=np.float32)
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise ValueError(f"terrain needs at least 2 x 2 heights, got shape {heights.shape}")
        if not np.any(np.isfinite(heights)):
            raise ValueError("terrain has no height at all: every pixel is without data")
        a, b, c, d, e, f = (float(value) for value in np.ravel(np.asarray(transform, dtype=float))[:6])
        if a * e == b * d:
            raise ValueError(f"terrain transform cannot be inverted: {(a, b, c, d, e, f)}")
        if geoid is not None:
            heights = _above_ellipsoid(heights, (a, b, c, d, e, f), crs, geoid)
        local_map = _local_map((a, b, c, d, e, f), heights.shape, crs)
        return TerrainGrid(
            heights, (a, b, c, d, e, f), crs, terrain_rays.bounds_of_heights(heights), local_map
        )

    def height_m(self, lat_rad: ArrayLike, lon_rad: ArrayLike) -> Floats:
        """Height above the ellipsoid, m, bilinear, elementwise; NaN at missing data or outside."""
        return terrain_rays.bilinear(self.heights_m, *self.pixels_from_geodetic(lat_rad, lon_rad))

    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest height of the surface, m."""
        return self.bounds.lowest_m, self.bounds.highest_m

    def pixels_from_geodetic(self, lat_rad: ArrayLike, lon_rad: ArrayLike) -> tuple[Floats, Floats]:
        """Fractional columns and rows of geodetic points, (0, 0) at the centre of the first pixel."""
        lat, lon = np.asarray(lat_rad, dtype=float), np.asarray(lon_rad, dtype=float)
        if self.local_map is not None and self.local_map.covers(lat, lon).all():
            return self.local_map.at(lat, lon)
        a, b, c, _, _, _ = self.transform
        to_map = _to_map(self.crs)
        if to_map is not None:
            return _pixels_from_map(self.transform, *to_map.transform(np.degrees(lon), np.degrees(lat)))
        # degrees; shift longitudes by 360 degrees to those of the raster
        middle = c + 0.5 * (a * self.heights_m.shape[1] + b * self.heights_m.shape[0])
        x = np.degrees(lon)
        return _pixels_from_map(self.transform, x + 360.0 * np.round((middle - x) / 360.0), np.degrees(lat))

    def pixels_along_tracks(self, tracks: Floats) -> Floats:
        """Short paths in the raster as polynomials of a parameter from -1 to 1.

        `tracks` (K, 3, N) are latitude and longitude, rad, and height, m, at K evenly spaced parameters, and
        are overwritten. Returned are coefficients (K, 3, N) of the powers of the parameter, from 0 on, in
        column, row, px, and height, m.
        """
        for track in tracks:
            track[:2] = self.pixels_from_geodetic(track[0], track[1])
        k = len(tracks)
        to_coefficients = np.linalg.inv(np.vander(_nodes(k - 1), increasing=True))
        return np.asarray((to_coefficients @ tracks.reshape(k, -1)).reshape(tracks.shape))


@record
class Raster:
    """Heights as a file has them."""

    heights_m: NDArray[np.float32] = array("R, C", "at pixel centres, NaN = no data")
    transform: tuple[float, float, float, float, float, float] = array("6", "as that of `TerrainGrid`")
    crs: str = scalar("of x and y, as PROJ understands it")


@record
class TerrainTiles:
    """Height models beside or above one another: a point has the height of the first that has one there."""

    grids: tuple[TerrainGrid, ...] = array("G", "the most important first")

    def height_m(self, lat_rad: Floats, lon_rad: Floats) -> Floats:
        """Height above the ellipsoid, m, elementwise; NaN where no grid has one."""
        heights = np.asarray(self.grids[0].height_m(lat_rad, lon_rad))
        for grid in self.grids[1:]:
            if np.isfinite(heights).all():
                break
            heights = np.where(np.isfinite(heights), heights, grid.height_m(lat_rad, lon_rad))
        return heights

    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest height of all grids, m."""
        lowest, highest = zip(*(grid.height_range_m() for grid in self.grids))
        return min(lowest), max(highest)


def joined(rasters: Sequence[Raster], most_pixels: int) -> tuple[Raster, ...]:
    """The rasters, tiles of one raster as one of at most `most_pixels`; the first one's heights count."""
    left, done = list(rasters), []
    while left:
        one, left = left[0], left[1:]
        while (
            n := next((n for n, other in enumerate(left) if _fits(one, other, most_pixels)), None)
        ) is not None:
            one = _together(one, left.pop(n))
        done.append(one)
    return tuple(done)


def intersect(origin_e: Floats, direction_e: Floats, surface: Surface) -> Floats:
    """First intersections (N, 3), frame e, m, of rays from above all ground downwards with the surface;
    origins, m, and directions of any length, (N, 3), are in frame e.

    Accurate to 1e-6 m in height. On a grid the ray is sampled once per pixel, so a crest that it crosses over
    less than a pixel may be missed. NaN for a ray without intersection, and where the first one may lie
    outside the surface or in pixels without data.
    """
    if isinstance(surface, TerrainTiles):
        return _on_tiles(origin_e, direction_e, surface)
    low, high = surface.height_range_m()
    p_e = np.empty((3, len(origin_e))).T  # components lie together in memory
    for first in range(0, len(origin_e), _CHUNK):
        part = slice(first, first + _CHUNK)
        origin, along = origin_e[part], direction_e[part]
        if high - low < _FLAT_M:
            p_e[part] = _on_flat(origin, along, surface, high)
        else:
            p_e[part] = _on_relief(origin, along, surface, low, high)
    return p_e


def _on_flat(origin_e: Floats, direction_e: Floats, surface: Surface, height: float) -> Floats:
    p_e = ray_ellipsoid_intersection(origin_e, direction_e, height)
    if isinstance(surface, ConstantHeight):
        return p_e
    lat, lon, _ = geodetic_from_ecef(p_e)
    return np.where(np.isfinite(surface.height_m(lat, lon))[:, None], p_e, np.nan)


@record
class _RaysOverSurface:
    """Rays from `top` to `top + path`, both (N, 3), frame e, m, over any surface."""

    surface: Surface
    top: Floats
    path: Floats

    def above_ground(self, share: Floats) -> Floats:
        lat, lon, height = geodetic_from_ecef(self.top + share[:, None] * self.path)
        return height - self.surface.height_m(lat, lon)

    def of(self, rays: Ints) -> _RaysOverSurface:
        return _RaysOverSurface(self.surface, self.top[rays], self.path[rays])


def _on_relief(origin_e: Floats, direction_e: Floats, surface: Surface, low: float, high: float) -> Floats:
    """First intersections (N, 3) on each ray from just above the highest ground to just below the lowest."""
    origin, direction = np.ascontiguousarray(origin_e.T), np.ascontiguousarray(direction_e.T)
    near = distances_to_shell(origin, direction, high + _MARGIN_M)
    far = distances_to_shell(origin, direction, low - _MARGIN_M)
    if isinstance(surface, TerrainGrid):
        middle, half = origin + (0.5 * (near + far)) * direction, (0.5 * (far - near)) * direction
        return np.asarray((middle + _shares_on_grid(middle, half, surface) * half).T)
    top, path = (origin + near * direction).T, ((far - near) * direction).T
    share = terrain_rays.crossings_by_steps(_RaysOverSurface(surface, top, path), len(top), _STEPS)
    return np.asarray(top + share[:, None] * path)


def _shares_on_grid(middle: Floats, half: Floats, grid: TerrainGrid) -> Floats:
    """Parameters s (N,) of the first intersections of the paths `middle + s half`, -1 <= s <= 1, both (3, N),
    frame e, m.
    """
    low, high = grid.height_range_m()
    horizontal2 = 4.0 * np.einsum("in,in->n", half, half) - (high - low) ** 2
    longest = float(np.nanmax(horizontal2, initial=0.0)) ** 0.5
    degree = 2 + int(np.searchsorted(_LONGEST_PATH_M, longest))
    tracks = np.empty((degree + 1, 3, middle.shape[1]))
    for s, track in zip(_nodes(degree), tracks):
        track[:] = geodetic_from_ecef((middle + s * half).T)
    return terrain_rays.first_crossings(grid.heights_m, grid.bounds, grid.pixels_along_tracks(tracks))


def _nodes(degree: int) -> Floats:
    """Evenly spaced parameters of a path (degree + 1,), from -1 to 1."""
    return np.asarray(np.linspace(-1.0, 1.0, degree + 1), dtype=np.float64)


def _on_tiles(origin_e: Floats, direction_e: Floats, tiles: TerrainTiles) -> Floats:
    """The nearest intersection with a grid where its heights are those of the tiles.

    Rays that pass from grid to grid just above the ground have none: they are sampled in even steps.
    """
    p_e, nearest = np.full((len(origin_e), 3), np.nan), np.full(len(origin_e), np.inf)
    for grid in tiles.grids:
        found = intersect(origin_e, direction_e, grid)
        lat, lon, height = geodetic_from_ecef(found)
        away = np.linalg.norm(found - origin_e, axis=1)
        on_it = (np.abs(height - tiles.height_m(lat, lon)) < _ON_GROUND_M) & (away < nearest)
        p_e[on_it], nearest[on_it] = found[on_it], away[on_it]
    between = np.flatnonzero(np.isinf(nearest))
    p_e[between] = _on_relief(origin_e[between], direction_e[between], tiles, *tiles.height_range_m())
    return p_e


def _above_ellipsoid(
    heights: NDArray[np.float32], transform: tuple[float, ...], crs: str, geoid: Geoid
) -> NDArray[np.float32]:
    """Heights above the ellipsoid (rows, columns) of heights above mean sea level, in blocks of rows."""
    a, b, c, d, e, f = transform
    rows, columns = heights.shape
    to_map = _to_map(crs)
    found = np.empty_like(heights)
    at_once = max(1, 2**20 // columns)
    for first in range(0, rows, at_once):
        row, column = np.arange(first, min(first + at_once, rows)) + 0.5, np.arange(columns) + 0.5
        if to_map is None and not b and not d:
            undulation = geoid.undulation_on_grid_m(np.radians(e * row + f), np.radians(a * column + c))
        else:
            column, row = np.meshgrid(column, row)
            lon, lat = a * column + b * row + c, d * column + e * row + f
            if to_map is not None:
                lon, lat = to_map.transform(lon, lat, direction="INVERSE")
            undulation = geoid.undulation_m(np.radians(lat), np.radians(lon))
        part = slice(first, first + at_once)
        np.add(heights[part], undulation, out=found[part], casting="same_kind")
    return found


def _pixels_from_map(transform: tuple[float, ...], x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
    a, b, c, d, e, f = transform
    dx, dy = np.asarray(x) - c, np.asarray(y) - f
    determinant = a * e - b * d
    return (e * dx - b * dy) / determinant - 0.5, (a * dy - d * dx) / determinant - 0.5


def _local_map(transform: tuple[float, ...], shape: tuple[int, ...], crs: str) -> LocalMap | None:
    """Polynomial in place of a map projection over a raster; None in degrees, or if none is accurate."""
    to_map = _to_map(crs)
    if to_map is None:
        return None
    a, b, c, d, e, f = transform
    along = np.linspace(0.0, 1.0, 9)
    edge = np.concatenate(
        [[along, 0 * along], [along, 0 * along + 1], [0 * along, along], [0 * along + 1, along]], axis=1
    )
    column, row = edge[0] * shape[1], edge[1] * shape[0]
    lon, lat = to_map.transform(a * column + b * row + c, d * column + e * row + f, direction="INVERSE")
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()) or np.ptp(lon) > 90.0:
        return None
    (low_v, high_v), (low_u, high_u) = ((g.min(), g.max()) for g in (np.radians(lon), np.radians(lat)))
    edge_u, edge_v = 0.02 * (high_u - low_u), 0.02 * (high_v - low_v)

    def true(u: Floats, v: Floats) -> tuple[Floats, Floats]:
        return _pixels_from_map(transform, *to_map.transform(np.degrees(v), np.degrees(u)))

    return fit_local_map(
        true, (low_u - edge_u, high_u + edge_u), (low_v - edge_v, high_v + edge_v), _LOCAL_MAP_PX
    )


def fit_local_map(
    true: Map, u: tuple[float, float], v: tuple[float, float], tolerance: float
) -> LocalMap | None:
    """Polynomial of least degree that agrees with `true` to `tolerance` (its units) in the region u x v, rad.

    None where no degree up to 9 does, or `true` is not finite there.
    """
    middle = 0.5 * (u[0] + u[1]), 0.5 * (v[0] + v[1])
    half = 0.5 * (u[1] - u[0]), 0.5 * (v[1] - v[0])
    if not (half[0] > 0.0 and half[1] > 0.0):
        return None
    for degree in _DEGREES:
        nodes = np.cos(np.pi * (np.arange(degree + 4) + 0.5) / (degree + 4))
        x, y = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
        values = np.stack(true(middle[0] + half[0] * x, middle[1] + half[1] * y), axis=1)
        if not np.isfinite(values).all():
            return None
        powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        A = np.stack([x**i * y**j for i, j in powers], axis=1)
        solution, *_ = np.linalg.lstsq(A, values, rcond=None)
        coefficients = np.zeros((2, degree + 1, degree + 1))
        for (i, j), pair in zip(powers, solution):
            coefficients[:, i, j] = pair
        fitted = LocalMap(middle, half, coefficients)
        edge = np.linspace(-1.0, 1.0, 4 * degree + 1)  # with the ends, where the error is largest
        u_check, v_check = (m + h * g.ravel() for m, h, g in zip(middle, half, np.meshgrid(edge, edge)))
        apart = np.abs(np.stack(fitted.at(u_check, v_check)) - np.stack(true(u_check, v_check)))
        if apart.max() <= tolerance:
            return fitted
    return None


def _horner(coefficients: Floats, x: Floats, y: Floats) -> Floats:
    """Horner's scheme in x over Horner's scheme in y, without powers above the total degree."""
    degree = len(coefficients) - 1
    result = np.full(x.shape, coefficients[degree, 0])
    for i in range(degree - 1, -1, -1):
        inner = np.full(x.shape, coefficients[i, degree - i])
        for j in range(degree - i - 1, -1, -1):
            inner *= y
            inner += coefficients[i, j]
        result *= x
        result += inner
    return result


@lru_cache(maxsize=16)
def _to_map(crs: str) -> Transformer | None:
    """Transformer from longitude and latitude (WGS84, degrees) to a CRS; None if the CRS is EPSG:4326."""
    target = CRS.from_user_input(crs)
    if target.is_geographic and target.to_epsg(min_confidence=20) == 4326:
        return None
    return Transformer.from_crs(CRS.from_epsg(4326), target, always_xy=True)


def _offset(one: Raster, other: Raster) -> Floats:
    """Row and column (2,) of the corner of `other` in pixels of `one`."""
    a, b, c, d, e, f = one.transform
    x, y = other.transform[2] - c, other.transform[5] - f
    return np.array([a * y - d * x, e * x - b * y]) / (a * e - b * d)


def _fits(one: Raster, other: Raster, most_pixels: int) -> bool:
    """Whether both are tiles of one raster that touch or overlap."""
    sides = np.array([one.transform, other.transform])[:, [0, 1, 3, 4]]
    longest = max(*one.heights_m.shape, *other.heights_m.shape)
    unequal_px = longest * np.abs(sides[1] - sides[0]).max() / np.abs(sides[0]).max()
    corner = _offset(one, other)
    off_px = np.abs(corner - np.round(corner)).max()
    if one.crs != other.crs or max(unequal_px, off_px) > _ON_LATTICE_PX:
        return False
    apart = np.any(np.round(corner) > one.heights_m.shape) or np.any(
        -np.round(corner) > other.heights_m.shape
    )
    return not apart and int(np.prod(_extent(one, other)[1])) <= most_pixels


def _extent(one: Raster, other: Raster) -> tuple[Ints, Ints]:
    """First row and column (2,) of both together, in pixels of `one`, and their number (2,)."""
    corner = np.round(_offset(one, other)).astype(np.int64)
    first = np.minimum(corner, 0)
    return first, np.maximum(corner + other.heights_m.shape, one.heights_m.shape) - first


def _together(one: Raster, other: Raster) -> Raster:
    first, shape = _extent(one, other)
    heights = np.full(tuple(shape.tolist()), np.nan, dtype=np.float32)
    corner = np.round(_offset(one, other)).astype(np.int64)
    for raster, (row, column) in ((other, corner - first), (one, -first)):
        rows, columns = raster.heights_m.shape
        part = heights[row : row + rows, column : column + columns]
        np.copyto(part, raster.heights_m, where=np.isfinite(raster.heights_m))
    a, b, c, d, e, f = one.transform
    row, column = first.tolist()
    return Raster(heights, (a, b, c + a * column + b * row, d, e, f + d * column + e * row), one.crs)
