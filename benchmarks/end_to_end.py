"""From pixels to the matrix, many missions rendered anew: are the errors as small as the covariance says?

    python benchmarks/end_to_end.py [--scenario mini] [--seeds 6] [--first 1] [--cuts 1] [--changed 0.3]

Each seed is simulated, calibrated and held against its truth by the same three steps that a user takes; dumps
lie in a scratch folder and are removed. The bound beside each error is the 1-sigma that the run states of
itself: the Cramér-Rao bound of its own sightings. The paper's mission takes 4 minutes and 2 GB a seed. The
first `--cuts` missions are calibrated again with their strips cut, in files of their own, into groups of CCDs
and between targets: how data are cut must not change the result, and each cut has errors as small as its
covariance says.
With `--changed` the strips are of another date than the chips: that share of the fields bears another crop,
under other light, with new patches and clouds. With `--clouds` opaque clouds hide that share of the strips
and shade as much beside, and a Sun that has turned casts shadows beside all bright structures.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from processes import Step, run_command
from record import arguments_of, exit_status, head, judge_largest, judge_nees, judge_share

from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.results.reading import read_saved_result
from boresight.pipeline.results.validate import TruthErrors, true_installation, validation_of

CUTS = ((1, 2), (1, 4), (2, 1), (3, 1), (2, 2))  # parts of the rows and of the CCDs


@dataclass(frozen=True)
class Run:
    """One seed."""

    seed: int
    calibrated: Step
    errors: TruthErrors
    stars: int
    targets: int
    visible: int
    used: int  # of the visible ones
    chi2_dof: float
    apart: tuple[float, float] = (0.0, 0.0)  # by cuts: theta in its sigma, and share of sigma, the largest
    squares: tuple[float, ...] = ()  # errors of the cuts, squared in their covariances


def with_strips_cut(dump: Path, out: Path, line: dict[str, np.ndarray], rows: int, ccds: int) -> None:
    """A copy of a dump, the strips cut into groups of CCDs and between the targets, which are at `line`."""
    shutil.copytree(dump, out)
    parts = []
    strips = pd.read_csv(out / "strips.csv", dtype={"id": str})
    for strip in strips.itertuples():
        image = cv2.imread(str(out / strip.file), cv2.IMREAD_UNCHANGED)
        free = [abs(line[strip.id] - row).min() for row in range(len(image))]
        middle = [round(len(image) * n / rows) for n in range(1, rows)]
        near = len(image) // (3 * rows)
        at = [0, *(m - near + int(np.argmax(free[m - near : m + near])) for m in middle), len(image)]
        for n, (first, last) in enumerate(pairwise(at)):
            file = f"strips/{strip.id}_{strip.ccd}_{n}.tif"
            cv2.imwrite(str(out / file), image[first:last])
            utc = np.datetime64(strip.utc_first_row) + np.timedelta64(
                round(first * strip.row_period_s * 1e9), "ns"
            )
            name = f"{strip.id}.{n}.{strip.ccd % ccds}"
            parts.append((name, strip.ccd, file, str(utc), strip.row_period_s, last - first))
    pd.DataFrame(parts, columns=strips.columns).to_csv(out / "strips.csv", index=False)


def apart_by_cuts(dump: Path, result: Path) -> tuple[tuple[float, float], tuple[float, ...]]:
    """How far theta moves, in its sigma, and by which share sigma, at most, where strips are cut; and the
    squared error of each cut in its covariance.
    """
    whole, table = read_saved_result(result), pd.read_parquet(result / "sightings" / "targets.parquet")
    line = {name: np.stack(of["xy_px"])[:, 1] for name, of in table.groupby("strip_id")}
    variance, moved, share, squares = np.diag(whole.cov_theta), [], [], []
    truth = true_installation(open_dump(dump))
    for rows, ccds in CUTS:
        with tempfile.TemporaryDirectory() as scratch:
            with_strips_cut(dump, Path(scratch) / "dump", line, rows, ccds)
            run_command("calibrate", f"{scratch}/dump", "--out", f"{scratch}/result", "--no-report")
            one = read_saved_result(Path(scratch) / "result")
        moved.append(np.abs(theta_between(one.R_cs, whole.R_cs) / np.sqrt(variance)).max())
        share.append(np.abs(np.sqrt(np.diag(one.cov_theta) / variance) - 1.0).max())
        off = theta_between(one.R_cs, truth)
        squares.append(float(off @ np.linalg.solve(one.cov_theta, off)))
        counts = [[of.installation[key] for key in ("frames", "stars", "targets")] for of in (one, whole)]
        told = f"{moved[-1]:.3f} sigma, {share[-1]:.2%}, {counts[0]} of {counts[1]}, NEES {squares[-1]:.2f}"
        print(f"  {rows} x rows, {ccds} x CCDs: {told}", flush=True)
    return (float(max(moved)), float(max(share))), tuple(squares)


def shade(dump: Path, seed: int, share: float) -> None:
    """Opaque clouds over that share of a dump's strips, their shadows, and those of bright structures."""
    rng = np.random.default_rng([seed, 19])
    for path in sorted((dump / "strips").glob("*.tif")):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        grey = image.astype(np.float32)
        high = (grey - cv2.GaussianBlur(grey, (0, 0), 4.0) > 8.0).astype(np.uint8)  # roofs, trees, banks
        shadow = np.zeros_like(high)
        for step in range(2, 7):  # px, towards the right and down: the Sun is at the upper left
            shadow |= np.roll(high, (step // 2, step), axis=(0, 1))
        noise = rng.normal(size=tuple(n // 16 + 2 for n in grey.shape)).astype(np.float32)
        field = cv2.resize(
            cv2.GaussianBlur(noise, (0, 0), 4.0), grey.shape[::-1], interpolation=cv2.INTER_CUBIC
        )
        cloud = field > np.quantile(field, 1.0 - share)
        shade = (shadow > high) | np.roll(cloud, (50, 90), axis=(0, 1))
        out = np.where(cloud, 217.0, np.where(shade, 0.45 * grey, grey))
        cv2.imwrite(str(path), np.round(out).astype(image.dtype))


def run_seed(scenario: str, seed: int, changed: float, clouds: float, workers: int, is_cut: bool) -> Run:
    """Simulate, calibrate, validate, cut, remove."""
    with tempfile.TemporaryDirectory() as scratch:
        dump, result = Path(scratch) / "dump", Path(scratch) / "result"
        light = ("gamma=0.8", "ramp=0.3", "occlusion=0.05", f"changed_fields={changed}")
        date = ["ground.cloud.cover=0.1", *(f"ground.other_date.{one}" for one in light)] if changed else []
        sets = [text for change in date for text in ("--set", change)]
        run_command("simulate", scenario, str(dump), "--seed", str(seed), *sets)
        if clouds:
            shade(dump, seed, clouds)
        command = "calibrate", str(dump), "--out", str(result), "--workers", str(workers)
        calibrated = run_command(*command, status=None if changed or clouds else 0)  # findings are allowed
        saved = read_saved_result(result)
        facts = saved.installation
        return Run(
            seed,
            calibrated,
            validation_of(saved, open_dump(dump)),
            facts["stars"],
            facts["targets"],
            *_visible(open_dump(dump), pd.read_parquet(result / "sightings" / "targets.parquet")),
            facts["chi2"] / facts["dof"],
            *(apart_by_cuts(dump, result) if is_cut else ()),
        )


def _visible(dump: Dump, sighted: pd.DataFrame) -> tuple[int, int]:
    """Images of targets around which, ± 40 px, no cloud hides half of a strip, and those of them in use."""
    strips, seen, used = {strip.strip_id: strip.images for strip in dump.strips}, 0, 0
    kept = sighted[sighted.kept]
    in_use = set(zip(kept.strip_id, kept.target_id, kept.ccd))
    for at in pd.read_csv(dump.root / "truth" / "targets.csv").itertuples():
        images, (x, y) = strips[at.strip], (round(at.sample), round(at.line))
        lines, samples = images.shape(at.ccd)
        box = max(0, y - 40), min(lines, y + 40), max(0, x - 40), min(samples, x + 40)
        is_seen = (images.read(at.ccd, *box) < 170).mean() > 0.5  # a cloud has 217, no land 170
        seen, used = seen + is_seen, used + (is_seen and (at.strip, at.id, at.ccd) in in_use)
    return int(seen), int(used)


def row(run: Run) -> str:
    """A line of the table."""
    v, cost = run.errors, run.calibrated
    along, across = v.after.rms_m
    return (
        f"{run.seed:4d}  {_triple(v.error_rad / ARCSEC, '+.3f')}  {_triple(v.sigma_rad / ARCSEC, '.3f')}  "
        f"{v.nees:5.2f}  {run.targets:4d} {run.stars:6d}  {run.chi2_dof:5.2f}  {along:.2f} {across:.2f}  "
        f"{cost.cpu_s:.1f} {cost.peak_mib:.0f}"
    )


def _triple(values: np.ndarray, form: str) -> str:
    return " ".join(format(float(value), form) for value in values)


def main() -> int:
    options = arguments_of(
        __doc__,
        ("--scenario", "mini", "mini, paper or a TOML file"),
        ("--seeds", 6, "missions"),
        ("--first", 1, "seed of the first"),
        ("--changed", 0.0, "share of the fields that bear another crop"),
        (
            "--clouds",
            0.0,
            "share of the strips under opaque clouds; shadows of these and of a Sun that has turned",
        ),
        ("--workers", 1, "processes of each calibration"),
        ("--cuts", 0, "missions whose strips are cut"),
    )
    head(f"End to end, scenario {options.scenario}")
    print("seed  error X Y Z, arcsec  1 sigma  NEES  targets stars  chi2/dof  check points, m  s CPU, MiB")
    runs = []
    for seed in range(options.first, options.first + options.seeds):
        is_cut = len(runs) < options.cuts
        runs.append(
            run_seed(options.scenario, seed, options.changed, options.clouds, options.workers, is_cut)
        )
        print(row(runs[-1]), flush=True)
    errors = np.array([run.errors.error_rad for run in runs])
    sigmas = np.array([run.errors.error_rad / run.errors.sigma_rad for run in runs])
    print(f"\nrms error {_triple(np.sqrt((errors**2).mean(axis=0)) / ARCSEC, '.3f')} arcsec")
    print(f"rms of errors in sigmas {_triple(np.sqrt((sigmas**2).mean(axis=0)), '.2f')}")
    name = f"{options.scenario} from pixels"
    if options.changed or options.clouds:
        name = f"{name}, {options.changed:g} of the fields changed, {options.clouds:g} under clouds"
        used, visible = (sum(getattr(run, what) for run in runs) for what in ("used", "visible"))
        judge_share(f"{name}: targets used of those visible", used, visible, least=0.8)
    judge_largest(f"{name}: largest error", float(np.abs(sigmas).max()), 4.0, "of its own sigma", len(runs))
    judge_nees(name, [run.errors.nees for run in runs])
    if options.cuts:
        moved, share = np.max([run.apart for run in runs], axis=0)
        judge_largest(f"{name}: strips cut, theta moves by", moved, 0.3, "of its sigma", options.cuts)
        judge_largest(f"{name}: strips cut, sigma moves by", share, 0.01, "of itself", options.cuts)
        for (rows, ccds), squares in zip(CUTS, zip(*(run.squares for run in runs if run.squares))):
            judge_nees(f"{name}: rows in {rows} parts, CCDs in {ccds}", squares)
    peak = max(run.calibrated.peak_mib for run in runs)
    judge_largest(f"{name}: memory of a calibration", peak, 1024.0, "MiB", len(runs))
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
