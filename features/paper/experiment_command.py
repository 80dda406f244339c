"""`boresight experiment`: a simulation of the paper, its printed values beside ours."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import typer

from boresight.features.paper.comparison import COMPARISONS
from boresight.features.paper.paper_page import run_all
from boresight.features.paper.pixels import PixelSettings
from boresight.features.paper.tables import EXPERIMENTS, FROM_PIXELS, run_experiment
from boresight.features.paper.vector_experiments import ExperimentSettings
from boresight.pipeline.console.arguments import argument, option
from boresight.pipeline.console.messages import Answer, wrong_usage
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.report.page_template import template

__all__ = ["experiment_command"]


def _experiments(context: typer.Context, incomplete: str) -> list[str]:
    """Names of experiments; after --pixels those that can be run from rendered images."""
    return [name for name in _known(context.params.get("pixels")) if name.startswith(incomplete)]


def experiment_command(
    name: str = argument(f"{', '.join(EXPERIMENTS)}; or all.", autocompletion=_experiments),
    out: Path = option("Folder for NAME.csv, .png and .txt; all: also paper.html.", ...),
    runs: int | None = option("Runs per cell; default 200 (Wang 40, table5 20, pixels 2 or 20).", min=1),
    seed: int = option("Seed of all random numbers.", 2020, min=0),
    pixels: bool = option("From rendered images: grid, table4.", False, "--pixels"),
) -> Answer:
    """Run a simulation of the paper from scratch, with its printed values beside ours.

    Example: boresight experiment geometry --out paper
    """
    known = _known(pixels)
    if name not in known:
        raise wrong_usage(f"there is no experiment {name!r} of this kind, only {', '.join(known)}")
    chosen = ExperimentSettings(seed=seed)
    if runs is not None:
        chosen = replace(chosen, runs=runs, wang_runs=runs, table5_runs=runs)
    rendered = PixelSettings(seed=seed, runs=runs or 2, table4_runs=runs or 20)
    with progress_bars() as told:
        if name == "all":
            tables, page = run_all(out, chosen, template("experiments.html.j2"), told)
            return Answer(text=f"all: {len(tables)} experiments -> {page}")
        table, written = run_experiment(name, out, rendered if pixels else chosen, partial(told, name))
    lines = COMPARISONS[f"{name}-pixels" if pixels else name](table)
    files = ", ".join(str(path) for path in written)
    return Answer(text="\n".join([*lines, f"{name}: {len(table)} rows -> {files}"]))


def _known(pixels: bool | None) -> tuple[str, ...]:
    return FROM_PIXELS if pixels else (*EXPERIMENTS, "all")
