"""Ways of working: the same bytes from one process, two, and a cluster; memory of them all; a slow network.

    python benchmarks/workers.py [--dump fixtures/mini] [--repeats 1] [--counts 1 2 0]
    python benchmarks/workers.py --dump ARCHIVE --counts 2 --limit-mib 2048 --units 0

`boresight calibrate` runs from nothing, the ways in turn. Efficiency is the CPU time of one process against
that of all processes, which holds on a busy machine, too. In one further run of each way the proportional set
sizes (PSS: a page shared by n processes counts 1/n for each) of the command and all processes below it are
summed ten times a second; no time is taken of it, since the sums need a tenth of a core.

For the slow network real dask workers get `--units` units that wait instead of computing, so that a few cores
carry many workers, and each message of theirs is held back by 20 ms. Busy is the share of the workers' time,
from the first unit's begin to the last one's end, that units take.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median

from processes import COMMAND
from record import ROOT, arguments_of, exit_status, head, judge_largest, verdict

COMPILED = {"PYTHONDONTWRITEBYTECODE": ""}  # compiled once, as `make install` leaves the modules
CLUSTER = {"threads_per_worker": 1, "processes": True, "dashboard_address": None}
SLOWER = """
import asyncio
from distributed.comm.tcp import TCP


async def late(self, *arguments, on_time=TCP.write, **options):
    await asyncio.sleep({latency_s})
    return await on_time(self, *arguments, **options)

if TCP.write.__name__ != "late":  # a process may load this twice
    TCP.write = late
"""


@dataclass(frozen=True)
class Way:
    """A way of working and what its runs took."""

    options: tuple[str, ...]
    elapsed_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    peak_mib: list[float] = field(default_factory=list)
    found: set[bytes] = field(default_factory=set)  # contents of installation.json

    def run(self, dump: str, report: tuple[str, ...], *, timed: bool) -> None:
        with tempfile.TemporaryDirectory() as out:
            begin, peak = time.perf_counter(), 0.0
            command = [*COMMAND, "calibrate", dump, "--out", out, *report, *self.options]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | COMPILED)
            while not (ended := os.wait4(process.pid, 0 if timed else os.WNOHANG))[0]:
                peak = max(peak, sum(pss_mib(pid) for pid in family(process.pid)))
                time.sleep(0.1)
            if ended[1]:
                raise SystemExit(f"calibrate {' '.join(self.options)} failed")
            if timed:
                self.elapsed_s.append(time.perf_counter() - begin)
                self.cpu_s.append(ended[2].ru_utime + ended[2].ru_stime)
            self.peak_mib.append(peak)  # 0 of one that is timed
            self.found.add((Path(out) / "installation.json").read_bytes())


def family(pid: int) -> Iterator[int]:
    """A process and all below it."""
    yield pid
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            below = children.read_text().split()
        except OSError:
            continue
        for child in below:
            yield from family(int(child))


def pss_mib(pid: int) -> float:
    """Proportional set size of one process, 0 for one that has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(float(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024.0


def ways_of_working(
    dump: str, counts: tuple[int, ...], repeats: int, limit_mib: float, report: tuple[str, ...]
) -> None:
    """Table and verdicts; a count of 0 is a cluster of two."""
    from distributed import LocalCluster

    with ExitStack() as stack:
        ways = [Way(("--workers", str(count))) for count in counts if count]
        if 0 in counts:
            cluster = stack.enter_context(LocalCluster(n_workers=2, **CLUSTER))
            ways.append(Way(("--scheduler", str(cluster.scheduler_address))))
        for n in range(repeats + 1):
            for way in ways:
                way.run(dump, report, timed=n > 0)  # the first one reads the files from the disk
    first = ways[0]
    print("way                      elapsed s   CPU s  one / this  efficiency  PSS, MiB")
    for way in ways:
        local = way.options[0] == "--workers"  # what a cluster's own processes use is not seen here
        elapsed, cpu, name = median(way.elapsed_s), median(way.cpu_s), " ".join(way.options)[:24]
        faster = median(first.elapsed_s) / elapsed
        spare = median(first.cpu_s) / cpu if local else float("nan")
        print(f"{name:24s} {elapsed:9.1f} {cpu:7.1f} {faster:11.2f} {spare:11.2f} {max(way.peak_mib):9.0f}")
    same = len(set.union(*(way.found for way in ways))) == 1
    words = "the same, bit for bit" if same else "not the same"
    verdict(f"installation.json of {len(ways)} ways of working: {words}", "the same", same, repeats)
    peak = max(size for way in ways for size in way.peak_mib)
    judge_largest("memory of all processes of a calibration", peak, limit_mib, "MiB", repeats)


def unit(seconds: float, _: int) -> tuple[float, float]:
    """When a unit of so many seconds began and ended."""
    begin = time.time()
    time.sleep(seconds)
    return begin, time.time()


def busy_share(workers: int, units: int, unit_s: float, latency_s: float) -> float:
    """Share of the workers' time that units take."""
    from distributed import Client, LocalCluster

    from boresight.pipeline.run.cluster import OnCluster, fingerprint

    with tempfile.TemporaryDirectory() as folder:
        preload = Path(folder) / "slower.py"
        preload.write_text(SLOWER.format(latency_s=latency_s))
        with (
            LocalCluster(n_workers=workers, preload=[str(preload)], memory_limit=0, **CLUSTER) as cluster,
            Client(cluster) as client,
        ):
            on = OnCluster(client, cluster.scheduler_address, fingerprint([]), None, print, {})
            work = partial(unit, unit_s)
            on.map(work, range(4 * workers), lambda n, _: None)  # libraries are loaded
            spans = on.map(work, range(units), lambda n, _: None)
    whole = max(end for _, end in spans) - min(begin for begin, _ in spans)
    return sum(end - begin for begin, end in spans) / (workers * whole)


def main() -> int:
    options = arguments_of(
        __doc__,
        ("--dump", str(ROOT / "fixtures" / "mini"), "to be calibrated"),
        ("--repeats", 1, "runs of each way"),
        ("--counts", (1, 2, 0), "of processes; 0: a cluster of two"),
        ("--limit-mib", 1024.0, "memory of all processes"),
        ("--report", False, "write page and evidence, too"),
        ("--cluster", 6, "workers of the slow network"),
        ("--units", 120, "units for them; 0: none"),
        ("--latency-s", 0.02, "more for each message"),
    )
    head("One process, several, a cluster")
    report = () if options.report else ("--no-report",)
    ways_of_working(options.dump, options.counts, options.repeats, options.limit_mib, report)
    if options.units:
        share = busy_share(options.cluster, options.units, 0.16, options.latency_s)
        text = (
            f"{options.cluster} workers with {1e3 * options.latency_s:g} ms more a message: busy {share:.1%}"
        )
        verdict(text, "at least 85 %", share >= 0.85, options.units)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
