"""One HTML page of all experiments: the paper's printed figures beside ours and the bound, with verdicts."""

from __future__ import annotations

import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import jinja2
import numpy as np
import pandas as pd

from boresight.features.paper.comparison import COMPARISONS, errors_of_axes, rms_of
from boresight.features.paper.paper_captions import (
    CAPTIONS,
    FAR_SIGMAS,
    FITS,
    NEAR_INPUT,
    NO_GAIN,
    SMALL_ARCSEC,
    WITHIN,
)
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
from boresight.geometry.record import record, scalar
from boresight.pipeline.files.whole_file import write_text

__all__ = ["run_all", "verdict_of"]

NamedProgress = Callable[[str, int, int], None]  # experiment, done, in all
Row = tuple[str, ...]  # cells of a line of a table; the first is its head, the last the verdict

AXES = ("X", "Y", "Z")  # of frame c
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
