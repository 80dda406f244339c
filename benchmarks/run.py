"""Run the benchmarks and write one table of their figures: `make benchmarks`.

    python benchmarks/run.py                                   # all, each with its small sample
    python benchmarks/run.py --only star_hard fuzz             # names that begin so; the table is printed
    python benchmarks/run.py --full --only end_to_end          # long campaigns
    python benchmarks/run.py --peers-python PEERS/bin/python   # beside packages that pin other versions

Each benchmark runs in processes of its own, two at a time; what it prints is kept in build/benchmarks. Its
verdicts become rows of benchmarks/results/table.md, headed by commit, date, machine, versions and command.
What a machine lacks (real data, other packages, Chromium, Java) is "not run", with the reason. Exit status 1
if a figure misses its limit or a benchmark fails.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import record  # first: it may start this process anew with one thread

HERE = Path(__file__).resolve().parent
TABLE = HERE / "results" / "table.md"
KEPT = record.ROOT / "build" / "benchmarks"


@dataclass(frozen=True)
class Benchmark:
    """A script with the arguments of its small sample and of its long campaign; with which of the peers'
    interpreters, if any, it is given.
    """

    name: str
    small: str = ""
    full: str = ""
    peer: str = ""  # "peers" or "rugged"
    peer_needed: bool = False

    @property
    def script(self) -> str:
        """The file's name without its ending: what the benchmark's name begins with."""
        return self.name.partition(" ")[0]


BENCHMARKS = (
    Benchmark("star_hard", "--frames 4", "--frames 80", peer="peers"),
    Benchmark("faults_grid", "--cases 40", "--cases 600 --minutes 60"),
    Benchmark("star_cameras", "--sets 1", "--sets 10"),
    Benchmark("clean_campaigns", "--sightings 200 --dumps 10", "--sightings 3000 --dumps 100"),
    Benchmark("end_to_end mini", "--seeds 6 --cuts 2", "--seeds 100 --cuts 60"),
    Benchmark("end_to_end dates", "--seeds 3 --changed 0.3", "--seeds 60 --changed 0.3"),
    Benchmark("end_to_end paper", "--scenario paper --seeds 1 --workers 2", "--scenario paper --seeds 20"),
    Benchmark("sky missions", "missions", "missions --seeds 40 --cameras paper"),
    Benchmark("sky trackers", "trackers", "trackers --seeds 20"),
    Benchmark("sky noise", "noise", "noise --seeds 200"),
    Benchmark("campaigns", "--runs 60", "--runs 400"),
    Benchmark("interior", "--vectors 4 --pixels 1", "--vectors 20 --pixels 5"),
    Benchmark("gross_errors", "", "--draws 40000"),
    Benchmark("vectors_wrong_stars", "", "--sets 1000"),
    Benchmark("years", "--seeds 20", "--seeds 100 --pairs 500 --kills 200 --results 10000"),
    Benchmark("star_accuracy", "--frames 6 --filled 2", "--frames 300 --filled 20"),
    Benchmark("star_naming", "--attitudes 40 --seeds 4 201 --noise 200", "--attitudes 150"),
    Benchmark("star_fields"),
    Benchmark("star_sequences", "--sequences 4 --long 200", "--sequences 20 --long 1000"),
    Benchmark("match_peers", "--pairs 40", "--pairs 200"),
    Benchmark("match_real_pairs"),
    Benchmark("paper_tables", "--runs 12", "--runs 200"),
    Benchmark("bench_pushbroom"),
    Benchmark("bench_rugged", peer="rugged", peer_needed=True),
    Benchmark("real_sentinel2"),
    Benchmark("real_windows"),
    Benchmark("real_exports"),
    Benchmark("prepared_faults"),
    Benchmark("fuzz dumps", "dumps --count 40", "dumps --count 2000"),
    Benchmark("fuzz readers", "readers --count 4000", "readers --count 100000"),
    Benchmark("fuzz images", "images --count 300", "images --count 10000"),
    Benchmark("fuzz door", "door --count 800", "door --count 5000"),
    Benchmark("workers", "", "--repeats 3 --counts 1 2 4 0 --units 240 --cluster 8"),
    Benchmark("speed", "", "--repeats 5 --tests 21"),
)


@dataclass
class Outcome:
    """What became of one benchmark."""

    benchmark: Benchmark
    verdicts: list[dict] = field(default_factory=list)
    cpu_s: float = 0.0
    elapsed_s: float = 0.0
    remark: str = ""  # why it was not run, or how it failed

    @property
    def failed(self) -> bool:
        return self.remark.startswith("failed") or not all(line["holds"] for line in self.verdicts)


def run(benchmark: Benchmark, full: bool, peers: dict[str, str]) -> Outcome:
    """One benchmark in a process of its own."""
    outcome, stem = Outcome(benchmark), benchmark.name.replace(" ", "-")
    if benchmark.peer_needed and not peers[benchmark.peer]:
        outcome.remark = f"not run: no interpreter given with --{benchmark.peer}-python"
        return outcome
    arguments = shlex.split(benchmark.full if full else benchmark.small)
    if benchmark.peer and peers[benchmark.peer]:
        arguments += ["--peers-python", peers[benchmark.peer]]
    verdicts, printed = KEPT / f"{stem}.jsonl", KEPT / f"{stem}.txt"
    verdicts.unlink(missing_ok=True)
    begin = time.perf_counter()
    with printed.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            [sys.executable, f"benchmarks/{benchmark.script}.py", *arguments],
            cwd=record.ROOT,
            env=os.environ | {record.VERDICTS: str(verdicts), "PYTHONPATH": str(record.ROOT)},
            stdout=stream,
            stderr=subprocess.STDOUT,
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    outcome.elapsed_s, outcome.cpu_s = time.perf_counter() - begin, usage.ru_utime + usage.ru_stime
    if verdicts.exists():
        outcome.verdicts = [json.loads(line) for line in verdicts.read_text("utf-8").splitlines()]
    last = (printed.read_text("utf-8").strip().splitlines() or [""])[-1]
    if process.returncode == 2 and last.startswith("NOT RUN: "):
        outcome.remark = f"not run: {last.removeprefix('NOT RUN: ')}"
    elif process.returncode not in (0, 1) or not outcome.verdicts or "Error" in last:
        outcome.remark = f"failed: {last[:120]}"
    return outcome


def table(outcomes: list[Outcome]) -> Iterator[str]:
    """The table in Markdown, headed by what it is of."""
    verdicts = [line for outcome in outcomes for line in outcome.verdicts]
    missed = [line for line in verdicts if not line["holds"]]
    remarks = [outcome.remark for outcome in outcomes if outcome.remark]
    yield "# Benchmarks"
    yield from ("", "```text", *record.lines_of_head(), "```", "")
    yield (
        f"{len(verdicts)} figures of {len(outcomes)} benchmarks: {len(missed)} miss their limits, "
        f"{sum(remark.startswith('not run') for remark in remarks)} benchmarks were not run, "
        f"{sum(remark.startswith('failed') for remark in remarks)} failed. "
        f"{sum(one.cpu_s for one in outcomes) / 60.0:.0f} minutes of CPU. A limit of a share or of a mean is "
        "missed where the 95 % interval, or the 99.9 % band of the mean, excludes it."
    )
    yield from (
        "",
        "| benchmark | figure | limit | holds | samples | CPU s |",
        "| --- | --- | --- | --- | --- | --- |",
    )
    for outcome in outcomes:
        name, cpu = outcome.benchmark.name, f"{outcome.cpu_s:.0f}"
        for line in outcome.verdicts:
            cells = (line["figure"].replace("|", "/"), line["limit"], "yes" if line["holds"] else "**no**")
            yield f"| {name} | {' | '.join(cells)} | {line['samples']} | {cpu} |"
            name = cpu = ""
        if outcome.remark:
            yield f"| {name} | {outcome.remark} | | | | {cpu} |"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="benchmarks whose names begin so")
    parser.add_argument("--full", action="store_true", help="long campaigns instead of small samples")
    parser.add_argument("--jobs", type=int, default=2, help="benchmarks at a time")
    parser.add_argument("--peers-python", default="", help="interpreter with the extra `peers`")
    parser.add_argument("--rugged-python", default="", help="interpreter with orekit-jpype, and Java")
    parser.add_argument("--out", type=Path, help="file of the table; by default benchmarks/results/table.md")
    options = parser.parse_args()
    chosen = [one for one in BENCHMARKS if not options.only or one.name.startswith(tuple(options.only))]
    if not chosen:
        parser.error(f"no benchmark begins with {', '.join(options.only)}")
    KEPT.mkdir(parents=True, exist_ok=True)
    peers = {"peers": options.peers_python, "rugged": options.rugged_python}

    def told(benchmark: Benchmark) -> Outcome:
        outcome = run(benchmark, options.full, peers)
        state = outcome.remark or ("misses a limit" if outcome.failed else "holds")
        print(
            f"{benchmark.name:22s} {outcome.elapsed_s:7.0f} s {outcome.cpu_s:7.0f} s CPU  {state}", flush=True
        )
        return outcome

    with ThreadPoolExecutor(options.jobs) as pool:
        outcomes = list(pool.map(told, chosen))
    text = "\n".join(table(outcomes)) + "\n"
    if out := options.out or (None if options.only else TABLE):
        out.write_text(text, encoding="utf-8")
    else:
        print(text)
    return int(any(outcome.failed for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
