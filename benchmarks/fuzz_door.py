"""Hostile arguments for every public function: does anything but a documented error come out?

Calls as in `tests/api/hostile_calls.py`, on the first strip of the example "mini". An error counts as
undocumented if docs/python.md does not list its class, if it says nothing, or if its text has several lines
or control characters. Warnings of NumPy about numbers (RuntimeWarning) count, too.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/fuzz_door.py [calls [seed]]

Exit status 1 when a requirement fails.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

from record import exit_status, head, verdict

import boresight as bs

TESTS = Path(__file__).parents[1] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "api")]
from hostile_calls import Door, door, hostile_calls  # noqa: E402


def main(calls: int = 5000, seed: int = 20261125) -> int:
    head("hostile arguments of the public functions")
    logging.disable(logging.CRITICAL)
    begun_s, outcomes, wrong = time.process_time(), Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        mini = bs.example("mini")
        result = bs.calibrate(mini, strips=["s01"], out=Path(folder) / "result")
        solution = bs.identify(mini / "exposures" / "e0001.png", camera=bs.open_dump(mini).star_camera)
        assert solution
        doors = door(solution, result, mini, Path(folder))
        for one, arguments in hostile_calls(doors, calls, seed):
            outcome = called(one, arguments)
            outcomes[outcome if outcome in ("result", "documented error") else "undocumented"] += 1
            if outcome not in ("result", "documented error"):
                wrong[f"{one.name}: {outcome}"] += 1
        os.chdir(TESTS)
    for name, count in outcomes.most_common():
        print(f"{count:6d} {name}")
    for name, count in wrong.most_common():
        print(f"{count:6d} {name}")
    print(f"{time.process_time() - begun_s:.0f} s of processor time")
    verdict(f"{outcomes['undocumented']} undocumented errors in {calls} calls (0)", not wrong)
    return exit_status()


def called(one: Door, arguments: dict[str, object]) -> str:
    """What a call comes to."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", RuntimeWarning)
        try:
            one.call(**arguments)
        except one.documented as error:
            said = str(error)
            return "documented error" if said and said.isprintable() else f"text {said[:60]!r}"
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            return f"{type(error).__name__} in {Path(place.filename).name}:{place.lineno}"
    return "result"


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
