"""First intersection of rays with a grid of heights, in the grid's pixel coordinates.

A ray is a polynomial (column, row, height) in the parameter s from -1 (above all ground) to 1 (below all
ground). Three steps: the interval of s is reduced by the highest and lowest ground of the tiles around the
ray, coarse to fine (`_possible_interval`); a ray steeper than the ground there has one crossing, found by
Newton's method (`_only_crossings`); any other is sampled once per pixel until it is below ground (`_first`),
and the crossing is refined by regula falsi (`_refined`).

Source of the refinement: Anderson, N., and Björck, Å. (1973), A new high order method of regula falsi type,
BIT 13, 253.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from boresight.records.record import Bools, Floats, Ints, record, scalar

__all__ = [
    "Clearance",
    "HeightBounds",
    "bilinear",
    "bounds_of_heights",
    "crossings_by_steps",
    "first_crossings",
]


_TILE = 8  # pixels a side of the finest tiles
_GROWTH = 4  # tile size from level to level
_BAND = 64 * _TILE  # rows per block in `bounds_of_heights`
_MARGIN_M = 1e-4  # added to the bounds of tiles
_CONVERGED_M = 1e-7  # step along a ray, m, at which its point on the ground has converged
_FEWER = 0.9  # of the rays: to take the others out costs less than to refine them once more
_NEWTON_STEPS = 8  # most steps of Newton's method before the rays left are enclosed instead (set by hand)
_FEW_LEFT = 0.5  # of the rays of Newton's method, likewise
_UNKNOWN_RISE_M = 1e9  # at pixels without data and outside the grid
_SAFETY = 0.8  # on a long path height decreases a few per cent more slowly at the end


class Clearance(Protocol):
    """Height of rays above ground, as a function of their parameter."""

    def above_ground(self, share: Floats) -> Floats:
        """Height of each ray above ground, m, at parameters (N,), 0 to 1; NaN without data."""
        ...

    def of(self, rays: Ints) -> Clearance:
        """The function restricted to the rays with indices (M,)."""
        ...


@record(kw_only=True)
class HeightBounds:
    """Lowest and highest ground of square tiles with their neighbours, on several levels of tile size."""

    lowest_m: float = scalar("lowest ground of the grid")
    highest_m: float = scalar("highest ground of the grid")
    sizes: tuple[int, ...] = scalar("tile sizes in pixels, fine to coarse, one per level")
    low_m: tuple[Floats, ...] = scalar(
        "per level, (tile rows + 4, tile columns + 4): lowest ground of a tile and its 8 neighbours, +inf"
        " without data; two rings of tiles surround the grid"
    )
    high_m: tuple[Floats, ...] = scalar("per level: highest ground likewise, -inf without data")
    rise_m: tuple[Floats, ...] = scalar("per level: greatest rise of the ground over one pixel likewise")


def bounds_of_heights(heights: NDArray[np.float32]) -> HeightBounds:
    """Bounds of a grid of heights (rows, columns), m, NaN = no data."""
    bands = [_finest_bounds(heights, first) for first in range(0, len(heights), _BAND)]
    low, high, rise = (np.concatenate(parts) for parts in zip(*bands))
    lowest, highest = float(low.min()), float(high.max())
    levels, size = [], _TILE
    while True:
        levels.append(
            (
                size,
                minimum_filter(np.pad(low, 2, constant_values=np.inf), 3, mode="nearest"),
                maximum_filter(np.pad(high, 2, constant_values=-np.inf), 3, mode="nearest"),
                maximum_filter(np.pad(rise, 2, constant_values=_UNKNOWN_RISE_M), 3, mode="nearest"),
            )
        )
        if max(low.shape) == 1:
            sizes, lows, highs, rises = zip(*levels)
            return HeightBounds(
                lowest_m=lowest, highest_m=highest, sizes=sizes, low_m=lows, high_m=highs, rise_m=rises
            )
        low = _tiles(low, _GROWTH, np.inf).min(axis=(1, 3))
        high = _tiles(high, _GROWTH, -np.inf).max(axis=(1, 3))
        rise = _tiles(rise, _GROWTH, _UNKNOWN_RISE_M).max(axis=(1, 3))
        size *= _GROWTH


def _finest_bounds(heights: NDArray[np.float32], first: int) -> tuple[Floats, Floats, Floats]:
    """Lowest and highest ground and greatest rise per pixel in the finest tiles of a block of rows."""
    band = heights[first : first + _BAND]
    unknown = np.isnan(band)
    lowest: NDArray[Any] = np.where(unknown, np.inf, band) if unknown.any() else band
    highest: NDArray[Any] = np.where(unknown, -np.inf, band) if unknown.any() else band
    # first over rows, which lie together in memory: both axes at once take four times as long
    low = _tiles(lowest, _TILE, np.inf).min(axis=1).min(axis=2)
    high = _tiles(highest, _TILE, -np.inf).max(axis=1).max(axis=2)
    # |d height / d column| + |d height / d row| in each cell; none begins at the last row or column
    cells = heights[first : first + _BAND + 1]
    along_row, along_column = np.diff(cells, axis=1), np.diff(cells, axis=0)
    for change in (along_row, along_column):
        np.abs(change, out=change)
    rise = np.maximum(along_row[1:], along_row[:-1])
    rise += np.maximum(along_column[:, 1:], along_column[:, :-1])
    rise[np.isnan(rise)] = _UNKNOWN_RISE_M
    missing = ((0, len(band) - len(rise)), (0, 1))
    rise = np.pad(rise, missing, constant_values=_UNKNOWN_RISE_M)
    return low, high, _tiles(rise, _TILE, _UNKNOWN_RISE_M).max(axis=1).max(axis=2)


def bilinear(heights: NDArray[np.float32], column: Floats, row: Floats) -> Floats:
    """Heights (N,), m, at fractional pixels, (0, 0) at the first centre; NaN outside or next to no data."""
    return _bilinear_and_slopes(heights, column, row)[0]


def _bilinear_and_slopes(
    heights: NDArray[np.float32], column: Floats, row: Floats
) -> tuple[Floats, Floats, Floats]:
    """Heights (N,) as `bilinear`, and their derivatives by column and row (N,), m/px."""
    rows, columns = heights.shape
    everywhere = len(row) > 0 and bool(
        column.min() >= 0.0 and column.max() <= columns - 1.0 and row.min() >= 0.0 and row.max() <= rows - 1.0
    )
    if not everywhere:
        inside = (column >= 0.0) & (column <= columns - 1.0) & (row >= 0.0) & (row <= rows - 1.0)
        column, row = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
    c, r = np.floor(column), np.floor(row)
    np.minimum(c, columns - 2.0, out=c)
    np.minimum(r, rows - 2.0, out=r)
    along_row, along_column = column - c, row - r
    r *= columns
    r += c
    upper_left = r.astype(np.int64)
    height, by_column = _between(heights.ravel(), upper_left, along_row)
    by_row, lower_by_column = _between(heights.ravel()[columns:], upper_left, along_row)
    by_row -= height
    height += by_row * along_column
    lower_by_column -= by_column
    lower_by_column *= along_column
    by_column += lower_by_column
    return height if everywhere else np.where(inside, height, np.nan), by_column, by_row


def _between(values: NDArray[np.float32], at: Ints, share: Floats) -> tuple[Floats, Floats]:
    """Values (N,) at indices `at` (N,) plus `share` (N,), and their differences to the next index (N,)."""
    first, difference = (part.take(at, mode="clip").astype(np.float64) for part in (values, values[1:]))
    difference -= first
    first += difference * share
    return first, difference


def first_crossings(heights: NDArray[np.float32], bounds: HeightBounds, coefficients: Floats) -> Floats:
    """Parameters (N,) of the first intersections of rays with the ground; NaN without one or without data.

    `heights` (rows, columns) have these `bounds`; `coefficients` (K, 3, N) are those of the powers 0 to K - 1
    of the parameter, -1 to 1, in column, row and height.
    """
    curve = _Polynomials(heights, coefficients)
    pixels, fall = curve.pixels(), -np.sum(coefficients[1::2, 2], axis=0)
    start, stop, highest, lowest, rise = _possible_interval(curve, pixels, fall, bounds)
    # A ray steeper than any slope of the ground here has one intersection: no sampling is needed.
    once = rise * pixels < fall * _SAFETY
    share = _only_crossings(curve, start, stop, once & (start <= stop))
    others = np.flatnonzero(np.isnan(share) & (start <= stop))
    if len(others):
        curve, fall = curve.of(others), fall[others]
        start = np.maximum(curve.share_at_height(highest[others], fall), -1.0)
        stop = np.minimum(curve.share_at_height(lowest[others], fall), 1.0)
        steps = np.where(once[others], 1.0, np.maximum(np.ceil((stop - start) * pixels[others]), 1.0))
        share[others] = _first(curve, start, stop, np.nan_to_num(np.where(start <= stop, steps, 0.0)))
    return share


def crossings_by_steps(clearance: Clearance, n: int, steps: int) -> Floats:
    """Parameters (n,) of the first intersections of n rays with any surface, sampled in even steps."""
    return _first(clearance, np.zeros(n), np.ones(n), np.full(n, float(steps)))


@record
class _Polynomials:
    """Rays in pixels: column, row and height as polynomials in the parameter."""

    heights: NDArray[np.float32]
    coefficients: Floats  # (K, 3, N), constant first

    def above_ground(self, share: Floats) -> Floats:
        column, row, height = self.at(share)
        return height - bilinear(self.heights, column, row)

    def of(self, rays: Ints) -> _Polynomials:
        return _Polynomials(self.heights, self.coefficients.take(rays, axis=2))

    def at(self, share: Floats, part: slice = slice(3)) -> Floats:
        """Column, row and height (3, N), or a part of them, at parameters (N,)."""
        coefficients = self.coefficients[:, part]
        value = coefficients[-1] * share
        for coefficient in coefficients[-2:0:-1]:
            value += coefficient
            value *= share
        value += coefficients[0]
        return value

    def newton_step(self, share: Floats) -> tuple[Floats, Floats]:
        """Steps (N,) of the parameter towards the ground from parameters (N,), and heights above it there
        (N,), m; the slope of a ray is that in its middle.
        """
        column, row, height = self.at(share)
        ground, by_column, by_row = _bilinear_and_slopes(self.heights, column, row)
        across, down, fall = self.coefficients[1]
        height -= ground
        with np.errstate(divide="ignore", invalid="ignore"):
            return height / (by_column * across + by_row * down - fall), height

    def share_at_height(self, height: Floats, fall: Floats) -> Floats:
        """Parameters (N,) at heights (N,), by one Newton step from the chord, which falls by `fall` (N,), m,
        per unit of the parameter.
        """
        share = (np.sum(self.coefficients[::2, 2], axis=0) - height) / fall
        slope = self.coefficients[1, 2] + 2.0 * share * self.coefficients[2, 2]
        return share - (self.at(share, slice(2, 3))[0] - height) / slope

    def pixels(self) -> Floats:
        """Upper bound (N,) of the pixels crossed per unit of the parameter, along rows or columns, whichever
        is more.
        """
        return np.max(np.sum(np.abs(self.coefficients[1:, :2]), axis=0), axis=0)


def _only_crossings(curve: _Polynomials, start: Floats, stop: Floats, once: Bools) -> Floats:
    """Parameters (N,) of the crossings of rays with one crossing between `start` and `stop` (`once`), by
    Newton's method; NaN for others, and where it does not converge between them to 1e-7 m.
    """
    share = np.full(len(start), np.nan)
    active: Ints = np.flatnonzero(once)
    here = curve if len(active) == len(start) else curve.of(active)
    s = 0.5 * (start[active] + stop[active])
    for iteration in range(_NEWTON_STEPS):
        step, above = here.newton_step(s)
        s += step
        found = np.abs(above) <= _CONVERGED_M
        more: Ints = np.flatnonzero(~found & np.isfinite(s))
        last = len(more) == 0 or iteration == _NEWTON_STEPS - 1
        if last or len(more) < _FEW_LEFT * len(active):
            share[active] = _where(found, s, np.nan)
            active, s, here = active[more], s[more], here.of(more)
        if last:
            break
    return _where((share >= start) & (share <= stop), share, np.nan)


def _possible_interval(
    curve: _Polynomials, pixels: Floats, fall: Floats, bounds: HeightBounds
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Where each ray can intersect the ground: five arrays (N,).

    Parameters between which it can, start > stop if it cannot; the highest and the lowest ground and its
    greatest rise over a pixel there, m. Per unit of the parameter the ray crosses `pixels` and falls by
    `fall`, m.
    """
    start: Floats = np.full(len(pixels), -1.0)
    stop: Floats = np.ones(len(pixels))
    rise: Floats = np.full(len(pixels), _UNKNOWN_RISE_M)
    # The height is that of the chord, `middle - fall s`, to `bow`.
    middle = np.sum(curve.coefficients[::2, 2], axis=0)
    bow = np.sum(np.abs(curve.coefficients[2:, 2]), axis=0) + _MARGIN_M
    per_m = 1.0 / fall
    first, last = (middle - bow) * per_m, (middle + bow) * per_m
    highest, lowest = middle + fall, middle - fall
    widest = float(np.nanmax(pixels, initial=0.0))
    fitting = [k for k, size in enumerate(bounds.sizes) if size - 1.0 >= widest]
    for k in range(fitting[0] if fitting else len(bounds.sizes) - 1, -1, -1):
        size, low, high = bounds.sizes[k], bounds.low_m[k], bounds.high_m[k]
        near = (0.5 * (stop - start) * pixels <= size - 1.0) & (start <= stop)
        column, row = curve.at(0.5 * (start + stop), slice(2))
        at = _tile_index(row, size, low.shape[0]) * low.shape[1] + _tile_index(column, size, low.shape[1])
        rise = _where(near, bounds.rise_m[k].ravel().take(at), rise)
        # Heights are float32: above 2048 m the margin would be lost in their sum.
        top, bottom = (tile.ravel().take(at).astype(np.float64) for tile in (high, low))
        highest = _where(near, np.minimum(highest, top + _MARGIN_M), highest)
        lowest = _where(near, np.maximum(lowest, bottom - _MARGIN_M), lowest)
        start, stop = (np.clip(s, -1.0, 1.0) for s in (first - highest * per_m, last - lowest * per_m))
    return start, stop, highest, lowest, rise


def _where(chosen: Bools, value: Floats, other: Floats | float) -> Floats:
    """As `np.where`, without a copy where all are chosen, which is usual."""
    return value if chosen.all() else np.where(chosen, value, other)


def _tile_index(pixel: Floats, size: int, count: int) -> Ints:
    inside = np.fmin(np.fmax(pixel * (1.0 / size), -2.0), count - 3.0)  # -2 for NaN
    return np.floor(inside).astype(np.int64) + 2


def _tiles(values: Floats, size: int, fill: float) -> Floats:
    """(rows, columns) reshaped to (tile rows, size, tile columns, size), padded with `fill`."""
    rows, columns = (-(-length // size) * size for length in values.shape)
    padded = np.pad(
        values, ((0, rows - values.shape[0]), (0, columns - values.shape[1])), constant_values=fill
    )
    return padded.reshape(rows // size, size, columns // size, size)


def _first(clearance: Clearance, start: Floats, stop: Floats, steps: Floats) -> Floats:
    """First parameter (N,) where a ray changes from above to below ground, sampled in `steps` (N,) steps."""
    share = np.full(len(start), np.nan)
    rays: Ints = np.flatnonzero(steps > 0.0)
    active = clearance if len(rays) == len(start) else clearance.of(rays)
    step = (stop[rays] - start[rays]) / steps[rays]
    left = start[rays]
    above = active.above_ground(left)
    k = 0
    while len(rays):
        k += 1
        right = left + step
        below = active.above_ground(right)
        crossed = below <= 0.0
        done: Ints = np.flatnonzero(crossed)
        if len(done):
            here = active if len(done) == len(rays) else active.of(done)
            share[rays[done]] = _refined(here, left[done], right[done], above[done], below[done])
        kept: Ints = np.flatnonzero(~crossed & (k < steps[rays]))
        left, above = right, below
        if len(kept) < len(rays):
            active = active.of(kept)
            rays, step, left, above = rays[kept], step[kept], left[kept], above[kept]
    return share


def _refined(clearance: Clearance, left: Floats, right: Floats, above: Floats, below: Floats) -> Floats:
    """Root (N,) between `left` (above ground) and `right` (below) by regula falsi (Anderson and Björck's).

    NaN where a sampled point has no data.
    """
    known = above >= 0.0
    root = np.where(known, right, np.nan)
    active: Ints = np.flatnonzero(known & (below < -_CONVERGED_M))
    a, b, fa, fb = left[active], right[active], above[active], below[active]
    here = clearance.of(active) if len(active) < len(left) else clearance
    for iteration in range(60):  # which halve the interval at worst
        if len(active) == 0:
            break
        c = b - fb * (b - a) / (fb - fa) if iteration % 8 != 7 else 0.5 * (a + b)
        fc = here.above_ground(c)
        root[active] = _where(np.isfinite(fc), c, np.nan)
        other_side, less = fc * fb < 0.0, 1.0 - fc / fb
        a, fa = np.where(other_side, b, a), np.where(other_side, fb, np.where(less > 0.0, less, 0.5) * fa)
        b, fb = c, fc
        going_on = np.abs(fc) > _CONVERGED_M
        more: Ints = np.flatnonzero(going_on)
        if len(more) < _FEWER * len(active):
            active, a, b, fa, fb, here = active[more], a[more], b[more], fa[more], fb[more], here.of(more)
        elif len(more) < len(active):  # the others stay where they are: the next point is b again
            a, fa, fb = np.where(going_on, a, b), np.where(going_on, fa, 1.0), np.where(going_on, fb, -1.0)
    return root
