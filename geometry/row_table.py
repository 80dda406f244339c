"""Quantities of the rows of a strip, tabulated and interpolated by cubics to a stated tolerance.

Orbit, Earth rotation and attitude vary slowly with the row but are expensive to evaluate a million times.
They are evaluated at evenly spaced nodes, whose spacing is halved until cubics through four nodes agree with
the function at all midpoints. At breaks, where derivatives jump (an attitude track's exposures), the table is
split into pieces and no cubic extends across. In a cell where the cubic is not accurate enough (`rough`) the
function itself is evaluated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from boresight.records.record import Bools, Floats, Ints, array, record, scalar

__all__ = ["RowTable", "tabulated"]


_FIRST_STEP = 64.0  # lines between the nodes of the first table; halved where interpolation errs
_LAST_STEP = 1.0  # least distance of nodes, lines; a function rougher than that is evaluated itself
_RUN = 4  # mean number of successive equal lines from which each is looked up only once
_ROUGH_SHARE = 0.005  # share of cells in which the function itself may be evaluated


@record
class RowTable:
    """Values of C quantities at lines, in P pieces of evenly spaced nodes; built by `tabulated`."""

    function: Callable[[Floats], Floats] = scalar("the tabulated function, lines (N,) to values (C, N)")
    edges: Floats = array("P + 1", "lines where pieces begin and end")
    cells: Ints = array("P", "number of cells of each piece")
    values: Floats = array("C, K", "at the nodes, piece after piece")
    rough: Bools = array("K", "cells, by their first node, where the function itself is evaluated")

    def covers(self, line: Floats) -> Bools:
        """Mask (N,) of the lines between the first and the last node."""
        return (line >= self.edges[0]) & (line <= self.edges[-1])

    def at(self, line: Floats) -> Floats:
        """Quantities (C, N) at lines (N,) inside the table; successive equal lines are looked up once."""
        new = np.flatnonzero(np.diff(line)) + 1
        if len(new) * _RUN < len(line):
            runs = np.concatenate([[0], new, [len(line)]])
            return np.repeat(self._at_each(line[runs[:-1]]), np.diff(runs), axis=1)
        return self._at_each(line)

    def mapped(self, linear: Callable[[Floats], Floats]) -> RowTable:
        """Table of the quantities after a linear map (C, N) -> (C, N)."""
        return replace(self, function=lambda line: linear(self.function(line)), values=linear(self.values))

    def _at_each(self, line: Floats) -> Floats:
        piece: Ints | int = 0
        if len(self.cells) > 1:
            piece = np.searchsorted(self.edges[1:-1], line, side="right")
        cells = self.cells[piece]
        where = (line - self.edges[piece]) * (self.cells / np.diff(self.edges))[piece]
        cell = np.minimum(np.maximum(where.astype(np.int64), 0), cells - 1)
        node = (np.cumsum(self.cells + 1) - self.cells - 1)[piece]
        start = np.minimum(np.maximum(cell - 1, 0), cells - 3)
        values = _cubic(self.values, where - start, node + start)
        exact = self.rough[node + cell]
        if exact.any():
            values[:, exact] = self.function(line[exact])
        return values


def tabulated(
    function: Callable[[Floats], Floats],
    first: float,
    last: float,
    tolerance: Floats | float,
    breaks: ArrayLike = (),
) -> RowTable:
    """Table of `function`, lines (N,) -> (C, N), between two lines, accurate to `tolerance` (C,) or a number.

    The function is evaluated from `first` to `last` only. `breaks` are lines at which its derivatives jump.
    Raises `ValueError` unless `last` > `first`.
    """
    if not last > first:
        raise ValueError(f"the last line must lie after the first, got {first} and {last}")
    inner = np.unique(np.asarray(breaks, dtype=float))
    inner = inner[(inner > first + _LAST_STEP) & (inner < last - _LAST_STEP)]
    edges = np.concatenate([[first], inner, [last]])
    cells = np.maximum(4, np.ceil(np.diff(edges) / _FIRST_STEP)).astype(np.int64)
    values = function(_nodes(edges, cells))
    while True:
        middles, before = _middles(edges, cells)
        exact = function(middles)
        where = before - np.repeat(np.cumsum(cells + 1) - cells - 1, cells)  # cell within its piece
        start = np.clip(where - 1, 0, np.repeat(cells, cells) - 3)
        interpolated = _cubic(values, where + 0.5 - start, before - where + start)
        rough = np.asarray((np.abs(interpolated - exact) > np.reshape(tolerance, (-1, 1))).any(axis=0))
        step = np.max(np.diff(edges) / cells)
        values, cells = np.insert(values, before + 1, exact, axis=1), 2 * cells
        middle = before + 1 + np.arange(len(before))
        if rough.mean() <= _ROUGH_SHARE or step <= _LAST_STEP:
            of_nodes = np.zeros(values.shape[1], dtype=np.bool_)
            of_nodes[middle - 1] = of_nodes[middle] = rough  # both halves of a cell
            return RowTable(function, edges, cells, values, of_nodes)


def _nodes(edges: Floats, cells: Ints) -> Floats:
    """Nodes: evenly spaced lines, both ends included, piece after piece."""
    pieces = [np.linspace(a, b, n + 1) for a, b, n in zip(edges[:-1], edges[1:], cells)]
    return np.concatenate(pieces)


def _middles(edges: Floats, cells: Ints) -> tuple[Floats, Ints]:
    """Lines midway between neighbouring nodes of every piece, and the index of the node before each."""
    nodes = _nodes(edges, cells)
    last_of_piece = np.cumsum(cells + 1) - 1
    before = np.setdiff1d(np.arange(len(nodes)), last_of_piece)
    return 0.5 * (nodes[before] + nodes[before + 1]), before


def _cubic(values: Floats, x: Floats, start: Ints) -> Floats:
    """Cubics (C, N) through four columns of `values` (C, K) from `start` (N,) on, at x (N,) columns after
    it.
    """
    a, b, c, d = x, x - 1.0, x - 2.0, x - 3.0
    ab, cd = a * b, c * d
    result = values.take(start, axis=1)
    result *= b * cd * (-1.0 / 6.0)
    term = np.empty_like(result)
    for k, weight in ((1, a * cd * 0.5), (2, ab * d * -0.5), (3, ab * c * (1.0 / 6.0))):
        np.take(values, start + k, axis=1, out=term, mode="clip")
        term *= weight
        result += term
    return result
