"""One, two, four processes and a cluster by its address: the same bytes, and how much faster.

    python benchmarks/workers.py --dump DUMP --repeats 3

`boresight calibrate` runs from nothing, the ways of working in turn, so many times over; the table gives
elapsed and CPU time, least and median, and whether installation.json is that of the first run, bit for bit.
`--twice` adds two runs with one process each, at once and into two folders: what the machine gives to two
processes that have nothing in common. With `--report` all ways write evidence and report as well.
Efficiency is the CPU time of one process against that of all processes: what is left of it on a machine that
others use, too, when elapsed time says nothing.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from end_to_end import machine

COMMAND = (sys.executable, "-m", "boresight", "calibrate")


@dataclass(frozen=True)
class Way:
    """A way of working and what its runs took."""

    options: tuple[str, ...]
    at_once: int = 1  # runs, each into a folder of its own
    elapsed_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    found: set[bytes] = field(default_factory=set)  # contents of installation.json

    def run(self, dump: Path, scratch: Path, report: bool) -> None:
        begin, more = time.perf_counter(), () if report else ("--no-report",)
        folders = [scratch / str(n) for n in range(self.at_once)]
        commands = [[*COMMAND, str(dump), "--out", str(out), *more, *self.options] for out in folders]
        processes = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for command in commands]
        ended = [os.wait4(process.pid, 0) for process in processes]
        if any(status for _, status, _ in ended):
            raise SystemExit(f"calibrate {' '.join(self.options)} failed")
        self.elapsed_s.append(time.perf_counter() - begin)
        self.cpu_s.append(sum(usage.ru_utime + usage.ru_stime for _, _, usage in ended) / self.at_once)
        self.found.update((out / "installation.json").read_bytes() for out in folders)

    def row(self, one: Way) -> str:
        same = "the same" if self.found == one.found and len(one.found) == 1 else "ANOTHER ONE"
        local = self.options[0] == "--workers"  # what a cluster's own processes use is not seen here
        cpu = f"{min(self.cpu_s):.1f}, {median(self.cpu_s):.1f}" if local else ""
        efficiency = f"{min(one.cpu_s) / min(self.cpu_s):.2f}" if local else ""
        return (
            f"| {' '.join(self.options)}{', twice at once' if self.at_once > 1 else ''} "
            f"| {min(self.elapsed_s):.1f}, {median(self.elapsed_s):.1f} | {cpu} "
            f"| {self.at_once * median(one.elapsed_s) / median(self.elapsed_s):.2f} | {efficiency} | {same} |"
        )


def main() -> None:
    from distributed import LocalCluster

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dump", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--counts", type=int, nargs="+", default=[1, 2, 4, 0], help="of processes; 0: a cluster of two"
    )
    parser.add_argument("--twice", action="store_true", help="two runs with one process each, at once, too")
    parser.add_argument("--report", action="store_true", help="evidence and report as well")
    options = parser.parse_args()
    print("\n".join(machine()))
    load = [os.getloadavg()[0]]
    cluster_options = {"processes": True, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with ExitStack() as stack:
        ways = [Way(("--workers", str(count))) for count in options.counts if count]
        ways += [Way(("--workers", "1"), at_once=2)] if options.twice else []
        if 0 in options.counts:  # its processes take a little time even while they have nothing to do
            cluster = stack.enter_context(LocalCluster(n_workers=2, **cluster_options))
            ways.append(Way(("--scheduler", str(cluster.scheduler_address))))
        for _ in range(options.repeats):
            for way in ways:
                with tempfile.TemporaryDirectory() as folder:
                    way.run(options.dump, Path(folder), options.report)
            load.append(os.getloadavg()[0])
    print("| way | elapsed (s) | CPU (s) | one process / this | efficiency | installation.json |")
    print("|---|---|---|---|---|---|")
    print("\n".join(way.row(ways[0]) for way in ways))
    told = ", ".join(f"{each:.1f}" for each in load)
    print(
        f"\nLeast and median of {options.repeats} runs; ratio of medians. Load average before each: {told}."
    )


if __name__ == "__main__":
    main()
