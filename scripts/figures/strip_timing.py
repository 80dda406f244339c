"""When the rows of a strip and the star exposures are taken: `python scripts/figures/strip_timing.py`."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from style import Ink, draw

from boresight.geometry.attitude import interpolation_weights

EXPOSURES_S = np.arange(-0.6, 2.61, 0.2)  # mid-exposure instants; the strip begins at 0
STRIP_S = 1.82  # 26 000 rows of 0.07 ms
TARGET_S = 1.07


def paint(ink: Ink) -> Figure:
    figure, (time, weight) = plt.subplots(
        2, 1, figsize=(8.2, 3.9), sharex=True, height_ratios=[1.0, 1.15], gridspec_kw={"hspace": 0.12}
    )
    time.barh(0.0, STRIP_S, left=0.0, height=0.5, color=ink.fill, edgecolor=ink.ground, lw=1.4)
    time.text(0.42, 0.0, "strip: 26 000 rows", color=ink.text, ha="center", va="center")
    time.vlines(EXPOSURES_S, 0.75, 1.25, color=ink.star, lw=2.0)
    time.text(-0.66, 1.42, "star exposures, every 0.2 s", color=ink.star, va="bottom")
    time.axvline(TARGET_S, color=ink.ground, lw=1.2, ls="--")
    time.plot(TARGET_S, 0.0, "s", color=ink.ground, ms=8)
    time.text(TARGET_S + 0.04, 0.0, "row of target j", color=ink.text, va="center")
    time.set_ylim(-0.45, 1.85)
    time.set_yticks([])
    near = np.argsort(np.abs(EXPOSURES_S - TARGET_S))[:4]
    nodes = np.sort(EXPOSURES_S[near])
    (weights,) = interpolation_weights(nodes, np.array([TARGET_S]))
    weight.axhline(0.0, color=ink.faint, lw=0.8)
    weight.bar(nodes, weights, width=0.035, color=ink.star)
    for t, w in zip(nodes, weights):
        weight.text(
            t, w + (0.05 if w > 0 else -0.06), f"{w:+.2f}", ha="center", va="bottom" if w > 0 else "top"
        )
    weight.axvline(TARGET_S, color=ink.ground, lw=1.2, ls="--")
    weight.set_ylim(-0.38, 1.05)
    weight.set_ylabel("weight $w_{jk}$")
    weight.set_xlabel("time since the first row, s")
    weight.set_xlim(-0.75, 2.65)
    for axes in (time, weight):
        axes.spines[["top", "right", "left"]].set_visible(False)
    return figure


draw("strip_timing", paint)
