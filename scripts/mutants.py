"""Physical mutations, one line each, against the nearest tests: `python scripts/mutants.py`.

`scripts/mutants/ROOM.toml` lists them:

    [[mutant]]
    what = "sign of refraction"             # what is broken, in words
    file = "geometry/groundlight.py"
    old = "apparent = zenith - angle"       # must occur exactly once in the file
    new = "apparent = zenith + angle"
    tests = ["tests/geometry/test_groundlight.py"]   # files, or nodes (file::test)
    equivalent = ""                         # why no test can tell, for a mutation that changes nothing

Each mutation is made in a copy of the working tree, and its tests run there until the first failure. One that
survives is a gap in the tests, or a line that does nothing. The record goes to benchmarks/results/mutants.md;
the exit status is 1 if a mutation without `equivalent` survives.

    python scripts/mutants.py --draw SEED --count N [--room ROOM] [--lines lines.json]

draws mutations itself (`drawn_mutants.py`) and prints which survive; the status is 1 if more than 8 % do.
With a trace of all tests (`traced_tests.py`) those that run the line are asked, else the nearest.
"""

from __future__ import annotations

import argparse
import compileall
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import Queue

from drawn_mutants import ROOMS, drawn_changes, nearest_tests
from forked_tests import NO_END, failure, import_libraries
from line_tests import LineTests

ROOT = Path(__file__).parents[1]
LISTS = ROOT / "scripts" / "mutants"
RECORD = ROOT / "benchmarks" / "results" / "mutants.md"
LEAST_KILLED = 0.92  # of drawn mutations
LONGEST_CPU_S = 240  # a mutation that makes its tests hang counts as killed
LONGEST_S = 3000  # elapsed, on a machine that others use


@dataclass(frozen=True)
class Mutant:
    """One line changed, and the tests that ought to notice."""

    room: str
    what: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...] = field(default=())
    equivalent: str = ""


def mutants() -> list[Mutant]:
    """All mutations of all lists, in the order of rooms."""
    found = []
    for path in sorted(LISTS.glob("*.toml")):
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]:
            found.append(Mutant(path.stem, **(entry | {"tests": tuple(entry["tests"])})))
    return found


def faults(mutant: Mutant, root: Path = ROOT) -> list[str]:
    """What is wrong with an entry of the lists: a line that is no longer there, a test that is gone."""
    wrong = []
    path = root / mutant.file
    count = path.read_text(encoding="utf-8").count(mutant.old) if path.is_file() else 0
    if count != 1:
        wrong.append(f"{mutant.file}: {mutant.old!r} occurs {count} times, expected once")
    if mutant.old == mutant.new or not mutant.tests:
        wrong.append(f"{mutant.what}: changes nothing or names no test")
    for test in mutant.tests:
        file, _, name = test.partition("::")
        if not (root / file).is_file() or (
            name and name.split("[")[0] not in (root / file).read_text(encoding="utf-8")
        ):
            wrong.append(f"{mutant.what}: there is no test {test}")
    return wrong


def copy_of_tree(folder: Path) -> Path:
    """A copy of the tracked and new files of the working tree."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        source, target = ROOT / name, folder / name
        if source.is_symlink() or source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)
    for room in ROOMS:
        compileall.compile_dir(folder / room, quiet=2)
    return folder


def killer(mutant: Mutant, tree: Path, known: Collection[str], unsound: set[str], most_cpu_s: float) -> str:
    """The first of the mutation's tests that fails with it in `tree`, or a file that cannot be imported.

    "" where all pass. A test that also fails without a mutation joins `unsound`, and the others are asked;
    tests that are not `known` any more are not. The tree is restored afterwards.
    """
    path = tree / mutant.file
    sound, times = path.read_text(encoding="utf-8"), path.stat()
    tests = [one for one in mutant.tests if "::" not in one or one in known]
    while tests:
        path.write_text(sound.replace(mutant.old, mutant.new, 1), encoding="utf-8")
        try:
            asked = [*tests, *(f"--deselect={one}" for one in unsound)]
            test = failure(asked, tree, most_cpu_s=int(most_cpu_s), most_s=LONGEST_S)
        finally:
            path.write_text(sound, encoding="utf-8")
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # as its compiled form says
        if (
            not test
            or test.endswith(NO_END)
            or not failure([test], tree, most_cpu_s=LONGEST_CPU_S, most_s=LONGEST_S)
        ):
            return test
        unsound.add(test)
    return ""


def tried(chosen: Sequence[Mutant], jobs: int, most_cpu_s: float) -> Iterator[tuple[Mutant, str, float]]:
    """Each mutation with the test that notices it, and the seconds that took, as they finish."""
    unsound: set[str] = set()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        trees: Queue[Path] = Queue()
        known = import_libraries(ROOT)
        known |= {test.partition("[")[0] for test in known}
        for n in range(jobs):
            trees.put(copy_of_tree(Path(folder) / str(n)))

        def one(mutant: Mutant) -> tuple[Mutant, str, float]:
            tree, begun = trees.get(), time.perf_counter()
            try:
                return mutant, killer(mutant, tree, known, unsound, most_cpu_s), time.perf_counter() - begun
            finally:
                trees.put(tree)

        yield from pool.map(one, chosen)
    print(f"left out, since they fail without a mutation: {', '.join(sorted(unsound)) or 'none'}")


def outcome_of(mutant: Mutant, killed: bool) -> str:
    """What became of a mutation."""
    if not mutant.tests:
        return "untested"
    return "killed" if killed else "equivalent" if mutant.equivalent else "survives"


def counted(rows: Sequence[tuple[Mutant, bool]]) -> list[str]:
    """Outcomes by room, as lines of a table in Markdown."""
    lines = ["| room | mutations | killed | equivalent | survive |", "| --- | --: | --: | --: | --: |"]
    for room in (*dict.fromkeys(mutant.room for mutant, _ in rows), "all"):
        own = Counter(outcome_of(*row) for row in rows if room in (row[0].room, "all"))
        left = own["survives"] + own["untested"]
        lines.append(f"| {room} | {own.total()} | {own['killed']} | {own['equivalent']} | {left} |")
    return lines


def record(rows: Sequence[tuple[Mutant, bool]], seconds: float) -> str:
    """The record as Markdown."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    ).stdout
    lines = [
        "# Mutations of physical statements",
        "",
        f"`python scripts/mutants.py`, commit {commit.strip()}, {time.strftime('%Y-%m-%d')}, Python "
        f"{platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores, {seconds:.0f} s.",
        "",
        *counted(rows),
        "",
        "| room | file | what | outcome |",
        "| --- | --- | --- | --- |",
    ]
    words = {"survives": "**survives**"}
    for mutant, killed in rows:
        outcome = outcome_of(mutant, killed)
        words["equivalent"] = f"equivalent: {mutant.equivalent}"
        lines.append(f"| {mutant.room} | `{mutant.file}` | {mutant.what} | {words.get(outcome, outcome)} |")
    return "\n".join(lines) + "\n"


def drawn(seed: int, count: int, room: str, lines: LineTests | None, most_cpu_s: float) -> list[Mutant]:
    """Mutations drawn by a seed, each with the tests that run its line, or the nearest; a whole file is
    replaced.
    """
    found = []
    for change in drawn_changes(ROOT, seed, count, room):
        source = (ROOT / change.file).read_text(encoding="utf-8")
        tests = nearest_tests(ROOT, change.file)
        if lines:
            tests = tuple(lines.of(change.file, change.start, most_cpu_s)) or tests
        place = change.file.partition("/")[0]
        found.append(Mutant(place, str(change), change.file, source, change.applied(source), tests))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="mutations whose room, file or text contains this")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="copies of the tree to work in")
    parser.add_argument("--draw", type=int, metavar="SEED", help="draw mutations instead")
    parser.add_argument("--count", type=int, default=40, help="how many are drawn")
    parser.add_argument("--room", default="", help="draw from the modules of this room only")
    parser.add_argument("--lines", type=Path, help="trace of all tests (traced_tests.py)")
    parser.add_argument("--cpu", type=float, default=100.0, help="s of tests of a line, the quickest first")
    options = parser.parse_args()
    is_drawn, most_cpu_s = options.draw is not None, float(LONGEST_CPU_S)
    if is_drawn:
        lines = LineTests.read(options.lines, ROOT) if options.lines else None
        chosen = drawn(options.draw, options.count, options.room, lines, options.cpu)
        most_cpu_s = 20.0 + 4.0 * options.cpu
    else:
        chosen = [m for m in mutants() if options.only in f"{m.room} {m.file} {m.what}"]
        if wrong := [text for mutant in chosen for text in faults(mutant)]:
            print("\n".join(wrong))
            return 2
    begun, rows = time.perf_counter(), []
    for mutant, test, seconds in tried(chosen, options.jobs, most_cpu_s):
        rows.append((mutant, bool(test)))
        outcome = outcome_of(*rows[-1])
        shown = outcome if test or outcome == "equivalent" else outcome.upper()
        end = f"  by {test}" if test else f"  of {len(mutant.tests)} tests"
        place = f"{len(rows):4d}/{len(chosen)} {shown:10s} {seconds:6.1f} s"
        print(f"{place}  {mutant.file}: {mutant.what}{end}", flush=True)
    print("", *counted(rows), sep="\n")
    if is_drawn:
        return int(sum(killed for _, killed in rows) < LEAST_KILLED * len(rows))
    if not options.only:
        RECORD.write_text(record(rows, time.perf_counter() - begun), encoding="utf-8")
    return int(any(outcome_of(*row) in ("survives", "untested") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
