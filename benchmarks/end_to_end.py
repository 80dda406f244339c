"""From pixels to the matrix, many missions rendered anew: are the errors as small as the covariance says?

    python benchmarks/end_to_end.py --scenario mini --seeds 1-20 --jobs 2

Each seed is simulated, calibrated and held against its truth by the same three steps that a user takes; dumps
lie in a scratch folder and are removed. Prints a table in Markdown and, with --out, writes it to a file. The
bound beside each error is the 1-sigma that the run states of itself: the Cramér-Rao bound of its own
sightings.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.results.reading import read_saved_result
from boresight.pipeline.results.validate import TruthErrors, validation_of

COMMAND = (sys.executable, "-m", "boresight")


@dataclass(frozen=True)
class Step:
    """One command: what it cost."""

    elapsed_s: float
    cpu_s: float
    peak_mib: float  # of the largest process


@dataclass(frozen=True)
class Run:
    """One seed."""

    seed: int
    simulated: Step
    calibrated: Step
    validation: TruthErrors
    exposures: int
    stars: int
    targets: int
    chi2_dof: float


def run_command(*arguments: str) -> Step:
    """Run `boresight` with these arguments in a process of its own; its cost, children included."""
    start, peak_kib = time.perf_counter(), 0
    with tempfile.TemporaryFile("w+") as told:
        process = subprocess.Popen([*COMMAND, *arguments], stdout=told, stderr=subprocess.STDOUT)
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            peak_kib = max(peak_kib, high_water_kib(process.pid))
            time.sleep(0.05)
        _, status, usage = ended
        if status:
            told.seek(0)
            raise SystemExit(f"boresight {' '.join(arguments)} failed:\n{told.read()}")
    return Step(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, peak_kib / 1024.0)


def high_water_kib(pid: int) -> int:
    """Largest resident size so far of a process (Linux; ru_maxrss would count the parent's before exec)."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM")), 0)


def run_seed(scenario: str, seed: int, scratch: Path, changes: list[str], workers: int) -> Run:
    """Simulate, calibrate, validate, remove."""
    dump, result = scratch / f"dump-{seed}", scratch / f"result-{seed}"
    try:
        sets = [text for change in changes for text in ("--set", change)]
        simulated = run_command("simulate", scenario, str(dump), "--seed", str(seed), *sets)
        calibrated = run_command("calibrate", str(dump), "--out", str(result), "--workers", str(workers))
        saved = read_saved_result(result)
        facts = saved.installation
        return Run(
            seed,
            simulated,
            calibrated,
            validation_of(saved, open_dump(dump)),
            facts["frames"],
            facts["stars"],
            facts["targets"],
            facts["chi2"] / facts["dof"],
        )
    finally:
        shutil.rmtree(dump, ignore_errors=True)
        shutil.rmtree(result, ignore_errors=True)


def table(runs: list[Run]) -> list[str]:
    """One line a run, then what holds over all of them."""
    lines = [
        "| seed | error X, Y, Z (arcsec) | stated 1 sigma (arcsec) | in sigmas | NEES | targets | stars "
        "| chi2/dof | check points rms along, across (m) | calibrate (s, s CPU, MiB) |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        v = run.validation
        along, across = v.after.rms_m
        cost = run.calibrated
        lines.append(
            f"| {run.seed} | {_triple(v.error_rad / ARCSEC, '+.3f')} "
            f"| {_triple(v.sigma_rad / ARCSEC, '.3f')} "
            f"| {_triple(v.error_rad / v.sigma_rad, '+.2f')} | {v.nees:.2f} | {run.targets} | {run.stars} "
            f"| {run.chi2_dof:.2f} | {along:.2f}, {across:.2f} "
            f"| {cost.elapsed_s:.1f}, {cost.cpu_s:.1f}, {cost.peak_mib:.0f} |"
        )
    errors = np.array([run.validation.error_rad for run in runs])
    sigmas = np.array([run.validation.error_rad / run.validation.sigma_rad for run in runs])
    nees = np.array([run.validation.nees for run in runs])
    lines += [
        "",
        f"{len(runs)} runs. Largest error {np.abs(sigmas).max():.2f} of its own sigma (allowed 4). "
        f"Mean NEES {nees.mean():.2f} (allowed 1.5 to 5, expected 3 with a standard error of "
        f"{np.sqrt(6 / len(runs)):.2f}).",
        f"Rms error {_triple(np.sqrt((errors**2).mean(axis=0)) / ARCSEC, '.3f')} arcsec; "
        f"mean {_triple(errors.mean(axis=0) / ARCSEC, '+.3f')} arcsec. "
        f"Rms of errors in sigmas {_triple(np.sqrt((sigmas**2).mean(axis=0)), '.2f')}.",
        f"Simulate: {np.mean([r.simulated.cpu_s for r in runs]):.0f} s CPU a run, "
        f"{max(r.simulated.peak_mib for r in runs):.0f} MiB at most; calibrate: "
        f"{np.mean([r.calibrated.cpu_s for r in runs]):.1f} s CPU a run, "
        f"{max(r.calibrated.peak_mib for r in runs):.0f} MiB at most.",
    ]
    return lines


def machine() -> list[str]:
    """Commit, digest of the code, date, machine, versions and the command."""
    from importlib.metadata import version

    from code_digest import WorkingTree, code_of
    from record import commit

    cpu = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        names = [s for s in Path("/proc/cpuinfo").read_text().splitlines() if s.startswith("model name")]
        cpu = names[0].split(":", 1)[1].strip() if names else cpu
    packages = ", ".join(f"{name} {version(name)}" for name in ("boresight", "numpy", "scipy", "pyerfa"))
    command = f"python benchmarks/{Path(sys.argv[0]).name} {' '.join(sys.argv[1:])}"
    return [
        f"Commit {commit()}, code {code_of(command, WorkingTree())}, {datetime.date.today().isoformat()}, "
        f"{os.cpu_count()} cores of {cpu}, Python {platform.python_version()}, {packages}",
        "",
        f"    {command}",
        "",
    ]


def _triple(values: NDArray[np.float64], form: str) -> str:
    return ", ".join(format(float(value), form) for value in values)


def _seeds(text: str) -> list[int]:
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="mini", help="mini, paper or a TOML file")
    parser.add_argument("--seeds", type=_seeds, default=_seeds("1-20"), help="first-last")
    parser.add_argument("--set", action="append", default=[], dest="changes", help="section.key=value")
    parser.add_argument("--jobs", type=int, default=1, help="seeds at the same time")
    parser.add_argument("--workers", type=int, default=1, help="processes of each calibration")
    parser.add_argument("--scratch", type=Path, help="folder for the dumps; default: the system's")
    parser.add_argument("--out", type=Path, help="Markdown file to write")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(dir=options.scratch) as scratch,
        ThreadPoolExecutor(options.jobs) as pool,
    ):

        def one(seed: int) -> Run:
            run = run_seed(options.scenario, seed, Path(scratch), options.changes, options.workers)
            print("\n".join(table([run])[2:3]), file=sys.stderr, flush=True)
            return run

        runs = list(pool.map(one, options.seeds))
    text = "\n".join([f"# End to end, scenario {options.scenario}", "", *machine(), *table(runs), ""])
    print(text)
    if options.out is not None:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
