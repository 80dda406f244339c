"""The figure of a plan: strips, targets, and what limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from boresight.pipeline.report.panels import AXES, BOUND, SERIES, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_forecast"]


def plot_forecast(
    table: pd.DataFrame, target_arcsec: float | None, by_targets: pd.DataFrame, without: pd.DataFrame
) -> Figure:
    """1-sigma of a plan against the numbers of strips and of targets, and without each source of error."""
    figure, axes = panels(1, 3, 3.4)
    strips, targets, sources = axes[0]
    names = list(without["source"].unique())
    for n, (axis, (colour, dash, marker)) in enumerate(zip(AXES, SERIES)):
        part = table[table["axis"] == axis]
        strips.plot(part["strips"], part["sigma_arcsec"], dash, color=colour, lw=1.8, label=axis)
        floor = part["floor_arcsec"].iloc[0]
        if floor > 0.0:
            strips.axhline(floor, color=colour, ls=":", lw=1)
        part = by_targets[by_targets["axis"] == axis]
        targets.plot(part["targets"], part["sigma_arcsec"], marker, ls=dash, color=colour, ms=4, label=axis)
        part = without[without["axis"] == axis]
        at = np.arange(len(names)) + 0.26 * (n - 1)
        sources.barh(at, part["sigma_arcsec"], 0.24, color=colour, label=axis)
    if target_arcsec is not None:
        strips.axhline(target_arcsec, label=f"target {target_arcsec:g}″", **BOUND)
    strips.set(xscale="log", yscale="log", xlabel="strips", ylabel="predicted 1σ of θ, arcsec")
    strips.set_title("strips; thin dotted: never below", fontsize=9)
    targets.set(xscale="log", yscale="log", xlabel="targets a strip")
    targets.set_xticks([3, 6, 12, 24, 48], ["3", "6", "12", "24", "48"], minor=False)
    targets.xaxis.minorticks_off()
    targets.set_title("targets", fontsize=9)
    sources.set(xscale="log", xlabel="predicted 1σ, arcsec", yticks=range(len(names)), yticklabels=names)
    sources.set_title("without one source of error", fontsize=9)
    sources.invert_yaxis()
    strips.legend()
    return figure
