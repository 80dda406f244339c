"""A dump with a fault through `boresight calibrate --json`: what is named, how wrong the matrix is, whether
the fault is found. Tests judge single cases by it, `benchmarks/faults_grid.py` a grid of them.

A case is *green while wrong* if the verdict is consistent although an angle errs by more than 4 of its stated
sigmas, and nothing of what the result says it cannot see names the fault. Names are asked for from 3 times
the smallest size on, of faults that the result does not list among what it cannot see. An innocent is accused
where the item of a finding has not the fault, unless the finding says that the data do not tell its cause
from others ("s01, or s02") and the fault is among these.
"""

import json
import os
import re
import resource
import shutil
import sys
import tomllib
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.hypotheses import LARGEST
from boresight.calib.reliability import BEYOND_SIGMAS
from boresight.console import run_command_line as main_of_program
from boresight.geometry.installation import theta_between
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.results.ownership import claimed
from boresight.pipeline.run.settings import Settings

__all__ = [
    "Case",
    "answer_of",
    "blind_spots",
    "calibrated",
    "case_of",
    "imported",
    "is_asked",
    "judged",
    "leaves_open",
    "true_rotation",
]

MOST_SIGMA = 4.0
NOISE_SIGMA = 3.0  # by which a right result may err on top of an error that hides
LIMIT_CPU_S, LIMIT_BYTES = 120, 6 * 2**30
LOADED = (  # by a calibration with report, at the least
    "boresight.pipeline.calibration_run",
    "boresight.pipeline.report.evidence",
    "boresight.pipeline.report.page",
)
ITEM = re.compile(r"CCD \d+|\b(?:s|sky)\d\d(?:-[tc]\d\d)?\b|\bSTR\d\b|\be\d{4}\b")
TOLD = ("cause", "item", "text", "file", "field", "is_fault", "refutes", "rivals", "value", "sigma", "unit")
Case = dict[str, Any]


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
    failed = [one for one in verdict["checks"] if one["fails"] and not one["is_caution"]]
    told += [told_by(one) for one in sorted(failed, key=lambda one: one["p_value"])]
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
    text = re.sub(r"; not [^.;]*", "", text)  # a cause that is excluded
    named = bool(case["words"]) and is_told(case, text)
    as_rival = any(is_told(case, f"{rival} {first['text']}") for rival in (first or {}).get("rivals") or ())
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
        "named_or_rival": named or (bool(case["words"]) and as_rival),
        "too_large": [one["cause"] for one in faults if is_too_large(one)],
        "first": text,
        "innocents": sorted(innocents),
        "left_open": left_open,
    }


def is_told(case: Case, text: str) -> bool:
    """Whether a text has all words of the fault, or of either of two."""
    every = [case["words_lower"], *([case["other_words"]] if case.get("other_words") else [])]
    return any(all(re.search(word, text.lower()) for word in words) for words in every)


def is_too_large(finding: dict[str, Any]) -> bool:
    """Whether a finding states a size that none of its kind can have."""
    value, sigma, unit = (finding.get(key) for key in ("value", "sigma", "unit"))
    if value is None or sigma is None or not np.isfinite(value) or not np.isfinite(sigma):
        return False
    return bool(abs(value) > LARGEST.get(unit or "", np.inf) + BEYOND_SIGMAS * sigma)


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


def is_asked(case: Case, found: Case) -> bool:
    """Whether the cause must be named: 3 times the smallest size, and not among what cannot be seen."""
    return case["times"] >= 3.0 and not case["harmless"] and (found["named"] or not found["blind"])


def true_rotation(dump: Path) -> Rotation:
    """R_cs of a simulated dump's `truth/`."""
    return Rotation.from_quat(tomllib.loads((dump / "truth/installation.toml").read_text())["quaternion_cs"])
