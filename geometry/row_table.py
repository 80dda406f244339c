"""A quantity of the rows of a strip, tabulated finely enough that reading it between the nodes costs nothing.

Orbit, Earth rotation and attitude are slow functions of the row, but dear to evaluate a million times. They
are evaluated at evenly spaced nodes, halving the spacing until cubics through four nodes agree with the true
function at every midpoint; where it does not even then (an attitude track has a kink at each exposure), the
cell is marked and the function itself is called there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["RowTable", "tabulated"]

Array = NDArray[np.float64]

_FIRST_STEP = 64.0  # lines
_LAST_STEP = 1.0
_ROUGH_SHARE = 0.02  # share of cells which may be left to the function itself


@dataclass(frozen=True, slots=True, eq=False)
class RowTable:
    """Values of C quantities at evenly spaced lines. Made by `tabulated`."""

    function: Callable[[Array], Array]  # (N,) lines -> (N, C)
    first: float  # line of the first node
    step: float  # lines between nodes
    values: Array  # (K, C)
    rough: NDArray[np.bool_]  # (K - 1,) cells in which the cubic is not good enough

    @property
    def last(self) -> float:
        return self.first + self.step * (len(self.values) - 1)

    def covers(self, line: Array) -> bool:
        """Whether every line lies between the first and the last node."""
        return len(line) == 0 or bool(line.min() >= self.first and line.max() <= self.last)

    def at(self, line: Array) -> Array:
        """The quantities (N, C) at lines (N,) inside the table."""
        where = (line - self.first) / self.step
        cell = np.clip(where.astype(np.int64), 0, len(self.values) - 2)
        values = _cubic(self.values, where, cell)
        exact = self.rough[cell]
        if exact.any():
            values[exact] = self.function(line[exact])
        return values


def tabulated(
    function: Callable[[Array], Array], first: float, last: float, tolerance: Array | float
) -> RowTable:
    """Tabulate `function`, lines (N,) -> (N, C), between two lines, to `tolerance` (C,) or a number.

    It is called at lines from `first` to `last` only.
    """
    if not last > first:
        raise ValueError(f"the last line must lie after the first, got {first} and {last}")
    cells = max(4, int(np.ceil((last - first) / _FIRST_STEP)))
    nodes = _even(first, last, cells + 1)
    values = function(nodes)
    while True:
        middles = 0.5 * (nodes[1:] + nodes[:-1])
        true = function(middles)
        guess = _cubic(values, np.arange(len(middles)) + 0.5, np.arange(len(middles)))
        rough = (np.abs(guess - true) > tolerance).any(axis=1)
        both = np.empty((len(nodes) + len(middles), values.shape[1]))
        both[::2], both[1::2] = values, true
        nodes, values, rough = _even(first, last, len(both)), both, np.repeat(rough, 2)
        step = nodes[1] - nodes[0]
        if rough.mean() <= _ROUGH_SHARE or step <= _LAST_STEP:
            return RowTable(function, float(first), float(step), values, rough)


def _even(first: float, last: float, number: int) -> Array:
    return np.asarray(np.linspace(first, last, number), dtype=np.float64)


def _cubic(values: Array, where: NDArray[Any], cell: NDArray[np.int64]) -> Array:
    """Cubics through four neighbouring rows of `values` (K, C) at fractional indices `where` (N,)."""
    start = np.clip(cell - 1, 0, len(values) - 4)
    x = (where - start)[:, None]
    a, b, c, d = x, x - 1.0, x - 2.0, x - 3.0
    ab, cd = a * b, c * d
    result = values[start] * (b * cd / -6.0)
    result += values[start + 1] * (a * cd * 0.5)
    result += values[start + 2] * (ab * d * -0.5)
    result += values[start + 3] * (ab * c / 6.0)
    return result
