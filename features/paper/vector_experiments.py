"""The paper's simulations from scratch, at the level of vectors, as long-form tables with the paper's values.

Every experiment is seeded and each cell has its own stream, so a cell does not depend on which others are
run. Errors of theta are estimate minus truth, arcsec, in the paper's sign, about the axes of frame c. `bound`
is the Cramér-Rao bound (predicted 1-sigma, rms over the runs), `nees` the mean squared error over that
covariance (3 is expected of an efficient estimator), `paper` the printed value of the same quantity.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from boresight.accepted import no_progress
from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.features.paper import paper_tables
from boresight.features.paper.frames import calibrate_frames
from boresight.features.paper.geometry_search import (
    GeometrySearch,
    covariance_shapes,
    predicted_sigma,
    star_camera_rotation,
)
from boresight.features.paper.geopositioning import GroundErrors, check_point_errors, smoothed_attitude
from boresight.features.paper.wang import attitudes_of, polynomial_residuals, wang_calibrate
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import StripSightings, VectorSets
from boresight.records.record import Floats, record, scalar
from boresight.simulator import campaign

__all__ = [
    "NO_NUISANCES",
    "TABLE_1",
    "ExperimentSettings",
    "Progress",
    "convergence_of_runs",
    "figure4",
    "figure8",
    "grid",
    "table4",
    "table5",
    "table5_readings",
]

Progress = Callable[[int, int], None]  # done, in all
MATRIX_28 = (0.003, 0.002, 0.001)  # rad, the paper's (28) under its own (12) and (13)
# 1-sigma errors of the paper's Table 1.
TABLE_1 = campaign.StripPlan(
    sigma_position_m=2.0, sigma_clock_s=1e-4, sigma_vibration_rad=0.1 * ARCSEC, sigma_distortion_rad=3e-7
)
# For an estimator that assumes no error but the noise of stars and targets, as the paper's.
NO_NUISANCES = CalibrationSettings(
    sigma_position_m=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0
)


@record(kw_only=True)
class ExperimentSettings:
    """Sizes of the experiments. The paper prints neither numbers of stars and targets nor the star camera's
    axis.
    """

    seed: int = scalar("seed of all random numbers", default=2020)
    runs: int = scalar("runs per cell", default=200)
    wang_runs: int = scalar("runs per cell of Wang's method, each of `wang_strips` strips", default=40)
    frames: tuple[int, ...] = scalar("frames per run of the grid", default=(150, 400))
    stars: int = scalar("stars per frame of the grid", default=30)
    targets: int = scalar("targets per frame of the grid", default=10)
    from_zenith_deg: float = scalar("star camera's axis from the zenith in the Y-Z plane of c", default=15.0)
    grid_sigma_s_px: tuple[float, ...] = scalar(
        "noise of the star camera, px", default=(0.05, 0.06, 0.07, 0.08, 0.09, 0.10)
    )
    grid_sigma_c_px: tuple[float, ...] = scalar(
        "noise of the remote-sensing camera, px", default=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    )
    table4_frames: int = scalar("frames per run of Table 4", default=400)
    table4_targets: int = scalar("targets per frame of Table 4", default=20)
    wang_strips: int = scalar("images of the paper", default=7)
    table5_strips: int = scalar("strips of ten exposures: 400 frames", default=40)
    table5_check_strips: int = scalar("further strips with check points", default=7)
    table5_runs: int = scalar("runs per row of Table 5", default=20)
    inputs_strips: int = scalar("strips drawn with each error of Table 1", default=400)
    search: GeometrySearch = scalar("directions and numbers of the map", default_factory=GeometrySearch)

    @property
    def cameras(self) -> campaign.CameraPair:
        """The paper's cameras, mounted `from_zenith_deg` apart from the zenith."""
        return campaign.CameraPair(campaign.installation_by_tilt(np.radians(self.from_zenith_deg)))


def convergence_of_runs(settings: ExperimentSettings) -> pd.DataFrame:
    """Figs. 5 and 6: error of one run, rms of all runs and bound against the number of frames."""
    tables = []
    for cell, ((sigma_s, sigma_c), paper_z) in enumerate(paper_tables.FIGURES_5_6_Z_ARCSEC.items()):
        rng = _stream(settings, 1, cell)
        errors, variances = [], []
        for _ in range(settings.runs):
            n_frames = max(settings.frames)
            drawn = campaign.draw_frames(
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
                        "paper_arcsec": paper_z if axis == 2 else 0.0,
                    }
                )
            )
    return pd.concat(tables, ignore_index=True)


def grid(settings: ExperimentSettings, progress: Progress = no_progress) -> pd.DataFrame:
    """Figs. 7 and 9: the error over the grid of both cameras' noise, for the information form and Wang's
    method.

    The paper prints no cell: `paper_arcsec` is Fig. 7's standard deviation over its grid for the information
    form, and for Wang's method the rms of the five cells that Table 4 prints.
    """
    paper_wang = np.array(paper_tables.TABLE_4_RMS_ARCSEC["wang"])
    cells = [(s, c) for s in settings.grid_sigma_s_px for c in settings.grid_sigma_c_px]
    tables = []
    for cell, (sigma_s, sigma_c) in enumerate(cells):
        for n_frames in settings.frames:
            runs = _frame_runs(
                settings, n_frames, settings.stars, settings.targets, (sigma_s, sigma_c), (2, cell)
            )
            paper = np.array(paper_tables.FIGURE_7_SIGMA_ARCSEC)
            tables.append(_long_form(runs, sigma_s, sigma_c, "information", n_frames, paper))
        tables += _strip_tables(settings, campaign.StripPlan().stars, sigma_s, sigma_c, (3, cell), paper_wang)
        progress(cell + 1, len(cells))
    return pd.concat(tables, ignore_index=True)


def table4(
    settings: ExperimentSettings, star_fields: Sequence[Floats], progress: Progress = no_progress
) -> pd.DataFrame:
    """Table 4: rms error over many runs beside the paper's single draws, "information" from many frames.

    `star_fields`: directions (n, 3) in frame s of the stars in the field, one array per exposure; each run
    draws its frames from them. "wang" and "strips" use the same seven strips: Wang's method, and `calibrate`
    on the data that Wang's method has.
    """
    tables = []
    for cell, ((sigma_s, sigma_c), (paper_wang, paper_own)) in enumerate(paper_tables.TABLE_4.items()):
        n_frames, targets = settings.table4_frames, settings.table4_targets
        runs = _frame_runs(settings, n_frames, star_fields, targets, (sigma_s, sigma_c), (4, cell))
        tables.append(_long_form(runs, sigma_s, sigma_c, "information", n_frames, np.abs(paper_own)))
        tables += _strip_tables(settings, 60, sigma_s, sigma_c, (5, cell), np.abs(paper_wang))
        progress(cell + 1, len(paper_tables.TABLE_4))
    return pd.concat(tables, ignore_index=True)


def table5(
    settings: ExperimentSettings,
    progress: Progress = no_progress,
    rows: Sequence[float] = tuple(paper_tables.TABLE_5),
) -> pd.DataFrame:
    """Table 5 and Fig. 10: geo-positioning at 20 check points per strip with every error of Table 1.

    The matrix comes from strips of ten exposures and 20 targets; check strips are others of the same camera.
    The floor is the error from GPS, vibration, clock and distortion with perfect attitude and matrix, same
    draws.
    """
    out = []
    for cell, sigma_s in enumerate(rows):
        paper = paper_tables.TABLE_5[sigma_s]
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
                out.append((*row, settings.table5_runs, plan.targets * settings.table5_check_strips))
        progress(cell + 1, len(rows))
    columns = "sigma_c_px sigma_s_px method direction rms_m floor_m paper_m runs check_points".split()
    return pd.DataFrame(out, columns=columns)


def table5_readings(settings: ExperimentSettings, progress: Progress = no_progress) -> pd.DataFrame:
    """Table 5 under the paper's own reading: Wang's matrix from each single image, ours from all of them.

    Varied is what the paper leaves open: the order of Wang's polynomial, GPS errors constant over a strip or
    white, attitudes smoothed over a strip or of the nearest exposure, and the star camera's axis.
    """
    axes = {"15 deg": settings.cameras, "60 deg": campaign.CameraPair(star_camera_rotation(60.0, 48.0, 0.0))}
    rows = []
    for cell, (axis, gps, sigma_s) in enumerate(product(axes, ("constant", "white"), (0.05, 0.075, 0.10))):
        rng, found = _stream(settings, 8, cell), defaultdict[tuple[str, str, int], list[GroundErrors]](list)
        whole, each = (0.0, 2.0) if gps == "white" else (2.0, 0.0)  # Table 1: 2 m
        plan = replace(
            TABLE_1,
            strips=2 * settings.wang_strips,
            targets=20,
            stars=30,
            sigma_s_px=sigma_s,
            sigma_position_m=whole,
            sigma_target_m=each,
        )
        for _ in range(max(settings.table5_runs // 2, 1)):
            for key, errors in _one_matrix_per_image(plan, settings.wang_strips, axes[axis], rng):
                found[key].append(errors)
        for (attitude, method, order), parts in found.items():
            for direction, rms in zip(("along", "across"), _rms(parts)):
                rows.append((axis, gps, attitude, sigma_s, method, order, direction, rms))
        progress(cell + 1, 12)
    return pd.DataFrame(rows, columns="axis gps attitude sigma_s_px method order direction rms_m".split())


def _one_matrix_per_image(
    plan: campaign.StripPlan, n: int, cameras: campaign.CameraPair, rng: np.random.Generator
) -> Iterator[tuple[tuple[str, str, int], GroundErrors]]:
    """Errors at the check strips n to 2n - 1 by (attitude, method, order), each with a matrix of an image
    before.
    """
    strips, _ = campaign.draw_strips(plan, cameras, rng)
    R_cs0 = _starting_matrix(cameras)
    stated = replace(CalibrationSettings(), sigma_position_m=plan.sigma_position_m)
    matrices = {("wang", order): wang_calibrate(strips[:n], R_cs0, order).R_cs_strips for order in (3, 5, 7)}
    ours = _estimated(strips[:n], R_cs0, stated).R_cs
    for k, strip in enumerate(strips[n:]):
        R_cs = {("ours", 0): ours} | {key: of_images[k] for key, of_images in matrices.items()}
        readings = ("smoothed", smoothed_attitude(strip)), ("exposure", _nearest(strip))
        for (attitude, R_si), (method, matrix) in product(readings, R_cs.items()):
            look_i = (matrix * R_si).inv().apply(strip.ground.u_c)
            yield (attitude, *method), check_point_errors(strip, look_i)


def _nearest(strip: StripSightings) -> Rotation:
    """R_si (J,) at the targets' instants from the nearest exposure and the nominal motion."""
    R_si, _ = attitudes_of(strip)
    k = np.abs(strip.ground.t_s[:, None] - strip.times_s).argmin(axis=1)
    return (R_si * strip.R_oi_exposures.inv())[k] * strip.R_oi_targets


def figure4(settings: ExperimentSettings) -> pd.DataFrame:
    """Fig. 4: the attitude's waves over 24 s about their mean, and as single exposures at 5 Hz measure them.

    The paper shows the observed motion of a satellite, without printed values; ours are waves of 3 to 12
    arcsec with periods of 3 to 7 s. `sigma_arcsec` is that of one exposure of `stars` stars of 0.06 px.
    """
    t = np.arange(121) / 5.0  # s; Table 2: 5 Hz
    waves, rng = _waves(settings, t)
    shapes, stars = covariance_shapes(settings.cameras), np.full(1, float(settings.stars))
    sigma = predicted_sigma(settings.cameras.R_cs, shapes, [(0.06, 0.0)], stars, np.ones(1))[0]
    table = {
        "axis": np.repeat(ATTITUDE_AXES, len(t)),
        "t_s": np.tile(t, 3),
        "attitude_arcsec": (waves - waves.mean(axis=0)).T.ravel(),
        "sigma_arcsec": np.repeat(sigma, len(t)),
    }
    measured = table["attitude_arcsec"] + table["sigma_arcsec"] * rng.normal(size=3 * len(t))
    return pd.DataFrame(table | {"measured_arcsec": measured})


def figure8(settings: ExperimentSettings) -> pd.DataFrame:
    """Fig. 8: residuals of polynomials of order 3, 5 and 7 fitted to the waves over 24 s and one strip."""
    tables = []
    for span in (24.0, campaign.StripPlan().duration_s):
        t = np.asarray(np.linspace(0.0, span, 481), dtype=np.float64)
        waves, _ = _waves(settings, t)
        for order in (3, 5, 7):
            columns = {
                "span_s": span,
                "order": order,
                "axis": np.repeat(ATTITUDE_AXES, len(t)),
                "t_s": np.tile(t, 3),
                "wave_arcsec": waves.T.ravel(),
                "residual_arcsec": polynomial_residuals(t, waves, order).T.ravel(),
            }
            tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


ATTITUDE_AXES = ("roll", "pitch", "yaw")  # names of the columns of `_waves`


def _waves(settings: ExperimentSettings, t_s: Floats) -> tuple[Floats, np.random.Generator]:
    """Attitude (N, 3) at `t_s` about the three axes, arcsec, of the one motion of Figs. 4 and 8, and its
    generator.
    """
    rng = _stream(settings, 7, 0)
    drawn = campaign.Waves.draw(campaign.StripPlan(), rng)
    return replace(drawn, amplitude=drawn.amplitude / ARCSEC).at(t_s), rng


def _estimated(
    strips: Sequence[StripSightings], R_cs0: Rotation, settings: CalibrationSettings
) -> InstallationEstimate:
    estimate = calibrate_strips(strips, R_cs0, settings)
    if not isinstance(estimate, InstallationEstimate):
        raise ValueError(f"the installation matrix is not observable in this campaign: {estimate.reason}")
    return estimate


def _starting_matrix(cameras: campaign.CameraPair) -> Rotation:
    return deviation_from_theta(np.array(MATRIX_28)).inv() * cameras.R_cs


def _frame_runs(
    settings: ExperimentSettings,
    n_frames: int,
    stars: int | Sequence[Floats],
    targets: int,
    sigma_px: tuple[float, float],
    stream: tuple[int, int],
) -> tuple[Floats, Floats]:
    rng = _stream(settings, *stream, n_frames)
    cameras = settings.cameras
    R_cs0 = _starting_matrix(cameras)
    errors, covariances = [], []
    for run in range(settings.runs):
        if run % 10 == 0:  # new positions of stars and targets every ten runs
            fields = stars
            if not isinstance(fields, int):
                fields = [fields[k] for k in rng.integers(0, len(fields), n_frames)]
            exact = campaign.draw_frames(n_frames, fields, targets, *sigma_px, cameras, rng, noise=False)
        found = calibrate_frames(campaign.noisy_frames(exact, rng), R_cs0)
        errors.append(theta_between(found.R_cs, cameras.R_cs))
        covariances.append(found.solution.covariance)
    return np.array(errors), np.array(covariances)


def _strip_tables(
    settings: ExperimentSettings,
    stars: int,
    sigma_s: float,
    sigma_c: float,
    stream: tuple[int, int],
    paper: Floats,
) -> list[pd.DataFrame]:
    """Long form of Wang's method and of `calibrate` on the same strips, with the same bound."""
    n = settings.wang_strips
    plan = campaign.StripPlan(strips=n, targets=20, stars=stars, sigma_s_px=sigma_s, sigma_c_px=sigma_c)
    rng, cameras = _stream(settings, *stream), settings.cameras
    R_cs0 = _starting_matrix(cameras)
    wang, ours, bounds = [], [], []
    for _ in range(settings.wang_runs):
        strips = with_attitudes(campaign.draw_strips(plan, cameras, rng)[0])
        estimate = _estimated(strips, R_cs0, NO_NUISANCES)
        wang.append(theta_between(wang_calibrate(strips, R_cs0).R_cs, cameras.R_cs))
        ours.append(theta_between(estimate.R_cs, cameras.R_cs))
        bounds.append(estimate.cov_theta)
    methods = {"wang": wang, "strips": ours}
    return [
        _long_form((np.array(errors), np.array(bounds)), sigma_s, sigma_c, name, n, paper)
        for name, errors in methods.items()
    ]


def _running_error(frames: VectorSets, R_cs: Rotation) -> tuple[Floats, Floats]:
    """Error and predicted variance (frames, 3) after each number of frames."""
    pairs = calibrate_frames(frames, R_cs).pairs
    F, F_theta = np.cumsum(pairs.F, axis=0), np.cumsum(pairs.F_theta, axis=0)
    theta = np.linalg.solve(F, F_theta[:, :, None])[:, :, 0]
    off = theta_between(pairs.R_cs_ref, R_cs) + theta  # both a few arcsec: they add
    return off, np.diagonal(np.linalg.inv(F), axis1=1, axis2=2)


def _check_points(
    plan: campaign.StripPlan, settings: ExperimentSettings, rng: np.random.Generator
) -> Iterator[tuple[str, GroundErrors]]:
    cameras, n = settings.cameras, settings.table5_strips
    strips, truth = campaign.draw_strips(plan, cameras, rng)
    strips, R_cs0 = with_attitudes(strips), _starting_matrix(cameras)
    # Calibrate with the ten exposures within each strip, as in the paper's 400 frames.
    used = [_central_exposures(strip, 10) for strip in strips[:n]]
    R_cs = {
        "information": _estimated(used, R_cs0, CalibrationSettings()).R_cs,
        "wang": wang_calibrate(used, R_cs0).R_cs,
    }
    for place in range(n, len(strips)):
        strip = strips[place]
        R_si = smoothed_attitude(strip)
        for method, matrix in R_cs.items():
            yield method, check_point_errors(strip, (matrix * R_si).inv().apply(strip.ground.u_c))
        yield "floor", check_point_errors(strip, truth.R_ci[place].inv().apply(truth.look_c[place]))


def _central_exposures(strip: StripSightings, n: int) -> StripSightings:
    first = (len(strip.exposures) - n) // 2
    keep = slice(first, first + n)
    return replace(
        strip,
        exposures=strip.exposures[keep],
        R_oi_exposures=strip.R_oi_exposures[keep],
        attitudes=strip.fitted.take(np.arange(first, first + n)),
    )


def _rms(parts: list[GroundErrors]) -> tuple[float, float]:
    along = np.concatenate([part.along_m for part in parts])
    across = np.concatenate([part.across_m for part in parts])
    return GroundErrors(along, across).rms_m


def _long_form(
    runs: tuple[Floats, Floats], sigma_s: float, sigma_c: float, method: str, frames: int, paper: Floats
) -> pd.DataFrame:
    errors, covariances = runs
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
            "paper_arcsec": paper,
        }
    )


def _stream(settings: ExperimentSettings, *place: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=place))
