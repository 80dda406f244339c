"""Figures of several panels in one style: light grid, three colours that stay apart in grey."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

__all__ = ["AXES", "BOUND", "GREY", "INK", "OURS", "THIRD", "WIDTH_IN", "panels"]

AXES = ("X", "Y", "Z")
WIDTH_IN = 7.3
OURS, THIRD, GREY, INK = "#124a86", "#e08a5b", "#7a7a7a", "#111111"  # dark, light, middle and black in grey
BOUND = {"color": INK, "ls": "--", "lw": 1.0}


def panels(
    rows: int, columns: int, height: float, *, sharex: bool = False, sharey: bool = False
) -> tuple[Figure, np.ndarray]:
    """A figure with rows x columns of axes, each row so many inches high."""
    figure = Figure(figsize=(WIDTH_IN, height * rows + 0.6), layout="constrained")
    axes: np.ndarray = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
    for ax in axes.ravel():
        ax.grid(True, which="major", color="#dddddd", lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_axisbelow(True)
    return figure, axes
