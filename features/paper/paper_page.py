"""One HTML page of all experiments: the figure of each, and the paper's printed values beside ours."""

from __future__ import annotations

import time
from base64 import b64encode
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jinja2
import pandas as pd

from boresight.features.paper.comparison import COMPARISONS
from boresight.features.paper.provenance import record_head
from boresight.features.paper.tables import EXPERIMENTS, run_experiment
from boresight.features.paper.vector_experiments import ExperimentSettings
from boresight.pipeline.files.whole_file import write_text

__all__ = ["run_all"]

NamedProgress = Callable[[str, int, int], None]  # experiment, done, in all
# What of the paper an experiment repeats, by its name.
TITLES = {
    "inputs": "Tables 1 to 3: inputs",
    "figure4": "Fig. 4: motion of the attitude",
    "convergence": "Figs. 5 and 6: error against the number of frames",
    "grid": "Figs. 7 and 9: error over the grid of both cameras' noise",
    "figure8": "Fig. 8: order of the polynomials in Wang's method",
    "table4": "Table 4: error of the matrix",
    "table5": "Table 5 and Fig. 10: geo-positioning",
    "readings": "Table 5 as the text reads: Wang's matrix of each single image",
    "geometry": "Geometries that give the paper's figures",
}


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
        picture = "data:image/png;base64," + b64encode(written[1].read_bytes()).decode("ascii")
        text = "\n".join(COMPARISONS[name](tables[name]))
        sections.append({"name": name, "title": TITLES[name], "picture": picture, "text": text})
    facts = [line.split(maxsplit=1) for line in record_head("all", time.process_time() - begin)[1:] if line]
    page = out / "paper.html"
    write_text(page, template.render(facts=facts, sections=sections))
    return tables, page
