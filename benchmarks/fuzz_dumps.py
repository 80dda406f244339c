"""One number of a dump changed at a time, through the whole calibration: is it refused, refuted or harmless?

    python benchmarks/fuzz_dumps.py --mutations 2000 --seed 1 --out fuzz-dumps.jsonl
    python benchmarks/fuzz_dumps.py --summary fuzz-dumps.jsonl

Each mutation changes one number in one text file of `fixtures/mini` (factor, sign, decimal point, a digit,
two digits exchanged, 0, -1, nan, 1e308). The dump is calibrated in memory in a process of its own under 4 GiB
of address space and 60 s; exposures and strips whose inputs are unchanged come from a store. Counted are
tracebacks, hangs, and results whose normalised error squared (NEES, 3 degrees of freedom) against the truth
is above 30 although the verdict is "consistent". The last kind is listed: what the data cannot reveal.
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
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from record import exit_status, head, verdict

FIXTURE = Path(__file__).resolve().parents[1] / "fixtures" / "mini"
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
# Errors that no data of one dump reveal, with the reason: they are rotations of what is estimated.
NOT_REVEALED = {
    ("star_camera.toml", "principal_point_px"): "a small shift is a rotation of the star camera",
}
LIMIT_BYTES, LIMIT_S, LIMIT_NEES = 4 * 2**30, 60, 30.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("fuzz-dumps.jsonl"), help="one line a mutation")
    parser.add_argument("--summary", type=Path, help="of files written before, instead of a run", nargs="+")
    options = parser.parse_args()
    files = options.summary or [options.out]
    if not options.summary:
        with tempfile.TemporaryDirectory() as folder:
            fuzz(Path(folder), options.mutations, options.seed, options.out)
    summarise([json.loads(line) for file in files for line in file.read_text().splitlines()])
    sys.exit(exit_status())


def fuzz(folder: Path, mutations: int, seed: int, out: Path) -> None:
    """Calibrate mutated copies of the dump; one line of JSON each is added to `out`."""
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.stages.calibrate import calibrate_dump
    from boresight.pipeline.work.unit_store import UnitStore

    warnings.simplefilter("ignore")
    root = folder / "dump"
    shutil.copytree(FIXTURE, root)
    store = UnitStore(folder / "store")
    calibrate_dump(open_dump(root), None, store)
    rng = random.Random(seed)
    texts = {name: (root / name).read_text() for name in TEXTS}
    with out.open("a") as stream:
        for _ in range(mutations):
            (name,) = rng.choices(list(TEXTS), list(TEXTS.values()))
            facts, text = mutated(texts[name], name, rng)
            (root / name).write_text(text)
            stream.write(json.dumps(facts | in_process(root, store)) + "\n")
            stream.flush()
            (root / name).write_text(texts[name])


def mutated(text: str, name: str, rng: random.Random) -> tuple[dict[str, Any], str]:
    """What was changed, and the text with one number changed."""
    spans = [match.span() for match in NUMBER.finditer(text)]
    begin, end = rng.choice(spans)
    old = text[begin:end]
    while (new := changed(old, rng)) == old:
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


def in_process(root: Path, store: Any) -> dict[str, Any]:
    """Outcome of a calibration in a process of its own."""
    begin, (read_end, write_end) = time.monotonic(), os.pipe()
    if not (child := os.fork()):
        os.close(read_end)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LIMIT_S)
        resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
        os.write(write_end, json.dumps(outcome(root, store)).encode())
        os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end, "rb") as stream:
        answer = stream.read()
    _, status = os.waitpid(child, 0)
    seconds = round(time.monotonic() - begin, 2)
    if not answer:
        hang = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGALRM
        return {"outcome": "hang" if hang else "died", "says": f"status {status}", "seconds": seconds}
    return json.loads(answer) | {"seconds": seconds}


def outcome(root: Path, store: Any) -> dict[str, Any]:
    """Refused, not sufficient, a traceback, or a result with its NEES and verdict."""
    from boresight.calib.verdict import assess
    from boresight.pipeline.errors import DataNotSufficientError, RawDataError
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.stages.calibrate import calibrate_dump

    class ReadOnly(type(store)):  # type: ignore[misc]
        def write(self, *arguments: Any) -> None:
            """Nothing: the store keeps the units of the unchanged dump."""

    try:
        dump = open_dump(root)
        found = calibrate_dump(dump, None, ReadOnly(store.root))
        said = assess(found.estimate, found.strips, sigma_installation_rad=dump.sigma_installation_rad)
        internal = [o.reason for o in found.omissions if "internal error" in o.reason]
        return {
            "outcome": "traceback" if internal else said.outcome.name.lower(),
            "says": internal[0] if internal else ", ".join(check.kind.name for check in said.refuted_by),
            "nees": nees(found.estimate),
        }
    except (RawDataError, DataNotSufficientError) as error:
        kind = "refused" if isinstance(error, RawDataError) else "not sufficient"
        return {"outcome": kind, "says": str(error)[:300]}
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {str(error)[:200]} ({Path(place.filename).name}:{place.lineno})"
        return {"outcome": "traceback", "says": text}


def nees(estimate: Any) -> float:
    """Normalised error squared of the three angles against the fixture's truth."""
    import tomllib

    import numpy as np
    from scipy.spatial.transform import Rotation

    from boresight.geometry.installation import theta_between

    truth = tomllib.loads((FIXTURE / "truth" / "installation.toml").read_text())["quaternion_cs"]
    error = theta_between(estimate.R_cs, Rotation.from_quat(truth))
    return float(error @ np.linalg.solve(estimate.cov_theta, error))


def summarise(lines: list[dict[str, Any]]) -> None:
    """Counts, what was slow or wrong, and the errors of the input that the data do not reveal."""
    head("One number of fixtures/mini changed at a time, calibrated from pixels")
    count = Counter(line["outcome"] for line in lines)
    print(f"{len(lines)} mutations: " + ", ".join(f"{n} {kind}" for kind, n in count.most_common()))
    seconds = sorted(line["seconds"] for line in lines)
    print(f"seconds: median {seconds[len(seconds) // 2]:.1f}, most {seconds[-1]:.1f}\n")
    for kind in ("traceback", "hang", "died"):
        for line in (line for line in lines if line["outcome"] == kind):
            print(f"{kind}: {_shown(line)}: {line['says']}")
    high = [line for line in lines if line.get("nees", 0.0) > LIMIT_NEES]
    consistent = [line for line in high if line["outcome"] == "consistent"]
    print(f"NEES above {LIMIT_NEES:g}: {len(high) - len(consistent)} refuted, {len(consistent)} consistent")
    unexplained = 0
    for line in sorted(consistent, key=lambda line: -line["nees"]):
        reason = NOT_REVEALED.get((line["file"], line["field"]), "")
        unexplained += not reason
        print(f"  {_shown(line)}: NEES {line['nees']:.0f}; {reason or 'UNEXPLAINED'}")
    print()
    verdict("no traceback", count["traceback"] == 0)
    verdict("no hang, no process that died", count["hang"] + count["died"] == 0)
    verdict(
        f"no result of NEES above {LIMIT_NEES:g} with the verdict consistent, but those listed",
        not unexplained,
    )


def _shown(line: dict[str, Any]) -> str:
    return f"{line['file']}:{line['line']} {line['field']} {line['old']} -> {line['new']}"


if __name__ == "__main__":
    main()
