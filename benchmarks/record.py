"""Head of a benchmark's record (commit, code, date, machine, versions, command) and its verdicts."""

from __future__ import annotations

import datetime
import os
import platform
import resource
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import scipy
from code_digest import WorkingTree, code_of
from scipy.stats import chi2

__all__ = ["band_of_mean_nees", "commit", "exit_status", "head", "peak_mib", "program", "verdict"]

# NumPy asks but once how many threads to use, when it is loaded; waiting threads count as CPU time. So a
# benchmark that was not told starts anew with one.
if "OPENBLAS_NUM_THREADS" not in os.environ:
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | one_thread)


_FAILED: list[str] = []  # verdicts of this process that do not hold


def commit(checkout: Path = Path(__file__).parent) -> str:
    """The commit of a checkout, "+ changes" where tracked files differ from it; "unknown" without git."""
    where = {"cwd": checkout, "capture_output": True, "text": True}
    try:
        name = subprocess.run(["git", "rev-parse", "--short", "HEAD"], **where, check=True).stdout.strip()
        changed = subprocess.run(["git", "status", "--porcelain", "-uno"], **where, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    # A record that is being written does not count as a change.
    lines = [line for line in changed.splitlines() if "benchmarks/results/" not in line]
    return f"{name} + changes" if lines else name


def program(checkout: Path) -> str:
    """Python source that runs the command `boresight` of a checkout, as its pyproject.toml declares it."""
    project = tomllib.loads((checkout / "pyproject.toml").read_text("utf-8"))["project"]
    module, function = project["scripts"]["boresight"].split(":")
    return f"import importlib; importlib.import_module({module!r}).{function}()"


def head(title: str) -> None:
    """Print title, commit, digest of the code, date, machine, versions and command."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            cpu = next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "unset")
    print(title)
    command = f"python {shlex.join(sys.argv)}"
    print(f"commit    {commit()}")
    print(f"code      {code_of(command, WorkingTree())}")
    print(f"date      {datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M} UTC")
    print(f"machine   {cpu}, {os.cpu_count()} cores, {platform.system()}; OPENBLAS_NUM_THREADS {threads}")
    print(f"versions  Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}")
    print(f"command   {command}")
    print(flush=True)


def band_of_mean_nees(runs: int, dof: int = 3) -> tuple[float, float]:
    """The 99.9 % band of the mean of `runs` normalised errors squared."""
    low, high = chi2(df=dof * runs).ppf([0.0005, 0.9995]) / runs
    return float(low), float(high)


def peak_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def verdict(text: str, holds: bool) -> None:
    """Print one line: what was asked for, and whether it holds. `exit_status` counts those that fail."""
    if not holds:
        _FAILED.append(text)
    print(f"{'holds' if holds else 'FAILS'}  {text}", flush=True)


def exit_status() -> int:
    """1 if a verdict of this process fails, else 0."""
    return int(bool(_FAILED))
