"""How busy the workers of a cluster are kept when every message of theirs takes 20 ms longer.

    python benchmarks/cluster_latency.py --workers 8 --units 240

Real dask worker processes on this machine get units that wait instead of computing, so that a few cores carry
many workers. Each message that a worker writes is held back by the latency, as on a slow network. Busy is the
share of the workers' time from the first unit's begin to the last one's end that units take.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import record  # first: it may start this process anew with one thread
from distributed import Client, LocalCluster

from boresight.pipeline.run.cluster import OnCluster, fingerprint

SLOWER = """
import asyncio
from distributed.comm.tcp import TCP


async def late(self, *arguments, on_time=TCP.write, **options):
    await asyncio.sleep({latency_s})
    return await on_time(self, *arguments, **options)

if TCP.write.__name__ != "late":  # a process may load this twice
    TCP.write = late
"""


def unit(seconds: float, _: int) -> tuple[float, float]:
    """When a unit of so many seconds began and ended."""
    begin = time.time()
    time.sleep(seconds)
    return begin, time.time()


def busy_share(workers: int, units: int, unit_s: float, latency_s: float) -> float:
    with tempfile.TemporaryDirectory() as folder:
        preload = Path(folder) / "slower.py"
        preload.write_text(SLOWER.format(latency_s=latency_s))
        options = {"threads_per_worker": 1, "processes": True, "dashboard_address": None, "memory_limit": 0}
        with (
            LocalCluster(n_workers=workers, preload=[str(preload)], **options) as cluster,
            Client(cluster) as client,
        ):
            on = OnCluster(client, cluster.scheduler_address, fingerprint([]), None, print, {})
            work = partial(unit, unit_s)
            on.map(work, range(4 * workers), lambda n, _: None)  # libraries are loaded
            spans = on.map(work, range(units), lambda n, _: None)
    whole = max(end for _, end in spans) - min(begin for begin, _ in spans)
    return sum(end - begin for begin, end in spans) / (workers * whole)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=8)
    parser.add_argument("--units", type=int, default=240)
    parser.add_argument("--unit-s", type=float, default=0.16, help="CPU time of a large exposure")
    parser.add_argument("--latency-s", type=float, default=0.02)
    options = parser.parse_args()
    record.head("Workers of a cluster with latency")
    for latency_s in (0.0, options.latency_s):
        share = busy_share(options.workers, options.units, options.unit_s, latency_s)
        print(
            f"{options.workers} worker processes, {options.units} units of {options.unit_s:g} s,"
            f" {1e3 * latency_s:.0f} ms more a message: busy {share:.1%}",
            flush=True,
        )
    record.verdict(f"busy >= 85 % with the latency: {share:.1%}", share >= 0.85)
    sys.exit(record.exit_status())


if __name__ == "__main__":
    main()
