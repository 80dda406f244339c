"""What the page of experiments says above each table: every number and judgement is computed from the table.

A sentence without a number of ours states what the paper prints or leaves out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pandas as pd

from boresight.features.paper.comparison import GAIN_M, errors_of_axes, rms_of
from boresight.features.paper.paper_tables import (
    FIGURE_7_CELLS,
    FIGURE_7_MEAN_ARCSEC,
    FIGURE_7_SIGMA_ARCSEC,
    FIGURES_5_6_Z_ARCSEC,
    TABLE_4_RMS_ARCSEC,
    TABLE_5,
)

__all__ = ["CAPTIONS", "FAR_SIGMAS", "FITS", "NEAR_INPUT", "NO_GAIN", "SMALL_ARCSEC", "WITHIN"]

AXES = ("X", "Y", "Z")  # of frame c
WITHIN = 1.25  # ratio of two errors, either way, that is called reproduced
NEAR_INPUT = 0.1  # share of a printed input by which ours may differ
SMALL_ARCSEC = 0.1  # what "tends to 0" is taken to mean in Figs. 5 and 6
FAR_SIGMAS = 5.0  # standard errors from zero that independent noise does not give
NO_GAIN = 0.8  # residual of order 7 over that of order 5 above which there is no gain
FITS = 1.2  # largest ratio to the paper, either way, that is a fit


def of_inputs(table: pd.DataFrame) -> str:
    """How many printed inputs come out."""
    rows = table[table["at"].isna()]
    near = (rows["ours"] - rows["paper"]).abs() <= NEAR_INPUT * rows["paper"].abs()
    return (
        f"{near.sum()} of {len(rows)} printed values come out within {100 * NEAR_INPUT:.0f} %."
        " Table 1: each error alone, simulated; its header is shifted by a row."
        " The distortion of Table 2 is (p1, p2, q1, q2) in millimetres; of Table 3 two samples are printed."
        " Numbers of stars and targets and the direction of the star camera's axis are not printed."
    )


def of_figure4(table: pd.DataFrame) -> str:
    """Size of our waves."""
    by_axis = table.groupby("axis", sort=False)["attitude_arcsec"]
    span_s = table["t_s"].max() - table["t_s"].min()
    return (
        f"The paper shows 24 s of attitude without values. Ours, over {span_s:.0f} s, have peaks of"
        f" {_range(by_axis.agg(lambda one: one.abs().max()), '.1f')}″; the last column is the noise of one"
        " exposure."
    )


def of_convergence(table: pd.DataFrame) -> str:
    """Whether X and Y become small, and Z as large as printed."""
    cells = [table[(table["sigma_s_px"] == s) & (table["sigma_c_px"] == c)] for s, c in FIGURES_5_6_Z_ARCSEC]
    frames = min(150, int(cells[0]["frames"].max()))
    last = [cell[cell["frames"] == frames].set_index("axis")["rms_arcsec"] for cell in cells]
    largest = max(float(one[axis]) for one in last for axis in "XY")
    z = [float(one["Z"]) for one in last]
    ratios = [value / paper for value, paper in zip(z, FIGURES_5_6_Z_ARCSEC.values())]
    is_near = largest < SMALL_ARCSEC and all(1 / WITHIN <= one <= WITHIN for one in ratios)
    return (
        f"{'Reproduced' if is_near else 'Not reproduced in every axis'}: after {frames} frames X and Y are at"
        f" most {largest:.4f}″ (the paper: tend to 0), and Z is {_list(z, '.4f')}″ where the text gives"
        f" {_list(FIGURES_5_6_Z_ARCSEC.values(), 'g')}″. Ours is the rms of all runs, the paper's one run."
    )


def of_grid(table: pd.DataFrame) -> str:
    """Our scatter beside the paper's, its mean of Z, and the bound."""
    ours = table[table["method"] == "information"]
    last = ours[ours["frames"] == ours["frames"].max()]
    _, rms, bounds = zip(*errors_of_axes(last))
    times = [one / paper for one, paper in zip(rms, FIGURE_7_SIGMA_ARCSEC)]
    z_away = abs(FIGURE_7_MEAN_ARCSEC[2]) / FIGURE_7_SIGMA_ARCSEC[2] * np.sqrt(len(FIGURE_7_CELLS))
    return (
        "The paper's scatter depends on a geometry that it does not print. With"
        f" {last['frames'].max()} frames ours is {_list(times, '.2f')} times the paper's in X, Y and Z, and"
        f" {_list([one / bound for one, bound in zip(rms, bounds)], '.2f')} of the bound. The paper's mean of"
        f" Z is {z_away:.1f} standard errors from zero"
        + (
            ", which an unbiased estimator with independent noise does not give."
            if z_away > FAR_SIGMAS
            else "."
        )
        + " Wang's method: beside the five cells of Table 4."
    )


def of_figure8(table: pd.DataFrame) -> str:
    """What higher orders gain over each span."""
    texts = []
    for span, part in table.groupby("span_s", sort=False):
        rms = part.groupby(["axis", "order"])["residual_arcsec"].agg(rms_of).unstack()
        seventh, fifth = rms[7] / rms[5], rms[5] / rms[3]
        gain = "no gain, as the paper says" if (seventh > NO_GAIN).all() else "a gain in some axis"
        texts.append(
            f"Over {span:g} s order 7 leaves {_range(seventh, '.2f')} of the residual of order 5 ({gain}),"
            f" and order 5 {_range(fifth, '.2f')} of that of order 3."
        )
    return " ".join(texts)


def of_table4(table: pd.DataFrame) -> str:
    """Error over bound, and Wang's errors beside the printed ones."""
    rms = {
        (method, axis): rms_of(part["rms_arcsec"])
        for (method, axis), part in table.groupby(["method", "axis"])
    }
    own = table[table["method"] == "information"].groupby("axis")
    over = [rms["information", a] / rms_of(part["bound_arcsec"]) for a, part in own]
    wang = [paper / rms["wang", axis] for axis, paper in zip(AXES, TABLE_4_RMS_ARCSEC["wang"])]
    own_times = [rms["information", axis] / paper for axis, paper in zip(AXES, TABLE_4_RMS_ARCSEC["paper"])]
    return (
        f"Our error is {_range(over, '.2f')} of the bound, and {_list(own_times, '.2f')} of the paper's in X,"
        f" Y and Z. Wang's errors, as printed, are {_list(wang, '.1f')} times those of his method here"
        + ("." if all(1 / WITHIN <= one <= WITHIN for one in wang) else "; why is not printed.")
        + " Values are rms over the five rows;"
        " paper: its method for the first three rows, its Wang for the others."
    )


def of_table5(table: pd.DataFrame) -> str:
    """Distance from the floor, and what Wang's matrix costs on the ground."""
    ours, wang = (table[table["method"] == name] for name in ("information", "wang"))
    above = np.sqrt(np.mean(ours["rms_m"] ** 2)) - np.sqrt(np.mean(ours["floor_m"] ** 2))
    cost = float(wang["rms_m"].mean() - ours["rms_m"].mean())
    return (
        f"Ours is {above:+.2f} m from the floor, which is the error of everything but attitude and matrix."
        f" With Wang's matrix it changes by {cost:+.2f} m in the mean of all rows; the paper prints"
        f" {GAIN_M:+.2f} m. Errors of GPS of each strip are in both."
    )


def of_readings(table: pd.DataFrame) -> str:
    """The gain over Wang of single images, and whether his printed errors are reached."""
    keys = ["axis", "gps", "attitude", "sigma_s_px", "direction"]
    ours = table[table["method"] == "ours"].set_index(keys)["rms_m"]
    third = table[(table["method"] == "wang") & (table["order"] == 3)].set_index(keys)["rms_m"]
    gain = 100.0 * (third / ours - 1.0)
    rows = [
        (s, n, name) for s in sorted(set(table["sigma_s_px"])) for n, name in ((0, "along"), (2, "across"))
    ]
    reached = sum(third.xs((s, name), level=(3, 4)).max() >= TABLE_5[s][n] for s, n, name in rows)
    return (
        f"Wang's error exceeds ours by {_range(gain, '.0f')} %, by more than the paper's 20 % in"
        f" {int((gain > 20.0).sum())} of {len(gain)} cases; his printed values are reached in {reached} of"
        f" {len(rows)} rows. Ranges are over GPS error, attitude and axis of the star camera; Wang: order 3."
    )


def of_geometry(table: pd.DataFrame) -> str:
    """Which of the paper's figures some geometry gives."""
    best = table.groupby("goal")["misfit"].min()
    told = {
        goal: f"{'fits' if best[goal] <= FITS else 'does not fit'} ({best[goal]:.2f})" for goal in best.index
    }
    return (
        f"Best direction of the star camera's axis: Fig. 7 alone {told['figure7']}, Table 4 alone"
        f" {told['table4']}, both {told['both']}."
        f" In brackets the misfit, the largest ratio to the paper; up to {FITS:g} is a fit."
        " Few: at most 400 frames of 60 stars and 20 targets."
    )


def _range(values: Iterable[float], form: str) -> str:
    """From the least to the greatest; one number where both print alike."""
    known = list(values)
    low, high = f"{min(known):{form}}", f"{max(known):{form}}"
    return low if low == high else f"{low} to {high}"


def _list(values: Iterable[float], form: str) -> str:
    *first, last = (f"{value:{form}}" for value in values)
    return f"{', '.join(first)} and {last}"


# What stands above the table of an experiment, by its name.
CAPTIONS: dict[str, Callable[[pd.DataFrame], str]] = {
    "inputs": of_inputs,
    "figure4": of_figure4,
    "convergence": of_convergence,
    "grid": of_grid,
    "figure8": of_figure8,
    "table4": of_table4,
    "table5": of_table5,
    "readings": of_readings,
    "geometry": of_geometry,
}
