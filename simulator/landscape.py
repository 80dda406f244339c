"""An invented landscape: parcels of land with fields, woods, water, settlements and roads, as polygons to
be painted.

The land is a lattice of quadrilaterals with displaced corners. What a parcel bears follows from its two
indices and the key alone. Parcels are drawn in cells of `_CELL` by `_CELL`, all at once. Map coordinates are
metres (east, north); tones are reflectance times 255, and strengths the amplitude of the texture on top in
`STRENGTH_UNIT` of a tone.
"""

from __future__ import annotations

from collections import OrderedDict
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import record
from boresight.simulator.lattice_noise import smooth_noise, white_at
from boresight.simulator.scenario import GroundSettings

__all__ = ["STRENGTH_UNIT", "Landscape", "Shapes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Tones = NDArray[np.uint8]

STRENGTH_UNIT = 1.0 / 8.0  # of a tone: 26 tones, the strongest texture, still fit into 8 bits
# Kinds of a parcel of the painted landscape, as small whole numbers.
_FIELD, _WATER, _SETTLEMENT, _FOREST = range(4)
_CELL = 8  # parcels on a side that are drawn together
_KEEP_CELLS = 256  # of the last used: the neighbouring tiles want them again
# Twelve points (12, 2) of a unit circle: outline of pools and trees.
_CIRCLE = np.column_stack([np.cos(np.arange(12) * np.pi / 6), np.sin(np.arange(12) * np.pi / 6)])
_REACH_M = 12.0  # a house of 20 m by 11 m about a corner of its parcel ends 11.5 m from there
_JITTER = 0.6  # of a parcel's side: the range of its corners about the lattice
_NARROWEST_M, _WIDEST_M = 9.0, 30.0  # from one row of a crop to the next
_HOUSE_M = 32.0  # from house to house
_ROOFS = 12  # different tones of roofs


@record
class Shapes:
    """Polygons with as many corners each, painted at once; those of one tone do not overlap."""

    corners: Array  # (n, k, 2) m
    tones: Tones  # (n,)
    strengths: Tones | None  # (n,); None: the texture below is left alone

    def of(self, which: Index) -> Shapes:
        """Some of them."""
        return Shapes(
            self.corners[which], self.tones[which], None if self.strengths is None else self.strengths[which]
        )


@record
class _Cell:
    """What the parcels of a cell bear, in the order of painting."""

    layers: tuple[Shapes, ...]
    low: Array  # (P, 2) corner to the south-west of each polygon, one layer after the other, m
    high: Array  # (P, 2) to the north-east
    ends: Index  # (layers - 1,) first polygon of each further layer

    @staticmethod
    def over(*layers: Shapes) -> _Cell:
        low = np.concatenate([layer.corners.min(axis=1) for layer in layers])
        high = np.concatenate([layer.corners.max(axis=1) for layer in layers])
        return _Cell(layers, low, high, np.cumsum([len(layer.tones) for layer in layers])[:-1])

    def within(self, west: float, south: float, east: float, north: float) -> dict[int, Shapes]:
        """Polygons that may show inside a box, by the number of their layer."""
        (low_x, low_y), (high_x, high_y) = self.low.T, self.high.T
        shows = np.flatnonzero((low_x < east) & (low_y < north) & (high_x > west) & (high_y > south))
        starts = np.append(0, self.ends)
        parts = np.split(shows, np.searchsorted(shows, self.ends))
        return {n: self.layers[n].of(part - starts[n]) for n, part in enumerate(parts) if len(part)}


class Landscape:
    """`date` 0 is the land as the chips show it, 1 as the strips do (settings `other_date`)."""

    def __init__(self, settings: GroundSettings, key: int, date: int) -> None:
        self._settings = settings
        self._key = key
        self._date = date
        self._cells: OrderedDict[tuple[int, int], _Cell] = OrderedDict()
        # Shares of the land become thresholds of noise; a sample of parcels gives its distribution.
        i, j = (index.ravel() for index in np.meshgrid(np.arange(100), np.arange(100)))
        self._levels = {
            kind: np.quantile(self._character(i, j, kind), 1.0 - share) for kind, share in self._shares()
        }

    def shapes(self, west: float, south: float, east: float, north: float) -> list[Shapes]:
        """Polygons that may show inside a box (m), in the order of painting: parcels first, roads last."""
        side, reach = self._settings.parcel_m * _CELL, 0.5 * _JITTER * self._settings.parcel_m + _REACH_M
        columns = range(int(np.floor((west - reach) / side)), int(np.floor((east + reach) / side)) + 1)
        rows = range(int(np.floor((south - reach) / side)), int(np.floor((north + reach) / side)) + 1)
        box = west, south, east, north
        cells = [self._cell(i, j).within(*box) for i, j in product(columns, rows)]
        layers = sorted({n for cell in cells for n in cell})
        return [_joined([cell[n] for cell in cells if n in cell]) for n in layers]

    def _shares(self) -> list[tuple[int, float]]:
        s = self._settings
        return [(_WATER, s.water), (_SETTLEMENT, s.settlement), (_FOREST, s.forest)]

    def _number(self, i: Index, j: Index, n: int) -> Array:
        """One uniform number in [0, 1) for each place."""
        return 0.5 + 0.5 * white_at(i, j, self._key * 64 + n).astype(float)

    def _character(self, i: Index, j: Index, kind: int) -> Array:
        """How much parcels are of a kind: smooth over some parcels, so that each kind gathers."""
        own = 2.0 * self._number(i, j, 20 + kind) - 1.0
        return smooth_noise(i / 4.3, j / 4.3, self._key + 100 + kind) + 0.35 * own

    def _kinds(self, i: Index, j: Index) -> Index:
        kinds = np.full(i.shape, _FIELD)
        for kind, share in reversed(self._shares()):
            if share > 0.0:
                kinds[self._character(i, j, kind) > self._levels[kind]] = kind
        return kinds

    def _vertices(self, i: Index, j: Index) -> Array:
        """Corners of the parcels, (..., 2)."""
        jitter = np.stack([self._number(i, j, 1), self._number(i, j, 2)], axis=-1)
        return (np.stack([i, j], axis=-1) + _JITTER * (jitter - 0.5)) * self._settings.parcel_m

    def _cell(self, column: int, row: int) -> _Cell:
        if (column, row) in self._cells:
            self._cells.move_to_end((column, row))
            return self._cells[column, row]
        i, j = np.meshgrid(
            np.arange(column * _CELL, (column + 1) * _CELL + 1), np.arange(row * _CELL, (row + 1) * _CELL + 1)
        )
        corners = self._vertices(i, j)  # (J, I, 2)
        quads = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2)
        quads = quads.reshape(-1, 4, 2)
        at = i[:-1, :-1].ravel(), j[:-1, :-1].ravel()
        kinds = self._kinds(*at)
        u = self._numbers_of(column, row, at)
        field, forest, town = (kinds == kind for kind in (_FIELD, _FOREST, _SETTLEMENT))
        self._cells[column, row] = _Cell.over(
            _parcels(quads, kinds, u[:, :2]),
            _textured(_shrunk(quads[forest], 0.12), _of_range(u[forest, 2], 20, 34), 150),  # inside of a wood
            self._crops(quads[field], u[field]),
            *_blots(quads[field], u[field, 6:22].reshape(-1, 4, 4), u[field, 5]),
            *self._houses(quads[town], u[town, 22:]),
            *_streets(quads[town]),
            self._occlusions(quads, at, u[:, 3]),
            *self._roads(i, j, corners),
        )
        while len(self._cells) > _KEEP_CELLS:
            self._cells.popitem(last=False)
        return self._cells[column, row]

    def _numbers_of(self, column: int, row: int, at: tuple[Index, Index]) -> Array:
        """Uniform numbers (parcels, N) of a cell's parcels; others where the date has changed a parcel."""
        count = 22 + 6 * self._houses_along**2
        of_dates = [
            np.random.default_rng([self._key, column & 0xFFFFFFFF, row & 0xFFFFFFFF, date]).random(
                (_CELL * _CELL, count)
            )
            for date in range(1 + self._date)
        ]
        if not self._date:
            return of_dates[0]
        changed = self._number(*at, 9) < self._settings.other_date.changed_fields
        return np.where(changed[:, None], of_dates[1], of_dates[0])

    @property
    def _houses_along(self) -> int:
        return max(2, round(self._settings.parcel_m / _HOUSE_M))

    def _crops(self, quads: Array, u: Array) -> Shapes:
        """Rows of a crop, lighter or darker than the field."""
        spacing = _NARROWEST_M + (_WIDEST_M - _NARROWEST_M) * u[:, 2]
        count = (self._settings.parcel_m / spacing).astype(int)  # of strips of land: rows lie between them
        turned = (np.arange(4) - (4.0 * u[:, 3:4]).astype(int)) % 4
        a, b, c, d = np.moveaxis(np.take_along_axis(quads, turned[:, :, None], axis=1), 1, 0)[:, :, None]
        k = np.arange(1, int(self._settings.parcel_m / _NARROWEST_M) + 1)
        along = (k / np.maximum(count, 1)[:, None])[:, :, None]
        tone = _of_range(u[:, 0], 28, 110) * np.array([0.8, 0.9, 1.15])[(3.0 * u[:, 4]).astype(int)]
        which, nth = np.nonzero(k < count[:, None])
        start, end = (a + (b - a) * along)[which, nth], (d + (c - d) * along)[which, nth]
        return _lines(start, end, 0.18 * spacing[which], np.clip(tone, 5, 250)[which], 40)

    def _houses(self, quads: Array, u: Array) -> list[Shapes]:
        """Trees, and houses whose roofs have a light and a dark slope."""
        n = self._houses_along
        x, y, kept, long, deep, dark = u.reshape(len(quads), 6, n * n).swapaxes(0, 1)
        column, row = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(n)))
        s, t = (column + 0.5 + 0.24 * (x - 0.5)) / n, (row + 0.5 + 0.24 * (y - 0.5)) / n
        centre = _inside(quads, s, t)  # (P, n^2, 2)
        tree, house = (kept >= 0.2) & (kept < 0.4), kept >= 0.4
        crowns = centre[tree][:, None] + (3.0 + 3.0 * long[tree])[:, None, None] * _CIRCLE
        along = quads[:, 1] - quads[:, 0]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = np.column_stack([-along[:, 1], along[:, 0]])
        of = np.nonzero(house)[0]
        middle = centre[house]
        half = (4.5 + 5.5 * long[house])[:, None] * along[of]
        depth = (7.0 + 4.0 * deep[house])[:, None] * across[of]
        tone = 30.0 * 7.0 ** (np.floor(_ROOFS * dark[house]) / _ROOFS)
        slopes = []
        for side, shade in ((-0.5, 1.0), (0.5, 0.72)):
            eaves = middle + side * depth
            roofs = np.stack([middle - half, middle + half, eaves + half, eaves - half], axis=1)
            slopes.append(Shapes(roofs, (tone * shade).astype(np.uint8), None))
        return [Shapes(crowns, np.full(len(crowns), 18, np.uint8), None), *slopes]

    def _occlusions(self, quads: Array, at: tuple[Index, Index], u: Array) -> Shapes:
        """Parcels that something new covers, bright or dark, at the strips' date."""
        share = self._settings.other_date.occlusion if self._date else 0.0
        covered = self._number(*at, 10) < share
        return _textured(_shrunk(quads[covered], 0.05), np.where(u[covered] < 0.5, 15, 200), 30)

    def _roads(self, i: Index, j: Index, corners: Array) -> list[Shapes]:
        """Roads run along some of the lattice's lines, over all parcels. Pieces that meet or cross are of
        different groups."""
        groups = []
        for n, index, path in ((0, j[:-1, 0], corners[:-1]), (1, i[0, :-1], corners[:, :-1].swapaxes(0, 1))):
            along = np.full_like(index, n)
            tones = 50 + 60 * self._number(index, along, 4)
            widths_m = 5.0 + 4.0 * (index % 3).astype(float)
            chosen = np.flatnonzero(self._number(index, along, 3) < 0.3)
            for parity in (0, 1):
                start = path[chosen, parity:-1:2].reshape(-1, 2)
                end = path[chosen, parity + 1 :: 2].reshape(-1, 2)
                of = np.repeat(chosen, _CELL // 2)
                groups.append(_lines(start, end, widths_m[of], tones[of], 15))
        return groups


def _joined(layer: list[Shapes]) -> Shapes:
    """The shapes of several cells in one."""
    if len(layer) == 1:
        return layer[0]
    strengths = [one.strengths for one in layer if one.strengths is not None]
    return Shapes(
        np.concatenate([one.corners for one in layer]),
        np.concatenate([one.tones for one in layer]),
        np.concatenate(strengths) if strengths else None,
    )


def _parcels(quads: Array, kinds: Index, u: Array) -> Shapes:
    """The land of each parcel."""
    lowest, highest = np.array([[28, 110], [12, 20], [50, 80], [24, 40]])[kinds].T
    tones = lowest + np.floor((highest - lowest) * u[:, 0])
    roughs = np.array([0, 12, 50, 120])[kinds] + (kinds == _FIELD) * (20 + 5 * np.floor(8 * u[:, 1]))
    return _textured(quads, tones, roughs)


def _blots(quads: Array, u: Array, count: Array) -> list[Shapes]:
    """Up to three single trees, sheds and ponds on each field, from numbers (parcels, 4, 4)."""
    s, t, radius, tone = np.moveaxis(u, 2, 0)
    centre = _inside(quads, 0.1 + 0.8 * s, 0.1 + 0.8 * t)
    outlines = centre[:, :, None] + (3.0 + 4.0 * radius)[:, :, None, None] * _CIRCLE
    tones = np.array([14, 24, 170], np.uint8)[(3.0 * tone).astype(int)]
    there = np.arange(4) < np.floor(4.0 * count)[:, None]
    return [Shapes(outlines[there[:, k], k], tones[there[:, k], k], None) for k in range(3)]


def _streets(quads: Array) -> list[Shapes]:
    """Two streets that cross in a settlement."""
    a, b, c, d = np.moveaxis(quads, 1, 0)
    ends = ((a + b) / 2, (c + d) / 2), ((a + d) / 2, (b + c) / 2)
    width, tone = np.full(len(quads), 6.0), np.full(len(quads), 75.0)
    return [_lines(start, end, width, tone, 15) for start, end in ends]


def _lines(start: Array, end: Array, widths_m: Array, tones: Array, rough: int) -> Shapes:
    """Straight lines from points (n, 2) to points (n, 2)."""
    along = end - start
    across = np.column_stack([-along[:, 1], along[:, 0]])
    half = 0.5 * widths_m[:, None] * across / np.linalg.norm(along, axis=1)[:, None]
    corners = np.stack([start + half, end + half, end - half, start - half], axis=1)
    return _textured(corners, tones, rough)


def _textured(corners: Array, tones: NDArray[Any], roughs: Array | int) -> Shapes:
    """Polygons whose texture is so strong, in 255ths of their tone."""
    strengths = np.rint(tones * (np.asarray(roughs) / (255.0 * STRENGTH_UNIT)))
    return Shapes(corners, tones.astype(np.uint8), strengths.astype(np.uint8))


def _inside(quads: Array, s: Array, t: Array) -> Array:
    """Points (P, n, 2) of parcels at shares s, t (P, n) of their sides."""
    a, b, c, d = np.moveaxis(quads, 1, 0)[:, :, None]
    s, t = s[:, :, None], t[:, :, None]
    return np.asarray((a + (b - a) * s) * (1 - t) + (d + (c - d) * s) * t)


def _of_range(u: Array, low: int, high: int) -> Tones:
    """Whole numbers from `low` up to below `high` from uniform numbers."""
    return np.asarray(low + np.floor((high - low) * u), dtype=np.uint8)


def _shrunk(quads: Array, by: float) -> Array:
    middle = quads.mean(axis=1, keepdims=True)
    return np.asarray(middle + (1.0 - by) * (quads - middle))
