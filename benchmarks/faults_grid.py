"""A grid of faults: is a wrong matrix ever green, is the cause named first, are innocents accused?

    python benchmarks/faults_grid.py WORK --quick
    python benchmarks/faults_grid.py WORK [--dump ground] [--seed 1] [--only "strip clock"] [--minutes 25]

Each fault of `faults.py` is put into a copy of each dump of `fault_dumps.py` and calibrated by the command
`boresight calibrate --json --no-report`, in a process forked from one that has imported everything; what the
fault leaves unchanged comes from the store of the sound dump's result. A run goes on where an earlier one of
the same commit ended: WORK/faults_grid.jsonl keeps a line for each case; the table is written anew each time.

Recorded are exit status, verdict, what is named first, and the error of the matrix against `truth/`. A case
is *green while wrong* if the verdict is consistent although an angle errs by more than 4 of its stated
sigmas, and nothing of what the result says it cannot see names the fault. Names are asked for from 3 times
the smallest size on, of faults that the result does not list among what it cannot see. An innocent is accused
where the item of a finding has not the fault, unless the finding says that the data do not tell its cause
from others ("s01, or s02") and the fault is among these; the table counts such cases apart.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import sys
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout, suppress
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

import record  # of this folder; sets the number of threads before NumPy is loaded

import numpy as np  # isort: skip
from fault_dumps import DUMPS, linked, sound_dump
from faults import Fault, faults_of
from scipy.spatial.transform import Rotation

from boresight.console import run_command_line as main_of_program
from boresight.geometry.installation import theta_between
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.results.ownership import claimed
from boresight.pipeline.run.settings import Settings

RESULTS = Path(__file__).parent / "results" / "faults_grid.txt"
MOST_SIGMA = 4.0
NOISE_SIGMA = 3.0  # by which a right result may err on top of an error that hides
LIMIT_CPU_S, LIMIT_BYTES = 120, 6 * 2**30
LOADED = (  # by a calibration with report, at the least
    "boresight.pipeline.calibration_run",
    "boresight.pipeline.report.evidence",
    "boresight.pipeline.report.page",
)
NAMED, INNOCENT = 0.95, 0.01  # shares asked for, from 3 times the smallest size on
ITEM = re.compile(r"CCD \d+|\b(?:s|sky)\d\d(?:-[tc]\d\d)?\b|\bSTR\d\b|\be\d{4}\b")
TOLD = ("cause", "item", "text", "file", "field", "is_fault", "refutes", "rivals")
GRID = tuple(name for name in DUMPS if name != "coloured")
Case = dict[str, Any]


# ---- one case ----


def answer_of(arguments: list[str], folder: Path) -> tuple[int, float, dict[str, Any]]:
    """Exit status, CPU seconds and JSON object of a `boresight` command, in a forked process."""
    out, err = folder / "answer.json", folder / "remarks.txt"
    if not (child := os.fork()):
        for path, stream in ((out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_CPU_S, LIMIT_CPU_S))
        resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
        sys.argv = ["boresight", *arguments]
        status = 70  # a traceback
        try:
            main_of_program()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 70
        finally:
            sys.stdout.flush()
            os._exit(status)
    _, ended, used = os.wait4(child, 0)
    status = os.waitstatus_to_exitcode(ended)
    try:
        answer = json.loads(out.read_text())
    except ValueError:
        answer = {"error": {"message": (err.read_text().strip().splitlines() or [f"status {status}"])[-1]}}
    return status, used.ru_utime + used.ru_stime, answer


def imported() -> None:
    """Load what a calibration needs, so that forked processes have it."""
    for name in LOADED:
        import_module(name)


def calibrated(dump: Path, folder: Path, work: Path | None) -> tuple[int, float, dict[str, Any]]:
    """The command's answer for a dump; finished units are taken from the folder `work` of another result."""
    out = folder / "result"
    shutil.rmtree(out, ignore_errors=True)
    with suppress(RawDataError):  # of a dump.toml that cannot be read; the command says so
        if work is not None:
            with claimed(out, [dump], Settings()):
                pass
            shutil.copytree(work, out / "work", copy_function=os.link)
    return answer_of(
        ["calibrate", str(dump), "--out", str(out), "--workers", "1", "--json", "--no-report"], folder
    )


def case_of(status: int, cpu_s: float, answer: dict[str, Any], R_true: Rotation) -> Case:
    """What is named, and how wrong the matrix is."""
    result, error = answer.get("result") or {}, answer.get("error")
    case: Case = {"exit": status, "cpu_s": round(cpu_s, 2), "verdict": "", "told": [], "blind": []}
    if error or "installation" not in result:
        where = " ".join(str(error[key]) for key in ("file", "field") if error and error.get(key))
        message = error["message"] if error else "no answer"
        case |= {"verdict": "traceback" if status in (70, -9, -6, -11) else "refused"}
        return case | {"told": [{"cause": "error", "item": where, "text": message, "is_fault": True}]}
    matrix = result["installation"]
    verdict = matrix["verdict"]
    case["verdict"] = verdict["outcome"]
    told = [one for one in result["findings"] if one.get("is_fault", True)]
    checks = sorted(verdict["checks"], key=lambda one: one["p_value"])
    told += [told_by(one) for one in checks if not one["holds"] and not one["is_caution"]]
    told += [one for one in result["findings"] if not one.get("is_fault", True)]
    case["told"] = [{key: one.get(key) for key in TOLD} for one in told[:12]]
    case["n_told"] = len(told)
    case["blind"] = blind_spots(matrix, verdict, result)
    case["rejected"] = sum(one["kind"] == "target" for one in result["omitted"])
    covariance = np.array(matrix["covariance_rad2"])
    error_rad = theta_between(Rotation.from_matrix(matrix["R_cs"]), R_true)
    sigma = np.sqrt(np.diag(covariance))
    case["sigma_arcsec"] = np.degrees(3600.0 * sigma).tolist()
    case["error_sigma"] = (error_rad / sigma).tolist()
    case["nees"] = float(error_rad @ np.linalg.solve(covariance, error_rad))
    return case


def told_by(check: dict[str, Any]) -> dict[str, Any]:
    """A failed check as a finding."""
    names = " ".join(name for group in check["names"] for name in group)
    return {"cause": check["kind"], "item": names, "text": "; ".join(check["look_at"]), "is_fault": True}


def blind_spots(*places: dict[str, Any]) -> list[str]:
    """What the result says that it cannot see, one text an entry."""
    for place in places:
        for key in ("blind_spots", "cannot_see", "not_visible"):
            if key in place:
                return [json.dumps(one, ensure_ascii=False) for one in place[key]]
    return []


def judged(case: Case) -> Case:
    """Whether a case is wrong, green, named, and whom it accuses; from the case's own text alone."""
    errors = case.get("error_sigma", [])
    wrong = any(abs(one) > MOST_SIGMA for one in errors)
    green = case["verdict"].startswith("consistent")
    faults = [one for one in case["told"] if one["is_fault"]]
    first = case["told"][0] if case["told"] else None
    parts = ("cause", "item", "text", "file", "field")
    text = ": ".join(str(first[key]) for key in parts if first.get(key)) if first else ""
    named = bool(case["words"]) and all(re.search(word, text.lower()) for word in case["words_lower"])
    own = set(case["own"])
    allowed = own | {name.partition("-")[0] for name in own}  # a target is named with its strip
    accused, left_open = set(), False
    for one in faults:
        items = set(ITEM.findall(one["item"] or ""))
        if not case["harmless"] and items - allowed and leaves_open(one, allowed, case["words_lower"]):
            left_open = True
        else:
            accused |= items
    innocents = accused if case["harmless"] else set() if "*" in own else accused - allowed
    blind = bool(case["blind_words"]) and any(
        re.search(case["blind_words"], one.lower()) and hides(one, errors) for one in case["blind"]
    )
    return {
        "wrong": wrong,
        "green": green,
        "clean": green and not faults,
        "green_wrong": green and wrong and not blind,
        "blind": blind,
        "named": named,
        "first": text,
        "innocents": sorted(innocents),
        "left_open": left_open,
    }


def leaves_open(finding: dict[str, Any], allowed: set[str], words: Iterable[str]) -> bool:
    """Whether a finding tells another cause as equally likely, behind "or", that is the fault: one of an item
    that has it, or one that all words of the fault match.
    """
    return any(
        bool(set(ITEM.findall(other)) & allowed) or all(re.search(word, other.lower()) for word in words)
        for other in finding.get("rivals") or ()
    )


def hides(spot: str, errors: list[float]) -> bool:
    """Whether an entry of what a result cannot see states that as large an error may hide in it."""
    one = json.loads(spot)
    largest = max((abs(e) for e in errors), default=0.0)
    return bool(one["is_unseen"]) or one["hidden_sigma"] + NOISE_SIGMA >= largest


# ---- the grid ----


def cases(options: argparse.Namespace) -> Iterator[tuple[str, int, Fault | None]]:
    """The sound dumps, then all faults, spread over kinds so that a part of them is a fair sample."""
    chosen: list[tuple[str, int, Fault]] = []
    for name in options.dump or GRID:
        for seed in options.seed or (1, 2):
            yield name, seed, None
            made = faults_of(sound_dump(name, seed, options.work), seed)
            chosen += [
                (name, seed, fault) for fault in made if not options.only or fault.kind in options.only
            ]
    order = np.random.default_rng(0).permutation(len(chosen))
    chosen = [chosen[k] for k in order]
    if options.quick:
        chosen = one_of_each_kind(chosen)
    if options.largest_first:
        chosen.sort(key=lambda one: -one[2].times)
    yield from chosen


def one_of_each_kind(every: list[tuple[str, int, Fault]]) -> list[tuple[str, int, Fault]]:
    """A case of each kind, of 3 times the smallest size where there are several, on the dumps in turn."""
    of_kind: dict[str, list[tuple[str, int, Fault]]] = defaultdict(list)
    for one in sorted(every, key=lambda one: abs(one[2].times - 3.0)):
        of_kind[one[2].kind].append(one)
    taken: dict[str, int] = defaultdict(int)
    chosen = []
    for those in of_kind.values():
        best = [one for one in those if one[2].times == those[0][2].times]
        chosen.append(min(best, key=lambda one: taken[one[0]]))
        taken[chosen[-1][0]] += 1
    return chosen


def run(options: argparse.Namespace) -> None:
    options.work.mkdir(parents=True, exist_ok=True)
    kept, commit = options.work / "faults_grid.jsonl", record.commit().split()[0]
    done = {key_of(one): one for one in read(kept) if one["commit"] == commit or options.any_commit}
    imported()
    begun = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    asked, used = [], 0.0
    for name, seed, fault in cases(options):
        label = {"dump": name, "seed": seed, "kind": "no fault", "name": "no fault", "times": 0.0}
        label |= {"words": [], "words_lower": [], "blind_words": "", "own": [], "harmless": True}
        if fault is not None:
            label |= {"kind": fault.kind, "name": fault.name, "times": fault.times, "words": fault.words}
            label |= {
                "words_lower": [word.lower() for word in fault.words],
                "blind_words": fault.blind.lower(),
            }
            label |= {"own": fault.own, "harmless": fault.harmless}
        asked.append(key_of(label))
        if key_of(label) in done:
            done[key_of(label)] |= label
            continue
        if used > 60.0 * options.minutes:
            continue  # finished ones behind it count
        case = label | one_case(name, seed, fault, options.work, commit) | {"commit": commit}
        with kept.open("a") as stream:
            stream.write(json.dumps(case) + "\n")
        done[key_of(label)] = case
        if options.verbose:
            print(line_of(case), flush=True)
        write_table([done[key] for key in asked if key in done], options.out)
        used = time.process_time() + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - begun
    write_table([done[key] for key in asked if key in done], options.out)


def one_case(name: str, seed: int, fault: Fault | None, work: Path, commit: str) -> Case:
    """The sound dump is calibrated once; its finished units serve all its faults."""
    source, folder = sound_dump(name, seed, work), work / "case"
    truth = tomllib.loads((source / "truth" / "installation.toml").read_text())["quaternion_cs"]
    base = work / f"base-{name}-{seed}-{commit}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    if not (base / "result" / "installation.json").is_file():
        shutil.rmtree(base, ignore_errors=True)
        base.mkdir()
        sound = calibrated(source, base, None)
        if fault is None:
            return case_of(*sound, Rotation.from_quat(truth))
    linked(source, folder / "dump")
    if fault is not None:
        fault.make(folder / "dump")
    stored = base / "result" / "work"
    answer = calibrated(folder / "dump", folder, stored if stored.is_dir() else None)
    return case_of(*answer, Rotation.from_quat(truth))


def key_of(case: Case) -> tuple[str, int, str]:
    return case["dump"], case["seed"], case["name"]


def read(path: Path) -> list[Case]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


# ---- the table ----


def is_asked(case: Case, found: Case) -> bool:
    """Whether the cause must be named: 3 times the smallest size, and not among what cannot be seen."""
    return case["times"] >= 3.0 and not case["harmless"] and (found["named"] or not found["blind"])


def is_unnamed(case: Case, found: Case) -> bool:
    """Whether something else was told first, where something had to be named."""
    harmless = case["harmless"] or found["blind"] or (found["green"] and not found["wrong"])
    return case["times"] >= 3.0 and not found["named"] and not harmless


def line_of(case: Case) -> str:
    """A case on one line."""
    found = judged(case)
    nees = f"{case['nees']:.3g}" if "nees" in case else "-"
    errors = "/".join(f"{one:+.1f}" for one in case.get("error_sigma", []))
    flag = "GREEN WHILE WRONG " if found["green_wrong"] else ""
    flag += f"innocents {','.join(found['innocents'][:6])} " if found["innocents"] else ""
    flag += "" if found["named"] or case["harmless"] else "not named "
    return (
        f"{case['dump']:8s} {case['seed']} {case['name'][:44]:44s} x{case['times']:<4g} exit {case['exit']} "
        f"{case['verdict'][:22]:22s} NEES {nees:>8s} {errors:24s} {flag}| {found['first'][:170]}"
    )


def write_table(every: list[Case], out: Path) -> None:
    """Counts of each kind and dump, then the cases that are not as they should be."""
    text = StringIO()
    with redirect_stdout(text):
        _print_table(every)
    out.write_text(text.getvalue())


def _print_table(every: list[Case]) -> None:
    record.head("A grid of faults: green while wrong, cause named first, innocents accused")
    cpu_s = sum(case["cpu_s"] for case in every)
    commits = Counter(case["commit"] for case in every)
    print(f"{len(every)} cases, {cpu_s / 60.0:.1f} min of CPU; by commit of the program:")
    print(", ".join(f"{n} {commit}" for commit, n in commits.most_common()) + "\n")
    print(
        "green: consistent without a finding of a fault; found: consistent with one; G!W: consistent though"
    )
    print("an angle errs by more than 4 sigma and no blind spot names the fault; named: cause and item told")
    print("first, of the cases from 3 times the smallest size on\n")
    print("fault                          dump         n refused refuted found green  G!W named innocents  "
          "worst NEES green")  # fmt: skip
    groups: dict[tuple[str, str], list[Case]] = defaultdict(list)
    for case in every:
        groups[(case["kind"], case["dump"])].append(case)
    for (kind, dump), those in sorted(groups.items()):
        found = [(case, judged(case)) for case in those]
        large = [j for case, j in found if is_asked(case, j)]
        named = f"{sum(j['named'] for j in large)}/{len(large)}" if large else "-"
        worst = max((case["nees"] for case, j in found if j["green"]), default=float("nan"))
        refused, refuted = (sum(case["verdict"] == one for case in those) for one in ("refused", "refuted"))
        clean = sum(j["clean"] for _, j in found)
        told = sum(j["green"] for _, j in found) - clean
        wrong, innocent = (sum(bool(j[key]) for _, j in found) for key in ("green_wrong", "innocents"))
        print(
            f"{kind[:30]:30s} {dump:9s} {len(those):4d} {refused:7d} {refuted:7d} {told:5d} {clean:5d} "
            f"{wrong:4d} {named:>5s} {innocent:9d} {worst:17.3g}"
        )
    _print_cases(every)


def _print_cases(every: list[Case]) -> None:
    found = [(case, judged(case)) for case in every]
    harm = [one for one in found if one[1]["green_wrong"]]
    blamed = [one for one in found if one[1]["innocents"] and one not in harm]
    unnamed = [one for one in found if is_unnamed(*one) and one not in harm and one not in blamed]
    traces = [one for one in found if one[0]["verdict"] == "traceback"]
    lists = {
        "green while wrong": harm,
        "innocents accused": blamed,
        "cause not named first": unnamed,
        "traceback": traces,
    }
    for title, those in lists.items():
        print(f"\n{title}: {len(those)}")
        for case, _ in those:
            print(line_of(case))
    faults = [(case, j) for case, j in found if case["kind"] != "no fault"]
    large = [j for case, j in faults if is_asked(case, j)]
    print()
    wrong = sum(j["green_wrong"] for _, j in found)
    named = sum(j["named"] for j in large) / max(len(large), 1)
    innocent = sum(bool(j["innocents"]) for _, j in found) / max(len(found), 1)
    left_open = sum(j["left_open"] for _, j in found)
    print(f"{left_open} cases with a finding that names another item, or the fault: not counted as accused")
    for text, holds in (
        (f"{wrong} of {len(found)} cases green while wrong (0)", wrong == 0),
        (f"cause named first in {named:.3f} of {len(large)} from 3 times on ({NAMED})", named >= NAMED),
        (f"innocents accused in {innocent:.3f} ({INNOCENT})", innocent <= INNOCENT),
    ):
        print(f"{'holds' if holds else 'FAILS'}  {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path, help="folder of dumps, results and finished cases")
    parser.add_argument("--quick", action="store_true", help="one case of each kind")
    parser.add_argument("--only", action="append", help="a kind of fault")
    parser.add_argument("--dump", action="append", choices=DUMPS)
    parser.add_argument("--seed", action="append", type=int)
    parser.add_argument("--minutes", type=float, default=25.0, help="of CPU, then it stops")
    parser.add_argument("--largest-first", action="store_true")
    parser.add_argument(
        "--any-commit", action="store_true", help="finished cases of other commits count, too"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--verbose", "-v", action="store_true", help="a line for each case as it ends")
    run(parser.parse_args())


if __name__ == "__main__":
    main()
