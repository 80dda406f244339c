"""`boresight experiment NAME`: a simulation of the paper from scratch, as long-form CSV, plot and record.

The simulations are in `vector_experiments`, `geometry_search` and `pixels`; stars of Table 4 are those of
Hipparcos.
"""

from __future__ import annotations

import datetime
import os
import platform
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import scipy
from scipy.spatial.transform import Rotation

from boresight.accepted import no_progress
from boresight.features.paper.comparison import COMPARISONS
from boresight.features.paper.geometry_search import geometry_map
from boresight.features.paper.inputs import inputs
from boresight.features.paper.pixels import PixelSettings, grid_from_pixels, table4_from_pixels
from boresight.features.paper.plots import PLOTS
from boresight.features.paper.vector_experiments import (
    ExperimentSettings,
    Progress,
    convergence_of_runs,
    figure4,
    figure8,
    grid,
    table4,
    table5,
    table5_readings,
)
from boresight.geometry.geodesy import unit_vectors
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_text
from boresight.records.record import Floats
from boresight.simulator.campaign import CameraPair
from boresight.star_id.catalogue import hipparcos_stars
from boresight.version import version_text

__all__ = ["EXPERIMENTS", "FROM_PIXELS", "hipparcos_fields", "record_head", "run_experiment"]

FAINTEST_V = 6.5  # about 55 stars in the field (docs/notes/paper.md)

# In the order in which the command runs them; the paper's figures and tables by name.
EXPERIMENTS = tuple("inputs figure4 convergence grid figure8 table4 table5 readings geometry".split())
FROM_PIXELS = ("grid", "table4")  # of them: those that can be run through rendered images


def run_experiment(
    name: str, out: Path, settings: ExperimentSettings | PixelSettings, progress: Progress = no_progress
) -> tuple[pd.DataFrame, list[Path]]:
    """Run one of `EXPERIMENTS`, with `PixelSettings` one of `FROM_PIXELS` through rendered images; its table,
    and the files written into `out`: `NAME.csv`, `NAME.png` and `NAME.txt`, or those of `NAME-pixels`.

    The text holds the paper's values beside ours, and commit, date, machine, versions, command and CPU time.
    """
    begin = time.process_time()
    table = _experiment_table(name, settings, progress)
    cpu_s, file = time.process_time() - begin, f"{name}{'-pixels' * isinstance(settings, PixelSettings)}"
    out.mkdir(parents=True, exist_ok=True)
    written = [out / f"{file}.{kind}" for kind in ("csv", "png", "txt")]
    write_text(written[0], table_csv(table, "%.6g"))
    PLOTS[file](table).savefig(written[1], dpi=160)
    lines = [*record_head(file, cpu_s), *COMPARISONS[file](table)]
    written[2].write_text("\n".join(lines) + "\n", encoding="utf-8")
    return table, written


def _experiment_table(
    name: str, settings: ExperimentSettings | PixelSettings, progress: Progress
) -> pd.DataFrame:
    if isinstance(settings, PixelSettings):
        return {"grid": grid_from_pixels, "table4": table4_from_pixels}[name](settings, progress)
    if name == "table4":
        return table4(settings, hipparcos_fields(settings.cameras, 400, settings.seed), progress)
    if name in ("grid", "table5", "readings"):
        return {"grid": grid, "table5": table5, "readings": table5_readings}[name](settings, progress)
    if name == "inputs":
        return inputs(settings.cameras, settings.seed, settings.inputs_strips)
    if name == "geometry":
        return geometry_map(settings.cameras, settings.search)
    return {"convergence": convergence_of_runs, "figure4": figure4, "figure8": figure8}[name](settings)


def hipparcos_fields(cameras: CameraPair, fields: int, seed: int) -> list[Floats]:
    """Directions (n, 3) in frame s of the Hipparcos stars in the star camera's field, pointed at random."""
    stars = hipparcos_stars(FAINTEST_V)
    places = stars.places.take(stars.usable_for_calibration)
    u_i = unit_vectors(places.ra_rad, places.dec_rad)
    half_x = cameras.star_half_width_px * cameras.star_pixel_rad
    half_y = cameras.star_half_height_px * cameras.star_pixel_rad
    found = []
    for R_si in Rotation.random(fields, rng=np.random.default_rng(seed)):
        u_s = R_si.apply(u_i)
        x, y, z = u_s.T
        found.append(u_s[(z > 0.0) & (np.abs(x) <= half_x * z) & (np.abs(y) <= half_y * z)])
    return found


def record_head(name: str, cpu_s: float) -> list[str]:
    """Lines that say what made a record of the experiment `name`, when, on what, and in which CPU time."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu = next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return [
        f"experiment {name}",
        f"commit    {version_text()}",
        f"date      {datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M} UTC",
        f"machine   {cpu}, {os.cpu_count()} cores, {platform.system()}",
        f"versions  Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}",
        f"command   boresight {' '.join(sys.argv[1:])}",
        f"CPU       {cpu_s:.0f} s",
        "",
    ]
