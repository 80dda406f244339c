"""The strip form against its bound, what each part of it is for, and the covariance with every error of
Table 1.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/calib_strips.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from record import band_of_mean_nees, exit_status, head, verdict
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.features.paper.vector_experiments import MATRIX_28, NO_NUISANCES, TABLE_1
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import StripSightings
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt

CAMERAS = CameraPair(installation_by_tilt(np.radians(60.0)))
Way = Callable[[StripSightings], list[StripSightings]]


def campaign(
    plan: StripPlan, settings: CalibrationSettings, runs: int, seed: int, way: Way | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (runs, 3) and covariances, rad, of campaigns drawn anew; `way` changes what the estimator is
    given.
    """
    rng = np.random.default_rng(seed)
    R_cs0 = deviation_from_theta(np.array(MATRIX_28)).inv() * CAMERAS.R_cs
    errors, covariances = [], []
    for _ in range(runs):
        strips, _ = draw_strips(plan, CAMERAS, rng)
        if way is not None:
            strips = [part for strip in strips for part in way(strip)]
        estimate = calibrate_strips(strips, R_cs0, settings)
        assert isinstance(estimate, InstallationEstimate)
        errors.append(theta_between(estimate.R_cs, CAMERAS.R_cs))
        covariances.append(estimate.cov_theta)
    return np.array(errors), np.array(covariances)


def figures(found: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """rms and bound (3,), arcsec, and the mean NEES."""
    errors, covariances = found
    nees = np.mean(np.einsum("ra,rab,rb->r", errors, np.linalg.inv(covariances), errors))
    bound = np.sqrt(np.mean(np.diagonal(covariances, axis1=1, axis2=2), axis=0))
    return np.sqrt(np.mean(errors**2, axis=0)) / ARCSEC, bound / ARCSEC, float(nees)


def line(name: str, rms: np.ndarray, bound: np.ndarray, nees: float) -> None:
    print(
        f"{name:58s} {rms[0]:7.3f} {rms[1]:7.3f} {rms[2]:8.3f}   "
        f"{bound[0]:6.3f} {bound[1]:6.3f} {bound[2]:7.3f}   {nees:9.2f}",
        flush=True,
    )


def nearest_exposure(strip: StripSightings, still: bool) -> list[StripSightings]:
    """Every target given the attitude of the exposure nearest in time; between the two the nominal
    motion, or none. Days lie between the parts: as the paper's frames, they share no error.
    """
    times = np.array([exposure.t_s for exposure in strip.exposures])
    nearest = np.argmin(np.abs(strip.ground.t_s[:, None] - times), axis=1)
    parts = []
    for k in np.unique(nearest):
        rows = np.flatnonzero(nearest == k)
        ground = strip.ground.take(rows)
        R_oi = strip.R_oi_exposures[int(k) : int(k) + 1]
        targets = Rotation.concatenate([R_oi[0]] * len(rows)) if still else strip.R_oi_targets[rows]
        one = StripSightings(
            strip_id=f"{strip.strip_id}/{k}",
            exposures=(strip.exposures[k],),
            ground=ground,
            R_oi_exposures=R_oi,
            R_oi_targets=targets,
        )
        parts.append(one.later(k * DAY_S))
    return parts


def attitudes_exact(strip: StripSightings) -> list[StripSightings]:
    """Stars stated a million times better than they are: interpolated attitudes taken as exact."""
    exposures = tuple(replace(exposure, cov_s=1e-12 * exposure.cov_s) for exposure in strip.exposures)
    return [replace(strip, exposures=exposures)]


def ablation(runs: int) -> None:
    plain = replace(NO_NUISANCES, robust=False)
    print(f"how the target's and the exposures' instants are brought together, {runs} runs of 8 strips")
    print(f"{'':58s} rms X       Y        Z   bound X      Y       Z        NEES")
    ways: dict[str, Way | None] = {
        "nearest exposure, motion ignored": lambda strip: nearest_exposure(strip, still=True),
        "nearest exposure, nominal orbital rate": lambda strip: nearest_exposure(strip, still=False),
        "star attitudes interpolated and taken as exact": attitudes_exact,
        "exposures' corrections unknown and eliminated": None,
    }
    for name, way in ways.items():
        line(name, *figures(campaign(StripPlan(), plain, runs, seed=1, way=way)))
    wave = replace(StripPlan(), sigma_vibration_rad=0.1 * ARCSEC, vibration_hz=30.0)
    line("  and a 30 Hz wave of 0.1 arcsec, not told", *figures(campaign(wave, plain, runs, seed=1)))
    told = replace(plain, sigma_vibration_rad=0.1 * ARCSEC)
    line("  and a 30 Hz wave of 0.1 arcsec, told as a density", *figures(campaign(wave, told, runs, seed=1)))
    print()


def at_the_bound(runs: int) -> None:
    print(
        f"strip form against its bound, {runs} runs of 8 strips, oscillating attitude, targets over all rows"
    )
    rms, bound, nees = figures(campaign(StripPlan(), NO_NUISANCES, runs, seed=2))
    line("strip form", rms, bound, nees)
    for axis in range(3):
        ratio = rms[axis] / bound[axis]
        verdict(f"{'XYZ'[axis]}: rms / bound {ratio:.3f} (0.95 to 1.05)", 0.95 <= ratio <= 1.05)
    low, high = band_of_mean_nees(runs)
    verdict(f"NEES {nees:.3f}, 99.9 % band {low:.3f} to {high:.3f}", low < nees < high)
    print()


def with_table_1(runs: int) -> None:
    print(f"every error of Table 1 on (GPS error constant over a strip), {runs} runs of 8 strips")
    low, high = band_of_mean_nees(runs)
    for scope in ("camera", "strip"):
        plan = replace(TABLE_1, distortion_scope=scope)
        settings = CalibrationSettings(distortion_scope=scope)  # type: ignore[arg-type]
        rms, bound, nees = figures(campaign(plan, settings, runs, seed=3))
        line(f"all nuisances on, distortion of the {scope}", rms, bound, nees)
        verdict(f"NEES {nees:.3f}, 99.9 % band {low:.3f} to {high:.3f}", low < nees < high)
    for name, off in (
        ("position nuisance left out", {"sigma_position_m": 0.0}),
        ("clock nuisance left out", {"sigma_clock_s": 0.0}),
        ("vibration density left out", {"sigma_vibration_rad": 0.0}),
        ("distortion left out", {"sigma_distortion_rad": 0.0}),
    ):
        line(
            name,
            *figures(campaign(TABLE_1, replace(CalibrationSettings(robust=False), **off), runs // 4, seed=3)),
        )
    print()


if __name__ == "__main__":
    head("calib: the strip form (star camera 60 degrees off the zenith)")
    ablation(60)
    at_the_bound(1600)
    with_table_1(400)
    raise SystemExit(exit_status())
