"""Commands of the program in processes of their own, and what they cost."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

__all__ = ["COMMAND", "Step", "run_command"]

COMMAND = (sys.executable, "-m", "boresight")


@dataclass(frozen=True)
class Step:
    """One command: what it cost."""

    elapsed_s: float
    cpu_s: float  # of user and system, children included
    peak_mib: float  # of the largest process
    said: str  # what it printed


def run_command(*arguments: str, status: int | None = 0) -> Step:
    """Run `boresight` with these arguments in a process of its own; None: it may end with any `status`."""
    start, peak_kib = time.perf_counter(), 0
    with tempfile.TemporaryFile("w+") as told:
        process = subprocess.Popen([*COMMAND, *arguments], stdout=told, stderr=subprocess.STDOUT)
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            peak_kib = max(peak_kib, _high_water_kib(process.pid))
            time.sleep(0.05)
        elapsed_s, usage = time.perf_counter() - start, ended[2]
        told.seek(0)
        said = told.read()
    if status is not None and os.waitstatus_to_exitcode(ended[1]) != status:
        raise SystemExit(f"boresight {' '.join(arguments)} failed:\n{said}")
    return Step(elapsed_s, usage.ru_utime + usage.ru_stime, peak_kib / 1024.0, said)


def _high_water_kib(pid: int) -> int:
    """Largest resident size so far of a process (Linux; ru_maxrss would count the parent's before exec)."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM")), 0)
