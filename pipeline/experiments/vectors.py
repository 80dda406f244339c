"""The paper's simulations from scratch, at the level of vectors: tables in long form, the paper's figures
beside ours.

Every experiment is seeded, and each cell has its own stream, so a cell is the same whichever others are
run. Errors of theta are ours minus truth, arcsec, in the paper's sign, about the axes of frame c. "bound"
is the Cramér-Rao bound (the predicted 1-sigma, rms over the runs), "nees" the mean of the error squared
over its covariance (3 is expected). Star camera `from_zenith_deg` off the zenith in the Y-Z plane: the
paper's Fig. 3 is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.frames import calibrate_frames
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import StripSightings
from boresight.geometry.vector_sets import VectorSets
from boresight.pipeline.experiments.geopositioning import (
    GroundErrors,
    MotionPrior,
    ground_errors,
    smoothed_attitude,
)
from boresight.pipeline.experiments.paper_tables import TABLE_4, TABLE_5
from boresight.pipeline.experiments.wang import polynomial_residuals, wang_calibrate
from boresight.simulator.campaign import (
    CameraPair,
    StripPlan,
    StripTruth,
    draw_frames,
    draw_strips,
    installation_by_tilt,
    noisy_frames,
)

__all__ = [
    "NO_NUISANCES",
    "TABLE_1",
    "ExperimentSettings",
    "convergence",
    "figure8",
    "grid",
    "run_strips",
    "table4",
    "table5",
]

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

MATRIX_28 = (0.003, 0.002, 0.001)  # rad, the paper's (28) under its own (12) and (13)
TABLE_1 = StripPlan(
    sigma_position_m=2.0, sigma_clock_s=1e-4, sigma_vibration_rad=0.1 * ARCSEC, sigma_distortion_rad=3e-7
)
NO_NUISANCES = CalibrationSettings(
    sigma_position_m=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0
)


@dataclass(frozen=True, slots=True)
class ExperimentSettings:
    """Sizes of the experiments. The paper leaves stars, targets and the star camera's direction open."""

    seed: int = 2020
    runs: int = 200  # a cell
    wang_runs: int = 40  # a cell: a run is seven strips
    frames: tuple[int, ...] = (150, 400)
    stars: int = 30  # a frame of the grid
    targets: int = 10  # a frame of the grid
    from_zenith_deg: float = 15.0
    grid_sigma_s_px: tuple[float, ...] = (0.05, 0.06, 0.07, 0.08, 0.09, 0.10)
    grid_sigma_c_px: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    table4_frames: int = 400
    table4_targets: int = 20
    wang_strips: int = 7  # the paper's images
    table5_strips: int = 40  # of ten exposures: 400 frames
    table5_check_strips: int = 7
    table5_runs: int = 20

    @property
    def cameras(self) -> CameraPair:
        return CameraPair(installation_by_tilt(np.radians(self.from_zenith_deg)))


def convergence(settings: ExperimentSettings) -> pd.DataFrame:
    """Figs. 5 and 6: the error against the number of frames, one draw, the rms of all, and the bound."""
    tables = []
    for cell, (sigma_s, sigma_c) in enumerate(((0.06, 0.1), (0.10, 1.0))):
        rng = _stream(settings, 1, cell)
        errors, variances = [], []
        for _ in range(settings.runs):
            n_frames = max(settings.frames)
            drawn = draw_frames(
                n_frames, settings.stars, settings.targets, sigma_s, sigma_c, settings.cameras, rng
            )
            error, variance = _running_error(drawn, settings.cameras.R_cs)
            errors.append(error)
            variances.append(variance)
        off = np.array(errors) / ARCSEC  # (runs, frames, 3)
        bound = np.sqrt(np.mean(variances, axis=0)) / ARCSEC
        for axis in range(3):
            tables.append(
                pd.DataFrame(
                    {
                        "frames": np.arange(1, off.shape[1] + 1),
                        "sigma_s_px": sigma_s,
                        "sigma_c_px": sigma_c,
                        "method": "information",
                        "axis": "XYZ"[axis],
                        "error_arcsec": off[0, :, axis],
                        "rms_arcsec": np.sqrt(np.mean(off[:, :, axis] ** 2, axis=0)),
                        "mean_arcsec": off[:, :, axis].mean(axis=0),
                        "bound_arcsec": bound[:, axis],
                        "runs": settings.runs,
                    }
                )
            )
    return pd.concat(tables, ignore_index=True)


def grid(settings: ExperimentSettings, progress: Progress | None = None) -> pd.DataFrame:
    """Figs. 7 and 9: the error over the grid of both cameras' noise, for the information form and for
    Wang's way.
    """
    cells = [(s, c) for s in settings.grid_sigma_s_px for c in settings.grid_sigma_c_px]
    tables = []
    for cell, (sigma_s, sigma_c) in enumerate(cells):
        for n_frames in settings.frames:
            runs = _frame_runs(
                settings, n_frames, settings.stars, settings.targets, (sigma_s, sigma_c), (2, cell)
            )
            tables.append(_long_form(runs, sigma_s, sigma_c, "information", n_frames))
        plan = replace(
            StripPlan(), strips=settings.wang_strips, targets=20, sigma_s_px=sigma_s, sigma_c_px=sigma_c
        )
        runs = _wang_runs(settings, plan, (3, cell))
        tables.append(_long_form(runs, sigma_s, sigma_c, "wang", settings.wang_strips))
        if progress:
            progress(cell + 1, len(cells))
    return pd.concat(tables, ignore_index=True)


def table4(
    settings: ExperimentSettings,
    star_fields: Sequence[Array] | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Table 4: rms error over many runs beside the paper's single draws.

    `star_fields`: directions (n, 3) in frame s of the stars in the field, one array an exposure; each run
    draws its frames from them. Without them, 60 stars a frame anywhere in the field. "wang" and "strips"
    see the same seven strips: Wang's way, and section 3's estimator on no more data than Wang's has.
    """
    tables = []
    for cell, ((sigma_s, sigma_c), (paper_wang, paper_own)) in enumerate(TABLE_4.items()):
        stars = 60 if star_fields is None else star_fields
        n_frames, targets = settings.table4_frames, settings.table4_targets
        runs = _frame_runs(settings, n_frames, stars, targets, (sigma_s, sigma_c), (4, cell))
        tables.append(_long_form(runs, sigma_s, sigma_c, "information", n_frames, np.abs(paper_own)))
        plan = StripPlan(
            strips=settings.wang_strips, targets=20, stars=60, sigma_s_px=sigma_s, sigma_c_px=sigma_c
        )
        runs = _wang_runs(settings, plan, (5, cell))
        tables.append(_long_form(runs, sigma_s, sigma_c, "wang", settings.wang_strips, np.abs(paper_wang)))
        runs = run_strips(
            plan, settings.cameras, NO_NUISANCES, settings.wang_runs, _stream(settings, 5, cell)
        )
        tables.append(_long_form(runs, sigma_s, sigma_c, "strips", settings.wang_strips))
        if progress:
            progress(cell + 1, len(TABLE_4))
    return pd.concat(tables, ignore_index=True)


def table5(
    settings: ExperimentSettings, progress: Progress | None = None, rows: Sequence[float] = tuple(TABLE_5)
) -> pd.DataFrame:
    """Table 5 and Fig. 10: geo-positioning at 20 check points a strip with every error of Table 1.

    The matrix comes from strips of ten exposures and 20 targets; the check strips are others, with the same
    camera. The floor is what GPS, vibration, clock and distortion leave with a perfect attitude and matrix,
    on the very same draws.
    """
    out = []
    for cell, sigma_s in enumerate(rows):
        paper = TABLE_5[sigma_s]
        rng = _stream(settings, 6, cell)
        plan = replace(
            TABLE_1,
            strips=settings.table5_strips + settings.table5_check_strips,
            targets=20,
            stars=60,
            exposures=20,
            exposure_margin_s=1.0,
            sigma_s_px=sigma_s,
        )
        found: dict[str, list[GroundErrors]] = {"information": [], "wang": [], "floor": []}
        for _ in range(settings.table5_runs):
            for method, errors in _check_points(plan, settings, rng):
                found[method].append(errors)
        floor = _rms(found["floor"])
        for method, places in (("information", (1, 3)), ("wang", (0, 2))):
            rms = _rms(found[method])
            for axis, direction in enumerate(("along", "across")):
                row = (0.3, sigma_s, method, direction, rms[axis], floor[axis], paper[places[axis]])
                out.append((*row, settings.table5_runs))
        if progress:
            progress(cell + 1, len(rows))
    columns = ["sigma_c_px", "sigma_s_px", "method", "direction", "rms_m", "floor_m", "paper_m", "runs"]
    return pd.DataFrame(out, columns=columns)


def figure8(settings: ExperimentSettings) -> pd.DataFrame:
    """Fig. 8: what polynomials of order 3, 5 and 7 leave of the attitude's waves, over 24 s and over one
    strip.
    """
    rng = _stream(settings, 7, 0)
    plan = StripPlan()
    tables = []
    amplitude = rng.uniform(*plan.wave_rad, 3) / ARCSEC
    omega, phase = 2 * np.pi / rng.uniform(*plan.wave_s, 3), rng.uniform(0, 2 * np.pi, 3)
    for span in (24.0, plan.duration_s):
        t = np.asarray(np.linspace(0.0, span, 481), dtype=np.float64)
        waves = amplitude * np.sin(omega * t[:, None] + phase)
        for order in (3, 5, 7):
            left = polynomial_residuals(t, np.asarray(waves, dtype=np.float64), order)
            for axis in range(3):
                tables.append(
                    pd.DataFrame(
                        {
                            "span_s": span,
                            "order": order,
                            "axis": ("roll", "pitch", "yaw")[axis],
                            "t_s": t,
                            "wave_arcsec": waves[:, axis],
                            "residual_arcsec": left[:, axis],
                        }
                    )
                )
    return pd.concat(tables, ignore_index=True)


def run_strips(
    plan: StripPlan,
    cameras: CameraPair,
    believed: CalibrationSettings,
    runs: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Errors (runs, 3) and stated covariances (runs, 3, 3) of the strip form over campaigns drawn anew."""
    R_cs0 = _starting_matrix(cameras)
    errors, covariances = [], []
    for _ in range(runs):
        strips, _ = draw_strips(plan, cameras, rng)
        estimate = _estimated(strips, R_cs0, believed)
        errors.append(theta_between(estimate.R_cs, cameras.R_cs))
        covariances.append(estimate.cov_theta)
    return np.array(errors), np.array(covariances)


def _estimated(
    strips: Sequence[StripSightings], R_cs0: Rotation, believed: CalibrationSettings
) -> InstallationEstimate:
    estimate = calibrate(strips, R_cs0, believed)
    if not isinstance(estimate, InstallationEstimate):
        raise ValueError(f"this campaign does not fix the installation matrix: {estimate.reason}")
    return estimate


def _starting_matrix(cameras: CameraPair) -> Rotation:
    return deviation_from_theta(np.array(MATRIX_28)).inv() * cameras.R_cs


def _frame_runs(
    settings: ExperimentSettings,
    n_frames: int,
    stars: int | Sequence[Array],
    targets: int,
    sigma_px: tuple[float, float],
    stream: tuple[int, int],
) -> tuple[Array, Array]:
    rng = _stream(settings, *stream, n_frames)
    cameras = settings.cameras
    R_cs0 = _starting_matrix(cameras)
    errors, covariances = [], []
    for run in range(settings.runs):
        if run % 10 == 0:  # where stars and targets lie is drawn anew every ten runs
            fields = stars if isinstance(stars, int) else _some(stars, n_frames, rng)
            exact = draw_frames(n_frames, fields, targets, *sigma_px, cameras, rng, noise=False)
        found = calibrate_frames(noisy_frames(exact, rng), R_cs0)
        errors.append(theta_between(found.R_cs, cameras.R_cs))
        covariances.append(found.solution.covariance)
    return np.array(errors), np.array(covariances)


def _some(fields: Sequence[Array], n: int, rng: np.random.Generator) -> list[Array]:
    return [fields[k] for k in rng.integers(0, len(fields), n)]


def _wang_runs(settings: ExperimentSettings, plan: StripPlan, stream: tuple[int, int]) -> tuple[Array, Array]:
    rng = _stream(settings, *stream)
    cameras = settings.cameras
    R_cs0 = _starting_matrix(cameras)
    errors = []
    for _ in range(settings.wang_runs):
        strips, _ = draw_strips(plan, cameras, rng)
        errors.append(theta_between(wang_calibrate(strips, R_cs0).R_cs, cameras.R_cs))
    return np.array(errors), np.full((len(errors), 3, 3), np.nan)


def _running_error(frames: VectorSets, R_cs: Rotation) -> tuple[Array, Array]:
    """Error and predicted variance (frames, 3) after each number of frames."""
    pairs = calibrate_frames(frames, R_cs).pairs
    F, F_theta = np.cumsum(pairs.F, axis=0), np.cumsum(pairs.F_theta, axis=0)
    theta = np.linalg.solve(F, F_theta[:, :, None])[:, :, 0]
    off = theta_between(pairs.R_cs_ref, R_cs) + theta  # both a few arcsec: they add
    return off, np.diagonal(np.linalg.inv(F), axis1=1, axis2=2)


def _check_points(
    plan: StripPlan, settings: ExperimentSettings, rng: np.random.Generator
) -> Iterator[tuple[str, GroundErrors]]:
    cameras, n = settings.cameras, settings.table5_strips
    strips, truth = draw_strips(plan, cameras, rng)
    R_cs0 = _starting_matrix(cameras)
    believed = CalibrationSettings()
    # The calibration has the ten exposures of each strip's own duration, as in the paper's 400 frames.
    used = [_central_exposures(strip, 10) for strip in strips[:n]]
    R_cs = {"information": _estimated(used, R_cs0, believed).R_cs, "wang": wang_calibrate(used, R_cs0).R_cs}
    for place in range(n, len(strips)):
        strip = strips[place]
        R_si = smoothed_attitude(strip, MotionPrior())
        for method, matrix in R_cs.items():
            yield method, _strip_errors(strip, (matrix * R_si).inv().apply(strip.ground.u_c))
        yield "floor", _strip_errors(strip, _true_looks(truth, place))


def _true_looks(truth: StripTruth, place: int) -> Array:
    return np.asarray(truth.R_ci[place].inv().apply(truth.look_c[place]))


def _strip_errors(strip: StripSightings, look_i: Array) -> GroundErrors:
    ground = strip.ground
    up_i = -strip.R_oi_targets.inv().apply([0.0, 0.0, 1.0])
    to_target = ground.range_m[:, None] * ground.u_i
    return ground_errors(np.zeros_like(to_target), look_i, to_target, up_i, ground.v_rel_i)


def _central_exposures(strip: StripSightings, n: int) -> StripSightings:
    first = (len(strip.exposures) - n) // 2
    keep = slice(first, first + n)
    return replace(strip, exposures=strip.exposures[keep], R_oi_exposures=strip.R_oi_exposures[keep])


def _rms(parts: list[GroundErrors]) -> tuple[float, float]:
    along = np.concatenate([part.along_m for part in parts])
    across = np.concatenate([part.across_m for part in parts])
    return GroundErrors(along, across).rms_m


def _long_form(
    runs: tuple[Array, Array],
    sigma_s: float,
    sigma_c: float,
    method: str,
    frames: int,
    paper: Array | None = None,
) -> pd.DataFrame:
    errors, covariances = runs
    nees = np.nan
    if np.all(np.isfinite(covariances)):
        nees = float(np.mean(np.einsum("ra,rab,rb->r", errors, np.linalg.inv(covariances), errors)))
    off = errors / ARCSEC
    return pd.DataFrame(
        {
            "frames": frames,
            "sigma_s_px": sigma_s,
            "sigma_c_px": sigma_c,
            "method": method,
            "axis": list("XYZ"),
            "rms_arcsec": np.sqrt(np.mean(off**2, axis=0)),
            "mean_arcsec": off.mean(axis=0),
            "bound_arcsec": np.sqrt(np.mean(np.diagonal(covariances, axis1=1, axis2=2), axis=0)) / ARCSEC,
            "nees": nees,
            "runs": len(errors),
            "paper_arcsec": np.full(3, np.nan) if paper is None else paper,
        }
    )


def _stream(settings: ExperimentSettings, *place: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=place))
