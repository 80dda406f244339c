"""A grid of faults: is a wrong matrix ever green, is the cause named first, are innocents accused?

    python benchmarks/faults_grid.py [--cases 24] [--seed 1] [--dump points]
    python benchmarks/faults_grid.py --cases 600 --work WORK --minutes 25

Faults that `tests/pipeline/faults/drawn_faults.py` draws by a seed (kind, place, profile, size, two at
once) are put into copies of the dumps of `fault_dumps.py` in turn and calibrated by the command `boresight
calibrate --json --no-report`, in a process forked from one that has imported everything; what the fault
leaves unchanged comes from the store of the sound dump's result. How a case is judged says `fault_cases.py`.
With --work a run goes on where an earlier one of the same commit ended: WORK/faults_grid.jsonl keeps a line
for each case.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import record  # of this folder; sets the number of threads before NumPy is loaded

sys.path.insert(0, str(record.ROOT / "tests"))
sys.path.insert(0, str(record.ROOT / "tests" / "pipeline" / "faults"))

from drawn_faults import drawn
from fault_cases import Case, calibrated, case_of, imported, is_asked, judged, true_rotation
from fault_dumps import DUMPS, linked, sound_dump
from faults import Fault

FIRST, NAMED, INNOCENT = 0.85, 0.95, 0.01  # shares asked for, from 3 times the smallest size on


def cases(options: argparse.Namespace, work: Path) -> Iterator[tuple[str, int, Fault | None]]:
    """Each sound dump, then drawn faults of the dumps in turn."""
    dumps = [(name, seed) for name in options.dump or DUMPS for seed in options.seed or (1,)]
    yield from ((name, seed, None) for name, seed in dumps)
    for n in range(options.first, options.first + options.cases):
        name, seed = dumps[n % len(dumps)]
        yield name, seed, drawn(sound_dump(name, seed, work), seed, n)


def run(options: argparse.Namespace, work: Path) -> list[Case]:
    """The cases, each calibrated or taken from an earlier run of the same commit."""
    kept, commit = work / "faults_grid.jsonl", record.commit().split()[0]
    lines = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    done = {key_of(line): line for line in lines if line["commit"] == commit}
    imported()
    begun, every = cpu_s(), []
    for name, seed, fault in cases(options, work):
        label = {"dump": name, "seed": seed} | label_of(fault)
        if key_of(label) in done:
            every.append(done[key_of(label)] | label)
        elif cpu_s() - begun < 60.0 * options.minutes:
            case = label | one_case(name, seed, fault, work, commit) | {"commit": commit}
            with kept.open("a") as stream:
                stream.write(json.dumps(case) + "\n")
            every.append(case)
            if options.verbose:
                print(line_of(case), flush=True)
    return every


def cpu_s() -> float:
    """Processor time of this process and of those that ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def label_of(fault: Fault | None) -> Case:
    """What a case keeps of its fault."""
    of = fault or Fault("no fault", "", 0.0, "", 0.0, lambda dump: None, (), harmless=True)
    lower = {"words_lower": [word.lower() for word in of.words], "blind_words": of.blind.lower()}
    lower["other_words"] = [word.lower() for word in of.other_words]
    kept = {key: getattr(of, key) for key in ("kind", "times", "words", "own", "harmless")}
    return kept | lower | {"name": of.name if fault else "no fault"}


def one_case(name: str, seed: int, fault: Fault | None, work: Path, commit: str) -> Case:
    """The sound dump is calibrated once; its finished units serve all its faults."""
    source, folder = sound_dump(name, seed, work), work / "case"
    base = work / f"base-{name}-{seed}-{commit}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    if not (base / "result" / "installation.json").is_file():
        shutil.rmtree(base, ignore_errors=True)
        base.mkdir()
        sound = calibrated(source, base, None)
        if fault is None:
            return case_of(*sound, true_rotation(source))
    copied(source, folder / "dump")
    if fault is not None:
        fault.make(folder / "dump")
    stored = base / "result" / "work"
    answer = calibrated(folder / "dump", folder, stored if stored.is_dir() else None)
    return case_of(*answer, true_rotation(source))


def copied(source: Path, target: Path) -> None:
    """A copy without `truth/`: links where the file system allows them."""
    try:
        linked(source, target)
    except (OSError, shutil.Error):
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("truth"))


def key_of(case: Case) -> tuple[str, int, str]:
    return case["dump"], case["seed"], case["name"]


# ---- the table ----


def is_unnamed(case: Case, found: Case) -> bool:
    """Whether something else was told first, where something had to be named."""
    harmless = case["harmless"] or found["blind"] or (found["green"] and not found["wrong"])
    return case["times"] >= 3.0 and not found["named"] and not harmless


def line_of(case: Case) -> str:
    """A case on one line."""
    found = judged(case)
    nees = f"{case['nees']:.3g}" if "nees" in case else "-"
    errors = "/".join(f"{value:+.1f}" for value in case.get("error_sigma", []))
    flag = "GREEN WHILE WRONG " if found["green_wrong"] else ""
    flag += f"innocents {','.join(found['innocents'][:6])} " if found["innocents"] else ""
    flag += "" if found["named"] or case["harmless"] else "not named "
    return (
        f"{case['dump']:8s} {case['seed']} {case['name'][:64]:44s} x{case['times']:<4.3g} "
        f"exit {case['exit']} "
        f"{case['verdict'][:22]:22s} NEES {nees:>8s} {errors:24s} {flag}| {found['first'][:170]}"
    )


def report(every: list[Case]) -> None:
    """Counts of each kind and dump, the cases that are not as they should be, and the verdicts."""
    print(f"{len(every)} cases, {sum(case['cpu_s'] for case in every) / 60.0:.1f} min of CPU")
    print("fault                          dump         n refused refuted found green  G!W named innocents")
    groups: dict[tuple[str, str], list[tuple[Case, Case]]] = defaultdict(list)
    found = [(case, judged(case)) for case in every]
    for case, answer in found:
        groups[case["kind"], case["dump"]].append((case, answer))
    for (kind, dump), those in sorted(groups.items()):
        large = [answer for case, answer in those if is_asked(case, answer)]
        named = f"{sum(answer['named'] for answer in large)}/{len(large)}" if large else "-"
        refused, refuted = (
            sum(case["verdict"] == word for case, _ in those) for word in ("refused", "refuted")
        )
        clean = sum(answer["clean"] for _, answer in those)
        told = sum(answer["green"] for _, answer in those) - clean
        wrong, innocent = (sum(bool(a[key]) for _, a in those) for key in ("green_wrong", "innocents"))
        print(
            f"{kind[:30]:30s} {dump:9s} {len(those):4d} {refused:7d} {refuted:7d} {told:5d} {clean:5d} "
            f"{wrong:4d} {named:>5s} {innocent:9d}"
        )
    lists = {
        "green while wrong": [case for case, answer in found if answer["green_wrong"]],
        "innocents accused": [case for case, answer in found if answer["innocents"]],
        "cause not named first": [case for case, answer in found if is_unnamed(case, answer)],
        "size above what is possible": [case for case, answer in found if answer["too_large"]],
        "traceback": [case for case, _ in found if case["verdict"] == "traceback"],
    }
    for title, those in lists.items():
        print(f"\n{title}: {len(those)}")
        for case in those:
            print(line_of(case))
    large = [answer for case, answer in found if case["kind"] != "no fault" and is_asked(case, answer)]
    left_open = sum(answer["left_open"] for _, answer in found)
    print(f"\n{left_open} cases with a finding that names another item, or the fault: not counted as accused")
    record.judge_share("green while wrong", len(lists["green while wrong"]), len(found), most=0.0)
    record.judge_share(
        "cause named first, from 3 times the smallest size on",
        sum(answer["named"] for answer in large),
        len(large),
        least=FIRST,
    )
    record.judge_share(
        "cause named first, or behind an or",
        sum(answer["named_or_rival"] for answer in large),
        len(large),
        least=NAMED,
    )
    too_large = len(lists["size above what is possible"])
    record.judge_share("size above what is possible", too_large, len(found), most=0.0)
    record.judge_share("innocents accused", len(lists["innocents accused"]), len(found), most=INNOCENT)
    record.judge_share("tracebacks", len(lists["traceback"]), len(found), most=0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, help="folder of dumps, results and finished cases")
    parser.add_argument("--cases", type=int, default=24, help="faults that are drawn")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them")
    parser.add_argument("--dump", action="append", choices=DUMPS)
    parser.add_argument("--seed", action="append", type=int, help="of the sound dumps")
    parser.add_argument("--minutes", type=float, default=25.0, help="of CPU, then it stops")
    parser.add_argument("--verbose", "-v", action="store_true", help="a line for each case as it ends")
    options = parser.parse_args()
    record.head("A grid of faults: green while wrong, cause named first, innocents accused")
    with tempfile.TemporaryDirectory() as folder:
        work = options.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        report(run(options, work))
    sys.exit(record.exit_status())


if __name__ == "__main__":
    main()
