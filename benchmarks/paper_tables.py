"""The paper's equations, and its table 4 and figures 7 and 9 at the level of vectors: error over bound.

    python benchmarks/paper_tables.py [--runs 12]

Equations are those of `tests/features/paper/equations.py`, each against its literal form or an authority.
The tables are those of `boresight experiment table4` and `grid`: 30 stars and 10 targets a frame.
The records that docs/notes/paper.md quotes (`table4.txt`, `figure8.txt` and others) are written by
`boresight experiment all --out benchmarks/results`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from record import ROOT, arguments_of, exit_status, head, judge_largest, verdict
from scipy.stats import chi2, norm

sys.path.insert(0, str(ROOT / "tests"))
sys.path.insert(0, str(ROOT / "tests" / "geometry"))
sys.path.insert(0, str(ROOT / "tests" / "features" / "paper"))

from equations import GROUPS

from boresight.features.paper.tables import run_experiment
from boresight.features.paper.vector_experiments import ExperimentSettings


def shown(number: str, what: str, difference: float, limit: float, unit: str = "") -> None:
    """Verdict on one equation."""
    judge_largest(f"equation ({number}), {what}:", difference, limit, unit.strip())


def grid(table: pd.DataFrame, name: str) -> None:
    """Errors of all cells over their bounds, pooled, and their means."""
    ours = table[table["method"] == "information"].copy()
    ours["ratio"] = ours["rms_arcsec"] / ours["bound_arcsec"]
    runs = int(ours["runs"].iloc[0])
    for (frames, axis), cells in ours.groupby(["frames", "axis"]):
        pooled, n = float(np.sqrt(np.mean(cells["ratio"] ** 2))), runs * len(cells)
        low, high = np.sqrt(chi2(n).ppf([0.0005, 0.9995]) / n)
        text = f"{name}, {frames} frames, {axis}: rms over bound {pooled:.4f}"
        verdict(text, f"{low:.3f} to {high:.3f}", low <= pooled <= high, n)
    pulls = ours["mean_arcsec"] / (ours["bound_arcsec"] / np.sqrt(runs))
    beyond, most = int((np.abs(pulls) > 3).sum()), 2 * norm.sf(3) * len(pulls)
    most += 3.3 * np.sqrt(most) + 1.0
    judge_largest(f"{name}: means beyond 3 standard errors of 0:", beyond, round(most), "", len(pulls))


def main() -> int:
    runs = arguments_of(__doc__, ("--runs", 12, "of each cell")).runs
    head("The paper's equations and tables")
    for seed, group in enumerate(GROUPS, start=1):
        group(np.random.default_rng(seed), shown)
    settings = ExperimentSettings(runs=runs, wang_runs=2)
    with tempfile.TemporaryDirectory() as folder:
        for name in ("table4", "grid"):
            grid(run_experiment(name, Path(folder), settings)[0], name)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
