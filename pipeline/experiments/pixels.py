"""The grid and table 5 through rendered images: raw pixels of the mini scenario, all the way to the matrix.

The noise of both cameras' detectors is what is varied; the sigmas in the tables are those that the
sightings state, since from pixels they are a result and no setting. Every mission is rendered, calibrated
and held against its truth in a folder of its own, which is removed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.experiments.paper_tables import TABLE_5
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.results.folder import begin_result, read_result, store_of, write_result
from boresight.pipeline.results.validate import Validation, validate
from boresight.pipeline.settings import Settings
from boresight.pipeline.stages.calibrate import Calibration, calibrate_dump
from boresight.pipeline.work.executor import InOrder

__all__ = ["PixelRuns", "PixelSettings", "grid_from_pixels", "run_missions", "table5_from_pixels"]

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class PixelSettings:
    """A reduced grid: detector noise of both cameras, in grey values."""

    star_noise_dn: tuple[float, ...] = (2.0, 6.0)
    strip_noise_dn: tuple[float, ...] = (0.8, 6.0)
    runs: int = 2
    seed: int = 2020


@dataclass(frozen=True, slots=True, eq=False)
class PixelRuns:
    """What one cell of the grid gave: R missions."""

    sigma_s_px: float
    sigma_c_px: float
    errors: Array  # (R, 3) rad
    covariances: Array  # (R, 3, 3) rad²
    along_m: Array  # all check points of all missions
    across_m: Array


def grid_from_pixels(settings: PixelSettings, progress: Progress | None = None) -> pd.DataFrame:
    """The grid's long form, method "pixels"."""
    rows = []
    for cell in run_missions(settings, progress):
        off = cell.errors / ARCSEC
        sigma2 = np.diagonal(cell.covariances, axis1=1, axis2=2)
        nees = np.mean(np.einsum("ra,rab,rb->r", cell.errors, np.linalg.inv(cell.covariances), cell.errors))
        for axis in range(3):
            rms, mean = np.sqrt(np.mean(off[:, axis] ** 2)), off[:, axis].mean()
            bound = np.sqrt(sigma2[:, axis].mean()) / ARCSEC
            head = (cell.sigma_s_px, cell.sigma_c_px, "pixels", "XYZ"[axis])
            rows.append((*head, rms, mean, bound, nees, settings.runs, np.nan))
    columns = ["sigma_s_px", "sigma_c_px", "method", "axis", "rms_arcsec", "mean_arcsec", "bound_arcsec"]
    return pd.DataFrame(rows, columns=[*columns, "nees", "runs", "paper_arcsec"])


def table5_from_pixels(settings: PixelSettings, progress: Progress | None = None) -> pd.DataFrame:
    """Table 5's long form, method "pixels", at the mission's own check points.

    The floor is unknown here (NaN), and the paper's figure is that of its row nearest in sigma_s: a camera
    pair of another size, given for orientation.
    """
    rows = []
    for cell in run_missions(settings, progress):
        paper = TABLE_5[min(TABLE_5, key=lambda s: abs(s - cell.sigma_s_px))]
        for direction, off, own in (("along", cell.along_m, paper[1]), ("across", cell.across_m, paper[3])):
            rms = float(np.sqrt(np.mean(off**2)))
            head = (cell.sigma_c_px, cell.sigma_s_px, "pixels", direction)
            rows.append((*head, rms, np.nan, own, settings.runs))
    columns = ["sigma_c_px", "sigma_s_px", "method", "direction", "rms_m", "floor_m", "paper_m", "runs"]
    return pd.DataFrame(rows, columns=columns)


def run_missions(settings: PixelSettings, progress: Progress | None = None) -> list[PixelRuns]:
    """Render, calibrate and validate every cell of the reduced grid."""
    cells = [(s, c) for s in settings.star_noise_dn for c in settings.strip_noise_dn]
    found = []
    for n, (star_noise, strip_noise) in enumerate(cells):
        missions = []
        for run in range(settings.runs):
            missions.append(_mission(star_noise, strip_noise, settings.seed + run))
            if progress:
                progress(n * settings.runs + run + 1, len(cells) * settings.runs)
        sigmas, validations = zip(*missions)
        sigma_s, sigma_c = np.mean(sigmas, axis=0)
        found.append(
            PixelRuns(
                float(sigma_s),
                float(sigma_c),
                np.array([v.error_rad for v, _ in validations]),
                np.array([covariance for _, covariance in validations]),
                np.concatenate([v.after.along_m for v, _ in validations]),
                np.concatenate([v.after.across_m for v, _ in validations]),
            )
        )
    return found


def _mission(
    star_noise_dn: float, strip_noise_dn: float, seed: int
) -> tuple[tuple[float, float], tuple[Validation, Array]]:
    changes = [f"sky.read_noise_dn={star_noise_dn}", f"ground.read_noise_dn={strip_noise_dn}"]
    with tempfile.TemporaryDirectory(prefix="boresight-") as folder:
        dump_folder, result = Path(folder) / "dump", Path(folder) / "result"
        write_dump(
            fly(named_scenario("mini", changes), seed),
            dump_folder,
            created_by="boresight experiment --pixels",
        )
        dump = open_dump(dump_folder)
        begin_result(result)
        calibration = calibrate_dump(dump, Settings(), store_of(result), InOrder())
        write_result(result, calibration, Settings())
        held = validate(read_result(result), dump)
    return _sigmas_px(calibration, dump), (held, calibration.estimate.cov_theta)


def _sigmas_px(calibration: Calibration, dump: Dump) -> tuple[float, float]:
    """Root mean square of what the sightings state, per axis, in pixels of either camera."""
    stars = np.concatenate([np.trace(s.cov_s, axis1=1, axis2=2) for s in calibration.stars])
    targets = np.concatenate([np.trace(s.ground.cov_c, axis1=1, axis2=2) for s in calibration.strips])
    star_pixel = dump.star_camera.pixel_m / dump.star_camera.focal_m
    pixel = dump.line_camera.ccds[0].pixel_m / dump.line_camera.focal_m
    return float(np.sqrt(0.5 * stars.mean()) / star_pixel), float(np.sqrt(0.5 * targets.mean()) / pixel)
