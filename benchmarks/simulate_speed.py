"""Processor time of `boresight simulate` now and before, in turn on one machine.

    OMP_NUM_THREADS=1 python benchmarks/simulate_speed.py --before CHECKOUT [--rounds 2]

CHECKOUT is a working tree of the commit to compare with. Every command runs in a process of its own with
threads of BLAS and OpenCV set to one; elapsed times of one and two workers are those of the present code.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from record import head

# One of the three strips of the paper's mission, a quarter of its rows, and the example of README.
JOBS = {
    "paper, one strip of 26000 rows": ("paper", "--set", "strips.count=1"),
    "paper, one strip of 6500 rows": ("paper", "--set", "strips.count=1", "--set", "strips.lines=6500"),
    "mini": ("mini",),
}
HERE = Path(__file__).resolve().parents[1]


def cost(checkout: Path, job: tuple[str, ...], *workers: str) -> tuple[float, float]:
    """Processor time and elapsed time of one run, s."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
    environment = os.environ | threads | {"PYTHONPATH": str(checkout)}
    out = Path(tempfile.mkdtemp())
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "boresight", "simulate", job[0], out / "dump", "--seed", "7", *job[1:]]
    subprocess.run(
        [*map(str, command), *workers],
        env=environment,
        cwd=out,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    elapsed, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    shutil.rmtree(out)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, elapsed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=2)
    given = parser.parse_args()
    commit = ["git", "-C", given.before, "log", "-1", "--format=%h of %cs"]
    head("Processor time of boresight simulate, before and now in turn")
    told = subprocess.run(commit, capture_output=True, text=True, check=True).stdout.strip()
    print(f"before: commit {told}\n")
    print("| mission | round | before, s CPU | now, s CPU | ratio | elapsed, 1 worker | 2 workers |")
    print("|---|---|---|---|---|---|---|")
    for name, job in JOBS.items():
        for n in range(given.rounds):
            old, _ = cost(given.before.resolve(), job)  # it may not know the option --workers
            new, one = cost(HERE, job, "--workers", "1")
            _, two = cost(HERE, job, "--workers", "2")
            costs = f"{old:.1f} | {new:.1f} | {new / old:.2f} | {one:.1f} | {two:.1f}"
            print(f"| {name} | {n + 1} | {costs} |", flush=True)


if __name__ == "__main__":
    main()
