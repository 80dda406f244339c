"""Figures of the experiments from their long-form tables: ours, the bound, and the paper's printed values.

All are 7.3 inches wide (legible at 800 px). Series differ in marker and dash, so they remain distinct in
grey.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from boresight.features.paper.paper_tables import (
    FIGURE_7_SIGMA_ARCSEC,
    FIGURES_5_6_Z_ARCSEC,
    TABLE_4,
    TABLE_5,
)
from boresight.pipeline.report.panels import AXES, BOUND, GREY, INK, OURS, THIRD, legend_below, panels

__all__ = ["PLOTS"]

# How Matplotlib draws the paper's values, as crosses, and as hollow marks.
PAPER: dict[str, Any] = {"color": INK, "ls": "none", "marker": "x", "ms": 6, "mew": 1.5}
HOLLOW = PAPER | {"ms": 5, "mfc": "#ffffff"}


def plot_inputs(table: pd.DataFrame) -> Figure:
    """Tables 1 to 3: error on the ground of each source, and the distortion of both cameras."""
    figure, axes = panels(1, 3, 3.4)
    ax = axes[0, 0]
    rows = table[table["source"] == "Table 1"]
    at = np.arange(len(rows))
    ax.barh(at, rows["ours"], 0.6, color=THIRD, label="ours")
    ax.plot(rows["expected"], at, "|", color=INK, ms=16, mew=2, label="by arithmetic")
    ax.plot(rows["paper"], at, label="paper", **PAPER)
    ax.set_yticks(at, rows["item"].str.replace(", ", "\n"), fontsize=8)
    ax.invert_yaxis()
    ax.set(xlabel="rms on the ground, m", title="Table 1")
    for ax, source, label in (
        (axes[0, 1], "Table 2", "mm from the principal point"),
        (axes[0, 2], "Table 3", "sample"),
    ):
        curve = table[(table["source"] == source) & (table["item"] == "distortion")]
        ax.plot(curve["at"], curve["ours"], color=OURS, lw=1.8, label="ours, distortion")
        printed = curve[curve["paper"].notna()].iloc[:: 2 if source == "Table 2" else 1]
        ax.plot(printed["at"], printed["paper"], label="paper", **PAPER)
        unit = "px" if source == "Table 2" else "µm"
        ax.set(xlabel=label, title=f"{source}: distortion, {unit}")
    handles = [line for ax in axes[0, :2] for line in zip(*ax.get_legend_handles_labels())]
    entries = {label: handle for handle, label in handles}
    figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle("Inputs of the simulations (paper: Tables 1 to 3)", fontsize=10)
    return figure


def plot_figure4(table: pd.DataFrame) -> Figure:
    """Fig. 4: the attitude over 24 s and what single exposures measure of it."""
    figure, axes = panels(3, 1, 1.7, sharex=True)
    for ax, (axis, part) in zip(axes[:, 0], table.groupby("axis", sort=False)):
        ax.axvspan(0.0, 1.8, color="#e4e4e4", label="duration of one strip, 1.8 s")
        ax.plot(part["t_s"], part["attitude_arcsec"], color=OURS, lw=1.6, label="attitude about its mean")
        noise = f"{axis}: 1σ of an exposure {part['sigma_arcsec'].iloc[0]:.2f}″"
        ax.plot(part["t_s"], part["measured_arcsec"], ".", color=THIRD, ms=4, label="exposures at 5 Hz")
        ax.set_title(noise, fontsize=9, loc="left")
    title = "Attitude of the remote-sensing camera (paper: Fig. 4, without printed values)"
    return _finished(figure, axes, title, "s", "arcsec")


def plot_convergence(table: pd.DataFrame) -> Figure:
    """Figs. 5 and 6: one run, the rms of many and the bound against the number of frames."""
    cells = list(table.groupby(["sigma_s_px", "sigma_c_px"]))
    figure, axes = panels(len(cells), 3, 2.5)
    for row, (_, cell) in enumerate(cells):
        sigma_s, sigma_c = (float(cell[name].iloc[0]) for name in ("sigma_s_px", "sigma_c_px"))
        for column, axis in enumerate(AXES):
            part, ax = cell[cell["axis"] == axis], axes[row, column]
            one, runs = np.abs(part["error_arcsec"]), part["runs"].iloc[0]
            ax.plot(part["frames"], one, color=THIRD, lw=0.8, label="one run, |error|")
            ax.plot(part["frames"], part["rms_arcsec"], color=OURS, lw=2.0, label=f"rms of {runs} runs")
            ax.plot(part["frames"], part["bound_arcsec"], label="Cramér-Rao bound", **BOUND)
            if axis == "Z":
                ax.plot([150.0], [FIGURES_5_6_Z_ARCSEC[sigma_s, sigma_c]], **PAPER)
            ax.axvline(150.0, color=GREY, ls=":", lw=1.2, label="paper: X and Y have converged")
            ax.plot([], [], label="paper: error of Z", **PAPER)
            ax.set(xscale="log", yscale="log", title=f"{axis},  σs {sigma_s:g}, σc {sigma_c:g} px")
            ax.set_ylim(part["bound_arcsec"].min() / 30, part["bound_arcsec"].max() * 3)
    title = "Error against the number of frames (paper: Figs. 5 and 6)"
    return _finished(figure, axes, title, "frames", "error, arcsec")


def plot_grid(table: pd.DataFrame) -> Figure:
    """Figs. 7 and 9: rms over the grid at the least and the largest star noise, bounds, and the paper's
    scatter.
    """
    ours = table[table["method"] == "information"]
    frames = int(ours["frames"].max())
    wang = table[table["method"] == "wang"]
    series = (
        (ours[ours["frames"] == frames], f"ours, {frames} frames", OURS, "o"),
        (wang, "Wang's method, 7 strips", THIRD, "s"),
    )
    figure, axes = panels(1, 3, 3.6)
    levels = sorted(ours["sigma_s_px"].unique())
    for n, axis in enumerate(AXES):
        ax = axes[0, n]
        for part, name, colour, marker in series:
            for sigma_s, fill in ((levels[0], "none"), (levels[-1], "full")):
                a = _at(part, axis, sigma_s)
                style: dict[str, Any] = {"color": colour, "marker": marker, "ms": 4, "fillstyle": fill}
                ax.plot(a["sigma_c_px"], a["rms_arcsec"], lw=1.2, label=f"{name}, σs {sigma_s:.2f}", **style)
                ax.plot(a["sigma_c_px"], a["bound_arcsec"], label="bound", **BOUND)
        ax.axhline(
            FIGURE_7_SIGMA_ARCSEC[n], color=INK, ls="-.", lw=1.6, label="paper, Fig. 7: scatter over its grid"
        )
        for (_, sigma_c), (values, _) in TABLE_4.items():
            ax.plot([sigma_c], [abs(values[n])], label="paper's Wang (Table 4)", **PAPER)
        ax.set(yscale="log", title=axis)
    title = "Error over the grid of both cameras' noise (paper: Figs. 7 and 9)"
    return _finished(figure, axes, title, "σc, px", "rms error, arcsec")


def plot_table4(table: pd.DataFrame) -> Figure:
    """Table 4: three series of ours with their bounds, beside the paper's two."""
    figure, axes = panels(1, 3, 3.8)
    at = np.arange(len(TABLE_4))
    frames = int(table[table["method"] == "information"]["frames"].iloc[0])
    methods = (
        ("wang", -0.27, THIRD, None, "Wang's method, 7 strips"),
        ("strips", 0.0, "#9db9d8", "//", "ours, the same 7 strips"),
        ("information", 0.27, OURS, None, f"ours, {frames} frames"),
    )
    for n, axis in enumerate(AXES):
        ax = axes[0, n]
        for method, shift, colour, hatch, label in methods:
            part = table[(table["method"] == method) & (table["axis"] == axis)]
            ax.bar(
                at + shift,
                part["rms_arcsec"],
                0.25,
                color=colour,
                hatch=hatch,
                edgecolor=INK,
                lw=0.5,
                label=label,
            )
            ax.plot(at + shift, part["bound_arcsec"], "_", color="#ffffff", ms=8, mew=4)
            ax.plot(at + shift, part["bound_arcsec"], "_", color=INK, ms=8, mew=1.5, label="bound")
        for who, shift, marker in (("wang", -0.27, "x"), ("paper", 0.27, "D")):
            values = [abs(row[who == "paper"][n]) for row in TABLE_4.values()]
            label = "paper's Wang, one run" if who == "wang" else "paper, one run"
            ax.plot(at + shift, values, label=label, **HOLLOW | {"marker": marker})
        ax.set_xticks(at, [f"{s:g}\n{c:g}" for s, c in TABLE_4], fontsize=8)
        ax.set(yscale="log", title=axis)
    title = "Table 4: ours and Wang's method, on equal data and as in the paper"
    return _finished(figure, axes, title, "σs, σc, px", "error, arcsec (rms of runs)")


def plot_table5(table: pd.DataFrame) -> Figure:
    """Table 5 and Fig. 10."""
    figure, axes = panels(1, 2, 3.6, sharey=True)
    styles: dict[str, dict[str, Any]] = {
        "wang": {"color": THIRD, "marker": "s", "ms": 8, "mfc": "none", "lw": 3.0},
        "information": {"color": OURS, "marker": "o", "ms": 3, "lw": 1.2},
    }
    for ax, direction in zip(axes[0], ("along", "across")):
        for method, paper, marker in (("wang", "paper's Wang", "x"), ("information", "paper", "D")):
            part = table[(table["method"] == method) & (table["direction"] == direction)]
            name = "Wang's method" if method == "wang" else "ours"
            ax.plot(part["sigma_s_px"], part["rms_m"], label=name, **styles[method])
            style = HOLLOW | {"marker": marker, "ls": ":", "lw": 0.8}
            ax.plot(part["sigma_s_px"], part["paper_m"], label=paper, **style)
        ax.plot(
            part["sigma_s_px"], part["floor_m"], label="floor: GPS, vibration, clock, distortion", **BOUND
        )
        ax.set(title=f"{direction} the track", ylim=(0, None))
    title = "Geo-positioning with every error of Table 1 (paper: Table 5 and Fig. 10)"
    return _finished(figure, axes, title, "σs, px", "rms at check points, m")


def plot_readings(table: pd.DataFrame) -> Figure:
    """Table 5 with one matrix per image: ours and Wang's against sigma_s, by what the paper leaves open."""
    figure, axes = panels(2, 2, 2.6, sharex=True, sharey=True)
    for row, direction in enumerate(("along", "across")):
        for column, axis in enumerate(table["axis"].unique()):
            ax, part = axes[row, column], table[(table["direction"] == direction) & (table["axis"] == axis)]
            for (gps, attitude), cell in part.groupby(["gps", "attitude"]):
                dash, marker = "-" if attitude == "smoothed" else "--", "o" if gps == "constant" else "s"
                for method, order, colour in (("ours", 0, OURS), ("wang", 3, THIRD)):
                    line = cell[(cell["method"] == method) & (cell["order"] == order)]
                    name = "ours" if method == "ours" else "Wang, order 3"
                    label = f"{name}, {attitude}, GPS {gps}"
                    ax.plot(
                        line["sigma_s_px"],
                        line["rms_m"],
                        dash,
                        marker=marker,
                        ms=4,
                        color=colour,
                        label=label,
                    )
            for n, who, marker in ((0, "paper's Wang", "x"), (1, "paper", "D")):
                values = [of_row[n + 2 * row] for of_row in TABLE_5.values()]
                ax.plot(list(TABLE_5), values, label=who, **HOLLOW | {"marker": marker})
            ax.set_title(f"{direction}, star camera {axis} off the zenith", fontsize=9)
    title = "Table 5 with Wang's matrix of each single image"
    return _finished(figure, axes, title, "σs, px", "rms, m")


def plot_figure8(table: pd.DataFrame) -> Figure:
    """Fig. 8: residuals of polynomials fitted to the attitude's waves."""
    spans = sorted(table["span_s"].unique(), reverse=True)
    figure, axes = panels(len(spans), 3, 2.5)
    orders = ((3, THIRD, "-"), (5, GREY, "--"), (7, OURS, "-"))
    for row, span in enumerate(spans):
        for column, axis in enumerate(("roll", "pitch", "yaw")):
            part, ax = table[(table["span_s"] == span) & (table["axis"] == axis)], axes[row, column]
            one = part[part["order"] == 3]
            wave = one["wave_arcsec"] - one["wave_arcsec"].mean()
            ax.plot(one["t_s"], wave, color=INK, ls=":", lw=0.9, label="attitude")
            rms = []
            for order, colour, dash in orders:
                fit = part[part["order"] == order]
                ax.plot(
                    fit["t_s"],
                    fit["residual_arcsec"],
                    dash,
                    color=colour,
                    lw=1.3,
                    label=f"residual, order {order}",
                )
                rms.append(f"{np.sqrt(np.mean(fit['residual_arcsec'] ** 2)):.2g}")
            ax.set_title(f"{axis}, {span:g} s\nrms {', '.join(rms)}″", fontsize=8.5)
    title = "Polynomials fitted to the attitude (paper: Fig. 8, no gain from order 5 to 7)"
    return _finished(figure, axes, title, "s", "arcsec")


def plot_geometry(table: pd.DataFrame) -> Figure:
    """Search for the geometry: best misfit over the direction of the star camera's axis, for three goals."""
    goals = (
        ("figure7", "Fig. 7 alone,\nany numbers"),
        ("figure7-few", "Fig. 7 alone, 400 frames of\n60 stars, 20 targets at most"),
        ("table4-few", "Table 4 alone, 400 frames of\n60 stars, 20 targets at most"),
        ("both", "Fig. 7 and Table 4,\nany numbers"),
    )
    figure, axes = panels(2, 2, 3.0, sharex=True, sharey=True)
    for ax, (goal, title) in zip(axes.ravel(), goals):
        part = table[table["goal"] == goal].pivot(
            index="from_zenith_deg", columns="azimuth_deg", values="misfit"
        )
        x, y = part.columns.to_numpy(), part.index.to_numpy()
        shown = ax.pcolormesh(
            x, y, np.log10(part.to_numpy()), cmap="Greys", vmin=0.0, vmax=1.0, shading="nearest"
        )
        if part.to_numpy().min() <= 1.2:
            ax.contour(x, y, part.to_numpy(), levels=[1.2], colors=[INK], linewidths=1.8)
        ax.set_title(f"{title}: best {part.to_numpy().min():.2f}", fontsize=9)
    _label_edges(axes, "azimuth (0: flight, 90: across), deg", "from the zenith, deg")
    bar = figure.colorbar(shown, ax=axes, shrink=0.7)
    bar.set_ticks(
        [0.0, np.log10(1.2), np.log10(2.0), np.log10(5.0), 1.0], labels=["1", "1.2", "2", "5", "10"]
    )
    bar.set_label("largest ratio to the paper's X, Y, Z (line: 1.2)")
    figure.suptitle("Direction of the star camera's axis that gives the paper's scatter", fontsize=10)
    return figure


def plot_grid_pixels(table: pd.DataFrame) -> Figure:
    """The grid from rendered images and from the same vectors: rms over bound by either camera's noise."""
    figure, axes = panels(2, 3, 2.5, sharey=True)
    pixels, vectors = (table[table["method"] == name] for name in ("pixels", "vectors"))
    for row, (column, name) in enumerate((("row_s_px", "σs, px"), ("row_c_px", "σc, px"))):
        for ax, axis in zip(axes[row], AXES):
            part = pixels[pixels["axis"] == axis]
            groups = part.groupby(column)
            ratio = np.sqrt(groups["mean_square"].mean())
            chance = ratio / np.sqrt(2 * groups["runs"].sum())
            ax.errorbar(
                ratio.index, ratio, chance, fmt="o", color=OURS, capsize=3, label="from pixels, ±1σ of chance"
            )
            other = np.sqrt(vectors[vectors["axis"] == axis].groupby(column)["mean_square"].mean())
            ax.plot(other.index, other, color=THIRD, lw=2.5, label="the same vectors, new noise")
            ax.axhline(1.0, label="bound", **BOUND)
            paper = part["paper_arcsec"].iloc[0] / part["paper_bound_arcsec"].iloc[0]
            label = "paper, Fig. 7: scatter over the bound of its cameras"
            ax.axhline(paper, color=INK, ls="-.", lw=1.6, label=label)
            ax.set(title=f"{axis}: pooled {np.sqrt(part['mean_square'].mean()):.2f}", xlabel=name)
    axes[0, 0].set_ylim(0.0, None)  # of all panels
    title = "The grid of Figs. 7 and 9 from rendered pixels of small cameras"
    return _finished(figure, axes, title, y_label="rms error / bound")


def plot_table4_pixels(table: pd.DataFrame) -> Figure:
    """Table 4 from rendered images: error over the bound with its chance, and the paper's over its own."""
    figure, axes = panels(1, 3, 3.4, sharey=True)
    runs = int(table["runs"].iloc[0])
    for ax, (axis, part) in zip(axes[0], table.groupby("axis")):
        at = np.arange(len(part))
        ratio = part["rms_arcsec"] / part["bound_arcsec"]
        style: dict[str, Any] = {"color": OURS, "ecolor": GREY, "capsize": 4, "width": 0.6}
        ax.bar(
            at, ratio, yerr=ratio / np.sqrt(2 * runs), label=f"rms of {runs} missions, ±1σ of chance", **style
        )
        ax.axhline(1.0, label="bound: stated 1σ", **BOUND)
        paper = part["paper_arcsec"] / part["paper_bound_arcsec"]
        marks = HOLLOW | {"marker": "D", "ms": 6}
        ax.plot(at, paper, label="paper: one run over the bound of its cameras", **marks)
        ax.set_xticks(at, [f"{s:g}\n{c:g}" for s, c in zip(part["row_s_px"], part["row_c_px"])], fontsize=8)
        ax.set_title(f"{axis}: rms / bound {np.sqrt(np.mean(ratio**2)):.2f}", fontsize=10)
    title = "Rows of Table 4 from rendered pixels of small cameras"
    return _finished(figure, axes, title, "σs, σc, px", "error / bound")


# What draws the table of an experiment, by the experiment's name.
PLOTS: dict[str, Callable[[pd.DataFrame], Figure]] = {
    "inputs": plot_inputs,
    "figure4": plot_figure4,
    "convergence": plot_convergence,
    "grid": plot_grid,
    "figure8": plot_figure8,
    "table4": plot_table4,
    "table5": plot_table5,
    "readings": plot_readings,
    "geometry": plot_geometry,
    "grid-pixels": plot_grid_pixels,
    "table4-pixels": plot_table4_pixels,
}


def _finished(figure: Figure, axes: np.ndarray, title: str, x_label: str = "", y_label: str = "") -> Figure:
    """The figure with labels at the panels' edges, the first panel's legend below them, and its title."""
    _label_edges(axes, x_label, y_label)
    legend_below(figure, axes[0, 0])
    figure.suptitle(title, fontsize=10)
    return figure


def _label_edges(axes: np.ndarray, x_label: str, y_label: str) -> None:
    """Labels below the lowest panels and left of the leftmost ones; where empty, panels keep their own."""
    for ax in axes[-1] if x_label else ():
        ax.set_xlabel(x_label)
    for ax in axes[:, 0] if y_label else ():
        ax.set_ylabel(y_label)


def _at(table: pd.DataFrame, axis: str, sigma_s: float) -> pd.DataFrame:
    return table[(table["axis"] == axis) & (table["sigma_s_px"] == sigma_s)].sort_values("sigma_c_px")
