"""The grid and Table 4 from rendered images: raw pixels of small cameras through calibration.

The cells of the grid and the rows of Table 4 are set by the star camera's read noise and by the survey errors
of the targets, since matching alone is far better than 0.3 px. The sigmas in the tables are those stated by
the measurements. Every mission is rendered, calibrated and compared with its truth in a temporary folder.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from boresight.accepted import no_progress
from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.features.paper.geometry_search import covariance_shapes, predicted_sigma
from boresight.features.paper.paper_tables import FIGURE_7_CELLS, FIGURE_7_SIGMA_ARCSEC, TABLE_4
from boresight.features.paper.vector_experiments import ExperimentSettings, Progress
from boresight.features.paper.wang import attitudes_of
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.results.folder import begin_result, store_of
from boresight.pipeline.results.reading import read_saved_result
from boresight.pipeline.results.validate import TruthErrors, validation_of
from boresight.pipeline.results.writing import write_result
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.records.record import Floats, record, scalar
from boresight.simulator.campaign import unit

__all__ = ["PixelSettings", "grid_from_pixels", "table4_from_pixels"]


# Changes of the mini scenario for the grid and Table 4: one strip of 1.1 s with a fourth of its pixels, eight
# exposures, and none of Table 1's errors, as in the paper. Stars far above the noise, so that sigma_s is low.
ONE_STRIP = (
    "line_camera.pixel_um=240.0",
    "line_camera.samples=256",
    "line_camera.principal_sample=127.0",
    "line_camera.overlap_px=12.0",
    "line_camera.distortion_um=[[2.0, 1077.2], [8.0, 866.3]]",
    "strips.count=1",
    "strips.lines=600",
    "strips.row_period_s=1.8e-3",
    "strips.exposure_lead_s=0.1",
    "targets.per_strip=20",
    "targets.chip_size_px=48",
    "targets.check_points_per_strip=1",
    "ground.parcel_m=440.0",
    "sky.flux_v0_e_per_s=6.0e7",
    "sky.bits=12",
    "errors.gps_m=0.0",
    "errors.vibration_arcsec=0.0",
    "errors.clock_s=0.0",
    "errors.distortion_px=0.0",
)
GROUND_PIXEL_M = 240e-6 / 10.0 * 530e3  # pixel pitch / focal length x height of the rendered camera
# Stars and targets of a frame where directions are drawn, not images: for Figure 7, for Table 4.
GRID_FRAME, TABLE_4_FRAME = (30, 10), (55, 20)
SIGMA_S_PX = (0.0091, 0.0332)  # mean stated sigma_s over the sky: first + second x read noise, px and px/DN


@record
class PixelSettings:
    """Numbers of missions."""

    runs: int = scalar("missions per cell of the grid", default=2)
    redraws: int = scalar("runs at the level of vectors per mission of the grid", default=20)
    table4_runs: int = scalar("missions per row of Table 4", default=20)
    seed: int = scalar("seed of the first mission", default=2020)


def grid_from_pixels(
    settings: PixelSettings,
    progress: Progress = no_progress,
    cells: Sequence[tuple[float, float]] = FIGURE_7_CELLS,
) -> pd.DataFrame:
    """Long-form table of the whole grid, methods "pixels" and "vectors": each mission has a sky, a ground and
    a seed of its own.

    `row_s_px` and `row_c_px` are the cell. "vectors" are the missions' stars and targets with new noise of
    the covariances that the measurements state: the same geometry without images. `paper_arcsec` is Fig. 7's
    standard deviation over the grid, `paper_bound_arcsec` the bound of cameras of that size.
    """
    table = _cells_from_pixels(cells, settings, (settings.runs, settings.redraws), progress)
    bound = _paper_bound(FIGURE_7_CELLS, GRID_FRAME)
    axes = table["axis"].map("XYZ".index)
    return table.assign(
        paper_arcsec=np.take(FIGURE_7_SIGMA_ARCSEC, axes), paper_bound_arcsec=np.take(bound, axes)
    )


def table4_from_pixels(
    settings: PixelSettings,
    progress: Progress = no_progress,
    rows: Sequence[tuple[float, float]] = tuple(TABLE_4),
) -> pd.DataFrame:
    """Long-form table of Table 4, method "pixels", made as the grid is.

    `paper_arcsec` is the size of the paper's single draw, of cameras with 5 and 24 times as many pixels, and
    `paper_bound_arcsec` the bound of those.
    """
    table = _cells_from_pixels(rows, settings, (settings.table4_runs, 0), progress)
    paper = np.concatenate([np.abs(TABLE_4[row][1]) for row in rows])
    bounds = np.concatenate([_paper_bound([row], TABLE_4_FRAME) for row in rows])
    return table.assign(paper_arcsec=paper, paper_bound_arcsec=bounds)


def _paper_bound(cells: Sequence[tuple[float, float]], frame: tuple[int, int]) -> Floats:
    """Bound (3,) of the paper's cameras over `cells`, arcsec, from 400 frames of (stars, targets)."""
    cameras, numbers = ExperimentSettings().cameras, (np.full(1, 400.0 * n) for n in frame)
    return predicted_sigma(cameras.R_cs, covariance_shapes(cameras), cells, *numbers)[0]


def _cells_from_pixels(
    cells: Sequence[tuple[float, float]],
    settings: PixelSettings,
    numbers: tuple[int, int],
    progress: Progress,
) -> pd.DataFrame:
    tables, (runs, redraws) = [], numbers
    for n, (sigma_s, sigma_c) in enumerate(cells):
        noise = (sigma_s - SIGMA_S_PX[0]) / SIGMA_S_PX[1]
        survey = [sigma_c * GROUND_PIXEL_M] * 3
        row = (*ONE_STRIP, f"sky.read_noise_dn={noise:.3f}", f"targets.sigma_m={survey}")
        first = settings.seed + n * runs
        missions = [
            ((*row, f"orbit.longitude_deg={360.0 * k / runs - 180.0}"), first + k) for k in range(runs)
        ]

        def finished(done: int, before: int = n * runs) -> None:
            progress(before + done, len(cells) * runs)

        tables += [
            table.assign(row_s_px=sigma_s, row_c_px=sigma_c) for table in _cell(missions, finished, redraws)
        ]
    return pd.concat(tables, ignore_index=True)


def _cell(
    missions: Sequence[tuple[Sequence[str], int]], finished: Callable[[int], None], redraws: int
) -> Iterator[pd.DataFrame]:
    """One row per axis of the results of missions, each given by its changes of the mini scenario and its
    seed; where vectors are redrawn, the same of those.
    """
    begin, sigmas_px, found, redrawn = time.process_time(), [], [], list[tuple[Floats, Floats]]()
    for n, (changes, seed) in enumerate(missions):
        sigmas, compared, calibration = _mission(changes, seed)
        sigmas_px.append(sigmas)
        found.append((compared.error_rad, calibration.estimate.cov_theta))
        redrawn += _redrawn_runs(calibration, redraws, np.random.default_rng(seed))
        finished(n + 1)
    sigma_s, sigma_c = np.sqrt(np.mean(np.square(sigmas_px), axis=0))
    cpu_s = time.process_time() - begin
    for method, results in (("pixels", found), ("vectors", redrawn)):
        if not results:
            continue
        errors, covariances = (np.array(part) for part in zip(*results))
        off, variance = errors / ARCSEC, np.diagonal(covariances, axis1=1, axis2=2)
        squares = np.einsum("ra,rab,rb->r", errors, np.linalg.inv(covariances), errors)
        yield pd.DataFrame(
            {
                "sigma_s_px": sigma_s,
                "sigma_c_px": sigma_c,
                "method": method,
                "axis": list("XYZ"),
                "rms_arcsec": np.sqrt(np.mean(off**2, axis=0)),
                "mean_arcsec": off.mean(axis=0),
                "bound_arcsec": np.sqrt(variance.mean(axis=0)) / ARCSEC,
                "mean_square": np.mean(errors**2 / variance, axis=0),  # in units of the stated variance
                "nees": squares.mean(),
                "runs": len(off),
                "cpu_s": cpu_s,
            }
        )


def _redrawn_runs(
    calibration: DumpCalibration, runs: int, rng: np.random.Generator
) -> Iterator[tuple[Floats, Floats]]:
    """Error of theta (3,), rad, and stated covariance (3, 3), rad², of `runs` calibrations of the same stars
    and targets with new noise.
    """
    R_cs = calibration.estimate.R_cs
    for _ in range(runs):
        strips = [_redrawn(strip, R_cs, rng) for strip in calibration.strips]
        estimate = calibrate_strips(strips, R_cs, calibration.settings)
        if not isinstance(estimate, InstallationEstimate):
            raise ValueError(f"redrawn vectors do not determine the matrix: {estimate.reason}")
        yield theta_between(estimate.R_cs, R_cs), estimate.cov_theta


def _redrawn(strip: StripSightings, R_cs: Rotation, rng: np.random.Generator) -> StripSightings:
    """The strip as seen by a satellite that keeps to the nominal motion, with noise of its covariances."""
    R_si, _ = attitudes_of(strip)
    R_so = (R_si * strip.R_oi_exposures.inv())[0]
    exposures = tuple(
        replace(seen, u_s=unit((R_so * R_oi).apply(seen.u_i) + _normal(seen.cov_s, rng)))
        for seen, R_oi in zip(strip.exposures, strip.R_oi_exposures)
    )
    ground = strip.ground
    _, first, place = np.unique(ground.target_id, return_index=True, return_inverse=True)
    survey_i = _normal(ground.cov_target_i[first], rng)[place]  # one error of a target on two CCDs
    seen_i = unit(ground.u_i + survey_i / ground.range_m[:, None])
    u_c = (R_cs * R_so * strip.R_oi_targets).apply(seen_i)
    ground = replace(ground, u_c=unit(u_c + _normal(ground.cov_c, rng)))
    return replace(strip, exposures=exposures, ground=ground, attitudes=None)


def _normal(covariance: Floats, rng: np.random.Generator) -> Floats:
    """Gaussian vectors (N, 3) of `covariance` (N, 3, 3), which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    size = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.shape)
    return np.asarray(np.einsum("nab,nb->na", vectors, size))


def _mission(changes: Sequence[str], seed: int) -> tuple[tuple[float, float], TruthErrors, DumpCalibration]:
    """Stated sigmas of stars and targets, px; the errors against the truth; the calibration."""
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
        compared = validation_of(read_saved_result(result), dump)
    return _sigmas_px(calibration, dump), compared, calibration


def _sigmas_px(calibration: DumpCalibration, dump: Dump) -> tuple[float, float]:
    """Root mean square of the stated 1-sigma of stars and of targets per axis, px.

    Targets: of the match and of the surveyed position across the line of sight.
    """
    stars = np.concatenate([np.trace(s.cov_s, axis1=1, axis2=2) for s in calibration.stars])
    targets = np.concatenate([_target_variances(s) for s in calibration.strips])
    camera = dump.star_images[0].camera
    star_pixel = camera.pixel_m / camera.focal_m
    pixel = dump.line_camera.pixel_rad
    return float(np.sqrt(0.5 * stars.mean()) / star_pixel), float(np.sqrt(0.5 * targets.mean()) / pixel)


def _target_variances(strip: StripSightings) -> Floats:
    """Sum of the stated variances (J,) of the targets over both axes across the line of sight, rad²."""
    ground = strip.ground
    along = np.einsum("ja,jab,jb->j", ground.u_i, ground.cov_target_i, ground.u_i)
    survey = np.trace(ground.cov_target_i, axis1=1, axis2=2) - along
    return np.asarray(np.trace(ground.cov_c, axis1=1, axis2=2) + survey / ground.range_m**2)
