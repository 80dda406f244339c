"""An invented landscape: parcels of land with fields, woods, water, settlements and roads, as polygons to
be painted.

The land is a lattice of quadrilaterals with displaced corners. What a parcel bears follows from its two
indices and the key alone. Map coordinates are metres (east, north); tones are reflectance times 255;
`rough` is the strength of the texture on top, times 255.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boresight.simulator.lattice_noise import smooth_noise, white_at
from boresight.simulator.scenario import GroundSettings

__all__ = ["Landscape", "Shapes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Kinds of a parcel of the painted landscape, as small whole numbers.
_FIELD, _WATER, _SETTLEMENT, _FOREST = range(4)
_KEEP_PARCELS = 4096  # parcels drawn lately are wanted again by the neighbouring tiles
# Twelve points (12, 2) of a unit circle: outline of pools and trees.
_CIRCLE = np.column_stack([np.cos(np.arange(12) * np.pi / 6), np.sin(np.arange(12) * np.pi / 6)])
_REACH_M = 12.0  # a house of 20 m by 11 m about a corner of its parcel ends 11.5 m from there
_SPARED = -1  # a shape that leaves the roughness below it alone


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Groups of polygons in the order in which they are painted; those of one tone do not overlap."""

    points: Array  # (P, 2) corners of all polygons, one after the other, m
    counts: tuple[tuple[int, int], ...]  # of each group: how many polygons, and how many corners each has
    tones: tuple[tuple[int, ...], ...]  # of each group: one for all its polygons, or one for each
    roughs: tuple[int, ...]  # of each group, or -1


class Landscape:
    """`date` 0 is the land as the chips show it, 1 as the strips do (settings `other_date`)."""

    def __init__(self, settings: GroundSettings, key: int, date: int) -> None:
        self._settings = settings
        self._key = key
        self._date = date
        self._parcels: OrderedDict[tuple[int, int], Shapes] = OrderedDict()
        # Shares of the land become thresholds of noise; a sample of parcels gives its distribution.
        i, j = (index.ravel() for index in np.meshgrid(np.arange(100), np.arange(100)))
        self._levels = {
            kind: np.quantile(self._character(i, j, kind), 1.0 - share) for kind, share in self._shares()
        }

    def shapes(self, west: float, south: float, east: float, north: float) -> list[Shapes]:
        """Polygons that may show inside a box (m), in the order of painting: parcels first, roads last."""
        side = self._settings.parcel_m
        i0, i1 = int(np.floor(west / side)) - 1, int(np.floor(east / side)) + 1
        j0, j1 = int(np.floor(south / side)) - 1, int(np.floor(north / side)) + 1
        i, j = np.meshgrid(np.arange(i0, i1 + 2), np.arange(j0, j1 + 2))
        corners = self._vertices(i, j)  # (J, I, 2)
        kinds = self._kinds(i, j)
        quads = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2)
        begins = quads.min(axis=2) < np.array([east, north]) + _REACH_M
        ends = quads.max(axis=2) > np.array([west, south]) - _REACH_M
        painted = [
            self._parcel(int(i[b, a]), int(j[b, a]), int(kinds[b, a]), quads[b, a])
            for b, a in np.argwhere(np.all(begins & ends, axis=-1)).tolist()
        ]
        return [*painted, self._roads(i, j, corners)]

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
        return (np.stack([i, j], axis=-1) + 0.6 * (jitter - 0.5)) * self._settings.parcel_m

    def _parcel(self, i: int, j: int, kind: int, quad: Array) -> Shapes:
        if (i, j) in self._parcels:
            self._parcels.move_to_end((i, j))
            return self._parcels[i, j]
        place = np.array([i]), np.array([j])
        other = self._settings.other_date
        changed = self._date == 1 and self._number(*place, 9)[0] < other.changed_fields
        rng = np.random.default_rng([self._key, i & 0xFFFFFFFF, j & 0xFFFFFFFF, int(changed)])
        brush = _Brush()
        if kind == _WATER:
            brush.polygon(quad, 12 + int(rng.integers(8)), 12)
        elif kind == _FOREST:
            brush.polygon(quad, int(rng.integers(24, 40)), 120)
            brush.polygon(_shrunk(quad, 0.12), int(rng.integers(20, 34)), 150)
        elif kind == _FIELD:
            self._field(brush, quad, rng)
        else:
            self._settlement(brush, quad, rng)
        if self._date == 1 and self._number(*place, 10)[0] < other.occlusion:
            brush.polygon(_shrunk(quad, 0.05), int(rng.choice([15, 200])), 30)
        self._parcels[i, j] = brush.shapes()
        while len(self._parcels) > _KEEP_PARCELS:
            self._parcels.popitem(last=False)
        return self._parcels[i, j]

    def _field(self, brush: _Brush, quad: Array, rng: np.random.Generator) -> None:
        """A crop in rows, with a few single trees, sheds and ponds."""
        tone = int(rng.integers(28, 110))
        brush.polygon(quad, tone, int(rng.integers(20, 60)))
        spacing = rng.uniform(9.0, 30.0)
        count = int(self._settings.parcel_m / spacing)
        a, b, c, d = np.roll(quad, int(rng.integers(4)), axis=0)
        stripe = int(np.clip(tone * rng.choice([0.8, 0.9, 1.15]), 5, 250))
        along = np.arange(1, count)[:, None] / max(count, 1)
        brush.lines(a + (b - a) * along, d + (c - d) * along, 0.18 * spacing, stripe, 40)
        for s, t in rng.uniform(0.1, 0.9, (int(rng.integers(0, 4)), 2)):
            centre = (a + (b - a) * s) * (1 - t) + (d + (c - d) * s) * t
            brush.polygon(centre + rng.uniform(3.0, 7.0) * _CIRCLE, int(rng.choice([14, 24, 170])), _SPARED)

    def _settlement(self, brush: _Brush, quad: Array, rng: np.random.Generator) -> None:
        """Gardens, two streets, houses whose roofs have a light and a dark slope, trees."""
        brush.polygon(quad, int(rng.integers(50, 80)), 50)
        a, b, c, d = quad
        n = max(2, round(self._settings.parcel_m / 32.0))
        along = (b - a) / np.linalg.norm(b - a)
        across = np.array([-along[1], along[0]])
        u, v, kept, long, deep, dark = rng.uniform(size=(6, n * n))[:, :, None]
        column, row = (index.reshape(-1, 1) for index in np.meshgrid(np.arange(n), np.arange(n)))
        s, t = (column + 0.5 + 0.24 * (u - 0.5)) / n, (row + 0.5 + 0.24 * (v - 0.5)) / n
        centre = (a + (b - a) * s) * (1 - t) + (d + (c - d) * s) * t  # (H, 2)
        tree = ((kept >= 0.2) & (kept < 0.4))[:, 0]
        brush.add(centre[tree, None] + (3.0 + 3.0 * long[tree, None]) * _CIRCLE, (18,), _SPARED)
        house = (kept >= 0.4)[:, 0]
        half, depth = (4.5 + 5.5 * long) * along, (7.0 + 4.0 * deep) * across
        for side, shade in ((-0.5, 1.0), (0.5, 0.72)):
            slope = side * depth
            roofs = np.stack(
                [centre - half, centre + half, centre + half + slope, centre - half + slope], axis=1
            )
            tones = tuple(int(30.0 * 7.0**one * shade) for one in dark[house, 0].tolist())
            brush.add(roofs[house], tones, _SPARED)
        brush.lines(((a + b) / 2)[None], ((c + d) / 2)[None], 6.0, 75, 15)
        brush.lines(((a + d) / 2)[None], ((b + c) / 2)[None], 6.0, 75, 15)

    def _roads(self, i: Index, j: Index, corners: Array) -> Shapes:
        """Roads run along some of the lattice's lines, over all parcels."""
        brush = _Brush()
        for n, index in ((0, j[:, 0]), (1, i[0])):
            chosen = self._number(index, np.full_like(index, n), 3) < 0.3
            tones = 50 + 60 * self._number(index, np.full_like(index, n), 4)
            for k in np.flatnonzero(chosen):
                path = corners[k] if n == 0 else corners[:, k]
                for start, stop in pairwise(path):  # one by one: they overlap where they meet
                    width_m = 5.0 + 4.0 * (int(index[k]) % 3)
                    brush.lines(start[None], stop[None], width_m, int(tones[k]), 15)
        return brush.shapes()


class _Brush:
    """Gathers polygons."""

    def __init__(self) -> None:
        self._groups: list[Array] = []
        self._tones: list[tuple[int, ...]] = []
        self._roughs: list[int] = []

    def add(self, corners: Array, tones: tuple[int, ...], rough: int) -> None:
        """Polygons (n, k, 2) of one tone that do not overlap, or each with a tone of its own."""
        if len(corners):
            self._groups.append(corners)
            self._tones.append(tones)
            self._roughs.append(rough)

    def polygon(self, corners: Array, tone: int, rough: int) -> None:
        self.add(corners[None], (tone,), rough)

    def lines(self, a: Array, b: Array, width_m: float, tone: int, rough: int) -> None:
        """Straight lines from points (n, 2) to points (n, 2)."""
        along = b - a
        half = (
            0.5
            * width_m
            * np.column_stack([-along[:, 1], along[:, 0]])
            / np.linalg.norm(along, axis=1)[:, None]
        )
        self.add(np.stack([a + half, b + half, b - half, a - half], axis=1), (tone,), rough)

    def shapes(self) -> Shapes:
        points = [group.reshape(-1, 2) for group in self._groups]
        return Shapes(
            points=np.concatenate(points) if points else np.zeros((0, 2)),
            counts=tuple((len(group), group.shape[1]) for group in self._groups),
            tones=tuple(self._tones),
            roughs=tuple(self._roughs),
        )


def _shrunk(quad: Array, by: float) -> Array:
    middle = quad.mean(axis=0)
    return np.asarray(middle + (1.0 - by) * (quad - middle))
