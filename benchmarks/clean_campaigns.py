"""Campaigns without a fault: how many are refuted or get a finding, and whether the covariance is honest.

    python benchmarks/clean_campaigns.py sightings --runs 1000
    python benchmarks/clean_campaigns.py dumps WORK --runs 100

`sightings`: directions with all stated errors at the paper's size, without images: strips of the ground, of
the sky, both, and attitudes of two heads with coloured noise; with 2, 4 and 14 exposures a strip; with a
residual distortion that is one curve over the field, and one that differs from CCD to CCD. The prior is that
of a dump that states look_distortion_px = 0.3 and no more.

`dumps`: whole dumps of `fault_dumps.py` with seeds of their own through `boresight calibrate --json`. Those
that are finished are kept in WORK/clean_campaigns.jsonl by commit.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import record  # of this folder; sets the number of threads before NumPy is loaded

import numpy as np  # isort: skip
from fault_dumps import sound_dump
from faults_grid import Case, calibrated, case_of, imported, judged
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
from boresight.simulator.cameras import calibrated_line_camera
from boresight.simulator.campaign import (
    CameraPair,
    DistortionCurve,
    StripPlan,
    draw_strips,
    installation_by_tilt,
)
from boresight.simulator.head_attitudes import HeadPlan, with_heads
from boresight.simulator.scenario import LineCameraSettings
from boresight.simulator.sky_campaign import draw_sky_strips

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


def sightings(runs: int, counts: Sequence[int], first_seed: int) -> list[tuple[tuple[str, ...], Run]]:
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


# ---- whole dumps ----


def dumps(runs: int, work: Path, first_seed: int) -> list[tuple[tuple[str, ...], Run]]:
    """Dumps of the kinds by their shares; each is made, calibrated and removed."""
    work.mkdir(parents=True, exist_ok=True)
    kept, commit = work / "clean_campaigns.jsonl", record.commit().split()[0]
    lines = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    done = {(one["dump"], one["seed"]): one for one in lines if one["commit"] == commit}
    imported()
    names = [name for name, share in SHARES.items() for _ in range(share * runs // 100)]
    wanted = [(name, first_seed + n) for n, name in enumerate(names)]  # no two dumps share a drawn error
    cases = []
    for name, seed in wanted:
        if (name, seed) not in done:
            case = one_dump(name, seed, work) | {"dump": name, "seed": seed, "commit": commit}
            with kept.open("a") as stream:
                stream.write(json.dumps(case) + "\n")
            done[name, seed] = case
        cases.append(done[name, seed])
    return [((case["dump"],), run_of(case)) for case in cases]


def one_dump(name: str, seed: int, work: Path) -> Case:
    with tempfile.TemporaryDirectory(dir=work) as folder:
        dump = sound_dump(name, seed, Path(folder))
        truth = tomllib.loads((dump / "truth" / "installation.toml").read_text())["quaternion_cs"]
        (Path(folder) / "case").mkdir()
        return case_of(*calibrated(dump, Path(folder) / "case", None), Rotation.from_quat(truth))


def run_of(case: Case) -> Run:
    """A case of the grid without a fault."""
    no_fault = {"words": [], "words_lower": [], "own": [], "harmless": True, "blind_words": ""}
    found = judged(case | no_fault)
    outcome = "consistent" if found["clean"] else case["verdict"]
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
        groups["all"].append(run)
    print(f"{'campaigns':34s}    n refuted findings not checkable   NEES   99.9 % band")
    for name, runs in groups.items():
        nees = [run.nees for run in runs if np.isfinite(run.nees)]
        low, high = record.band_of_mean_nees(max(len(nees), 1))
        count = [sum(run.outcome == one for run in runs) for one in ("consistent, findings", "not checkable")]
        print(
            f"{name:34s} {len(runs):4d} {sum(run.refuted for run in runs):7d} {count[0]:8d} {count[1]:13d} "
            f"{np.mean(nees) if nees else np.nan:6.2f}   {low:.2f} to {high:.2f}"
        )
    every = groups["all"]
    for run in every:
        if run.why and run.outcome != "consistent":
            print(f"{run.outcome}, {run.why}")
    refuted = sum(run.refuted for run in every) / len(every)
    findings = sum(run.outcome == "consistent, findings" for run in every) / len(every)
    print()
    record.verdict(f"refuted {refuted:.4f} of {len(every)} ({MOST_REFUTED})", refuted <= MOST_REFUTED)
    most = MOST_FINDINGS[what]
    record.verdict(f"findings in {findings:.4f} ({most})", findings <= most)
    for name in (name for name in groups if name.startswith("all")):
        nees = float(np.nanmean([run.nees for run in groups[name]]))
        low, high = record.band_of_mean_nees(len(groups[name]))
        low, high = min(low, NEES_BAND[0]), max(high, NEES_BAND[1])
        record.verdict(f"mean NEES {nees:.2f} of {name} ({low:.2f} to {high:.2f})", low <= nees <= high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=tuple(MOST_FINDINGS))
    parser.add_argument("work", type=Path, nargs="?", help="folder, for dumps")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--exposures", type=int, action="append", help="a strip, of sightings")
    parser.add_argument("--first-seed", type=int, default=101)
    options = parser.parse_args()
    record.head(f"Campaigns without a fault: {options.what}")
    if options.what == "sightings":
        counts = options.exposures or EXPOSURES
        report(sightings(options.runs, counts, options.first_seed), "sightings")
    else:
        work = options.work or Path(tempfile.mkdtemp())
        report(dumps(options.runs, work, options.first_seed), "dumps")
        if options.work is None:
            shutil.rmtree(work)
    raise SystemExit(record.exit_status())


if __name__ == "__main__":
    main()
