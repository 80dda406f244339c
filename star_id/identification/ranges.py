"""Ranges and groups of rows, many at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["least_of_each", "ranges"]


def ranges(first: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All whole numbers of several ranges, `first` (N,) to before `end` (N,), one range after the other: to
    which range each belongs, and the numbers themselves."""
    counts = end - first
    owner = np.arange(len(counts)).repeat(counts)
    return owner, np.arange(len(owner)) + (end - counts.cumsum()).take(owner)


def least_of_each(group: NDArray[np.int64], value: NDArray[np.float64], groups: int) -> NDArray[np.int64]:
    """The row of the least `value` (N,) of each `group` (N,) that has any, the groups in order, 0 to `groups`
    - 1."""
    greatest_first = (-value).argsort()
    least = np.full(groups, -1)
    least[group.take(greatest_first)] = greatest_first  # the least comes last and stays
    return least[least >= 0]
