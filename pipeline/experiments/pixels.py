"""The grid and Table 5 from rendered images: raw pixels of the mini scenario through the whole calibration.

The detector noise of both cameras is varied; the sigmas in the tables are those stated by the measurements.
Every mission is rendered, calibrated and compared with its truth in a temporary folder.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from boresight.geometry.constants import ARCSEC
from boresight.geometry.record import Floats, array, record, scalar
from boresight.pipeline.experiments.paper_tables import TABLE_5
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.results.folder import begin_result, store_of
from boresight.pipeline.results.reading import read_result
from boresight.pipeline.results.validate import Validation, validate
from boresight.pipeline.results.writing import write_result
from boresight.pipeline.settings import Settings
from boresight.pipeline.stages.calibrate import Calibration, calibrate_dump
from boresight.pipeline.work.executor import InOrder

__all__ = ["PixelRuns", "PixelSettings", "grid_from_pixels", "run_missions", "table5_from_pixels"]

Progress = Callable[[int, int], None]


@record
class PixelSettings:
    """A reduced grid of detector noise."""

    star_noise_dn: tuple[float, ...] = scalar("read noise of the star camera, DN", default=(2.0, 6.0))
    strip_noise_dn: tuple[float, ...] = scalar(
        "read noise of the remote-sensing camera, DN", default=(0.8, 6.0)
    )
    runs: int = scalar("missions per cell", default=2)
    seed: int = scalar("seed of the first mission", default=2020)


@record(kw_only=True)
class PixelRuns:
    """Results of R missions of one cell with N check points."""

    sigma_s_px: float = scalar("stated 1-sigma of stars per axis, px")
    sigma_c_px: float = scalar("stated 1-sigma of targets per axis, px")
    errors: Floats = array("R, 3", "theta minus truth, rad, axes of c")
    covariances: Floats = array("R, 3, 3", "stated covariance of theta, rad²")
    along_m: Floats = array("N", "error of check points along the track, m")
    across_m: Floats = array("N", "and across, m")


def grid_from_pixels(settings: PixelSettings, progress: Progress | None = None) -> pd.DataFrame:
    """Long-form table of the grid, method "pixels"; the paper prints no value for this camera pair."""
    rows = []
    for cell in run_missions(settings, progress):
        off = cell.errors / ARCSEC
        sigma2 = np.diagonal(cell.covariances, axis1=1, axis2=2)
        nees = np.mean(np.einsum("ra,rab,rb->r", cell.errors, np.linalg.inv(cell.covariances), cell.errors))
        for axis in range(3):
            rms, mean = np.sqrt(np.mean(off[:, axis] ** 2)), off[:, axis].mean()
            bound = np.sqrt(sigma2[:, axis].mean()) / ARCSEC
            head = (cell.sigma_s_px, cell.sigma_c_px, "pixels", "XYZ"[axis])
            rows.append((*head, rms, mean, bound, nees, settings.runs))
    columns = ["sigma_s_px", "sigma_c_px", "method", "axis", "rms_arcsec", "mean_arcsec", "bound_arcsec"]
    return pd.DataFrame(rows, columns=[*columns, "nees", "runs"])


def table5_from_pixels(settings: PixelSettings, progress: Progress | None = None) -> pd.DataFrame:
    """Long-form table of Table 5, method "pixels", at the check points of the missions.

    `paper_m` is the paper's row nearest in sigma_s, of a larger camera pair; no floor is known.
    """
    rows = []
    for cell in run_missions(settings, progress):
        paper = TABLE_5[min(TABLE_5, key=lambda s: abs(s - cell.sigma_s_px))]
        for direction, off, own in (("along", cell.along_m, paper[1]), ("across", cell.across_m, paper[3])):
            rms = float(np.sqrt(np.mean(off**2)))
            head = (cell.sigma_c_px, cell.sigma_s_px, "pixels", direction)
            rows.append((*head, rms, own, settings.runs))
    columns = ["sigma_c_px", "sigma_s_px", "method", "direction", "rms_m", "paper_m", "runs"]
    return pd.DataFrame(rows, columns=columns)


def run_missions(settings: PixelSettings, progress: Progress | None = None) -> list[PixelRuns]:
    """Results of all cells of the reduced grid, rendered, calibrated and compared with the truth."""
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
                sigma_s_px=float(sigma_s),
                sigma_c_px=float(sigma_c),
                errors=np.array([v.error_rad for v, _ in validations]),
                covariances=np.array([covariance for _, covariance in validations]),
                along_m=np.concatenate([v.after.along_m for v, _ in validations]),
                across_m=np.concatenate([v.after.across_m for v, _ in validations]),
            )
        )
    return found


def _mission(
    star_noise_dn: float, strip_noise_dn: float, seed: int
) -> tuple[tuple[float, float], tuple[Validation, Floats]]:
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
        compared = validate(read_result(result), dump)
    return _sigmas_px(calibration, dump), (compared, calibration.estimate.cov_theta)


def _sigmas_px(calibration: Calibration, dump: Dump) -> tuple[float, float]:
    """Root mean square of the stated 1-sigma of stars and of targets per axis, px."""
    stars = np.concatenate([np.trace(s.cov_s, axis1=1, axis2=2) for s in calibration.stars])
    targets = np.concatenate([np.trace(s.ground.cov_c, axis1=1, axis2=2) for s in calibration.strips])
    star_pixel = dump.star_camera.pixel_m / dump.star_camera.focal_m
    pixel = dump.line_camera.ccds[0].pixel_m / dump.line_camera.focal_m
    return float(np.sqrt(0.5 * stars.mean()) / star_pixel), float(np.sqrt(0.5 * targets.mean()) / pixel)
