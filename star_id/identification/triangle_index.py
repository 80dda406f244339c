"""Index of catalogue triangles by shape, so that three stars of an image can be looked up anywhere on the
sky.

For a field of view the index takes the stars that are among the brightest of their neighbourhood, makes every
triangle of them that fits into a good part of the field, and sorts the triangles into cells of (middle side /
longest side, shortest side / longest side). All triangles of one handedness seen from inside the sphere have
a longest side with the sign of it. The vertices stand in the order: longest-and-middle side,
longest-and-shortest side, middle-and-shortest side. Beside the triangles a table knows the nearest index
stars of each of its stars, which tell a true proposal from the many false ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boresight.geometry.starlight import StarPlaces
from boresight.star_id.identification.ranges import ranges

__all__ = ["CLOSE_RAD", "StarIndex", "TriangleTable", "build_index", "equivalent_fov", "triangle_shapes"]

Array = NDArray[np.float64]

STARS_A_FIELD = 14  # index stars in the area of one field of view
_NEIGHBOURS = 16  # nearest index stars kept for each: they fill a circle 1.2 fields of view wide
_WIDER = 1.5  # a second table for a known camera: fewer stars, sides up to 0.93 of its field
CLOSE_RAD = np.radians(0.5)  # eight widths of a star's image in the coarsest camera
LONGEST_SIDE = 0.62  # of the field of view
SHORTEST_SIDE = 0.06
_LEVEL_STEP = 1.4  # fields of view of neighbouring tables of an index for unknown cameras
_CELLS = 100  # along each ratio
_FULL_SKY_SR = 4.0 * np.pi
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # of three, going round


@dataclass(frozen=True, slots=True, eq=False)
class TriangleTable:
    """Triangles for fields of view near `fov_rad`, sorted by cell."""

    fov_rad: float
    vertices: NDArray[np.int32]  # (T, 3) rows of the index's stars
    ratios: NDArray[np.float32]  # (T, 2) shapes, as `triangle_shapes` gives them
    longest: NDArray[np.float32]  # (T,) the rest of the shapes: longest sides with their signs, rad
    cell_start: NDArray[np.int64]  # (cells + 1,) first row of each cell
    neighbours: NDArray[np.int32]  # (S, K) nearest index stars of each, S beyond the last index star's row

    def lookup(
        self, shapes: Array, tolerance: Array, scale_error: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs (query, row) of triangles alike: ratios within `tolerance` (Q,), longest sides within
        `tolerance` and `scale_error`, relative."""
        ratios, longest = shapes[:, :2], shapes[:, 2]
        low = np.maximum((ratios - tolerance[:, None]) * _CELLS, 0.0).astype(np.int64)
        high = np.minimum((ratios + tolerance[:, None]) * _CELLS, _CELLS - 1.0).astype(np.int64)
        query, line = ranges(low[:, 0], high[:, 0] + 1)
        line *= _CELLS
        part, row = ranges(
            self.cell_start.take(line + low[:, 1].take(query)),
            self.cell_start.take(line + high[:, 1].take(query) + 1),
        )
        query = query.take(part)
        reach = (tolerance + scale_error) * np.abs(longest)  # the longest side tells most: it is asked first
        alike = (np.abs(self.longest.take(row) - longest.take(query)) < reach.take(query)).nonzero()[0]
        query, row = query.take(alike), row.take(alike)
        off = np.abs(self.ratios.take(row, axis=0) - ratios.take(query, axis=0)).max(axis=1, initial=0.0)
        alike = (off < tolerance.take(query)).nonzero()[0]
        return query.take(alike), row.take(alike)


@dataclass(frozen=True, slots=True, eq=False)
class StarIndex:
    """Stars, brightest first, and triangle tables of them. Directions are those of the epoch, no light
    effects."""

    stars: StarPlaces
    u_i: Array  # (N, 3)
    tables: tuple[TriangleTable, ...]
    along_z: NDArray[np.int64]  # (N,) rows, ascending in z
    u_along_z: NDArray[np.float32]  # (N, 3)
    close: NDArray[np.int64]  # (P, 2) rows of all pairs within `CLOSE_RAD`, the brighter star first
    close_rad: Array  # (P,) their distances
    to_brighter_rad: Array  # (N,) to the nearest brighter star; infinite where none is within `CLOSE_RAD`

    @property
    def arrays(self) -> dict[str, NDArray]:
        """The tables as plain arrays, to be kept."""
        return {
            f"{k}.{field.name}": np.asarray(getattr(table, field.name))
            for k, table in enumerate(self.tables)
            for field in fields(TriangleTable)
        }

    @classmethod
    def from_arrays(cls, stars: StarPlaces, epoch_jyear: float, arrays: Mapping[str, NDArray]) -> StarIndex:
        """The index that gave `arrays`, of the same stars and epoch. Raises `ValueError` if they belong to no
        index."""
        stars, u_i = _sorted(stars, epoch_jyear)
        count = len({name.partition(".")[0] for name in arrays})
        tables = tuple(_checked(arrays, str(k), len(u_i)) for k in range(count))
        if not tables:
            raise ValueError("an index has a table of triangles at least, got none")
        return cls._of(stars, u_i, tables)

    @classmethod
    def _of(cls, stars: StarPlaces, u_i: Array, tables: tuple[TriangleTable, ...]) -> StarIndex:
        along_z, tree = np.argsort(u_i[:, 2]), cKDTree(u_i)
        close = np.sort(tree.query_pairs(CLOSE_RAD, output_type="ndarray"), axis=1)
        close_rad = np.linalg.norm(u_i[close[:, 0]] - u_i[close[:, 1]], axis=1)
        to_brighter = np.full(len(u_i), np.inf)
        np.minimum.at(to_brighter, close[:, 1], close_rad)
        u_along_z = u_i[along_z].astype(np.float32)
        return cls(stars, u_i, tables, along_z, u_along_z, close, close_rad, to_brighter)

    def tables_for(self, fov_rad: float) -> tuple[TriangleTable, ...]:
        """The table made for the nearest field of view, and the next wider one."""
        nearest = min(self.tables, key=lambda table: abs(math.log(table.fov_rad / fov_rad)))
        wider = [table for table in self.tables if table.fov_rad > nearest.fov_rad]
        return (nearest, *sorted(wider, key=lambda table: table.fov_rad)[:1])

    def near(self, direction_i: Array, radius_rad: float) -> NDArray[np.int64]:
        """Rows of the stars within `radius_rad`, good to 1e-6, of a unit vector, brightest first."""
        chord = 2.0 * math.sin(0.5 * min(radius_rad, math.pi))
        direction = direction_i.astype(np.float32)
        first, end = self.u_along_z[:, 2].searchsorted([direction[2] - chord, direction[2] + chord])
        near = self.u_along_z[first:end] @ direction > math.cos(min(radius_rad, math.pi))
        return np.sort(self.along_z[first:end].take(near.nonzero()[0]))


def build_index(stars: StarPlaces, epoch_jyear: float, fov_rad: float | tuple[float, float]) -> StarIndex:
    """Index for a field of view, or for all between two of them.

    Parameters
    ----------
    stars : StarPlaces
        Any order; carried to `epoch_jyear` by their proper motions.
    fov_rad : float or (float, float)
        Width of a 4:3 field of the camera's area (`equivalent_fov`), or least and greatest.
    """
    stars, u_i = _sorted(stars, epoch_jyear)
    if isinstance(fov_rad, tuple):
        low, high = fov_rad
        levels = max(1, int(np.ceil(np.log(high / low) / np.log(_LEVEL_STEP))))
        fovs = low * (high / low) ** ((np.arange(levels) + 0.5) / levels)
    else:
        fovs = fov_rad * np.array([1.0, _WIDER])
    return StarIndex._of(stars, u_i, tuple(_table(u_i, float(fov)) for fov in fovs))


def _sorted(stars: StarPlaces, epoch_jyear: float) -> tuple[StarPlaces, Array]:
    stars = stars.take(np.argsort(stars.v_mag, kind="stable"))
    return stars, _directions_at(stars, epoch_jyear)


def _checked(arrays: Mapping[str, NDArray], k: str, stars: int) -> TriangleTable:
    """Table `k` of `arrays`, if its parts fit one another and `stars` stars."""
    expected = {field.name: f"{k}.{field.name}" for field in fields(TriangleTable)}
    if missing := [name for name in expected.values() if name not in arrays]:
        raise ValueError(f"an index of triangles holds no {missing[0]}")
    part = {name: arrays[key] for name, key in expected.items()}
    n = len(part["vertices"])
    shapes = [("vertices", (n, 3)), ("ratios", (n, 2)), ("longest", (n,)), ("fov_rad", ())]
    for name, shape in [*shapes, ("cell_start", (_CELLS * _CELLS + 1,))]:
        if part[name].shape != shape:
            raise ValueError(f"{k}.{name} must have shape {shape}, got {part[name].shape}")
    start, vertices, neighbours = part["cell_start"], part["vertices"], part["neighbours"]
    largest = int(vertices.max(initial=-1))
    if start[0] != 0 or start[-1] != n or (np.diff(start) < 0).any():
        raise ValueError(f"{k}.cell_start must rise from 0 to the {n} triangles of the table")
    if vertices.min(initial=0) < 0 or largest >= min(stars, len(neighbours)):
        raise ValueError(f"{k}.vertices must be rows of {len(neighbours)} of {stars} stars, got {largest}")
    if neighbours.min(initial=0) < 0 or neighbours.max(initial=-1) >= stars:
        raise ValueError(f"{k}.neighbours must be rows of {stars} stars")
    return TriangleTable(float(part["fov_rad"]), vertices, part["ratios"], part["longest"], start, neighbours)


def equivalent_fov(width_px: int, height_px: int, focal_px: float) -> float:
    """Width (rad) of the 4:3 field that has the area of this one."""
    return 2.0 * math.atan(0.5 * math.sqrt(width_px * height_px / 0.75) / focal_px)


def triangle_shapes(u: Array, triples: NDArray[np.integer]) -> tuple[NDArray, Array]:
    """Vertices in canonical order (T, 3), and shapes of triangles (T, 3): middle / longest side, shortest /
    longest, and the longest (rad), which is negative where the vertices' triple product is."""
    corners = u.take(triples, axis=0)  # (T, 3, 3)
    across = corners.take(_NEXT, axis=1) - corners.take(_LAST, axis=1)  # sides opposite to each vertex
    # angles from chords: safe however small
    chords = np.sqrt(np.einsum("tij,tij->ti", across, across))
    sides = 2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))
    order = sides.argsort(axis=1)  # shortest, middle, longest
    order += np.arange(0, order.size, 3)[:, None]
    # the vertex opposite the shortest side lies between the middle and the longest, and so on
    vertices, (shortest, middle, longest) = triples.take(order), sides.take(order).T
    p, q, r = u.take(vertices, axis=0).transpose(1, 0, 2)
    shapes = np.empty((len(triples), 3))
    shapes[:, 0], shapes[:, 1] = middle / longest, shortest / longest
    shapes[:, 2] = np.copysign(longest, np.einsum("ti,ti->t", p, cross(q, r)))
    return vertices, shapes


def cross(a: Array, b: Array) -> Array:
    """Vector products (N, 3)."""
    return a.take(_NEXT, axis=1) * b.take(_LAST, axis=1) - a.take(_LAST, axis=1) * b.take(_NEXT, axis=1)


def _table(u_i: Array, fov_rad: float) -> TriangleTable:
    chosen = _brightest_of_neighbourhood(u_i, fov_rad)
    triples = chosen[_triples(u_i[chosen], LONGEST_SIDE * fov_rad)]
    vertices, shapes = triangle_shapes(u_i, triples)
    longest = np.abs(shapes[:, 2])
    keep = (longest < LONGEST_SIDE * fov_rad) & (shapes[:, 1] * longest > SHORTEST_SIDE * fov_rad)
    cell = np.minimum((shapes[:, :2] * _CELLS).astype(np.int64), _CELLS - 1) @ np.array([_CELLS, 1])
    rows = np.flatnonzero(keep)
    rows = rows[np.argsort(cell[rows], kind="stable")]
    counts = np.bincount(cell[rows], minlength=_CELLS * _CELLS)
    return TriangleTable(
        fov_rad,
        vertices[rows].astype(np.int32),
        shapes[rows, :2].astype(np.float32),
        shapes[rows, 2].astype(np.float32),
        np.concatenate([[0], np.cumsum(counts)]),
        _neighbours(u_i, chosen),
    )


def _neighbours(u_i: Array, chosen: NDArray[np.int64]) -> NDArray[np.int32]:
    """(S, K) the stars of `chosen` (ascending) nearest to each of them; rows of other stars are zero."""
    nearest = min(_NEIGHBOURS + 1, len(chosen))
    _, place = cKDTree(u_i[chosen]).query(u_i[chosen], k=np.arange(2, nearest + 1))  # the first is the star
    neighbours = np.zeros((int(chosen.max(initial=-1)) + 1, nearest - 1), dtype=np.int32)
    neighbours[chosen] = chosen[place]
    return neighbours


def _brightest_of_neighbourhood(u_i: Array, fov_rad: float) -> NDArray[np.int64]:
    """Rows (stars are sorted by brightness) with fewer than STARS_A_FIELD brighter stars in a field around
    them."""
    area = 0.75 * fov_rad**2
    radius = np.sqrt(area / np.pi)
    enough = min(len(u_i), int(4 * STARS_A_FIELD * _FULL_SKY_SR / area))
    pairs = cKDTree(u_i[:enough]).query_pairs(2.0 * np.sin(0.5 * radius), output_type="ndarray")
    brighter = np.bincount(pairs.max(axis=1), minlength=enough)
    return np.flatnonzero(brighter < STARS_A_FIELD)


def _triples(u: Array, longest_rad: float) -> NDArray[np.int64]:
    """All index triples i < j < k with both sides at i no longer than `longest_rad`."""
    pairs = cKDTree(u).query_pairs(2.0 * np.sin(0.5 * longest_rad), output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    last = np.searchsorted(pairs[:, 0], np.arange(len(u)), side="right")
    # later partners of the same first star
    one, other = ranges(np.arange(1, len(pairs) + 1), last[pairs[:, 0]])
    triples = np.column_stack([pairs[one], pairs[other, 1]])
    closes = ((u[triples[:, 1]] - u[triples[:, 2]]) ** 2).sum(axis=1) < (2.0 * np.sin(0.5 * longest_rad)) ** 2
    return np.asarray(triples[closes])


def _directions_at(stars: StarPlaces, epoch_jyear: float) -> Array:
    """Catalogue directions (N, 3) carried along straight lines; parallax and all effects of light are left
    out."""
    ra, dec = stars.ra_rad, stars.dec_rad
    east = np.column_stack([-np.sin(ra), np.cos(ra), np.zeros(len(ra))])
    north = np.column_stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    here = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    years = epoch_jyear - stars.epoch_jyear
    moved = here + years * (
        (stars.pm_ra_rad_yr * np.cos(dec))[:, None] * east + stars.pm_dec_rad_yr[:, None] * north
    )
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))
