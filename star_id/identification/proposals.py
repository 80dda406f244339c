"""Candidate attitudes of three detections: triangles looked up by shape, and of many the likelier ones.

A proposal fixes the attitude. Where there are more than can be tried, the index stars nearest to one of its
vertices are predicted in the image, and each counts for or against it, depending on whether a bright
detection lies near: a coarse form of the ratio in `likelihood`, computed for all proposals at once. As there,
at most 1/K of false proposals reach a ratio of K, so of P proposals those are worth a trial whose ratio is a
good part of P.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats, Ints, record
from boresight.star_id.identification.tangent_plane import (
    FieldOfView,
    PlaneDetections,
    directions_of_tangents,
)
from boresight.star_id.identification.triangle_index import (
    LONGEST_SIDE,
    SHORTEST_SIDE,
    STARS_PER_FIELD,
    TriangleTable,
    triangle_shapes,
)

__all__ = ["MOST_DETECTIONS", "Proposals", "propose"]

# Brightest detections of which triangles are made: 2024 triangles.
MOST_DETECTIONS = 24
# Most proposals of one call that are examined where most are right (set by hand).
_TRIALS = 16
# Probability that an index star in the field is among the bright detections (set by hand).
_DETECTION_RATE = 0.5
# Natural logarithm: a proposal is examined if its likelihood ratio is a tenth of the number of proposals,
# or more.
_MARGIN = np.log(10.0)
# Nearest neighbours of which one must be detected for the others to be looked at (set by hand).
_FIRST = 6
# Proposals judged at a time; bounds memory to some MB.
_CHUNK = 1024
# Brightest detections on the map that proposals are judged by: enough to include the stars of the index, 14
# a field.
_BRIGHT = 60
# Most cells of that map along x (set by hand; bounds its memory).
_MAP_CELLS = 256
# Side of a cell in units of the camera's error at the edges: a star is then found at most one cell off.
_CELL = 0.35


@record
class Proposals:
    """Triangles worth a trial, best first. Row n of every array is the same triangle."""

    detections: Ints  # (T, 3)
    R: Floats  # (T, 3, 3) R_si
    log_scale: Floats  # (T,) of the image relative to the nominal focal length
    examined: int  # triangles that agreed with the catalogue, these included


def propose(
    image: PlaneDetections, table: TriangleTable, u_i: Floats, done: int, size: int, *, unlikely_too: bool
) -> Proposals:
    """Proposals from triangles of the brightest `size` detections that are not all among the first `done`;
    the best of many, if `unlikely_too` those that are hardly better than chance.

    `u_i` (N, 3) are the directions of the index's stars.
    """
    u_s = directions_of_tangents(image.points[:size])
    detected, longest, rows = _look_up(image.field, u_s, table, done)
    examined = len(rows)
    if image.field.is_calibrated or examined <= _TRIALS:  # most are right: the largest fix the attitude best
        largest = (-longest).argsort(kind="stable")[:_TRIALS]
        detected, longest, rows = detected.take(largest, axis=0), longest.take(largest), rows.take(largest)
    vertices, R, log_scale = _posed(image, table, u_s, u_i, detected, longest, rows)
    if len(rows) > _TRIALS:
        sky = _DetectionMap.of(image)
        chunks = (slice(k, k + _CHUNK) for k in range(0, examined, _CHUNK))
        log_ratio = np.concatenate(
            [sky.log_ratios(table, u_i, vertices[c], R[:, :, c], log_scale[c]) for c in chunks]
        )
        worth = np.flatnonzero((log_ratio > np.log(examined) - _MARGIN) | unlikely_too)
        best = worth[np.argsort(-log_ratio[worth], kind="stable")][:_TRIALS]
        detected, R, log_scale = detected[best], R[:, :, best], log_scale[best]
    return Proposals(detected, R.transpose(2, 0, 1), log_scale, examined)


# Rows of the three detections of each triangle, sorted by the faintest: the first (k choose 3) are
# those of the k brightest detections.
_TRIPLES = np.array(sorted(combinations(range(MOST_DETECTIONS), 3), key=lambda t: t[2]), dtype=np.int64)


def _look_up(field: FieldOfView, u_s: Floats, table: TriangleTable, done: int) -> tuple[Ints, Floats, Ints]:
    """Agreeing triangles: detections (P, 3), longest sides (P,) in rad, and rows (P,) of the table."""
    vertices, shapes = triangle_shapes(u_s, _TRIPLES[comb(done, 3) : comb(len(u_s), 3)])
    longest = np.abs(shapes[:, 2])
    fits = longest < LONGEST_SIDE * table.fov_rad * (1.0 + field.scale_error)
    fits &= longest * shapes[:, 1] > SHORTEST_SIDE * table.fov_rad * (1.0 - field.scale_error)
    fitting = fits.nonzero()[0]
    vertices, shapes, longest = vertices.take(fitting, axis=0), shapes.take(fitting, axis=0), longest[fits]
    # a side's own error: half a pixel at both ends, and the camera's relative error
    tolerance = field.shape_error + 1.5 * field.pixel / longest
    queries, rows = table.lookup(shapes, tolerance, field.scale_error)
    return vertices.take(queries, axis=0), longest.take(queries), rows


def _posed(
    image: PlaneDetections,
    table: TriangleTable,
    u_s: Floats,
    u_i: Floats,
    detected: Ints,
    longest: Floats,
    rows: Ints,
) -> tuple[NDArray[np.int32], Floats, Floats]:
    """Vertices (P, 3), R_si (3, 3, P) and log scales (P,) of agreeing triangles, as of `_look_up`."""
    vertices, log_scale = table.vertices.take(rows, axis=0), np.zeros(len(rows))
    if image.field.scale_error > 0.0:
        log_scale = np.log(longest / np.abs(table.longest.take(rows)))
    return vertices, _attitudes(u_s, u_i, detected, vertices, log_scale), log_scale


def _attitudes(
    u_s: Floats, u_i: Floats, detected: Ints, vertices: NDArray[np.int32], log_scale: Floats
) -> Floats:
    """R_si (3, 3, P) that align the ends of each longest side, the misfit of its length halved."""
    ends = np.ascontiguousarray(u_s.take(detected[:, :2], axis=0).T)  # (3, 2, P)
    if log_scale.any():
        ends[:2] *= np.exp(-log_scale)
        ends /= np.sqrt((ends * ends).sum(axis=0))
    axes = _axes(np.concatenate([ends, u_i.take(vertices[:, :2], axis=0).T], axis=2))
    axes_s, axes_i = axes[:, :, : len(detected)], axes[:, :, len(detected) :]
    return np.asarray((axes_s[:, :, None] * axes_i[:, None]).sum(axis=0))


def _axes(ends: Floats) -> Floats:
    """Orthonormal vectors, one a row (3, 3, P), from unit vectors (3, 2, P): midpoint, along, normal."""
    a, b = ends[:, 0], ends[:, 1]
    axes = np.empty((3, 3, ends.shape[2]))
    axes[0], axes[1] = a + b, b - a
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        axes[2, k] = a[i] * b[j] - a[j] * b[i]
    axes /= np.sqrt(np.einsum("aip,aip->ap", axes, axes))[:, None]
    return axes


@record
class _DetectionMap:
    """Cells of the image with a bright detection in or beside them, on a coarse grid with a border of one
    cell."""

    image: PlaneDetections
    cell: float  # side of a cell, tangent-plane units
    occupied: Bools  # (rows + 2, columns + 2)

    @classmethod
    def of(cls, image: PlaneDetections) -> _DetectionMap:
        field = image.field
        width, height = 2.0 * field.half_x, 2.0 * field.half_y
        cell = max(_CELL * field.shape_error * width + 2.0 * field.pixel, width / _MAP_CELLS)
        columns, rows = int(width / cell) + 1, int(height / cell) + 1
        occupied = np.zeros((rows + 2, columns + 2), dtype=bool)
        bright = image.points[:_BRIGHT]
        column = ((bright.real + field.half_x) / cell).astype(np.int64)
        row = ((bright.imag + field.half_y) / cell).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        around = np.arange(3)  # the border shifts indices by one
        occupied[row[inside, None, None] + around[:, None], column[inside, None, None] + around] = True
        return cls(image, cell, occupied)

    def log_ratios(
        self, table: TriangleTable, u_i: Floats, vertices: NDArray[np.int32], R: Floats, log_scale: Floats
    ) -> Floats:
        """(P,) log likelihood ratios of attitudes `R` (3, 3, P), by the neighbours of each first vertex,
        detected or missed."""
        neighbours = table.neighbours.take(vertices[:, 0], axis=0)  # (P, K), the nearest first
        hits, misses = self._counted(u_i, neighbours[:, :_FIRST], vertices, R, log_scale)
        some = hits.nonzero()[0]  # a right proposal has none of the first in one case of a hundred
        of_others = neighbours[some, _FIRST:], vertices[some], R[:, :, some], log_scale[some]
        for first, more in zip((hits, misses), self._counted(u_i, *of_others)):
            first[some] += more
        rate = _DETECTION_RATE * min(1.0, len(self.image.points) / STARS_PER_FIELD)
        chance = max(np.count_nonzero(self.occupied) / self.occupied.size, 1e-6)
        return np.asarray(hits * np.log(1.0 - rate + rate / chance) + misses * np.log(1.0 - rate))

    def _counted(
        self,
        u_i: Floats,
        neighbours: NDArray[np.int32],
        vertices: NDArray[np.int32],
        R: Floats,
        log_scale: Floats,
    ) -> tuple[Ints, Ints]:
        """How many of the neighbours (P, K) in the image are detected, and how many are missed (P,)."""
        field = self.image.field
        u, v, w = np.ascontiguousarray(u_i.take(neighbours, axis=0).T)  # (K, P) each
        stretch = np.exp(log_scale) / np.maximum(R[2, 0] * u + R[2, 1] * v + R[2, 2] * w, 0.05)
        x = (R[0, 0] * u + R[0, 1] * v + R[0, 2] * w) * stretch
        y = (R[1, 0] * u + R[1, 1] * v + R[1, 2] * w) * stretch
        seen = (np.abs(x) < field.half_x) & (np.abs(y) < field.half_y)
        seen &= (neighbours.T != vertices[:, 1]) & (neighbours.T != vertices[:, 2])
        inside = seen.ravel().nonzero()[0]
        column = ((x.take(inside) + field.half_x) / self.cell).astype(np.int64) + 1
        row = ((y.take(inside) + field.half_y) / self.cell).astype(np.int64) + 1
        detected = np.zeros(seen.shape, dtype=bool)
        detected.ravel()[inside] = self.occupied.take(row * self.occupied.shape[1] + column)
        hits = np.count_nonzero(detected, axis=0)
        return hits, np.count_nonzero(seen, axis=0) - hits
