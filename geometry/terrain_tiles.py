"""Tiles of one raster of heights (equal pixels on one lattice, side by side or overlapping) joined to one.

Heights are then interpolated across their edges. Rasters that do not fit stay apart (`terrain.TerrainTiles`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.record import Floats, Ints, array, record, scalar

__all__ = ["Raster", "joined"]

_ON_LATTICE_PX = 0.01  # by which tiles of one raster may be off, as coordinates are rounded


@record
class Raster:
    """Heights as a file has them."""

    heights_m: NDArray[np.float32] = array("R, C", "at pixel centres, NaN = no data")
    transform: tuple[float, float, float, float, float, float] = array("6", "as that of `TerrainGrid`")
    crs: str = scalar("of x and y, as PROJ understands it")


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
