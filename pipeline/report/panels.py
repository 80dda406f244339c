"""Figures of several panels in one style: light grid, three colours that stay apart in grey."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["AXES", "BOUND", "GREY", "INK", "OURS", "SERIES", "THIRD", "WIDTH_IN", "legend_below", "panels"]

AXES = ("X", "Y", "Z")  # of frame c, as figures name them
# Width of a figure of several panels, inches.
WIDTH_IN = 7.3
OURS, THIRD, GREY, INK = "#124a86", "#e08a5b", "#7a7a7a", "#111111"  # dark, light, middle and black in grey
SERIES = ((OURS, "-", "o"), (THIRD, "--", "s"), (GREY, ":", "^"))  # colour, dash and marker of x, y and z
BOUND = {"color": INK, "ls": "--", "lw": 1.0}  # how Matplotlib draws a limit


def panels(rows: int, columns: int, height: float, **given: Any) -> tuple[Figure, np.ndarray]:
    """A figure with rows x columns of axes, each row so many inches high; `given` is passed to `subplots`."""
    from matplotlib.figure import Figure  # 0.2 s to load; only needed to draw

    figure = Figure(figsize=(WIDTH_IN, height * rows + 0.6), layout="constrained")
    axes: np.ndarray = figure.subplots(rows, columns, squeeze=False, **given)
    for ax in axes.ravel():
        ax.grid(True, which="major", color="#dddddd", lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_axisbelow(True)
    return figure, axes


def legend_below(figure: Figure, ax: Axes) -> None:
    """One legend below all panels, each label of `ax` once."""
    entries = dict(zip(*reversed(ax.get_legend_handles_labels())))
    columns = 2 if max(map(len, entries)) > 30 else min(len(entries), 3)
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside lower center",
        ncols=columns,
        fontsize=8,
        handlelength=3.2,  # long enough to tell dashed lines from solid ones
    )
