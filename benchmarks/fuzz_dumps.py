"""One number of a dump changed at a time, through the whole calibration: is it refused, refuted or harmless?

    python benchmarks/fuzz_dumps.py --mutations 2000 --seed 1 --out fuzz-dumps.jsonl
    python benchmarks/fuzz_dumps.py --mutations 24 --field x_offset_mm --out offsets.jsonl
    python benchmarks/fuzz_dumps.py --mutations 24 --dump sky --field focal_length_mm --out focal.jsonl
    python benchmarks/fuzz_dumps.py --mutations 2000 --seed 1 --again fuzz-dumps.jsonl --out again.jsonl
    python benchmarks/fuzz_dumps.py --summary fuzz-dumps.jsonl

Each mutation changes one number in one text file of `fixtures/mini`, or `fixtures/sky` (factor, sign, decimal
point, a digit, two digits exchanged, 0, -1, nan, 1e308; of a chosen field every other time by 1 to 1e-5 of
itself). The dump is calibrated and its result written, with the report where NEES or verdict differ from
those of the sound dump, in a process of its own under 4 GiB of address space,
120 s of CPU and an hour. That process is forked from one that has imported everything; exposures and strips
whose inputs are unchanged come from a store. Counted are tracebacks, hangs, and results whose normalised
error squared (NEES, 3 degrees of freedom) against the truth is above 30 although the verdict is "consistent".
A run that was stopped goes on where it was when it is started again with the same `--seed` and `--out`.
With `--again` only those are tried that an earlier run of the same seed neither refused nor found consistent
with a NEES of at most 20: all on which a changed verdict or estimator may decide otherwise.

Each of the last kind is listed with what it does to R_cs R_si, the attitude of the remote-sensing camera in
space. Where that is unchanged, the error is a rotation of the star camera's axes: R_cs is right for the
star-camera file that it was estimated with, ground coordinates are unchanged, and no data can reveal it.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import tomllib
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from faults_grid import blind_spots
from record import exit_status, head, verdict
from scipy.spatial.transform import Rotation

from boresight.calib.verdict import Outcome
from boresight.geometry.installation import theta_between
from boresight.geometry.ledger import Reason
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.text_files import read_json
from boresight.pipeline.report.evidence import write_evidence
from boresight.pipeline.report.page import write_report
from boresight.pipeline.results.folder import begin_result
from boresight.pipeline.results.writing import write_result
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.unit_store import UnitStore

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures"
TEXTS = {  # file: weight
    "dump.toml": 1,
    "star_camera.toml": 2,
    "remote_camera.toml": 3,
    "installation.toml": 1,
    "orbit.oem": 3,
    "exposures.csv": 2,
    "strips.csv": 2,
    "targets.csv": 3,
}
NUMBER = re.compile(r"(?<![\w.])[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?(?![A-Za-z_])")
LIMIT_BYTES, LIMIT_CPU_S, LIMIT_S, LIMIT_NEES = 4 * 2**30, 120, 3600, 30.0
UNCLEAR_NEES = 20.0
LIMIT_ROTATION_SIGMA = 1.0  # of the remote-sensing camera in space, for an error that is a rotation of axes
BLIND = {  # field: regular expression of an entry of what a result says that it cannot see
    "utc_first_row": "clock|late",
    "row_period_s": "period",
    "time_of_row": "clock|late",
    "tdi_stages": "clock|late",
    "utc_mid": "clock|late",
    "x_offset_mm": "ccd",
    "y_first_mm": "ccd",
    "rotation_mrad": "ccd",
    "focal_length_m": "focal",
    "focal_length_mm": "focal",
    "principal_point_px": "principal",
    "height_m": "height|radial",
}
ORDINARY_NEES = 1.0  # a NEES that differs by more from that of the sound dump is worth a report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--dump", choices=("mini", "sky"), default="mini", help="of fixtures/")
    parser.add_argument("--field", default="", help="only numbers of this field, such as x_offset_mm")
    parser.add_argument("--out", type=Path, default=Path("fuzz-dumps.jsonl"), help="one line a mutation")
    parser.add_argument("--again", type=Path, help="of an earlier run: only what was not clear there")
    parser.add_argument("--summary", type=Path, help="of files written before, instead of a run", nargs="+")
    options = parser.parse_args()
    files = options.summary or [options.out]
    if not options.summary:
        with tempfile.TemporaryDirectory() as folder:
            wanted = unclear(options.again) if options.again else set(range(options.mutations))
            fuzz(Path(folder), FIXTURES / options.dump, options, wanted)
    lines = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    summarise(lines, options.dump)
    sys.exit(exit_status())


class Finished(UnitStore):
    """A store that is only read: it keeps the units of the sound dump."""

    def write(self, *arguments: Any) -> Path:
        """Nothing."""
        return self.root


def unclear(file: Path) -> set[int]:
    """Numbers of the mutations that a run neither refused nor found consistent with a NEES near 3."""
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    clear = ("refused", "consistent")
    return {
        line["n"] for line in lines if line["outcome"] not in clear or line.get("nees", 0.0) > UNCLEAR_NEES
    }


def fuzz(folder: Path, fixture: Path, options: argparse.Namespace, wanted: set[int]) -> None:
    """Calibrate the wanted mutated copies of the dump; one line of JSON each is added to `options.out`, those
    there are kept.
    """
    out = options.out
    done = {json.loads(line)["n"] for line in out.read_text().splitlines()} if out.exists() else set()
    warnings.simplefilter("ignore")
    root = folder / "dump"
    shutil.copytree(fixture, root)
    sound = calibrate_dump(open_dump(root), None, UnitStore(folder / "store"))
    rng = random.Random(options.seed)
    texts = {name: (root / name).read_text() for name in TEXTS if (root / name).is_file()}
    texts = {name: text for name, text in texts.items() if spans_of(text, options.field)}
    with out.open("a") as stream:
        for n in range(options.mutations):
            (name,) = rng.choices(list(texts), [TEXTS[one] for one in texts])
            facts, text = mutated(texts[name], name, rng, options.field)
            if n in done or n not in wanted:
                continue
            (root / name).write_text(text)
            stream.write(json.dumps({"n": n} | facts | in_process(folder, sound)) + "\n")
            stream.flush()
            (root / name).write_text(texts[name])


def spans_of(text: str, field: str) -> list[tuple[int, int]]:
    """Where the numbers of a text are; with a field those in lines that begin with it."""
    spans = [match.span() for match in NUMBER.finditer(text)]
    return [one for one in spans if text[text.rfind("\n", 0, one[0]) + 1 :].startswith(field)]


def mutated(text: str, name: str, rng: random.Random, field: str = "") -> tuple[dict[str, Any], str]:
    """What was changed, and the text with one number changed."""
    begin, end = rng.choice(spans_of(text, field))
    old = text[begin:end]
    small = bool(field) and rng.random() < 0.5
    while (new := slightly_changed(old, rng) if small else changed(old, rng)) == old:
        pass
    line = text.count("\n", 0, begin) + 1
    where = text[text.rfind("\n", 0, begin) + 1 : begin]
    if name.endswith(".csv"):
        column = text.splitlines()[0].split(",")[where.count(",")] if line > 1 else "header"
    elif name.endswith(".oem"):
        column = where.partition(" ")[0] if "=" in where else f"word {len(where.split())}"
    else:
        column = where.partition(" ")[0]
    return {"file": name, "line": line, "field": column, "old": old, "new": new}, text[:begin] + new + text[
        end:
    ]


def slightly_changed(old: str, rng: random.Random) -> str:
    """A number's text a little larger or smaller."""
    return f"{float(old) * (1.0 + rng.choice((-1.0, 1.0)) * 10.0 ** -rng.uniform(0.0, 5.0)):.12g}"


def changed(old: str, rng: random.Random) -> str:
    """A number's text with one thing about it changed."""
    factors = (10.0, 0.1, 2.0, 0.5, 1.1, 1.01, 1.001, 1.0001)
    kind = rng.randrange(8)
    if kind == 0:
        value = float(old) * rng.choice(factors)
        return f"{value:.0f}" if re.fullmatch(r"[+-]?\d+", old) else f"{value:.12g}"
    if kind == 1:
        return old[1:] if old.startswith(("-", "+")) else f"-{old}"
    if kind == 2:
        return rng.choice(("0", "-1", "nan", "1e308", "9e15", "-1e308"))
    places = [n for n, c in enumerate(old) if c.isdigit()]
    at = rng.choice(places)
    if kind in (3, 4):
        return old[:at] + str(rng.randrange(10)) + old[at + 1 :]
    if kind == 5 and at + 1 in places:
        return old[:at] + old[at + 1] + old[at] + old[at + 2 :]
    if kind == 6 and "." in old:
        return (
            old.replace(".", "")
            if rng.random() < 0.5
            else old.replace(".", "")[:at] + "." + old[at:].replace(".", "")
        )
    return old[:at] + old[at + 1 :] if len(places) > 1 else f"{old}0"


def in_process(folder: Path, sound: DumpCalibration) -> dict[str, Any]:
    """Outcome of a calibration in a process of its own."""
    begin, (read_end, write_end) = time.monotonic(), os.pipe()
    if not (child := os.fork()):
        os.close(read_end)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LIMIT_S)
        resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_CPU_S, LIMIT_CPU_S))  # SIGKILL
        resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
        os.write(write_end, json.dumps(outcome(folder, sound)).encode())
        os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end, "rb") as stream:
        answer = stream.read()
    _, status = os.waitpid(child, 0)
    shutil.rmtree(folder / "result", ignore_errors=True)
    seconds = round(time.monotonic() - begin, 2)
    if not answer:
        by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        hang = by in (signal.SIGALRM, signal.SIGXCPU, signal.SIGKILL)
        return {"outcome": "hang" if hang else "died", "says": f"status {status}", "seconds": seconds}
    return json.loads(answer) | {"seconds": seconds}


def outcome(folder: Path, sound: DumpCalibration) -> dict[str, Any]:
    """Refused, not sufficient, a traceback, or a result with its NEES and verdict."""
    try:
        dump = open_dump(folder / "dump")
        found = calibrate_dump(dump, None, Finished(folder / "store"))
        expected, value = nees(sound, dump.root), nees(found, dump.root)
        unusual = found.verdict.outcome is Outcome.REFUTED or abs(value - expected) > ORDINARY_NEES
        result = folder / "result"
        result.mkdir()
        begin_result(result)
        write_evidence(result, dump, found, Settings())
        write_result(result, found, Settings())
        if unusual:
            (result / "run.json").write_text('{"dump": "mutated"}')
            write_report(result)
        internal = [o.text for o in found.omissions if o.reason is Reason.INTERNAL_ERROR]
        return {
            "outcome": "traceback" if internal else found.verdict.outcome.value,
            "says": internal[0] if internal else ", ".join(c.kind.name for c in found.verdict.refuted_by),
            "nees": value,
            "blind": blind_spots(read_json(result / "installation.json")),
            "rotation_of_remote_camera_sigma": rotation_in_space(found, sound),
        }
    except (RawDataError, DataNotSufficientError) as error:
        kind = "refused" if isinstance(error, RawDataError) else "not sufficient"
        return {"outcome": kind, "says": str(error)[:300]}
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {str(error)[:200]} ({Path(place.filename).name}:{place.lineno})"
        return {"outcome": "traceback", "says": text}


def nees(found: DumpCalibration, root: Path) -> float:
    """Normalised error squared of the three angles against the truth of the dump."""
    truth = tomllib.loads((root / "truth" / "installation.toml").read_text())["quaternion_cs"]
    error = theta_between(found.estimate.R_cs, Rotation.from_quat(truth))
    return float(error @ np.linalg.solve(found.estimate.cov_theta, error))


def rotation_in_space(found: DumpCalibration, sound: DumpCalibration) -> float:
    """Rotation of the remote-sensing camera in space against the sound dump's, in units of its 1-sigma."""
    places = {star.t_s: k for k, star in enumerate(sound.stars)}
    both = [(k, places[star.t_s]) for k, star in enumerate(found.stars) if star.t_s in places]
    both = [(k, m) for k, m in both if found.attitudes.usable[k] and sound.attitudes.usable[m]]
    if not both:
        return float("inf")
    R_ci, R_ci_sound = (
        one.estimate.R_cs * Rotation.from_matrix(one.attitudes.R_si[list(rows)])
        for one, rows in zip((found, sound), zip(*both))
    )
    rotation = np.median((R_ci * R_ci_sound.inv()).as_rotvec(), axis=0)
    return float(np.sqrt(rotation @ np.linalg.solve(sound.estimate.cov_theta, rotation)))


def summarise(lines: list[dict[str, Any]], dump: str) -> None:
    """Counts, what was slow or wrong, and the errors of the input that the data do not reveal."""
    head(f"One number of fixtures/{dump} changed at a time, calibrated from pixels")
    count = Counter(line["outcome"] for line in lines)
    print(f"{len(lines)} mutations: " + ", ".join(f"{n} {kind}" for kind, n in count.most_common()))
    seconds = sorted(line["seconds"] for line in lines)
    print(f"seconds: median {seconds[len(seconds) // 2]:.1f}, most {seconds[-1]:.1f}\n")
    for kind in ("traceback", "hang", "died"):
        for line in (line for line in lines if line["outcome"] == kind):
            print(f"{kind}: {_shown(line)}: {line['says']}")
    high = [line for line in lines if line.get("nees", 0.0) > LIMIT_NEES]
    consistent = [line for line in high if line["outcome"].startswith("consistent")]
    print(f"NEES above {LIMIT_NEES:g}: {len(high) - len(consistent)} refuted, {len(consistent)} consistent")
    unexplained = 0
    for line in sorted(consistent, key=lambda line: -line["nees"]):
        rotated = line["rotation_of_remote_camera_sigma"]
        reason = "a rotation of the star camera's axes" if rotated <= LIMIT_ROTATION_SIGMA else ""
        word = BLIND.get(line["field"], "")
        if word and any(re.search(word, one.lower()) for one in line.get("blind", [])):
            reason = "told as what the result cannot see"
        unexplained += not reason
        reason = reason or "UNEXPLAINED"
        print(
            f"  {_shown(line)}: NEES {line['nees']:.0f}; remote camera in space {rotated:.2f} sigma: {reason}"
        )
    print()
    verdict("no traceback", count["traceback"] == 0)
    verdict("no hang, no process that died", count["hang"] + count["died"] == 0)
    verdict(
        f"no result of NEES above {LIMIT_NEES:g} and verdict consistent, but rotations of the star camera "
        "and what the result says that it cannot see",
        not unexplained,
    )


def _shown(line: dict[str, Any]) -> str:
    return f"{line['file']}:{line['line']} {line['field']} {line['old']} -> {line['new']}"


if __name__ == "__main__":
    main()
