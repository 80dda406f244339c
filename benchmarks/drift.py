"""Does a mounting at rest raise an alarm, is a step found with its date, and does the merged covariance hold?

    python benchmarks/drift.py [--rest 100] [--steps 20] [--calibrated 4] [--pixels]

A run is a year: twelve calibrations at uneven dates, drawn at the level of vectors with every error of the
paper's Table 1 and one distortion of the camera for the whole year; the star camera looks 15 deg off the
zenith and is rotated by 37 deg. The estimator does not know the matrix: information refers to one that is
2" (1 sigma, each axis) wrong. `--rest` years of four strips a month show the alarms at rest, `--steps` years
of ten strips a month show steps: a moved mounting is the same year seen by a star camera that is rotated from
a date on. `--calibrated` more go through `calib.calibrate` month by month, look for gross errors and iterate.
`--pixels` also renders dumps of
four months, the mounting moved by 1" in the middle, and runs the program on them.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from processes import run_command
from record import arguments_of, exit_status, head, judge_largest, judge_nees, judge_share
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips, strip_pairs
from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs, solve_total
from boresight.features.drift.matrix_drift import DriftSettings, MountingSeries, estimate_drift
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.pipeline.results.plan_forecast import settings_of_plan
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt

Array = NDArray[np.float64]

DAYS = np.array([0, 29, 62, 88, 121, 155, 180, 214, 240, 273, 300, 336.0])
AT_REST, FOR_STEPS = 4, 10  # strips a month
PLAN = StripPlan(
    exposures=8,
    stars=20,
    sigma_position_m=2.0,
    sigma_clock_s=1e-4,
    sigma_vibration_rad=0.1 * ARCSEC,
    sigma_distortion_rad=3e-7,
)
R_CS = installation_by_tilt(np.radians(15.0), np.radians(37.0))
STEPS = [("X", s) for s in (0.25, 0.5, 0.75, 1.0, 1.5)] + [("Y", s) for s in (0.25, 0.5, 0.75, 1.0, 1.5)]
STEPS += [("Z", s) for s in (2.0, 4.0, 6.0, 8.0, 12.0)]
ALARMS = (0.05, 0.01)
WAYS = ("shared", "independent")
NONE = np.zeros((0, 0))
FOUND = ("X 1", "Y 1", "Z 8")  # steps, arcsec, of which nine in ten must be found


@dataclass(frozen=True)
class Year:
    """What one simulated year showed. Steps in the order of STEPS."""

    p_rest: dict[str, tuple[float, float]]  # a way: p against one constant, p of the best step
    nees: dict[str, float]
    sigma: dict[str, Array]  # (3,) rad of the merged matrix
    p_step: dict[str, list[tuple[float, float]]]
    gap_right: list[bool]
    date_inside: list[bool]
    date_width_d: list[float]


@dataclass(frozen=True)
class Job:
    """One year to be simulated."""

    seed: tuple[int, int]
    strips: int  # a month
    calibrated: bool  # by `calibrate`, month by month
    steps: list[tuple[str, float]]  # axis, arcsec


def months_of(job: Job) -> tuple[list[InformationPairs], float]:
    """One pair a month about a matrix of its own, and the day of a step."""
    rng = np.random.default_rng(job.seed)
    strips, _ = draw_strips(replace(PLAN, strips=job.strips * len(DAYS)), CameraPair(R_CS), rng)
    day = rng.uniform(DAYS[2], DAYS[9])
    settings = settings_of_plan(PLAN)
    start = deviation_from_theta(2.0 * ARCSEC * rng.normal(size=3)) * R_CS
    months = [strips[job.strips * k : job.strips * (k + 1)] for k in range(len(DAYS))]
    if job.calibrated:
        pairs = [calibrate_strips(month, start, settings).pairs for month in months]
    else:
        whole, _ = strip_pairs(strips, start, replace(settings, robust=False))
        rows = [np.isin(whole.names, [strip.strip_id for strip in month]) for month in months]
        pairs = [
            InformationPairs(whole.names[r], whole.F[r], whole.F_theta[r], start, whole.shared) for r in rows
        ]
    return [pair.as_one(f"{k:02d}", (), NONE) for k, pair in enumerate(pairs)], day


def as_if_independent(pair: InformationPairs) -> InformationPairs:
    """A calibration's own theta and covariance alone, as if it shared nothing."""
    prior = prior_information(pair.shared)
    alone = solve_total(pair.F[0], pair.F_theta[0], prior, sigma_observable_rad=1e-2)
    right = alone.information @ alone.theta
    return InformationPairs(pair.names, alone.information[None], right[None], pair.R_cs_ref)


def moved(pair: InformationPairs, theta: Array) -> InformationPairs:
    """The same month seen by a star camera that has been turned: the matrix turns, all else stays."""
    R_after = deviation_from_theta(theta) * R_CS
    return replace(pair, R_cs_ref=pair.R_cs_ref * R_CS.inv() * R_after)


def drift_of(months: list[InformationPairs]):
    pairs = reduce(InformationPairs.merged, months)
    series = MountingSeries.of(pairs, prior_information(pairs.shared), DAYS * DAY_S)
    return estimate_drift(series, DriftSettings(density_rad2_s=0.0))


def year(job: Job) -> Year:
    months, day = months_of(job)
    ways = {"shared": months, "independent": [as_if_independent(pair) for pair in months]}
    p_rest, nees, sigma, p_step = {}, {}, {}, {way: [] for way in WAYS}
    right, inside, width = [], [], []
    for way, pairs in ways.items():
        drift = drift_of(pairs)
        error = theta_between(drift.merged.R_cs, R_CS)
        p_rest[way] = (drift.constant.p_value, drift.step.p_value)
        nees[way] = float(error @ np.linalg.solve(drift.merged.covariance, error))
        sigma[way] = np.sqrt(np.diag(drift.merged.covariance))
        for axis, size in job.steps:
            theta = np.eye(3)["XYZ".index(axis)] * size * ARCSEC
            after = [moved(p, theta) if d > day else p for p, d in zip(pairs, DAYS)]
            found = drift_of(after)
            p_step[way].append((found.constant.p_value, found.step.p_value))
            if way == "shared":
                low, high = (t / DAY_S for t in found.step.interval_s)
                inside.append(low <= day <= high)
                width.append(high - low)
                right.append(DAYS[int(found.step.after)] < day <= DAYS[int(found.step.before)])
    return Year(p_rest, nees, sigma, p_step, right, inside, width)


def alarm(p: tuple[float, float], probability: float) -> bool:
    """As `estimate_drift` decides."""
    return min(p) < 0.5 * probability


def years(
    seed: int, count: int, strips: int, calibrated: bool, steps: Sequence[tuple[str, float]]
) -> list[Year]:
    return [year(Job((seed, n), strips, calibrated, list(steps))) for n in range(count)]


def at_rest(name: str, seen: list[Year]) -> None:
    """Alarms, and the covariance of the merged matrix; beside it if results are taken as independent."""
    for way in WAYS:
        counts = [sum(alarm(one.p_rest[way], asked) for one in seen) for asked in ALARMS]
        sigma = ", ".join(f"{s:.3f}" for s in np.mean([one.sigma[way] for one in seen], axis=0) / ARCSEC)
        nees = np.mean([one.nees[way] for one in seen])
        print(f"{name}, {way}: alarms {counts} of {len(seen)}, NEES {nees:.2f}, 1 sigma {sigma} arcsec")
    for asked in ALARMS:
        count = sum(alarm(one.p_rest["shared"], asked) for one in seen)
        judge_share(f"{name}: alarms at rest, {100 * asked:g} % asked", count, len(seen), most=asked)
    judge_nees(f"{name}: merged matrix", [one.nees["shared"] for one in seen])


def after_steps(name: str, seen: list[Year], steps: Sequence[tuple[str, float]]) -> None:
    """How often each step is found, in the right gap, and its date within its interval."""
    inside = 0
    for k, (axis, size) in enumerate(steps):
        found = [one for one in seen if alarm(one.p_step["shared"][k], ALARMS[1])]
        alone = sum(alarm(one.p_step["independent"][k], ALARMS[1]) for one in seen)
        right = sum(one.gap_right[k] for one in found)
        inside += sum(one.date_inside[k] for one in seen)
        width = np.median([one.date_width_d[k] for one in seen])
        print(
            f"{name}, {axis} {size:g} arcsec: found {len(found)} of {len(seen)} ({alone} as independent), "
            f"right gap {right}, interval of the date {width:.0f} d"
        )
        if f"{axis} {size:g}" in FOUND:
            judge_share(
                f"{name}: step of {size:g} arcsec about {axis} found", len(found), len(seen), least=0.9
            )
    judge_share(f"{name}: 95 % interval holds the date", inside, len(seen) * len(steps), least=0.93)


MONTHS = ("2024-10-20", "2024-11-20", "2024-12-20", "2025-01-20")
THETA = np.array([0.003, 0.002, 0.001])  # the simulator's own, of the paper's (28)
STEP = np.array([0.6, -0.8, 0.0]) * ARCSEC  # 1 arcsec


def from_pixels(folder: Path) -> None:
    """Dumps of four months rendered, the mounting moved after the second; `calibrate` finds it by itself."""
    turned = theta_between(deviation_from_theta(STEP) * deviation_from_theta(THETA), Rotation.identity())
    common = ["errors.gps_m=0.2", "errors.distortion_px=0.0", "strips.only_around_targets_px=60.0"]
    dumps = []
    for k, month in enumerate(MONTHS):
        theta = (THETA if k < 2 else turned).tolist()
        changes = [*common, f'epoch_utc="{month}T03:40:00"', f"installation.theta_rad={theta}"]
        options = [part for change in changes for part in ("--set", change)]
        dumps.append(str(folder / month))
        run_command("simulate", "mini", dumps[-1], "--seed", str(11 + k), *options)
    out = folder / "result"
    # one matrix for all months is refuted: the mounting moved
    run_command("calibrate", *dumps, "--out", str(out), "--workers", "1", "--no-report", status=3)
    drift = json.loads((out / "drift.json").read_text())
    found = np.array(drift["step"]["theta_rad"])
    sigma = np.sqrt(np.diag(drift["step"]["covariance_rad2"]))
    p = drift["step"]["p_value"]
    print(f"step found {np.round(found / ARCSEC, 2)} arcsec, true {STEP / ARCSEC}; p {p:.1e}")
    off = float(np.abs((found - STEP) / sigma).max())
    judge_largest("four rendered months, step of 1 arcsec: largest error", off, 4.0, "sigma")


def main() -> int:
    options = arguments_of(
        __doc__,
        ("--rest", 100, "years of four strips a month"),
        ("--steps", 20, "years of ten strips a month"),
        ("--calibrated", 4, "of them through `calibrate` each month"),
        ("--seed", 2020, "of all"),
        ("--pixels", False, "render and calibrate four months, too"),
    )
    head("A year of calibrations: alarms, steps, dates")
    at_rest(f"{AT_REST} strips a month", years(options.seed, options.rest, AT_REST, False, []))
    drawn = years(options.seed + 1, options.steps, FOR_STEPS, False, STEPS)
    at_rest(f"{FOR_STEPS} strips a month", drawn)
    after_steps(f"{FOR_STEPS} strips a month", drawn, STEPS)
    if options.calibrated:
        large = [step for step in STEPS if step[1] == 1.0]
        after_steps("calibrated", years(options.seed + 2, options.calibrated, FOR_STEPS, True, large), large)
    if options.pixels:
        with tempfile.TemporaryDirectory() as folder:
            from_pixels(Path(folder))
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
