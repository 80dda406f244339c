"""Rays over a grid of heights, in the grid's own pixels: where each first comes down to the ground.

A ray is given by three points (column, row, height): its beginning above all ground, its middle and its end
below it; between them it is a parabola in the share u of its way, 0 to 1. It is first shortened by the
highest and lowest ground of the tiles around it, coarse to fine; then looked at once a pixel until it is
below ground; then the crossing is narrowed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

__all__ = ["HeightBounds", "bilinear", "bounds_of_heights", "crossing_by_steps", "first_crossings"]

Array = NDArray[np.float64]
Clearance = Callable[[Array, NDArray[np.int64]], Array]

_TILE = 8  # pixels a side of the finest tiles
_GROWTH = 4
_MARGIN_M = 1e-4  # beyond the bounds of tiles
_CLEARANCE_M = 1e-7
_NARROWINGS = 60


@dataclass(frozen=True, slots=True, eq=False)
class HeightBounds:
    """Lowest and highest ground in and around square tiles, on several levels of tile size."""

    lowest_m: float
    highest_m: float
    sizes: tuple[int, ...]  # pixels a side, from fine to coarse
    low_m: tuple[Array, ...]  # (tile rows + 4, tile columns + 4): tile and its 8 neighbours; +inf where there
    high_m: tuple[Array, ...]  # is no data, -inf here. Two rings of tiles beyond the edge.


def bounds_of_heights(heights: NDArray[np.float32]) -> HeightBounds:
    """Bounds of a grid of heights, NaN = no data."""
    low: Array = np.where(np.isnan(heights), np.inf, heights)
    high: Array = np.where(np.isnan(heights), -np.inf, heights)
    lowest, highest = float(low.min()), float(high.max())
    sizes, lows, highs, size = [], [], [], _TILE
    factor = _TILE
    while True:
        low = _tiles(low, factor, np.inf).min(axis=(1, 3))
        high = _tiles(high, factor, -np.inf).max(axis=(1, 3))
        sizes.append(size)
        lows.append(minimum_filter(np.pad(low, 2, constant_values=np.inf), 3, mode="nearest"))
        highs.append(maximum_filter(np.pad(high, 2, constant_values=-np.inf), 3, mode="nearest"))
        if max(low.shape) == 1:
            return HeightBounds(lowest, highest, tuple(sizes), tuple(lows), tuple(highs))
        size, factor = size * _GROWTH, _GROWTH


def bilinear(heights: NDArray[np.float32], column: Array, row: Array) -> Array:
    """Heights at fractional pixels, (0, 0) at the centre of the first; NaN past the edge or beside no
    data."""
    rows, columns = heights.shape
    inside = (column >= 0.0) & (column <= columns - 1.0) & (row >= 0.0) & (row <= rows - 1.0)
    x, y = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
    c = np.minimum(x.astype(np.int64), columns - 2)
    r = np.minimum(y.astype(np.int64), rows - 2)
    fx, fy = x - c, y - r
    flat, at = heights.ravel(), r * columns + c
    upper_left, lower_left = flat.take(at).astype(np.float64), flat.take(at + columns).astype(np.float64)
    upper = upper_left + fx * (flat.take(at + 1) - upper_left)
    lower = lower_left + fx * (flat.take(at + columns + 1) - lower_left)
    return np.where(inside, upper + fy * (lower - upper), np.nan)


def first_crossings(heights: NDArray[np.float32], bounds: HeightBounds, tracks: Array) -> Array:
    """Share of the way, (N,), at which rays first meet the ground; NaN where they do not, or where it is not
    known.

    Parameters
    ----------
    heights : (rows, columns) array
    bounds : HeightBounds
        Of these heights.
    tracks : (3, 3, N) array
        At the beginning, middle and end of the way: column, row and height.
    """
    curve = _Parabolas.through(tracks)
    start, stop = _shortened(curve, bounds)

    def clearance(share: Array, rays: NDArray[np.int64]) -> Array:
        column, row, height = curve.at(share, rays)
        return height - bilinear(heights, column, row)

    length = (stop - start) * curve.pixels()
    steps = np.where(stop >= start, np.maximum(np.ceil(length), 1.0), 0.0)
    return _first(clearance, start, stop, np.nan_to_num(steps))


def crossing_by_steps(clearance: Clearance, n: int, steps: int) -> Array:
    """The same for any surface: `clearance(share (M,), rays (M,))` is looked at in so many even steps."""
    return _first(clearance, np.zeros(n), np.ones(n), np.full(n, float(steps)))


@dataclass(frozen=True, slots=True, eq=False)
class _Parabolas:
    """Column, row and height as a + b u + c u^2: each (3, N)."""

    a: Array
    b: Array
    c: Array

    @staticmethod
    def through(tracks: Array) -> _Parabolas:
        begin, middle, end = tracks
        return _Parabolas(begin, 4.0 * middle - 3.0 * begin - end, 2.0 * (begin + end) - 4.0 * middle)

    def at(self, share: Array, rays: NDArray[np.int64] | slice) -> Array:
        return np.asarray(self.a[:, rays] + share * (self.b[:, rays] + share * self.c[:, rays]))

    def pixels(self) -> Array:
        """Pixels that the whole way goes over, along the row or the column, whichever is more."""
        return np.max(np.abs(self.b[:2]) + np.abs(self.c[:2]), axis=0)

    def share_at_height(self, height: Array) -> Array:
        above = self.a[2] - height
        slope = -self.b[2]
        root = np.sqrt(np.maximum(slope * slope - 4.0 * self.c[2] * above, 0.0))
        return 2.0 * above / (slope + root)


def _shortened(curve: _Parabolas, bounds: HeightBounds) -> tuple[Array, Array]:
    """Shares between which each ray can meet ground, by the tiles that it is over; start > stop if it
    cannot."""
    n = curve.a.shape[1]
    start: Array = np.zeros(n)
    stop: Array = np.ones(n)
    pixels = curve.pixels()
    everything = slice(None)
    for size, low, high in zip(bounds.sizes[::-1], bounds.low_m[::-1], bounds.high_m[::-1]):
        near = 0.5 * (stop - start) * pixels <= size - 1.0
        if not near.any():
            continue
        column, row, _ = curve.at(0.5 * (start + stop), everything)
        r = _tile_index(row, size, low.shape[0])
        c = _tile_index(column, size, low.shape[1])
        at = r * low.shape[1] + c
        lowest, highest = low.ravel().take(at), high.ravel().take(at)
        empty = near & (highest < lowest)  # no data anywhere near
        near &= ~empty
        begin = curve.share_at_height(np.where(near, highest + _MARGIN_M, 0.0))
        end = curve.share_at_height(np.where(near, lowest - _MARGIN_M, 0.0))
        start = np.where(near, np.maximum(start, begin), start)
        stop = np.where(near, np.minimum(stop, end), stop)
        start[empty], stop[empty] = 1.0, 0.0
    return start, stop


def _tile_index(pixel: Array, size: int, count: int) -> NDArray[np.int64]:
    inside = np.clip(np.nan_to_num(pixel, nan=-1e9), -1e9, 1e9)
    return np.clip(np.floor(inside * (1.0 / size)).astype(np.int64) + 2, 0, count - 1)


def _tiles(values: Array, size: int, fill: float) -> Array:
    """(rows, columns) as (tile rows, size, tile columns, size), filled up at the end."""
    rows, columns = (-(-length // size) * size for length in values.shape)
    padded = np.pad(
        values, ((0, rows - values.shape[0]), (0, columns - values.shape[1])), constant_values=fill
    )
    return padded.reshape(rows // size, size, columns // size, size)


def _first(clearance: Clearance, start: Array, stop: Array, steps: Array) -> Array:
    """First change from above ground to below it between `start` and `stop`, looked at in so many steps."""
    result = np.full(len(start), np.nan)
    rays: NDArray[np.int64] = np.flatnonzero(steps > 0.0)
    step = (stop[rays] - start[rays]) / steps[rays]
    left = start[rays]
    above = clearance(left, rays)
    k = 0
    while len(rays):
        k += 1
        right = left + step
        below = clearance(right, rays)
        crossed = below <= 0.0
        if crossed.any():
            result[rays[crossed]] = _narrowed(
                clearance, rays[crossed], left[crossed], right[crossed], above[crossed], below[crossed]
            )
        going_on = ~crossed & (k < steps[rays])
        rays, step, left, above = rays[going_on], step[going_on], right[going_on], below[going_on]
    return result


def _narrowed(
    clearance: Clearance, rays: NDArray[np.int64], left: Array, right: Array, above: Array, below: Array
) -> Array:
    """Root between `left` (above ground) and `right` (below) by regula falsi with halved weights (Illinois).

    NaN where the ground is not known at `left`, or at any point that is looked at.
    """
    root = right.copy()
    active: NDArray[np.int64] = np.arange(len(rays))
    root[~(above >= 0.0)] = np.nan
    active = active[(above >= 0.0) & (below < -_CLEARANCE_M)]
    a, b, fa, fb = left[active], right[active], above[active], below[active]
    for iteration in range(_NARROWINGS):
        if len(active) == 0:
            break
        c = b - fb * (b - a) / (fb - fa) if iteration % 8 != 7 else 0.5 * (a + b)
        fc = clearance(c, rays[active])
        root[active] = np.where(np.isfinite(fc), c, np.nan)
        other_side = fc * fb < 0.0
        a, fa = np.where(other_side, b, a), np.where(other_side, fb, 0.5 * fa)
        b, fb = c, fc
        more = np.abs(fc) > _CLEARANCE_M
        active, a, b, fa, fb = active[more], a[more], b[more], fa[more], fb[more]
    return root
