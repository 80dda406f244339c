"""`boresight drift`: several results merged, and whether the mounting moved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.drift.drift_files import write_drift
from boresight.features.drift.matrix_drift import DriftSettings
from boresight.features.drift.mounting_drift import drift_json, drift_of_results, drift_summary, named_results
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.pipeline.console.messages import Answer

__all__ = ["drift_command"]


def drift_command(
    results: Annotated[
        list[Path], typer.Argument(metavar="RESULT", help="Folders that `calibrate` wrote, in any order.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for drift.json, drift.csv and drift.png.")],
    density: Annotated[
        float | None,
        typer.Option(help="Random walk of the mounting, arcsec per root day; default: estimated.", min=0.0),
    ] = None,
    false_alarm: Annotated[
        float,
        typer.Option(help="Probability that a mounting at rest is called moved.", min=1e-9, max=0.5),
    ] = 0.01,
    orbit_phase: Annotated[
        bool, typer.Option("--orbit-phase", help="Fit a term of the argument of latitude (thermal change).")
    ] = False,
) -> Answer:
    """Merge several results into one matrix, and test whether, how and when the mounting has moved.

    Example: boresight drift results/* --out drift
    """
    settings = DriftSettings(
        probability_false_alarm=false_alarm,
        density_rad2_s=None if density is None else (density * ARCSEC) ** 2 / DAY_S,
        orbit_phase=orbit_phase,
    )
    found = drift_of_results(named_results(results), settings)
    files = tuple(write_drift(found, out))
    text = f"{drift_summary(found)}\n-> {', '.join(str(path) for path in files)}"
    return Answer(text=text, content=drift_json(found), files=files)
