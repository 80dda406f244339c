"""Both cameras on the satellite, their axes and R_cs: `python scripts/figures/frames.py`."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Polygon, Rectangle
from style import Ink, draw


def arrow(axes, start, end, colour, label="", offset=(0.0, 0.0), style="-|>", width=1.6) -> None:
    axes.add_patch(
        FancyArrowPatch(
            start, end, arrowstyle=style, mutation_scale=12, color=colour, lw=width, shrinkA=0, shrinkB=0
        )
    )
    if label:
        axes.text(end[0] + offset[0], end[1] + offset[1], label, color=colour, ha="center", va="center")


def camera(axes, centre, angle_deg, colour, fill) -> np.ndarray:
    """A camera's body; returns the unit vector along its optical axis in the drawing."""
    out = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    side = np.array([-out[1], out[0]])
    c = np.asarray(centre)
    body = [
        c - 0.45 * side - 0.5 * out,
        c + 0.45 * side - 0.5 * out,
        c + 0.3 * side + 0.5 * out,
        c - 0.3 * side + 0.5 * out,
    ]
    axes.add_patch(Polygon(body, closed=True, facecolor=fill, edgecolor=colour, lw=1.5, zorder=3))
    return out


def paint(ink: Ink) -> Figure:
    figure, axes = plt.subplots(figsize=(8.2, 5.4))
    axes.set_xlim(-5.4, 5.6)
    axes.set_ylim(-4.2, 4.1)
    axes.set_aspect("equal")
    axes.axis("off")
    # Satellite body and cameras.
    axes.add_patch(Rectangle((-1.7, -0.9), 3.4, 1.8, facecolor=ink.fill, edgecolor=ink.faint, lw=1.2))
    axes.text(0.0, -0.02, "satellite, frame b", color=ink.text, ha="center", va="center")
    s, c = np.array([1.35, 1.35]), np.array([-0.7, -1.4])
    out_s = camera(axes, s, 62.0, ink.star, ink.fill)
    out_c = camera(axes, c, -90.0, ink.ground, ink.fill)
    # Axes of s: z outward, x and y against columns and rows.
    tip = s + 0.5 * out_s
    arrow(axes, tip, tip + 1.2 * out_s, ink.star, "$z_s$", (0.28, 0.02))
    arrow(axes, tip, tip + 0.9 * np.array([-out_s[1], out_s[0]]), ink.star, "$x_s$", (-0.1, 0.24))
    axes.plot(*tip, "o", color=ink.star, ms=7, mfc="none")
    axes.plot(*tip, ".", color=ink.star, ms=4)
    axes.text(tip[0] + 0.42, tip[1] - 0.22, "$y_s$", color=ink.star)
    axes.text(3.0, 0.95, "star camera, frame s", color=ink.star, ha="left")
    # Axes of c: z to the ground, x along the flight, y along the detectors.
    low = c + 0.5 * out_c
    arrow(axes, low, low + 1.0 * out_c, ink.ground, "$z_c$", (0.26, 0.05))
    arrow(axes, low, low + np.array([1.1, 0.0]), ink.ground, "$x_c$  (flight)", (0.78, 0.0))
    axes.plot(*low, "o", color=ink.ground, ms=7, mfc="none")
    axes.plot(*low, ".", color=ink.ground, ms=4)
    axes.text(low[0] - 0.2, low[1] - 0.26, "$y_c$", color=ink.ground, ha="right")
    axes.text(-1.5, -1.35, "remote-sensing\ncamera, frame c", color=ink.ground, ha="right", va="center")
    # Star, target, and the angle between them.
    star, target = np.array([4.3, 3.6]), np.array([-2.6, -3.75])
    axes.plot(*star, marker="*", ms=15, color=ink.star)
    axes.text(star[0] - 0.3, star[1] + 0.1, "star, $v$ known in i (GCRS)", color=ink.text, ha="right")
    arrow(axes, s, star - 0.12 * (star - s), ink.star, "", style="-", width=1.0)
    axes.text(3.15, 2.35, "$u_s$", color=ink.star)
    x = np.linspace(-5.0, 4.6, 60)
    axes.plot(x, -3.8 - 0.012 * x**2, color=ink.faint, lw=1.2)
    axes.plot(*target, marker="s", ms=8, color=ink.ground)
    axes.text(target[0] - 0.25, target[1] + 0.28, "ground target", color=ink.text, ha="right")
    arrow(axes, c, target + 0.05 * (c - target), ink.ground, "", style="-", width=1.0)
    axes.text(-2.0, -2.6, "$w_c$", color=ink.ground, ha="right")
    # R_cs from s to c.
    axes.add_patch(
        FancyArrowPatch(
            (2.0, 0.9),
            (0.55, -1.75),
            connectionstyle="arc3,rad=-0.45",
            arrowstyle="-|>",
            mutation_scale=14,
            color=ink.text,
            lw=1.6,
        )
    )
    axes.text(2.25, -0.75, "$R_{cs}$:  $w_c = R_{cs}\\,u_s$", color=ink.text, ha="left")
    axes.text(2.25, -1.25, "s to c, the installation matrix", color=ink.text, ha="left")
    return figure


draw("frames", paint)
