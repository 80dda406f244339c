"""Does a mounting at rest raise an alarm, is a step found with its date, and does the merged covariance hold?

    python benchmarks/drift.py --out benchmarks/results/drift.md
    python benchmarks/drift.py --pixels FOLDER

A run is a year: twelve calibrations at uneven dates, drawn at the level of vectors with every error of the
paper's Table 1 and one distortion of the camera for the whole year; the star camera looks 15 deg off the
zenith and is rotated by 37 deg. The estimator does not know the matrix: information refers to one that is
2" (1 sigma, each axis) wrong. `--rest` years of four strips a month show the alarms at rest, `--steps` years
of ten strips a month show steps: a moved mounting is the same year seen by a star camera that is rotated from
a date on. `--calibrated` more go through `calib.calibrate` month by month, look for gross errors and iterate.
`--series` are Gaussian draws from given covariances, for the tests alone. `--pixels` renders dumps of four
months, the mounting moved by 1" in the middle, and runs the program on them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from end_to_end import machine
from numpy.typing import NDArray
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
REST_HEAD = (
    "| years | runs | alarms, 5 % asked | alarms, 1 % asked | mean p (0.5) | NEES of the merged (3) "
    "| its 1σ X, Y, Z, ″ |"
)
STEP_HEAD = (
    "| step | found | found, taken as independent | in the right gap, of those found "
    "| date's 95 % interval holds it, of all | its median width |"
)


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


def share(count: int, of: int) -> str:
    """Per cent with its binomial 1-sigma (of one count, where there is none)."""
    p = count / of
    sigma = np.sqrt(max(p * (1.0 - p), 1.0 / of) / of)
    return f"{100 * p:.1f} ± {100 * sigma:.1f} %"


def years(jobs: list[Job], processes: int) -> list[Year]:
    with Pool(processes) as pool:
        found = []
        for one in pool.imap(year, jobs, chunksize=4):
            found.append(one)
            print(f"\r{len(found)} of {len(jobs)} years", end="", file=sys.stderr)
    return found


def rest_rows(found: list[Year], name: str) -> Iterator[str]:
    n = len(found)
    for way in WAYS:
        counts = [sum(alarm(one.p_rest[way], p) for one in found) for p in ALARMS]
        mean_p = np.mean([one.p_rest[way][0] for one in found])
        nees = np.mean([one.nees[way] for one in found])
        sigma = np.mean([one.sigma[way] for one in found], axis=0) / ARCSEC
        alarms = " | ".join(f"{count}: {share(count, n)}" for count in counts)
        yield (
            f"| {name}, {way} | {n} | {alarms} "
            f"| {mean_p:.3f} ± {np.sqrt(1 / 12 / n):.3f} | {nees:.2f} ± {np.sqrt(6 / n):.2f} "
            f"| {sigma[0]:.3f}, {sigma[1]:.3f}, {sigma[2]:.2f} |"
        )


def step_rows(found: list[Year]) -> Iterator[str]:
    n = len(found)
    for k, (axis, size) in enumerate(STEPS):
        seen = [one for one in found if alarm(one.p_step["shared"][k], 0.01)]
        alone = sum(alarm(one.p_step["independent"][k], 0.01) for one in found)
        if not seen:
            yield f'| {axis} {size:g}" | {share(0, n)} | {share(alone, n)} | | | |'
            continue
        right = sum(one.gap_right[k] for one in seen)
        inside = sum(one.date_inside[k] for one in found)
        width = np.median([one.date_width_d[k] for one in seen])
        yield (
            f'| {axis} {size:g}" | {share(len(seen), n)} | {share(alone, n)} | {share(right, len(seen))} '
            f"| {share(inside, n)} | {width:.0f} d |"
        )


def series_rows(seed: int, runs: int) -> Iterator[str]:
    """Gaussian draws: three axes of 0.1", 0.15" and 1" (1 sigma) give or take half, turned anew each time."""
    for K in (3, 6, 12):
        rng, counts = np.random.default_rng((seed, K)), [0, 0]
        for _ in range(runs):
            sigma = np.array([0.1, 0.15, 1.0]) * ARCSEC * rng.uniform(0.5, 1.5, (K, 1))
            Q = Rotation.random(K, random_state=rng).as_matrix()
            theta = np.einsum("kij,kj->ki", Q, sigma * rng.normal(size=(K, 3)))
            F = np.einsum("kij,kj,klj->kil", Q, sigma**-2.0, Q)
            names = np.array([f"{k:02d}" for k in range(K)])
            pairs = InformationPairs(names, F, np.einsum("kij,kj->ki", F, theta), R_CS)
            series = MountingSeries.of(pairs, NONE, DAYS[:K] * DAY_S)
            drift = estimate_drift(series, DriftSettings(density_rad2_s=0.0))
            p = (drift.constant.p_value, drift.step.p_value)
            counts = [count + alarm(p, asked) for count, asked in zip(counts, ALARMS)]
        yield f"| {K} | {runs} | " + " | ".join(f"{c}: {share(c, runs)}" for c in counts) + " |"


def vectors_report(options: argparse.Namespace) -> str:
    begin = time.perf_counter()
    seed = options.seed
    at_rest = years([Job((seed, n), AT_REST, False, []) for n in range(options.rest)], options.processes)
    drawn = years(
        [Job((seed + 1, n), FOR_STEPS, False, STEPS) for n in range(options.steps)], options.processes
    )
    calibrated = years(
        [Job((seed + 2, n), FOR_STEPS, True, STEPS) for n in range(options.calibrated)], options.processes
    )
    lines = [
        "# A year of calibrations: alarms, steps, dates",
        "",
        *machine(),
        f"{len(DAYS)} results on days {', '.join(f'{d:.0f}' for d in DAYS)}, strips "
        f"({PLAN.exposures} exposures of {PLAN.stars} stars, {PLAN.targets} targets; every error of Table 1; "
        "one distortion a year). *shared*: the distortion is one unknown of all results, as `boresight "
        "drift` has it. *independent*: each result's own covariance, for comparison.",
        "",
        "## At rest",
        "",
        REST_HEAD,
        "|---|---|---|---|---|---|---|",
        *rest_rows(at_rest, f"{AT_REST} strips a month"),
        *rest_rows(drawn, f"{FOR_STEPS} strips a month"),
        *rest_rows(calibrated, f"{FOR_STEPS}, `calibrate` each month"),
        "",
        "Gaussian draws from given covariances, nothing shared:",
        "",
        "| results | series | alarms, 5 % asked | alarms, 1 % asked |",
        "|---|---|---|---|",
        *series_rows(seed + 3, options.series),
        "",
        "## A step on a random day between day 62 and day 273, 1 % false alarms asked",
        "",
        f"{options.steps} years of {FOR_STEPS} strips a month.",
        "",
        STEP_HEAD,
        "|---|---|---|---|---|---|",
        *step_rows(drawn),
        "",
        f"The same through `calibrate` each month ({options.calibrated} years), steps of 1″ about X and Y:",
        "",
        STEP_HEAD,
        "|---|---|---|---|---|---|",
        *(row for row in step_rows(calibrated) if ' 1"' in row),
        "",
        f"{time.perf_counter() - begin:.0f} s with {options.processes} processes.",
    ]
    return "\n".join(lines).replace('"', "″") + "\n"


MONTHS = ("2024-10-20", "2024-11-20", "2024-12-20", "2025-01-20")
THETA = np.array([0.003, 0.002, 0.001])  # the simulator's own, of the paper's (28)
STEP = np.array([0.6, -0.8, 0.0]) * ARCSEC  # 1 arcsec


def pixels_report(folder: Path) -> str:
    """Dumps of four months rendered, the mounting moved after the second; `calibrate` finds it by itself."""
    program = [sys.executable, "-m", "boresight"]
    turned = theta_between(deviation_from_theta(STEP) * deviation_from_theta(THETA), Rotation.identity())
    common = ["errors.gps_m=0.2", "errors.distortion_px=0.0", "strips.only_around_targets_px=60.0"]
    dumps = []
    for k, month in enumerate(MONTHS):
        theta = (THETA if k < 2 else turned).tolist()
        changes = [*common, f'epoch_utc="{month}T03:40:00"', f"installation.theta_rad={theta}"]
        options = [part for change in changes for part in ("--set", change)]
        dumps.append(str(folder / month))
        subprocess.run([*program, "simulate", "mini", dumps[-1], "--seed", str(11 + k), *options], check=True)
    out = folder / "result"
    ran = subprocess.run(
        [*program, "calibrate", *dumps, "--out", str(out), "--workers", "1", "--no-report"],
        check=False,
        capture_output=True,
        text=True,
    )
    if ran.returncode != 3:  # one matrix for all months is refuted: the mounting moved
        raise SystemExit(f"exit status {ran.returncode}, expected 3:\n{ran.stdout}{ran.stderr}")
    drift = json.loads((out / "drift.json").read_text())
    found = np.array(drift["step"]["theta_rad"]) / ARCSEC
    sigma = np.sqrt(np.diag(drift["step"]["covariance_rad2"])) / ARCSEC
    changes = " ".join(f"--set {change}" for change in [*common, "epoch_utc=…", "installation.theta_rad=…"])
    lines = [
        "## From pixels: four dumps of mini, the mounting moved by 1″ after the second",
        "",
        *machine(),
        f"    boresight simulate mini MONTH --seed 11 … 14 {changes}",
        "    boresight calibrate MONTHS --out RESULT",
        "",
        f"Dumps of {', '.join(MONTHS)}; step {', '.join(f'{v:g}' for v in STEP / ARCSEC)}″ about X, Y, Z.",
        "",
        *(f"    {line}" for line in ran.stdout.splitlines()),
        "",
        f"Step minus truth over 1σ: {', '.join(f'{v:+.2f}' for v in (found - STEP / ARCSEC) / sigma)}.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rest", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--calibrated", type=int, default=40)
    parser.add_argument("--series", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=2020)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--pixels", type=Path, help="render dumps here and calibrate them, nothing else")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    text = pixels_report(options.pixels) if options.pixels else vectors_report(options)
    if options.out:
        options.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
