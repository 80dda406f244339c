"""Head of a benchmark's output (commit, date, machine, versions, command) and its verdicts.

A verdict is one figure, its limit, whether it holds, and of how many samples it is. Where a limit is for a
mean or a share of all samples there are, a small sample is judged with its confidence interval: it fails
where the interval excludes the limit.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import resource
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy
from scipy.stats import beta, chi2

__all__ = [
    "ROOT",
    "SHARED",
    "VERDICTS",
    "arguments_of",
    "band_of_mean_nees",
    "commit",
    "exit_status",
    "head",
    "judge_largest",
    "judge_nees",
    "judge_share",
    "lines_of_head",
    "peak_mib",
    "program",
    "verdict",
]

# NumPy asks but once how many threads to use, when it is loaded; waiting threads count as CPU time. So a
# benchmark that was not told starts anew with one.
if "OPENBLAS_NUM_THREADS" not in os.environ:
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | one_thread)

VERDICTS = (
    "BENCHMARK_VERDICTS"  # environment: file to which every verdict is appended, one JSON object a line
)
ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"  # real data, which are not part of the project
_FAILED: list[str] = []  # verdicts of this process that do not hold


def commit(checkout: Path = ROOT) -> str:
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


def lines_of_head() -> list[str]:
    """Commit, date, machine, versions and command of this process."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            cpu = next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "unset")
    return [
        f"commit    {commit()}",
        f"date      {datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M} UTC",
        f"machine   {cpu}, {os.cpu_count()} cores, {platform.system()}; OPENBLAS_NUM_THREADS {threads}",
        f"versions  Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}",
        f"command   python {shlex.join(sys.argv)}",
    ]


def head(title: str) -> None:
    """Print title, commit, date, machine, versions and command."""
    print("\n".join([title, *lines_of_head(), ""]), flush=True)


def arguments_of(doc: str | None, *options: tuple[str, object, str]) -> argparse.Namespace:
    """Arguments of a benchmark: each option's name, default and help. Its type is that of the default; a
    type in place of a default makes it mandatory.
    """
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    for name, default, text in options:
        if isinstance(default, type):
            parser.add_argument(
                name, type=default, help=text, **({"required": True} if name[0] == "-" else {})
            )
        elif default is False:
            parser.add_argument(name, action="store_true", help=text)
        elif isinstance(default, tuple):
            parser.add_argument(name, nargs="+", type=type(default[0]), default=default, help=text)
        else:
            parser.add_argument(name, type=type(default), default=default, help=text)
    return parser.parse_args()


def band_of_mean_nees(runs: int, dof: int = 3) -> tuple[float, float]:
    """The 99.9 % band of the mean of `runs` normalised errors squared."""
    low, high = chi2(df=dof * runs).ppf([0.0005, 0.9995]) / runs
    return float(low), float(high)


def peak_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def not_run(reason: str) -> None:
    """End this process with status 2: what the benchmark needs is not there."""
    print(f"NOT RUN: {reason}", file=sys.stderr)
    sys.exit(2)


def verdict(figure: str, limit: str, holds: bool, samples: int = 1) -> None:
    """Print one line: the figure, its limit, whether it holds. `exit_status` counts those that fail."""
    holds = bool(holds)
    if not holds:
        _FAILED.append(figure)
    if path := os.environ.get(VERDICTS):
        line = {"figure": figure, "limit": limit, "holds": holds, "samples": int(samples)}
        with open(path, "a", encoding="utf-8") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")
    print(f"{'holds' if holds else 'FAILS'}  {figure} ({limit}; {samples} samples)", flush=True)


def judge_largest(what: str, value: float, most: float, unit: str = "", samples: int = 1) -> None:
    """Verdict of a value that may be as large as `most`."""
    of_unit = f" {unit}" if unit else ""
    verdict(f"{what} {value:.4g}{of_unit}", f"at most {most:g}{of_unit}", bool(value <= most), samples)


def judge_nees(
    what: str, squares: Sequence[float], dof: int = 3, asked: tuple[float, float] = (np.inf, -np.inf)
) -> None:
    """Verdict of a mean of normalised errors squared: in its 99.9 % band, or in a wider one that is asked."""
    low, high = band_of_mean_nees(len(squares), dof)
    low, high, mean = min(low, asked[0]), max(high, asked[1]), float(np.mean(squares))
    verdict(f"{what}: mean NEES {mean:.2f}", f"{low:.2f} to {high:.2f}", low <= mean <= high, len(squares))


def judge_share(
    what: str, count: int, of: int, most: float | None = None, least: float | None = None
) -> None:
    """Verdict of a share, with its 95 % interval (Clopper and Pearson), which must not exclude the limit."""
    low = float(beta.ppf(0.025, count, of - count + 1)) if count else 0.0
    high = float(beta.ppf(0.975, count + 1, of - count)) if count < of else 1.0
    figure = f"{what}: {count} of {of}, 95 % interval {low:.3g} to {high:.3g}"
    if most is not None:
        verdict(figure, f"at most {most:g}", low <= most, of)
    if least is not None:
        verdict(figure, f"at least {least:g}", high >= least, of)


def exit_status() -> int:
    """1 if a verdict of this process fails, else 0."""
    return int(bool(_FAILED))
