"""The strip form as a block matrix: `python scripts/figures/strip_form.py`.

Rows are residuals of targets (two each), columns the unknowns; a filled cell is a dependence.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from style import Ink, draw

TARGETS, EXPOSURES = 7, 8
BLOCKS = (
    ("θ", 3),
    ("exposures' attitudes φ$_k$", 3 * EXPOSURES),
    ("position", 3),
    ("clock", 1),
    ("distortion", 8),
)


def seen() -> np.ndarray:
    """(2 J, unknowns) 1 where a residual depends on an unknown."""
    width = sum(n for _, n in BLOCKS)
    pattern = np.zeros((2 * TARGETS, width))
    for j in range(TARGETS):
        rows = slice(2 * j, 2 * j + 2)
        first = min(max(round(j * EXPOSURES / TARGETS) - 1, 0), EXPOSURES - 4)
        knot = min(j, 6)
        pattern[rows, :3] = 1
        pattern[rows, 3 + 3 * first : 3 + 3 * (first + 4)] = 1
        pattern[rows, 3 + 3 * EXPOSURES : 7 + 3 * EXPOSURES] = 1
        pattern[rows, 7 + 3 * EXPOSURES + knot : 9 + 3 * EXPOSURES + knot] = 1
    return pattern


def paint(ink: Ink) -> Figure:
    pattern = seen()
    rows, columns = pattern.shape
    figure, axes = plt.subplots(figsize=(8.2, 3.7))
    for r, c in zip(*np.nonzero(pattern)):
        colour = ink.ground if c < 3 else ink.star if c < 3 + 3 * EXPOSURES else ink.faint
        axes.add_patch(Rectangle((c + 0.08, r + 0.08), 0.84, 0.84, facecolor=colour, lw=0))
    at = 0
    for name, width in BLOCKS:
        axes.add_patch(Rectangle((at, 0), width, rows, fill=False, edgecolor=ink.text, lw=1.1))
        axes.text(at + width / 2, -1.75 if name == "clock" else -0.45, name, ha="center", va="bottom")
        axes.text(at + width / 2, rows + 0.4, f"{width}", ha="center", va="top", color=ink.text)
        at += width
    axes.text(columns + 1.0, rows + 0.4, "unknowns", va="top")
    for j in range(TARGETS):
        axes.text(-0.6, 2 * j + 1, f"target {j + 1}", ha="right", va="center")
    axes.annotate(
        "", (3.0, rows + 2.6), (columns, rows + 2.6), arrowprops={"arrowstyle": "<->", "color": ink.text}
    )
    axes.text(
        (3 + columns) / 2,
        rows + 2.9,
        "$X_q$, scaled to unit prior variance, eliminated",
        ha="center",
        va="top",
    )
    axes.text(1.5, rows + 2.9, "$X_θ$", ha="center", va="top")
    axes.set_xlim(-4.5, columns + 5.5)
    axes.set_ylim(rows + 4.2, -3.2)
    axes.axis("off")
    return figure


draw("strip_form", paint)
