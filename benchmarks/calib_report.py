"""Head of a benchmark's report: when, on what, with what, by which command."""

from __future__ import annotations

import datetime
import os
import platform
import resource
import sys

import numpy as np
import scipy
from scipy.stats import chi2

__all__ = ["band_of_mean_nees", "head", "peak_mib", "verdict"]

# NumPy asks but once how many threads to use, when it is loaded; waiting threads count as CPU time. So a
# benchmark that was not told starts anew with one.
if "OPENBLAS_NUM_THREADS" not in os.environ:
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | one_thread)


def head(title: str) -> None:
    """Print title, date, machine, versions and command."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            cpu = next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "unset")
    print(title)
    print(f"date      {datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M} UTC")
    print(f"machine   {cpu}, {os.cpu_count()} cores, {platform.system()}; OPENBLAS_NUM_THREADS {threads}")
    print(f"versions  Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}")
    print(f"command   python {' '.join(sys.argv)}")
    print(flush=True)


def band_of_mean_nees(runs: int, dof: int = 3) -> tuple[float, float]:
    """The 99.9 % band of the mean of `runs` normalised errors squared."""
    low, high = chi2(df=dof * runs).ppf([0.0005, 0.9995]) / runs
    return float(low), float(high)


def peak_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def verdict(text: str, holds: bool) -> None:
    """One line: what was asked for, and whether it holds."""
    print(f"{'holds' if holds else 'FAILS'}  {text}", flush=True)
