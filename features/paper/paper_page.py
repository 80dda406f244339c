"""One HTML page of all experiments: the paper's printed figures beside ours and the bound, with verdicts.

Every number and judgement of a caption is computed from its table; a sentence without a number of ours states
what the paper prints or leaves out.
"""

from __future__ import annotations

import time
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import jinja2
import numpy as np
import pandas as pd

from boresight.features.paper.comparison import COMPARISONS, GAIN_M, errors_of_axes, rms_of
from boresight.features.paper.paper_tables import (
    FIGURE_7_CELLS,
    FIGURE_7_MEAN_ARCSEC,
    FIGURE_7_SIGMA_ARCSEC,
    FIGURES_5_6_Z_ARCSEC,
    TABLE_4_RMS_ARCSEC,
    TABLE_5,
)
from boresight.features.paper.tables import EXPERIMENTS, record_head, run_experiment
from boresight.features.paper.vector_experiments import ExperimentSettings
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.report.panels import AXES
from boresight.records.record import record, scalar

__all__ = ["CAPTIONS", "run_all", "verdict_of"]

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


NamedProgress = Callable[[str, int, int], None]  # experiment, done, in all
Row = tuple[str, ...]  # cells of a line of a table; the first is its head, the last the verdict

NONE = "not printed"  # what a cell says where the paper gives no number


@record(kw_only=True)
class Section:
    """One experiment as the page shows it."""

    name: str = scalar("name for the command line")
    title: str = scalar("what of the paper it repeats")
    caption: str = scalar("what reproduces, what is better, what does not hold")
    head: Row = scalar("names of the columns")
    rows: list[Row] = scalar("lines of the table")
    picture: str = scalar("figure as data URI")
    details: str = scalar("the whole comparison as text")


def run_all(
    out: Path,
    settings: ExperimentSettings,
    template: jinja2.Template,
    progress: NamedProgress = lambda name, done, total: None,
) -> tuple[dict[str, pd.DataFrame], Path]:
    """Run all `EXPERIMENTS` into `out` and write `paper.html` there; tables by name, and the page's path.

    The page is `template`, that of the report's `experiments.html.j2`; it holds figures and tables itself and
    needs no other file.
    """
    begin, tables, sections = time.process_time(), {}, []
    for name in EXPERIMENTS:
        tables[name], written = run_experiment(name, out, settings, partial(progress, name))
        title, head, rows = SECTIONS[name]
        sections.append(
            Section(
                name=name,
                title=title,
                caption=CAPTIONS[name](tables[name]),
                head=head,
                rows=list(rows(tables[name])),
                picture="data:image/png;base64," + b64encode(written[1].read_bytes()).decode("ascii"),
                details="\n".join(COMPARISONS[name](tables[name])),
            )
        )
    facts = [line.split(maxsplit=1) for line in record_head("all", time.process_time() - begin)[1:] if line]
    text = template.render(facts=facts, sections=sections, within_percent=f"{100 * (WITHIN - 1):.0f}")
    page = out / "paper.html"
    write_text(page, text)
    return tables, page


def verdict_of(ours: float, paper: float, *, smaller: str = "better") -> str:
    """Verdict on the error `ours` beside the paper's: reproduced (`WITHIN`), else how many times off."""
    ratio = abs(paper) / ours
    if 1 / WITHIN <= ratio <= WITHIN:
        return "reproduced"
    return f"{smaller}, {ratio:.1f} times" if ratio > 1.0 else f"larger, {1 / ratio:.1f} times"


def _inputs(table: pd.DataFrame) -> Iterator[Row]:
    for row in table[table["at"].isna()].to_dict("records"):
        expected = "–" if np.isnan(row["expected"]) else f"{row['expected']:.3f}"
        near = abs(row["ours"] - row["paper"]) <= NEAR_INPUT * abs(row["paper"])
        head = f"{row['source']}: {row['item']}, {row['unit']}"
        yield head, f"{row['paper']:g}", f"{row['ours']:.4g}", expected, "reproduced" if near else "differs"


def _figure4(table: pd.DataFrame) -> Iterator[Row]:
    for axis, part in table.groupby("axis", sort=False):
        rms, noise = rms_of(part["attitude_arcsec"]), part["sigma_arcsec"].iloc[0]
        yield f"{axis}", NONE, f"{rms:.2f}", f"{noise:.2f}", "not printed"


def _convergence(table: pd.DataFrame) -> Iterator[Row]:
    for (sigma_s, sigma_c), paper_z in FIGURES_5_6_Z_ARCSEC.items():
        cell = table[(table["sigma_s_px"] == sigma_s) & (table["sigma_c_px"] == sigma_c)]
        frames = min(150, int(cell["frames"].max()))
        for row in cell[cell["frames"] == frames].to_dict("records"):
            rms, axis = row["rms_arcsec"], row["axis"]
            name = f"{axis}, σs {sigma_s:g}, σc {sigma_c:g} px, {frames} frames"
            near = "reproduced" if rms < SMALL_ARCSEC else f"larger than {SMALL_ARCSEC:g}″"
            verdict = verdict_of(rms, paper_z) if axis == "Z" else near
            paper = f"{paper_z:g}" if axis == "Z" else "“tends to 0”"
            yield name, paper, f"{rms:.4f}", f"{row['bound_arcsec']:.4f}", verdict


def _grid(table: pd.DataFrame) -> Iterator[Row]:
    ours = table[table["method"] == "information"]
    for frames, part in ours.groupby("frames"):
        for (axis, *errors), paper in zip(errors_of_axes(part), FIGURE_7_SIGMA_ARCSEC):
            yield f"Fig. 7, σ of {axis}, {frames} frames", *_beside(paper, *errors, smaller="smaller")
    last = ours[ours["frames"] == ours["frames"].max()]
    for n, axis in enumerate(AXES):
        mean, cells = FIGURE_7_MEAN_ARCSEC[n], last[last["axis"] == axis]
        away = abs(mean) / FIGURE_7_SIGMA_ARCSEC[n] * np.sqrt(len(FIGURE_7_CELLS))
        verdict = "contradicts itself" if away > FAR_SIGMAS else "reproduced"
        found = f"{cells['mean_arcsec'].mean():+.4f}"
        yield f"Fig. 7, mean of {axis}", f"{mean:+.4f}, {away:.1f} σ from 0", found, "0", verdict
    wang = errors_of_axes(table[table["method"] == "wang"])
    for (axis, *errors), paper in zip(wang, TABLE_4_RMS_ARCSEC["wang"]):
        yield f"Fig. 9, Wang in {axis}", *_beside(paper, *errors, smaller="smaller")


def _table4(table: pd.DataFrame) -> Iterator[Row]:
    names = {
        "information": ("paper", "paper's method, {} frames"),
        "wang": ("wang", "Wang's method, {} strips"),
        "strips": ("wang", "ours, the same {} strips"),
    }
    for method, (who, name) in names.items():
        part, smaller = table[table["method"] == method], "smaller" if method == "wang" else "better"
        said = name.format(int(part["frames"].iloc[0]))
        for (axis, *errors), paper in zip(errors_of_axes(part), TABLE_4_RMS_ARCSEC[who]):
            yield f"{axis}, {said}", *_beside(paper, *errors, smaller=smaller)


def _table5(table: pd.DataFrame) -> Iterator[Row]:
    ours, wang = (table[table["method"] == name] for name in ("information", "wang"))
    for row, theirs in zip(ours.to_dict("records"), wang.to_dict("records")):
        values = (row["paper_m"], row["rms_m"], theirs["paper_m"], theirs["rms_m"], row["floor_m"])
        head = f"{row['direction']}, σs {row['sigma_s_px']:.3f} px"
        yield head, *(f"{value:.2f}" for value in values), verdict_of(row["rms_m"], row["paper_m"])


def _readings(table: pd.DataFrame) -> Iterator[Row]:
    for n, direction in enumerate(("along", "across")):
        for sigma_s in sorted(set(table["sigma_s_px"])):
            part = table[(table["direction"] == direction) & (table["sigma_s_px"] == sigma_s)]
            paper_wang, paper = TABLE_5[sigma_s][2 * n : 2 * n + 2]
            ours = part[part["method"] == "ours"]["rms_m"].to_numpy()
            third = part[(part["method"] == "wang") & (part["order"] == 3)]["rms_m"].to_numpy()
            texts = (f"{values.min():.2f} to {values.max():.2f}" for values in (ours, third))
            reached = "reached" if third.max() >= paper_wang else "Wang's not reached"
            texts_of = (f"{paper:.2f}", next(texts), f"{paper_wang:.2f}", next(texts))
            yield f"{direction}, σs {sigma_s:g} px", *texts_of, reached


def _figure8(table: pd.DataFrame) -> Iterator[Row]:
    for (span, axis), part in table.groupby(["span_s", "axis"], sort=False):
        rms = [rms_of(part[part["order"] == order]["residual_arcsec"]) for order in (3, 5, 7)]
        verdict = "reproduced" if rms[2] > NO_GAIN * rms[1] else "gains"
        yield f"{axis}, {span:g} s", "no gain from 5 to 7", *(f"{value:.4f}" for value in rms), verdict


def _geometry(table: pd.DataFrame) -> Iterator[Row]:
    goals = {
        "figure7": "Fig. 7 alone",
        "table4": "Table 4 alone",
        "both": "both",
        "figure7-few": "Fig. 7, few",
        "table4-few": "Table 4, few",
    }
    for goal, name in goals.items():
        best = table[table["goal"] == goal].sort_values("misfit").iloc[0]
        fits = [
            ", ".join(f"{best[f'fit_{source}_{axis}']:.4f}" for axis in "xyz")
            for source in ("figure7", "table4")
        ]
        verdict = "fits" if best["misfit"] <= FITS else "no fit"
        yield name, *fits, f"{best['misfit']:.2f}", verdict
    printed = (FIGURE_7_SIGMA_ARCSEC, TABLE_4_RMS_ARCSEC["paper"])
    yield "paper", *(", ".join(f"{value:.4f}" for value in values) for values in printed), "–", ""


def _beside(paper: float, rms: float, bound: float, *, smaller: str) -> Row:
    return f"{paper:.4f}", f"{rms:.4f}", f"{bound:.4f}", verdict_of(rms, paper, smaller=smaller)


# Column headings of tables of angles, and of tables of errors on the ground.
ARCSEC_HEAD = ("", "paper, ″", "ours, ″", "bound, ″", "verdict")
GROUND_HEAD = ("", "paper, m", "ours, m", "Wang: paper", "ours")

# title, columns, rows
SECTIONS: dict[str, tuple[str, Row, Callable[[pd.DataFrame], Iterator[Row]]]] = {
    "inputs": ("Tables 1 to 3: inputs", ("", "paper", "ours", "arithmetic", "verdict"), _inputs),
    "figure4": (
        "Fig. 4: motion of the attitude",
        ("", "paper", "rms, ″", "one exposure, ″", "verdict"),
        _figure4,
    ),
    "convergence": ("Figs. 5 and 6: error against the number of frames", ARCSEC_HEAD, _convergence),
    "grid": ("Figs. 7 and 9: error over the grid of both cameras' noise", ARCSEC_HEAD, _grid),
    "figure8": (
        "Fig. 8: order of the polynomials in Wang's method",
        ("", "paper", "order 3, ″", "order 5, ″", "order 7, ″", "verdict"),
        _figure8,
    ),
    "table4": ("Table 4: error of the matrix", ARCSEC_HEAD, _table4),
    "table5": ("Table 5 and Fig. 10: geo-positioning", (*GROUND_HEAD, "floor, m", "verdict"), _table5),
    "readings": (
        "Table 5 as the text reads: Wang's matrix of each single image",
        (*GROUND_HEAD, "verdict"),
        _readings,
    ),
    "geometry": (
        "Geometries that give the paper's figures",
        ("", "Fig. 7 X, Y, Z, ″", "Table 4 X, Y, Z, ″", "misfit", "verdict"),
        _geometry,
    ),
}
