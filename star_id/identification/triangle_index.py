"""Index of catalogue triangles by shape, in which three detections are looked up over the whole sky.

For a field of view the index takes the stars that are among the brightest of their neighbourhood, makes all
triangles of them that fit into a good part of the field, and sorts the triangles into cells of (middle side /
longest side, shortest side / longest side). The sign of the stored longest side is the handedness, seen from
inside the sphere. The vertices stand in the order: longest-and-middle side, longest-and-shortest side,
middle-and-shortest side. A table also holds the nearest index stars of each of its stars, by which true
proposals are distinguished from false ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boresight.geometry.starlight import StarPlaces
from boresight.records.record import Floats, Ints, array, record, scalar, shape_of
from boresight.star_id.image_attitude import NEXT, PREV

__all__ = [
    "CLOSE_RAD",
    "StarIndex",
    "TriangleTable",
    "build_index",
    "concatenated_ranges",
    "equivalent_fov",
    "triangle_shapes",
]

# Brightest stars in each field of view that the index is made of: 364 triangles a field (set by hand).
STARS_PER_FIELD = 14
# Nearest index stars with which each forms triangles: they fill a circle 1.2 fields of view wide.
_NEIGHBOURS = 16
# Distance of two stars, rad, up to which pairs are listed: eight widths of a star's image in the coarsest
# camera.
CLOSE_RAD = np.radians(0.5)
# Longest side of a triangle over the field of view: longer ones seldom lie within the image.
LONGEST_SIDE = 0.62
# Shortest side over the field of view: of shorter ones centroid errors change the shape (set by hand).
SHORTEST_SIDE = 0.06
# Ratio of the fields of view of successive tables of an index: the next wider one has half as many stars and
# sides up to 0.87 of the field, the next denser one twice as many, should many be missing (set by hand).
_LEVEL_STEP = 1.4
# Cells along each of the two ratios of sides by which triangles are looked up.
_CELLS = 100


def _orders_of_three() -> Ints:
    """(8, 3) orders of three numbers a, b, c by 1 (a > b) + 2 (a > c) + 4 (b > c), ascending."""
    ab, ac, bc = (np.arange(8) >> bit & 1 for bit in range(3))
    return np.argsort([ab + ac, 1 - ab + bc, 2 - ac - bc], axis=0, kind="stable").T


# Order of three numbers, ascending, by 1 if the first exceeds the second, plus 2 if it exceeds the third,
# plus 4 if the second exceeds the third; two of the eight cases cannot be.
_ORDERS = _orders_of_three()


@record(kw_only=True)
class TriangleTable:
    """Triangles for fields of view near `fov_rad`, sorted by cell."""

    fov_rad: float = scalar("width of a 4:3 field, rad")
    vertices: NDArray[np.int32] = array("T, 3", "rows of the index's stars")
    ratios: NDArray[np.float32] = array("T, 2", "side ratios, as `triangle_shapes` returns them")
    longest: NDArray[np.float32] = array("T", "longest sides with the sign of the handedness, rad")
    cell_start: Ints = array("C + 1", "first row of each cell")
    neighbours: NDArray[np.int32] = array("S, K", "nearest index stars of each; S exceeds the last row used")

    def lookup(self, shapes: Floats, tolerance: Floats, scale_error: float) -> tuple[Ints, Ints]:
        """Pairs (query, row) (P,), (P,) of agreeing triangles.

        `shapes` (Q, 3) are those of `triangle_shapes`; side ratios agree within `tolerance` (Q,), longest
        sides within `tolerance` + `scale_error`, relative, and in handedness.
        """
        ratios, longest = shapes[:, :2], shapes[:, 2]
        low = np.maximum((ratios - tolerance[:, None]) * _CELLS, 0.0).astype(np.int64)
        high = np.minimum((ratios + tolerance[:, None]) * _CELLS, _CELLS - 1.0).astype(np.int64)
        query, line = concatenated_ranges(low[:, 0], high[:, 0] + 1)
        line *= _CELLS
        first = self.cell_start.take(line + low[:, 1].take(query))
        counts = self.cell_start.take(line + high[:, 1].take(query) + 1) - first
        last = counts.cumsum()
        row = (first + counts - last).repeat(counts)
        row += np.arange(len(row))
        limit = (tolerance + scale_error) * np.abs(longest)  # the longest side discriminates most
        off = np.abs(self.longest.take(row) - longest.take(query).repeat(counts))
        agree = (off < limit.take(query).repeat(counts)).nonzero()[0]
        query, row = query.take(last.searchsorted(agree, "right")), row.take(agree)
        off = np.abs(self.ratios.take(row, axis=0) - ratios.take(query, axis=0)).max(axis=1, initial=0.0)
        agree = (off < tolerance.take(query)).nonzero()[0]
        return query.take(agree), row.take(agree)


@record(kw_only=True)
class StarIndex:
    """Catalogue stars, brightest first, with tables of their triangles.

    Directions include proper motion to the index's epoch; parallax, aberration and light bending are left
    out.
    """

    stars: StarPlaces = scalar("the stars, in the order of the rows")
    u_i: Floats = array("N, 3", "unit vectors at the epoch of the index, GCRS axes")
    tables: tuple[TriangleTable, ...] = scalar("triangles, one table for each field of view")
    along_z: Ints = array("N", "rows, ascending in z")
    u_along_z: NDArray[np.float32] = array("N, 3", "unit vectors in that order")
    close: Ints = array("P, 2", "rows of all pairs closer than `CLOSE_RAD`, the brighter star first")
    close_rad: Floats = array("P", "distances of these pairs, rad")
    to_brighter_rad: Floats = array("N", "distance of the nearest brighter star, rad; inf beyond `CLOSE_RAD`")

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All but the stars as named arrays (N, ...), a row per pair, triangle or star, for `from_arrays`."""
        own = {field.name: getattr(self, field.name) for field in fields(self) if shape_of(field)}
        return own | {
            f"{k}.{field.name}": np.asarray(getattr(table, field.name))
            for k, table in enumerate(self.tables)
            for field in fields(TriangleTable)
        }

    @classmethod
    def from_arrays(cls, stars: StarPlaces, arrays: Mapping[str, NDArray[Any]]) -> StarIndex:
        """Index from `arrays` saved by `arrays()`, rows (N, ...), for the same stars and epoch.

        Raises `ValueError` naming the array if one is missing or inconsistent.
        """
        count = len({name.partition(".")[0] for name in arrays if "." in name})
        tables = tuple(_checked(arrays, str(k), len(stars.hip)) for k in range(count))
        if not tables:
            raise ValueError("an index needs at least one table of triangles, got none")
        names = [field.name for field in fields(cls) if shape_of(field)]
        return cls(stars=_brightest_first(stars), tables=tables, **_named(names, arrays))

    def tables_for(self, fov_rad: float) -> tuple[TriangleTable | None, ...]:
        """The table for the field of view closest to `fov_rad`, the next wider one, and the next denser one,
        of a smaller field; None where there is none."""
        by_fov = sorted(self.tables, key=lambda table: table.fov_rad)
        k = min(range(len(by_fov)), key=lambda k: abs(math.log(by_fov[k].fov_rad / fov_rad)))
        denser, usual, wider = [None, *by_fov, None][k : k + 3]
        return usual, wider, denser

    def near(self, direction_i: Floats, radius_rad: float, enough: float = math.inf) -> Ints:
        """Rows of the stars within `radius_rad` (good to 1e-6) of a unit vector (3,), GCRS axes, brightest
        first; of more than `enough` those that are bright enough for as many of a mean field."""
        chord, cosine = 2.0 * math.sin(0.5 * min(radius_rad, math.pi)), math.cos(min(radius_rad, math.pi))
        direction = direction_i.astype(np.float32)
        if (bright := enough / (0.25 * chord * chord)) < len(self.u_i):  # by the share of the sphere
            return (self.u_i[: int(bright)] @ direction_i > cosine).nonzero()[0]
        first, end = self.u_along_z[:, 2].searchsorted([direction[2] - chord, direction[2] + chord])
        near = self.u_along_z[first:end] @ direction > cosine
        return np.sort(self.along_z[first:end].take(near.nonzero()[0]))


def build_index(stars: StarPlaces, epoch_jyear: float, fov_rad: float | tuple[float, float]) -> StarIndex:
    """Star index for one field of view, or for all between two of them.

    Parameters
    ----------
    stars : StarPlaces
        Catalogue, in any order.
    epoch_jyear : float
        Julian year to which the proper motions carry the directions.
    fov_rad : float or (float, float)
        Width of a 4:3 field of the camera's area (`equivalent_fov`), or smallest and largest, rad.

    Returns
    -------
    StarIndex
        For one field of view with a wider and a denser table. Takes one to two seconds to build.
    """
    stars = _brightest_first(stars)
    u_i = _directions_at(stars, epoch_jyear)
    if isinstance(fov_rad, tuple):
        low, high = fov_rad
        levels = max(1, int(np.ceil(np.log(high / low) / np.log(_LEVEL_STEP))))
        fovs = low * (high / low) ** ((np.arange(levels) + 0.5) / levels)
    else:
        fovs = fov_rad * np.power(_LEVEL_STEP, np.arange(-1.0, 2.0))  # denser, own, wider
    close = np.sort(cKDTree(u_i).query_pairs(CLOSE_RAD, output_type="ndarray"), axis=1)
    close_rad = np.linalg.norm(u_i[close[:, 0]] - u_i[close[:, 1]], axis=1)
    to_brighter = np.full(len(u_i), np.inf)
    np.minimum.at(to_brighter, close[:, 1], close_rad)
    along_z = np.argsort(u_i[:, 2], kind="stable")
    return StarIndex(
        stars=stars,
        u_i=u_i,
        tables=tuple(_table(u_i, float(fov)) for fov in fovs),
        along_z=along_z,
        u_along_z=u_i[along_z].astype(np.float32),
        close=close,
        close_rad=close_rad,
        to_brighter_rad=to_brighter,
    )


def _brightest_first(stars: StarPlaces) -> StarPlaces:
    return stars.take(np.argsort(stars.v_mag, kind="stable"))


def _named(names: Sequence[str], arrays: Mapping[str, NDArray[Any]], table: str = "") -> dict[str, Any]:
    """Arrays of an index or of one of its tables by the names of their fields."""
    if missing := [table + name for name in names if table + name not in arrays]:
        raise ValueError(f"an index of triangles lacks the array {missing[0]}")
    return {name: arrays[table + name] for name in names}


def _checked(arrays: Mapping[str, NDArray[Any]], k: str, stars: int) -> TriangleTable:
    """Table `k` of `arrays`, checked for consistency with an index of `stars` stars."""
    part = _named([field.name for field in fields(TriangleTable)], arrays, f"{k}.")
    table = TriangleTable(**(part | {"fov_rad": float(part["fov_rad"].item())}))
    start, vertices, neighbours, n = table.cell_start, table.vertices, table.neighbours, len(table.vertices)
    if len(start) != _CELLS * _CELLS + 1:
        raise ValueError(f"{k}.cell_start must have {_CELLS * _CELLS + 1} values, got {len(start)}")
    largest = int(vertices.max(initial=-1))
    if start[0] != 0 or start[-1] != n or (np.diff(start) < 0).any():
        raise ValueError(f"{k}.cell_start must ascend from 0 to the {n} triangles of the table")
    if vertices.min(initial=0) < 0 or largest >= min(stars, len(neighbours)):
        raise ValueError(f"{k}.vertices must be rows of {len(neighbours)} of {stars} stars, got {largest}")
    if neighbours.min(initial=0) < 0 or neighbours.max(initial=-1) >= stars:
        raise ValueError(f"{k}.neighbours must be rows of {stars} stars")
    return table


def equivalent_fov(width_px: int, height_px: int, focal_px: float) -> float:
    """Width (rad) of the 4:3 field of view with the same area as an image of `width_px` x `height_px`."""
    return 2.0 * math.atan(0.5 * math.sqrt(width_px * height_px / 0.75) / focal_px)


def triangle_shapes(u: Floats, triples: NDArray[np.integer]) -> tuple[NDArray[Any], Floats]:
    """Vertices in canonical order (T, 3), and shapes (T, 3) of triangles of unit vectors `u` (N, 3).

    A shape is middle / longest side, shortest / longest side, and the longest side in rad, negative where the
    triple product of the ordered vertices is. `triples` (T, 3) are rows of `u`.
    """
    corners = u.take(triples, axis=0)  # (T, 3, 3)
    across = corners.take(NEXT, axis=1) - corners.take(PREV, axis=1)  # sides opposite to each vertex

    chords = np.sqrt(np.einsum("tij,tij->ti", across, across))  # accurate for small angles
    sides = 2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))
    first, second, third = sides.T
    order = _ORDERS.take((first > second) + 2 * (first > third) + 4 * (second > third), axis=0)
    order += np.arange(0, order.size, 3)[:, None]
    # the vertex opposite the shortest side lies between the middle and the longest, and so on
    vertices, (shortest, middle, longest) = triples.take(order), sides.take(order).T
    p, q, r = u.take(vertices, axis=0).transpose(1, 0, 2)
    shapes = np.empty((len(triples), 3))
    shapes[:, 0], shapes[:, 1] = middle / longest, shortest / longest
    shapes[:, 2] = np.copysign(longest, np.einsum("ti,ti->t", p, cross(q, r)))
    return vertices, shapes


def cross(a: Floats, b: Floats) -> Floats:
    """Vector products (N, 3)."""
    return a.take(NEXT, axis=1) * b.take(PREV, axis=1) - a.take(PREV, axis=1) * b.take(NEXT, axis=1)


def _table(u_i: Floats, fov_rad: float) -> TriangleTable:
    chosen = _brightest_of_neighbourhood(u_i, fov_rad)
    triples = chosen[_triples(u_i[chosen], LONGEST_SIDE * fov_rad)]
    vertices, shapes = triangle_shapes(u_i, triples)
    longest = np.abs(shapes[:, 2])
    keep = (longest < LONGEST_SIDE * fov_rad) & (shapes[:, 1] * longest > SHORTEST_SIDE * fov_rad)
    cell = np.minimum((shapes[:, :2] * _CELLS).astype(np.int64), _CELLS - 1) @ np.array([_CELLS, 1])
    rows = np.flatnonzero(keep)
    rows = rows[np.argsort(cell[rows].astype(np.uint16), kind="stable")]  # of 16 bits: a radix sort
    counts = np.bincount(cell[rows], minlength=_CELLS * _CELLS)
    return TriangleTable(
        fov_rad=fov_rad,
        vertices=vertices[rows].astype(np.int32),
        ratios=shapes[rows, :2].astype(np.float32),
        longest=shapes[rows, 2].astype(np.float32),
        cell_start=np.concatenate([[0], np.cumsum(counts)]),
        neighbours=_neighbours(u_i, chosen),
    )


def _neighbours(u_i: Floats, chosen: Ints) -> NDArray[np.int32]:
    """(S, K) the nearest stars of `chosen` (ascending) to each of them; rows of other stars are zero."""
    nearest = min(_NEIGHBOURS + 1, len(chosen))
    _, nearest_of = cKDTree(u_i[chosen]).query(
        u_i[chosen], k=np.arange(2, nearest + 1)
    )  # the first is the star
    neighbours = np.zeros((int(chosen.max(initial=-1)) + 1, nearest - 1), dtype=np.int32)
    neighbours[chosen] = chosen[nearest_of]
    return neighbours


def _brightest_of_neighbourhood(u_i: Floats, fov_rad: float) -> Ints:
    """Rows of the stars with fewer than STARS_PER_FIELD brighter ones in the field of view around them."""
    area = 0.75 * fov_rad**2
    radius = np.sqrt(area / np.pi)
    enough = min(len(u_i), int(4 * STARS_PER_FIELD * (4.0 * np.pi) / area))
    pairs = cKDTree(u_i[:enough]).query_pairs(2.0 * np.sin(0.5 * radius), output_type="ndarray")
    brighter = np.bincount(pairs[:, 1], minlength=enough)  # the larger row of a pair comes second
    return np.flatnonzero(brighter < STARS_PER_FIELD)


def _triples(u: Floats, longest_rad: float) -> Ints:
    """All index triples i < j < k with both sides at i no longer than `longest_rad`."""
    pairs = cKDTree(u).query_pairs(2.0 * np.sin(0.5 * longest_rad), output_type="ndarray")
    star, partner = np.divmod(np.sort(pairs @ np.array([len(u), 1])), len(u))
    last = np.searchsorted(star, np.arange(len(u)), side="right")
    # later partners of the same first star
    one, other = concatenated_ranges(np.arange(1, len(pairs) + 1), last[star])
    j, k = partner.take(other), partner.take(one)
    across = u.take(j, axis=0) - u.take(k, axis=0)
    closes = np.flatnonzero(np.einsum("ti,ti->t", across, across) < (2.0 * np.sin(0.5 * longest_rad)) ** 2)
    return np.column_stack([star.take(one.take(closes)), k.take(closes), j.take(closes)])


def _directions_at(stars: StarPlaces, epoch_jyear: float) -> Floats:
    """Unit vectors (N, 3), GCRS axes, at an epoch: linear proper motion only."""
    ra, dec = stars.ra_rad, stars.dec_rad
    here = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    moved = here + (epoch_jyear - stars.epoch_jyear) * stars.motions()
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def concatenated_ranges(first: Ints, end: Ints) -> tuple[Ints, Ints]:
    """The integers of the ranges `first` (N,) to before `end` (N,), joined: the range of each, and the
    integers."""
    counts = end - first
    owner = np.arange(len(counts)).repeat(counts)
    return owner, np.arange(len(owner)) + (end - counts.cumsum()).repeat(counts)
