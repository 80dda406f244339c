"""Campaigns without a fault: how many are refuted or get a finding, and whether the covariance is honest.

    python benchmarks/clean_campaigns.py [--sightings 120] [--dumps 5] [--cuts 0]

`sightings`: directions with all stated errors at the paper's size, without images: strips of the ground, of
the sky, both, and attitudes of two heads with coloured noise; with 2, 4 and 14 exposures a strip; with a
residual distortion that is one curve over the field, and one that differs from CCD to CCD. The prior is that
of a dump that states look_distortion_px = 0.3 and no more.

`cuts`: the same strips whole, cut in two by rows, as two and as four simultaneous strips, and with a second
camera of a third of the field that sees other targets: how strips are cut must not change the covariance, and
that between the cameras must be honest too.

`dumps`: whole dumps of `tests/pipeline/faults/fault_dumps.py` with seeds of their own, from pixels, through
`boresight calibrate --json`.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import record  # of this folder; sets the number of threads before NumPy is loaded

sys.path.extend(str(record.ROOT / place) for place in ("tests", "tests/pipeline/faults"))

import numpy as np  # isort: skip
from drawn_campaigns import draw_other_camera
from drawn_heads import HeadPlan, with_heads
from fault_cases import Case, calibrated, case_of, imported, judged, true_rotation
from fault_dumps import sound_dump
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.reliability import examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Verdict, assess
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.files.dump_schema import Errors
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.records.record import Floats
from boresight.simulator.cameras import calibrated_line_camera
from boresight.simulator.campaign import (
    CameraPair,
    DistortionCurve,
    StripPlan,
    draw_sky_strips,
    draw_strips,
    installation_by_tilt,
)
from boresight.simulator.scenario import LineCameraSettings

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0), np.radians(37.0)))
R_CS0 = Rotation.from_rotvec([3e-3, 2e-3, 1e-3]) * CAMERAS.R_cs
SIGMA_INSTALLATION = np.full(3, 3e-3)
STATED = Errors(
    position_m=2.0,
    clock_s=1e-4,
    vibration_arcsec=0.1,
    look_distortion_px=0.3,
    look_distortion_length_px=1500.0,
)
PLAN = StripPlan(
    strips=3,
    stars=60,
    exposure_margin_s=0.3,
    sigma_position_m=STATED.position_m,
    sigma_clock_s=STATED.clock_s,
    sigma_vibration_rad=STATED.vibration_arcsec * ARCSEC,
    sigma_distortion_rad=STATED.look_distortion_px * CAMERAS.pixel_rad,
    distortion_length_px=STATED.look_distortion_length_px,
    sigma_target_m=0.3,
)
SKY_RATES = (-0.0143, 0.0143)  # rad/s: the imaging rate, forward and back
SECOND_HEAD = Rotation.from_euler("xyz", [-35.0, 20.0, 110.0], degrees=True)
COLOURED = AttitudeNoise(
    white_rad=np.array([0.8, 0.9, 6.5]) * ARCSEC,
    correlated_rad=np.array([0.5, 0.5, 4.7]) * ARCSEC,
    correlation_time_s=np.full(3, 0.8),
    constant_rad=np.array([0.3, 0.3, 2.3]) * ARCSEC,
)
KINDS = ("ground", "sky", "mixed", "heads")
CURVES = ("field", "CCD")
EXPOSURES = (2, 4, 14)
SHARES = {"sky": 40, "scans": 20, "coloured": 20, "ground": 10, "mixed": 10}  # of 100 dumps
MOST_FINDINGS = {"sightings": 0.003, "dumps": 0.01}
MOST_REFUTED, NEES_BAND = 0.001, (2.7, 3.3)


@dataclass(frozen=True)
class Run:
    """What became of one campaign."""

    outcome: str  # of the verdict
    nees: float
    why: str = ""  # seed and what was said, of one that is not consistent

    @property
    def refuted(self) -> bool:
        return self.outcome in ("refuted", "refused", "traceback")


# ---- at the level of sightings ----


def plan_of(exposures: int, curve: str) -> StripPlan:
    """The plan of a campaign."""
    pixel_rad = CAMERAS.pixel_rad if curve == "field" else 0.0
    return replace(PLAN, exposures=exposures, distortion_pixel_rad=pixel_rad)


def strips_of(kind: str, exposures: int, curve: str, rng: np.random.Generator) -> list[StripSightings]:
    """Sightings of one campaign."""
    plan = plan_of(exposures, curve)
    distortion = DistortionCurve.draw(plan, CAMERAS, rng)
    strips: list[StripSightings] = []
    if kind != "sky":
        strips, truth = draw_strips(plan, CAMERAS, rng, curve=distortion)
    if kind == "heads":
        step_s = (plan.duration_s + 2.0 * plan.exposure_margin_s) / (exposures - 1)
        heads = [
            HeadPlan(name, CAMERAS.R_cs * R_sh, COLOURED, step_s=step_s, margin_s=plan.exposure_margin_s)
            for name, R_sh in (("STR1", Rotation.identity()), ("STR2", SECOND_HEAD))
        ]
        return with_heads(strips, truth, heads, [SECOND_HEAD], plan.duration_s, rng)
    if kind != "ground":
        plan = replace(plan, strips=2, sigma_c_px=0.05, targets=14)
        strips = strips + draw_sky_strips(plan, CAMERAS, rng, rates_rad_s=SKY_RATES, curve=distortion)
    return strips


def settings() -> CalibrationSettings:
    """Those of a dump that states `STATED`."""
    return calibration_settings(Settings(), STATED, calibrated_line_camera(LineCameraSettings()))


def sightings(runs: int, counts: tuple[int, ...], first_seed: int) -> list[tuple[tuple[str, ...], Run]]:
    """Campaigns of all combinations in turn, `counts` the exposures a strip."""
    cells = list(itertools.product(KINDS, CURVES, counts))
    stated, done = settings(), []
    for n in range(first_seed, first_seed + runs):
        kind, curve, exposures = cells[n % len(cells)]
        strips = strips_of(kind, exposures, curve, np.random.default_rng([39, n]))
        found = calibrate_strips(strips, R_CS0, stated)
        key = (kind, curve, f"{exposures} exposures")
        if not isinstance(found, InstallationEstimate):
            done.append((key, Run("refused", float("nan"))))
            continue
        reliability = examine(found, strips, stated, pixel_rad=CAMERAS.pixel_rad)
        verdict = assess(found, strips, sigma_installation_rad=SIGMA_INSTALLATION, reliability=reliability)
        error = theta_between(found.R_cs, CAMERAS.R_cs)
        nees = float(error @ np.linalg.solve(found.cov_theta, error))
        done.append((key, Run(verdict.outcome.value, nees, f"seed {n}: {said(verdict)}")))
    return done


def said(verdict: Verdict) -> str:
    """The checks that fail and the inputs that look wrong."""
    failed = [f"{one.kind.value}: p {one.p_value:.1e}" for one in verdict.refuted_by]
    return "; ".join([*failed, *(one.cause + ", " + one.item for one in verdict.findings)])


# ---- the same strips, cut otherwise ----

OBLIQUE = CameraPair(
    Rotation.from_euler("xyz", [25.0, -9.0, 81.0], degrees=True) * CAMERAS.R_cs,
    pixel_rad=2.0 * CAMERAS.pixel_rad,
    ccd_px=CAMERAS.ccd_px // 3,
    n_ccds=2,
)


def cut(strip: StripSightings, part: NDArray[np.int64]) -> list[StripSightings]:
    """The strip as simultaneous strips of the targets with the same number in `part`."""
    rows = [np.flatnonzero(part == k) for k in np.unique(part)]
    return [
        replace(strip, strip_id=f"{strip.strip_id}-{k}", ground=strip.ground.take(own), R_oi_targets=R_oi)
        for k, own in enumerate(rows)
        for R_oi in [strip.R_oi_targets[own]]
    ]


def by_rows(strip: StripSightings) -> list[StripSightings]:
    """The first and the second half of a strip, each with the exposures around it."""
    times, t_s = np.array([one.t_s for one in strip.exposures]), strip.ground.t_s
    middle, step = float(np.mean(times)), float(times[1] - times[0])
    parts = []
    for one, near in zip(cut(strip, (t_s > middle).astype(np.int64)), (times < middle, times > middle)):
        seen = np.flatnonzero(near | (np.abs(times - middle) < 1.5 * step))
        exposures = tuple(strip.exposures[k] for k in seen)
        parts.append(replace(one, exposures=exposures, R_oi_exposures=strip.R_oi_exposures[seen]))
    return parts


CUTS: dict[str, Callable[[StripSightings], list[StripSightings]]] = {
    "whole": lambda strip: [strip],
    "cut in two by rows": by_rows,
    "two simultaneous strips": lambda strip: cut(strip, np.arange(len(strip.ground.t_s)) % 2),
    "four simultaneous strips": lambda strip: cut(strip, np.arange(len(strip.ground.t_s)) % 4),
}


def squared(off: Floats, covariance: Floats) -> float:
    return float(off @ np.linalg.solve(covariance, off))


def cut_campaigns(runs: int, first_seed: int) -> dict[str, list[float]]:
    """Squared errors in their covariances, three degrees of freedom each, of each cut and of two cameras."""
    stated = replace(settings(), of_cameras=(("oblique", replace(settings(), ccd_px=(OBLIQUE.ccd_px,) * 2)),))
    found: dict[str, list[float]] = defaultdict(list)
    for n in range(first_seed, first_seed + runs):
        rng = np.random.default_rng([55, n])
        plan = plan_of(8, "CCD")
        strips, truth = draw_strips(plan, CAMERAS, rng)
        for name, pieces in CUTS.items():
            estimate = calibrate_strips([p for strip in strips for p in pieces(strip)], R_CS0, settings())
            assert isinstance(estimate, InstallationEstimate)
            found[name].append(squared(theta_between(estimate.R_cs, CAMERAS.R_cs), estimate.cov_theta))
        nadir = [replace(strip, camera="nadir") for strip in strips]
        both = [*nadir, *draw_other_camera(strips, truth, plan, OBLIQUE, "oblique", rng)]
        turn = R_CS0 * CAMERAS.R_cs.inv()
        start = {"nadir": R_CS0, "oblique": turn * OBLIQUE.R_cs}
        estimate = calibrate_strips(both, start, stated)
        assert isinstance(estimate, InstallationEstimate)
        for name, camera in (("nadir", CAMERAS), ("oblique", OBLIQUE)):
            R_cs, covariance = estimate.of_camera(name)
            found[f"two cameras, {name}"].append(squared(theta_between(R_cs, camera.R_cs), covariance))
        (between,) = estimate.between()
        off = theta_between(between.R_ab, CAMERAS.R_cs * OBLIQUE.R_cs.inv())
        found["between two cameras"].append(squared(off, between.covariance))
    return found


def report_cuts(found: dict[str, list[float]]) -> None:
    """Mean of each, which is 3 within 3 sqrt(6 / n)."""
    print(f"{'strips':34s}    n   NEES")
    for name, squares in found.items():
        print(f"{name:34s} {len(squares):4d} {np.mean(squares):6.2f}")
    print()
    for name, squares in found.items():
        reach = 3.0 * np.sqrt(6.0 / len(squares))
        record.judge_nees(name, squares, asked=(3.0 - reach, 3.0 + reach))


# ---- whole dumps ----


def dumps(runs: int, first_seed: int) -> list[tuple[tuple[str, ...], Run]]:
    """Dumps of the kinds by their shares; each is made, calibrated and removed."""
    imported()
    names = [name for name, share in SHARES.items() for _ in range(max(1, share * runs // 100))]
    done = []
    for n, name in enumerate(names):  # no two dumps share a drawn error
        with tempfile.TemporaryDirectory() as folder:
            dump = sound_dump(name, first_seed + n, Path(folder))
            (Path(folder) / "case").mkdir()
            case = case_of(*calibrated(dump, Path(folder) / "case", None), true_rotation(dump))
        done.append(((name,), run_of(case)))
    return done


def run_of(case: Case) -> Run:
    """A case of the grid without a fault."""
    no_fault = {"words": [], "words_lower": [], "own": [], "harmless": True, "blind_words": ""}
    found = judged(case | no_fault)
    outcome = case["verdict"]
    if outcome == "consistent" and not found["clean"]:
        outcome = "consistent, findings"
    return Run(outcome, case.get("nees", float("nan")))


# ---- the table ----


def report(done: list[tuple[tuple[str, ...], Run]], what: str) -> None:
    """Counts and mean NEES of each combination, of each of its parts, and of all."""
    groups: dict[str, list[Run]] = defaultdict(list)
    for key, run in done:
        if len(key) > 1:
            groups[", ".join(key)].append(run)
        for part in key:
            groups[f"all of {part}"].append(run)
        groups[f"all {what}"].append(run)
    print(f"{'campaigns':34s}    n refuted findings not checkable   NEES")
    for name, runs in groups.items():
        nees = [run.nees for run in runs if np.isfinite(run.nees)]
        count = [sum(run.outcome == one for run in runs) for one in ("consistent, findings", "not checkable")]
        print(
            f"{name:34s} {len(runs):4d} {sum(run.refuted for run in runs):7d} {count[0]:8d} {count[1]:13d} "
            f"{np.mean(nees) if nees else np.nan:6.2f}"
        )
    every = [run for _, run in done]
    for run in every:
        if run.why and run.outcome != "consistent":
            print(f"{run.outcome}, {run.why}")
    print()
    record.judge_share(f"{what}: refuted", sum(run.refuted for run in every), len(every), most=MOST_REFUTED)
    findings = sum(run.outcome == "consistent, findings" for run in every)
    record.judge_share(f"{what}: findings", findings, len(every), most=MOST_FINDINGS[what])
    for name in (name for name in groups if name.startswith("all") and len(groups[name]) > 1):
        record.judge_nees(name, [one.nees for one in groups[name] if np.isfinite(one.nees)], asked=NEES_BAND)


def main() -> None:
    options = record.arguments_of(
        __doc__,
        ("--sightings", 120, "campaigns of directions"),
        ("--cuts", 0, "campaigns whose strips are cut otherwise, and of two cameras"),
        ("--dumps", 5, "of 100: how many of each kind say their shares; one of each at least"),
        ("--exposures", EXPOSURES, "a strip, of sightings"),
        ("--first-seed", 101, "of either"),
    )
    record.head("Campaigns without a fault")
    if options.sightings:
        report(sightings(options.sightings, options.exposures, options.first_seed), "sightings")
    if options.cuts:
        report_cuts(cut_campaigns(options.cuts, options.first_seed))
    if options.dumps:
        report(dumps(options.dumps, options.first_seed), "dumps")
    raise SystemExit(record.exit_status())


if __name__ == "__main__":
    main()
