"""Files of a drift between results: the estimate, its table and its plot.

drift.json   merged matrix with covariance, tests, step and its date, random walk, orbit term
drift.csv    theta of each result and the smoothed drift, long form
drift.png    both, against the date
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from boresight.features.drift.matrix_drift import DriftSettings
from boresight.features.drift.mounting_drift import (
    DatedDrift,
    drift_json,
    drift_of_results,
    drift_summary,
    drift_table,
    drift_verdict,
    step_dates,
)
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_figure, write_text
from boresight.pipeline.report.panels import GREY, INK, OURS, THIRD, legend_below, panels
from boresight.pipeline.results.writing import write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_drift", "write_drift"]


def write_drift(dated: DatedDrift, out: Path) -> list[Path]:
    """Paths of `drift.json`, `drift.csv` and `drift.png`, which are written into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    table = drift_table(dated)
    figure = plot_drift(table, step_dates(dated) if dated.drift.moved else None, drift_verdict(dated))
    written = [out / f"drift.{ending}" for ending in ("json", "csv", "png")]
    write_json(written[0], drift_json(dated))
    write_text(written[1], table_csv(table, "%.9g"))
    write_figure(written[2], figure)
    return written


def plot_drift(table: pd.DataFrame, step: tuple[str, str, str] | None, title: str) -> Figure:
    """Angles of the mounting against time, an axis a panel.

    `table` as in drift.csv; `step`: its most likely date and the ends of its interval (UTC), or None.
    """
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    figure, axes = panels(3, 1, 2.2, sharex=True)
    for ax, (axis, part) in zip(axes[:, 0], table.groupby("axis", sort=True)):
        when = _naive(part["utc"])
        smoothed, sigma = part["smoothed_arcsec"], part["smoothed_sigma_arcsec"]
        ax.axhline(0.0, color=GREY, lw=0.8, label="merged matrix")
        ax.fill_between(when, smoothed - sigma, smoothed + sigma, color=OURS, lw=0, alpha=0.25)
        ax.plot(when, smoothed, color=OURS, lw=1.8, label="smoothed (random walk), 1σ")
        ax.errorbar(
            when,
            part["theta_arcsec"],
            yerr=part["sigma_arcsec"],
            fmt="o",
            ms=4,
            color=INK,
            lw=1,
            capsize=2,
            label="each result, 1σ",
        )
        if step is not None:
            date, low, high = _naive(pd.Series(list(step)))
            ax.axvspan(low, high, facecolor="none", edgecolor=THIRD, hatch="///", lw=0, alpha=0.5)
            ax.axvline(date, color=THIRD, ls="--", lw=1.2, label="best step, interval of its date")
        ax.set_ylabel(f"θ {axis}, arcsec")
    locator = AutoDateLocator()
    axes[-1, 0].xaxis.set_major_locator(locator)
    axes[-1, 0].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes[-1, 0].set_xlabel("date, UTC")
    figure.suptitle(title, fontsize=11)
    legend_below(figure, axes[0, 0])
    return figure


def _naive(utc: pd.Series) -> pd.Series:
    """Dates without time zone for matplotlib; second 60 is drawn as second 59."""
    text = utc.str.rstrip("Z").str.replace(":60", ":59")
    return pd.to_datetime(text, format="%Y-%m-%dT%H:%M:%S")


def drift_of_dumps(out: Path, names: list[str]) -> str:
    """Whether the mounting moved between the dumps of a joint result, written into its folder `out`."""
    try:
        dated = drift_of_results({name: out / name for name in names}, DriftSettings())
    except DataNotSufficientError as error:
        return f"no drift: {error}"
    write_drift(dated, out)
    return drift_summary(dated)
