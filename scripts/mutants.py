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


def is_killed(mutant: Mutant, tree: Path) -> bool:
    """Whether the nearest tests fail with the mutation made in `tree`, which is restored afterwards."""
    return bool(killer(mutant, tree, mutant.tests))


def killer(
    mutant: Mutant,
    tree: Path,
    tests: Sequence[str],
    without: Collection[str] = (),
    most_cpu_s: float = LONGEST_CPU_S,
) -> str:
    """The first of some tests, but those in `without`, that fails with the mutation made in `tree`; else "".
    The tree is restored afterwards.
    """
    path = tree / mutant.file
    sound, times = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(sound.replace(mutant.old, mutant.new, 1), encoding="utf-8")
    try:
        return first_failure([*tests, *(f"--deselect={one}" for one in without)], tree, most_cpu_s)
    finally:
        path.write_text(sound, encoding="utf-8")
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # as its compiled form says


def first_failure(tests: Sequence[str], tree: Path, most_cpu_s: float = LONGEST_CPU_S) -> str:
    """The first of some tests that fails in a tree, or a file that cannot be imported; "" where all pass."""
    return failure(tests, tree, most_cpu_s=int(most_cpu_s), most_s=LONGEST_S)


def failures_without_mutation(chosen: Sequence[Mutant], jobs: int) -> str:
    """The end of what pytest prints if the named tests do not pass on the unchanged tree, else ""."""
    tests = sorted({test for mutant in chosen for test in mutant.tests})
    with tempfile.TemporaryDirectory() as folder:
        tree = copy_of_tree(Path(folder))
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", str(jobs), *tests]
        environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    return done.stdout[-2000:] if done.returncode else ""


def tried(chosen: Sequence[Mutant], jobs: int) -> Iterator[tuple[Mutant, bool, float]]:
    """Each mutation with whether it was killed and the seconds that took, as they finish."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        trees: Queue[Path] = Queue()
        import_libraries(ROOT)
        for n in range(jobs):
            trees.put(copy_of_tree(Path(folder) / str(n)))

        def one(mutant: Mutant) -> tuple[Mutant, bool, float]:
            tree, begun = trees.get(), time.perf_counter()
            try:
                return mutant, is_killed(mutant, tree), time.perf_counter() - begun
            finally:
                trees.put(tree)

        yield from pool.map(one, chosen)


def record(rows: Sequence[tuple[Mutant, bool, float]], seconds: float) -> str:
    """The record as Markdown."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    ).stdout
    rooms = Counter(m.room for m, _, _ in rows)
    killed = Counter(m.room for m, dead, _ in rows if dead)
    equal = Counter(m.room for m, dead, _ in rows if not dead and m.equivalent)
    lines = [
        "# Mutations of physical statements",
        "",
        f"`python scripts/mutants.py`, commit {commit.strip()}, {time.strftime('%Y-%m-%d')}, Python "
        f"{platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores, {seconds:.0f} s.",
        "",
        "| room | mutations | killed | equivalent | survive |",
        "| --- | --: | --: | --: | --: |",
    ]
    for room in rooms:
        left = rooms[room] - killed[room] - equal[room]
        lines.append(f"| {room} | {rooms[room]} | {killed[room]} | {equal[room]} | {left} |")
    total, dead, same = len(rows), sum(killed.values()), sum(equal.values())
    lines += [
        f"| all | {total} | {dead} | {same} | {total - dead - same} |",
        "",
        "| room | file | what | outcome |",
    ]
    lines.append("| --- | --- | --- | --- |")
    for mutant, was_killed, _ in rows:
        outcome = (
            "killed"
            if was_killed
            else f"equivalent: {mutant.equivalent}"
            if mutant.equivalent
            else "**survives**"
        )
        lines.append(f"| {mutant.room} | `{mutant.file}` | {mutant.what} | {outcome} |")
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


def try_drawn(chosen: Sequence[Mutant], most_cpu_s: float) -> int:
    """Print each drawn mutation with its outcome, and the rates by room. A test that also fails without a
    mutation kills none: it is left out, and the others are asked.
    """
    killed, total, unsound = Counter[str](), Counter[str](), set[str]()
    with tempfile.TemporaryDirectory() as folder:
        tree = copy_of_tree(Path(folder))
        known = import_libraries(tree)
        for mutant in chosen:
            begun, test = time.perf_counter(), ""
            tests = [one for one in mutant.tests if "::" not in one or one in known]
            while tests and (test := killer(mutant, tree, tests, unsound, most_cpu_s)):
                if test.endswith(NO_END) or not first_failure([test], tree):
                    break
                unsound.add(test)
            killed[mutant.room] += bool(test)
            total[mutant.room] += 1
            outcome = "killed" if test else "SURVIVES" if tests else "UNTESTED"
            end = f"  by {test}" if test else f"  of {len(tests)} tests"
            print(f"{outcome:9s} {mutant.what}{end}, {time.perf_counter() - begun:.0f} s", flush=True)
    print(f"left out, since they fail without a mutation: {', '.join(sorted(unsound)) or 'none'}")
    print(f"\n{'room':12s}{'drawn':>7s}{'killed':>8s}")
    for room in sorted(total):
        print(f"{room:12s}{total[room]:7d}{killed[room]:8d}")
    share = killed.total() / max(total.total(), 1)
    print(f"{'all':12s}{total.total():7d}{killed.total():8d}  {share:.0%}")
    return int(share < LEAST_KILLED)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", default="", help="mutations whose room, file or description contains this text"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="copies of the tree to work in")
    parser.add_argument("--draw", type=int, metavar="SEED", help="draw mutations instead")
    parser.add_argument("--count", type=int, default=40, help="how many are drawn")
    parser.add_argument("--room", default="", help="draw from the modules of this room only")
    parser.add_argument("--lines", type=Path, help="trace of all tests (traced_tests.py)")
    parser.add_argument("--cpu", type=float, default=100.0, help="s of tests of a line, the quickest first")
    options = parser.parse_args()
    if options.draw is not None:
        lines = LineTests.read(options.lines, ROOT) if options.lines else None
        mutations = drawn(options.draw, options.count, options.room, lines, options.cpu)
        return try_drawn(mutations, 20.0 + 4.0 * options.cpu)
    chosen = [m for m in mutants() if options.only in f"{m.room} {m.file} {m.what}"]
    if wrong := [text for mutant in chosen for text in faults(mutant)]:
        print("\n".join(wrong))
        return 2
    if printed := failures_without_mutation(chosen, options.jobs):
        print(printed + "\nthe tests must pass before a mutation is made")
        return 2
    begun, rows = time.perf_counter(), []
    for mutant, was_killed, seconds in tried(chosen, options.jobs):
        rows.append((mutant, was_killed, seconds))
        outcome = "killed" if was_killed else "equivalent" if mutant.equivalent else "SURVIVES"
        print(
            f"{len(rows):4d}/{len(chosen)} {outcome:10s} {seconds:6.1f} s  {mutant.file}: {mutant.what}",
            flush=True,
        )
    if not options.only:
        RECORD.write_text(record(rows, time.perf_counter() - begun), encoding="utf-8")
    return int(any(not was_killed and not mutant.equivalent for mutant, was_killed, _ in rows))


if __name__ == "__main__":
    sys.exit(main())
