"""Figures of the experiments: the paper's figures beside ours, drawn from the long-form tables alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from boresight.pipeline.experiments.paper_tables import TABLE_4

__all__ = ["PLOTS", "plot_forecast"]

AXES = ("X", "Y", "Z")
OURS, WANG, PAPER, BOUND = "#1b6ca8", "#c8553d", "#6b6b6b", "#111111"


def plot_convergence(table: pd.DataFrame) -> Figure:
    """Figs. 5 and 6: one draw, the rms of many and the bound against the number of frames."""
    cells = list(table.groupby(["sigma_s_px", "sigma_c_px"]))
    figure, axes = _panels(len(cells), 3, 3.7, 2.9)
    for row, ((sigma_s, sigma_c), cell) in enumerate(cells):
        for column, axis in enumerate(AXES):
            part, ax = cell[cell["axis"] == axis], axes[row, column]
            ax.plot(
                part["frames"],
                np.abs(part["error_arcsec"]),
                color=OURS,
                alpha=0.35,
                lw=1,
                label="one run, |error|",
            )
            ax.plot(
                part["frames"],
                part["rms_arcsec"],
                color=OURS,
                lw=1.8,
                label=f"rms of {part['runs'].iloc[0]} runs",
            )
            ax.plot(
                part["frames"], part["bound_arcsec"], color=BOUND, ls="--", lw=1, label="Cramér-Rao bound"
            )
            ax.set(
                xscale="log",
                yscale="log",
                title=f"{axis},  σs {sigma_s:g} px, σc {sigma_c:g} px",
                xlabel="frames",
            )
            low = part["bound_arcsec"].min()
            ax.set_ylim(low / 30, part["bound_arcsec"].max() * 3)
        axes[row, 0].set_ylabel("error, arcsec")
    axes[0, 0].legend(fontsize=7, loc="lower left")
    figure.suptitle("Deviation angle against the number of frames (paper, Figs. 5 and 6)")
    return figure


def plot_grid(table: pd.DataFrame) -> Figure:
    """Figs. 7 and 9: rms error over the grid; solid ours, dashed the bound, dotted Wang's way."""
    ours = table[table["method"] == "information"]
    frames = int(ours["frames"].max())
    ours, wang = ours[ours["frames"] == frames], table[table["method"] == "wang"]
    figure, axes = _panels(1, 3, 4.2, 3.8)
    levels = sorted(ours["sigma_s_px"].unique())
    shades = [(0.1 + 0.12 * k, 0.42 + 0.07 * k, 0.66 + 0.04 * k) for k in range(len(levels))]
    for column, axis in enumerate(AXES):
        ax = axes[0, column]
        for sigma_s, shade in zip(levels, shades):
            a = _at(ours, axis, sigma_s)
            ax.plot(
                a["sigma_c_px"], a["rms_arcsec"], color=shade, marker="o", ms=3, label=f"σs {sigma_s:.2f} px"
            )
            ax.plot(a["sigma_c_px"], a["bound_arcsec"], color=BOUND, ls="--", lw=0.7)
        for sigma_s in (levels[0], levels[-1]):
            w = _at(wang, axis, sigma_s)
            ax.plot(
                w["sigma_c_px"],
                w["rms_arcsec"],
                color=WANG,
                ls=":",
                marker="s",
                ms=2.5,
                label=f"Wang, σs {sigma_s:.2f}",
            )
        ax.set(yscale="log", title=f"{axis}", xlabel="σc, px")
    axes[0, 0].set_ylabel("rms error, arcsec")
    axes[0, 2].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.suptitle(
        f"Error over the grid, {frames} frames; black dashed: bound; Wang: 7 strips (paper, Figs. 7 and 9)"
    )
    return figure


def plot_table4(table: pd.DataFrame) -> Figure:
    """Table 4: ours and Wang's way, each beside the paper's figure."""
    figure, axes = _panels(1, 3, 4.2, 3.6)
    cells = list(TABLE_4)
    place = np.arange(len(cells))
    for column, axis in enumerate(AXES):
        ax = axes[0, column]
        for method, colour, shift in (("wang", WANG, -0.2), ("information", OURS, 0.2)):
            part = table[(table["method"] == method) & (table["axis"] == axis)]
            label = "Wang's way" if method == "wang" else "ours"
            ax.bar(place + shift, part["rms_arcsec"], 0.36, color=colour, label=f"{label}, rms")
            ax.plot(
                place + shift,
                part["paper_arcsec"],
                "_",
                color=BOUND,
                ms=14,
                mew=2,
                label="the paper's figure for it" if shift > 0 else None,
            )
        ax.set_xticks(place, [f"{s:g}\n{c:g}" for s, c in cells])
        ax.set(yscale="log", title=axis, xlabel="σs, σc, px")
    axes[0, 0].set_ylabel("error, arcsec")
    axes[0, 2].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.suptitle("Table 4: rms over runs (bars) and the paper's single draws (dashes)")
    return figure


def plot_table5(table: pd.DataFrame) -> Figure:
    """Table 5 and Fig. 10."""
    figure, axes = _panels(1, 2, 4.6, 3.6)
    for ax, direction in zip(axes[0], ("along", "across")):
        for method, colour, name in (("wang", WANG, "Wang's way"), ("information", OURS, "ours")):
            part = table[(table["method"] == method) & (table["direction"] == direction)]
            marker = (
                {"marker": "s", "ms": 8, "mfc": "none", "lw": 3}
                if method == "wang"
                else {"marker": "o", "ms": 3}
            )
            ax.plot(part["sigma_s_px"], part["rms_m"], color=colour, label=name, **marker)
            paper = "the paper's Wang" if method == "wang" else "the paper"
            ax.plot(part["sigma_s_px"], part["paper_m"], color=colour, ls=":", marker="x", ms=4, label=paper)
        ax.plot(
            part["sigma_s_px"],
            part["floor_m"],
            color=BOUND,
            ls="--",
            lw=1,
            label="floor: GPS, vibration, clock, distortion",
        )
        ax.set(title=f"{direction} track", xlabel="σs, px", ylim=(0, None))
    axes[0, 0].set_ylabel("rms at check points, m")
    axes[0, 1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.suptitle("Table 5: geo-positioning with every error of Table 1")
    return figure


def plot_figure8(table: pd.DataFrame) -> Figure:
    """Fig. 8: what polynomials leave of the attitude's waves."""
    spans = sorted(table["span_s"].unique(), reverse=True)
    figure, axes = _panels(len(spans), 3, 3.9, 2.6)
    for row, span in enumerate(spans):
        for column, axis in enumerate(("roll", "pitch", "yaw")):
            part, ax = table[(table["span_s"] == span) & (table["axis"] == axis)], axes[row, column]
            one = part[part["order"] == part["order"].min()]
            ax.plot(
                one["t_s"],
                one["wave_arcsec"] - one["wave_arcsec"].mean(),
                color=PAPER,
                lw=0.8,
                label="attitude",
            )
            for order, colour in zip((3, 5, 7), (WANG, "#d9a441", OURS)):
                fit = part[part["order"] == order]
                rms = np.sqrt(np.mean(fit["residual_arcsec"] ** 2))
                ax.plot(
                    fit["t_s"],
                    fit["residual_arcsec"],
                    color=colour,
                    lw=1.2,
                    label=f"order {order}: {rms:.2g}″",
                )
            ax.set(title=f"{axis}, {span:g} s", xlabel="s")
            low, high = ax.get_ylim()
            ax.set_ylim(low, high + 0.55 * (high - low))
            ax.legend(fontsize=6.5, loc="upper center", ncols=2)
        axes[row, 0].set_ylabel("arcsec")
    figure.suptitle("Residuals of polynomials fitted to the attitude (paper, Fig. 8)")
    return figure


def plot_grid_pixels(table: pd.DataFrame) -> Figure:
    """The grid from rendered images: rms of a few missions beside what they state of themselves."""
    figure, axes = _panels(1, 3, 3.6, 3.2)
    for column, axis in enumerate(AXES):
        ax, part = axes[0, column], table[table["axis"] == axis]
        place = np.arange(len(part))
        ax.bar(
            place - 0.2, part["rms_arcsec"], 0.36, color=OURS, label=f"rms of {part['runs'].iloc[0]} missions"
        )
        ax.bar(place + 0.2, part["bound_arcsec"], 0.36, color=PAPER, label="stated 1σ")
        ax.set_xticks(place, [f"{s:.3f}\n{c:.2f}" for s, c in zip(part["sigma_s_px"], part["sigma_c_px"])])
        ax.set(yscale="log", title=axis, xlabel="σs, σc of the sightings, px")
    axes[0, 0].set_ylabel("arcsec")
    axes[0, 2].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.suptitle("From pixels (mini scenario, every error of Table 1)")
    return figure


def plot_table5_pixels(table: pd.DataFrame) -> Figure:
    """Geo-positioning from rendered images."""
    figure, axes = _panels(1, 1, 5.0, 3.4)
    ax = axes[0, 0]
    for direction, colour, shift in (("along", OURS, -0.2), ("across", WANG, 0.2)):
        part = table[table["direction"] == direction]
        place = np.arange(len(part))
        ax.bar(place + shift, part["rms_m"], 0.36, color=colour, label=f"{direction} track")
        ax.set_xticks(place, [f"{s:.3f}\n{c:.2f}" for s, c in zip(part["sigma_s_px"], part["sigma_c_px"])])
    ax.set(xlabel="σs, σc of the sightings, px", ylabel="rms at check points, m")
    ax.legend(fontsize=7)
    ax.set_title("Geo-positioning from pixels (mini scenario)", fontsize=10)
    return figure


def plot_forecast(table: pd.DataFrame, target_arcsec: float | None) -> Figure:
    """1-sigma of a plan against the number of strips."""
    figure, axes = _panels(1, 1, 6.0, 4.2)
    ax = axes[0, 0]
    for axis, colour in zip(AXES, (OURS, "#d9a441", WANG)):
        part = table[table["axis"] == axis]
        ax.plot(part["strips"], part["sigma_arcsec"], color=colour, lw=1.8, label=axis)
        floor = part["floor_arcsec"].iloc[0]
        if floor > 0.0:
            ax.axhline(floor, color=colour, ls=":", lw=1)
    if target_arcsec is not None:
        ax.axhline(target_arcsec, color=BOUND, ls="--", lw=1, label=f"target {target_arcsec:g}″")
    ax.set(xscale="log", yscale="log", xlabel="strips", ylabel="predicted 1σ of θ, arcsec")
    ax.legend()
    ax.set_title("What the plan will reach (dotted: what no number of strips falls below)")
    return figure


PLOTS: dict[str, Callable[[pd.DataFrame], Figure]] = {
    "convergence": plot_convergence,
    "grid": plot_grid,
    "table4": plot_table4,
    "table5": plot_table5,
    "figure8": plot_figure8,
    "grid-pixels": plot_grid_pixels,
    "table5-pixels": plot_table5_pixels,
}


def _panels(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes: np.ndarray = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.ravel():
        _quiet(ax)
    return figure, axes


def _quiet(ax: Axes) -> None:
    ax.grid(True, which="major", color="#dddddd", lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def _at(table: pd.DataFrame, axis: str, sigma_s: float) -> pd.DataFrame:
    return table[(table["axis"] == axis) & (table["sigma_s_px"] == sigma_s)].sort_values("sigma_c_px")
