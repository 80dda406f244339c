"""Proposals of what three detections are: triangles looked up by shape, and of many the likelier ones.

A proposal fixes the attitude. Where there are more than can be tried, the index stars nearest to one of its
vertices are predicted in the image, and each that has a bright detection beside it, or none, speaks for or
against it: the likelihood ratio of `verify` in its coarsest form, all proposals at once. As there, no more
than 1/K of false proposals reach a ratio of K, so of P proposals those are worth a trial whose ratio is a
good part of P.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.identification.tangent_plane import FieldOfView, PlaneImage, directions_of_plane
from boresight.star_id.identification.triangle_index import (
    LONGEST_SIDE,
    SHORTEST_SIDE,
    STARS_A_FIELD,
    TriangleTable,
    cross,
    triangle_shapes,
)

__all__ = ["MOST_DETECTIONS", "Proposals", "propose"]

Array = NDArray[np.float64]

MOST_DETECTIONS = 24  # of which triangles are made
_TRIALS = 16  # at most, of one call
_SEEN = 0.5  # probability that an index star in the field is among the bright detections, if there are enough
_DOUBT = np.log(10.0)  # a proposal is tried if its ratio is a tenth of the number of proposals
_AT_ONCE = 4096
_BRIGHT = 60  # detections on the map: the stars that an index knows are among them, noise or not
_MAP_CELLS = 256  # at most, along x
_REACH = 0.35  # cell of the map in units of the camera's error at the edges: a star is found one cell off


@dataclass(frozen=True, slots=True, eq=False)
class Proposals:
    """Triangles worth a trial, best first. Row n of every array speaks of the same one."""

    detections: NDArray[np.int64]  # (T, 3)
    R: Array  # (T, 3, 3) attitude
    log_scale: Array  # (T,) of the image against the nominal one
    examined: int  # triangles that agreed with the catalogue, these among them


def propose(image: PlaneImage, table: TriangleTable, u_i: Array, done: int, size: int) -> Proposals:
    """Proposals from triangles of the brightest `size` detections that are not all among the first `done`."""
    u_s = directions_of_plane(image.plane[:size])
    detected, longest, rows = _look_up(image.field, u_s, table, done)
    examined = len(rows)
    if image.field.known or examined <= _TRIALS:  # of a known camera most are right: the widest fix it best
        widest = (-longest).argsort()[:_TRIALS]
        detected, longest, rows = detected.take(widest, axis=0), longest.take(widest), rows.take(widest)
    named = table.vertices.take(rows, axis=0)
    if image.field.scale_error > 0.0:
        log_scale = np.log(longest / np.abs(table.longest.take(rows)))
    else:
        log_scale = np.zeros(len(rows))
    R = _attitudes(u_s, u_i, detected, named, log_scale)
    if len(rows) > _TRIALS:
        sky = _Map.of(image)
        parts = [slice(k, k + _AT_ONCE) for k in range(0, len(rows), _AT_ONCE)]
        votes = np.concatenate([sky.votes(table, u_i, named[p], R[p], log_scale[p]) for p in parts])
        worth = np.flatnonzero(votes > np.log(len(rows)) - _DOUBT)
        best = worth[np.argsort(-votes[worth], kind="stable")][:_TRIALS]
        detected, R, log_scale = detected[best], R[best], log_scale[best]
    return Proposals(detected, R, log_scale, examined)


# the first k over 3 of them are those of the k brightest
_TRIPLES = np.array(sorted(combinations(range(MOST_DETECTIONS), 3), key=lambda t: t[2]), dtype=np.int64)


def _look_up(
    field: FieldOfView, u_s: Array, table: TriangleTable, done: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Triangles that agree: the image's detections (P, 3) and longest sides (P,), and rows of the table
    (P,)."""
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


def _attitudes(
    u_s: Array,
    u_i: Array,
    detected: NDArray[np.int64],
    named: NDArray[np.int32],
    log_scale: Array,
) -> Array:
    """(P, 3, 3) rotations that bring the ends of each longest side upon one another, halving its misfit."""
    ends = u_s.take(detected[:, :2], axis=0)
    if log_scale.any():
        ends[:, :, :2] *= np.exp(-log_scale)[:, None, None]
        ends /= np.linalg.norm(ends, axis=2, keepdims=True)
    axes = _axes(np.concatenate([ends, u_i.take(named[:, :2], axis=0)]))
    return np.asarray(axes[: len(ends)] @ axes[len(ends) :].transpose(0, 2, 1))


def _axes(ends: Array) -> Array:
    """Orthonormal columns (P, 3, 3) from pairs of unit vectors (P, 2, 3): half way, along, across."""
    a, b = ends[:, 0], ends[:, 1]
    axes = np.empty((len(ends), 3, 3))
    axes[:, :, 0], axes[:, :, 1], axes[:, :, 2] = a + b, b - a, cross(a, b)
    return np.asarray(axes / np.sqrt(np.einsum("pij,pij->pj", axes, axes))[:, None, :])


@dataclass(frozen=True, slots=True, eq=False)
class _Map:
    """Where in the image a bright detection is near, on a coarse grid."""

    image: PlaneImage
    cell: float  # tangent plane
    occupied: NDArray[np.bool_]  # (rows + 2, columns + 2) a bright detection lies in this cell or beside it

    @classmethod
    def of(cls, image: PlaneImage) -> _Map:
        field = image.field
        width, height = 2.0 * field.half_x, 2.0 * field.half_y
        cell = max(_REACH * field.shape_error * width + 2.0 * field.pixel, width / _MAP_CELLS)
        columns, rows = int(width / cell) + 1, int(height / cell) + 1
        occupied = np.zeros((rows + 2, columns + 2), dtype=bool)
        bright = image.plane[:_BRIGHT]
        column = ((bright.real + field.half_x) / cell).astype(np.int64)
        row = ((bright.imag + field.half_y) / cell).astype(np.int64)
        there = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        occupied[row[there, None] + _AROUND[:, 1], column[there, None] + _AROUND[:, 0]] = True
        return cls(image, cell, occupied)

    def votes(
        self, table: TriangleTable, u_i: Array, named: NDArray[np.int32], R: Array, log_scale: Array
    ) -> Array:
        """(P,) logarithm of the likelihood ratio by the neighbours of each first vertex, found or missed."""
        field = self.image.field
        neighbours = table.neighbours[named[:, 0]]  # (P, K)
        v = u_i[neighbours] @ R.transpose(0, 2, 1)
        stretch = np.exp(log_scale)[:, None] / np.maximum(v[:, :, 2], 0.05)
        x, y = v[:, :, 0] * stretch, v[:, :, 1] * stretch
        seen = (np.abs(x) < field.half_x) & (np.abs(y) < field.half_y)
        seen &= (neighbours != named[:, 1, None]) & (neighbours != named[:, 2, None])
        column = ((np.where(seen, x, 0.0) + field.half_x) / self.cell).astype(np.int64) + 1
        row = ((np.where(seen, y, 0.0) + field.half_y) / self.cell).astype(np.int64) + 1
        hits = (self.occupied[row, column] & seen).sum(axis=1)
        share = _SEEN * min(1.0, len(self.image.plane) / STARS_A_FIELD)
        chance = max(float(self.occupied.mean()), 1e-6)
        hit, miss = np.log(1.0 - share + share / chance), np.log(1.0 - share)
        return np.asarray(hits * hit + (seen.sum(axis=1) - hits) * miss)


_AROUND = np.array([(i, j) for j in range(3) for i in range(3)])  # the border of the map counts one
