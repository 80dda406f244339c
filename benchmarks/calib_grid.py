"""The paper's grid (Figs. 7 and 9) at vector level: error against the Cramér-Rao bound, cell by cell and
pooled.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/calib_grid.py [runs]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from record import band_of_mean_nees, exit_status, head, verdict
from scipy.stats import chi2, norm

from boresight.features.paper.tables import run_experiment
from boresight.features.paper.vector_experiments import ExperimentSettings

OUT = Path(__file__).parents[1] / "build" / "experiments"  # the records of them are of `boresight experiment`


def report(table: pd.DataFrame) -> None:
    ours = table[table["method"] == "information"].copy()
    ours["ratio"] = ours["rms_arcsec"] / ours["bound_arcsec"]
    runs = int(ours["runs"].iloc[0])
    low, high = np.sqrt(chi2(df=runs).ppf([0.0005, 0.9995]) / runs)
    for frames, part in ours.groupby("frames"):
        for axis, cells in part.groupby("axis"):
            pooled = float(np.sqrt(np.mean(cells["ratio"] ** 2)))
            inside = int(cells["ratio"].between(low, high).sum())
            text = f"{frames} frames, {axis}: rms / bound pooled over {len(cells)} cells {pooled:.4f}"
            verdict(f"{text} (0.98 to 1.02)", 0.98 <= pooled <= 1.02)
            wanted = f"of {len(cells)} cells inside their own 99.9 % band ({low:.3f} to {high:.3f})"
            print(
                f"       {inside} {wanted}; least {cells['ratio'].min():.3f}, most {cells['ratio'].max():.3f}"
            )
    pulls = ours["mean_arcsec"] / (ours["bound_arcsec"] / np.sqrt(runs))
    beyond = int((np.abs(pulls) > 3).sum())
    expected = 2 * norm.sf(3) * len(pulls)
    verdict(
        f"{beyond} of {len(pulls)} means beyond 3 standard errors of 0 ({expected:.1f} expected by chance)",
        beyond <= 4,
    )
    by_axis = ours.groupby("axis")["mean_arcsec"].mean()
    print(
        "       mean error over the grid "
        + ", ".join(f"{a} {m:+.5f}" for a, m in by_axis.items())
        + " arcsec"
    )
    print("       (the paper: X -0.0018, Y -0.0001, Z -0.2602)")
    cells = ours[ours["axis"] == "X"]
    band = band_of_mean_nees(runs)
    inside = int(cells["nees"].between(*band).sum())
    print(f"       {inside} of {len(cells)} cells with mean NEES inside {band[0]:.2f} to {band[1]:.2f}")
    band = band_of_mean_nees(runs * len(cells))
    pooled = float(cells["nees"].mean())
    verdict(
        f"NEES pooled {pooled:.4f}, 99.9 % band {band[0]:.4f} to {band[1]:.4f}", band[0] < pooled < band[1]
    )
    wang = (
        table[table["method"] == "wang"].groupby("axis")["rms_arcsec"].apply(lambda x: np.sqrt(np.mean(x**2)))
    )
    print(
        "       Wang's way, seven strips, rms over the grid: "
        + ", ".join(f"{a} {r:.3f}" for a, r in wang.items())
        + " arcsec"
    )


if __name__ == "__main__":
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    settings = ExperimentSettings(runs=runs, wang_runs=max(runs // 5, 2))
    head(f"calib: the grid of Fig. 7, {runs} runs a cell, 150 and 400 frames of 30 stars and 10 targets")
    table, _ = run_experiment("grid", OUT, settings)
    report(table)
    raise SystemExit(exit_status())
