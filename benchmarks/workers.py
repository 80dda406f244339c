"""One, two, four processes and a cluster by its address: the same bytes, and how much faster.

    python benchmarks/workers.py --dump DUMP

`boresight calibrate` runs once for each way of working, from nothing; the table gives the elapsed time, the
CPU time and whether installation.json is that of the first run, bit for bit. Starting two processes takes
some seconds: a dump of a hundred exposures or more shows what they are good for.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from end_to_end import machine

COMMAND = (sys.executable, "-c", "from pipeline.cli import main; main()", "calibrate")


def run(dump: Path, out: Path, *way: str) -> tuple[float, float, bytes]:
    """Elapsed and CPU seconds, and the bytes of installation.json."""
    begin = time.perf_counter()
    process = subprocess.Popen(
        [*COMMAND, str(dump), "--out", str(out), "--no-report", *way], stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"calibrate {' '.join(way)} failed")
    elapsed = time.perf_counter() - begin
    return elapsed, usage.ru_utime + usage.ru_stime, (out / "installation.json").read_bytes()


def main() -> None:
    from distributed import LocalCluster

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dump", type=Path, required=True)
    options = parser.parse_args()
    print("\n".join(machine()))
    print("| way | elapsed (s) | CPU (s) | against one process | installation.json |")
    print("|---|---|---|---|---|")
    first: tuple[float, bytes] | None = None
    cluster_options = {"processes": True, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with tempfile.TemporaryDirectory() as folder, LocalCluster(n_workers=2, **cluster_options) as cluster:
        ways = [("--workers", "1"), ("--workers", "2"), ("--workers", "4")]
        for n, way in enumerate([*ways, ("--scheduler", str(cluster.scheduler_address))]):
            elapsed, cpu, content = run(options.dump, Path(folder) / str(n), *way)
            first = first or (elapsed, content)
            same = "the same" if content == first[1] else "ANOTHER ONE"
            print(
                f"| {' '.join(way)} | {elapsed:.1f} | {cpu:.1f} | {first[0] / elapsed:.2f} | {same} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
