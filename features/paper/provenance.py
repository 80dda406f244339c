"""Head of an experiment's record: commit, date, machine, versions and command."""

from __future__ import annotations

import datetime
import os
import platform
import sys

import numpy as np
import scipy

from boresight.version import version_text

__all__ = ["record_head"]


def record_head(name: str, cpu_s: float) -> list[str]:
    """Lines that say what made a record of the experiment `name`, when, on what, and in which CPU time."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu = next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return [
        f"experiment {name}",
        f"commit    {version_text()}",
        f"date      {datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M} UTC",
        f"machine   {cpu}, {os.cpu_count()} cores, {platform.system()}",
        f"versions  Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}",
        f"command   boresight {' '.join(sys.argv[1:])}",
        f"CPU       {cpu_s:.0f} s",
        "",
    ]
