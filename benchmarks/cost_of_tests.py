"""Processor time of a calibration with and without the tests of inputs, in turn in one process.

    python benchmarks/cost_of_tests.py [--dump fixtures/mini] [--times 7]

Without them no hypothesis is computed or tested, no loss is counted and nothing is searched again; matching,
estimation and the checks of the verdict are the same.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

import record  # of this folder; sets the number of threads before NumPy is loaded

import numpy as np  # isort: skip

from boresight.calib.reliability import Reliability
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files.dump import open_dump

MOST = 1.05  # of the processor time without the tests
STAGE = "boresight.pipeline.calibration.assessment."
WITHOUT = {
    "examined": Reliability((), (), ()),
    "moved_inputs": (),
    "sky_counts": {},
    "_explanations": [],
    "input_findings": [],
    "targets_out_of_view": [],
}


@contextmanager
def without_tests() -> Iterator[None]:
    """The program without the tests of inputs."""
    with ExitStack() as stack:
        for name, nothing in WITHOUT.items():
            stack.enter_context(patch(f"{STAGE}{name}", lambda *_, nothing=nothing, **__: nothing))
        stack.enter_context(patch(f"{STAGE}_sighted", lambda basis, first, last, looked_for: last.strips))
        yield


def seconds(dump: Path) -> float:
    """Processor time of a calibration."""
    begun = time.process_time()
    calibrate_dump(open_dump(dump))
    return time.process_time() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dump", type=Path, default=Path(__file__).parents[1] / "fixtures" / "mini")
    parser.add_argument("--times", type=int, default=7)
    options = parser.parse_args()
    record.head("Processor time of a calibration with and without the tests of inputs")
    seconds(options.dump)  # all modules and tables loaded
    on, off = [], []
    for _ in range(options.times):
        with without_tests():
            off.append(seconds(options.dump))
        on.append(seconds(options.dump))
    for name, times in (("with the tests", on), ("without", off)):
        spread = f"{min(times):.2f} to {max(times):.2f}"
        print(f"{name:16s} median {np.median(times):.2f} s of {len(times)}: {spread}")
    ratio = float(np.median(on) / np.median(off))
    print(f"median of the ratios of neighbours {np.median(np.divide(on, off)):.3f}\n")
    record.verdict(f"with over without {ratio:.3f} ({MOST})", ratio <= MOST)
    raise SystemExit(record.exit_status())


if __name__ == "__main__":
    main()
