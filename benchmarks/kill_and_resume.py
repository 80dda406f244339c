"""A run killed again and again, at random moments: is anything finished lost, is the result the same?

    python benchmarks/kill_and_resume.py --dump fixtures/mini --kills 20 --seed 1

`boresight calibrate` is started, killed with SIGKILL after a random share of the time that an undisturbed run
takes to work, and started again, until it was killed so many times; then it may finish. A unit that was on
disk when the process died must not be made again; units that were in flight may be.
"""

from __future__ import annotations

import argparse
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COMMAND = (sys.executable, "-c", "from pipeline.cli import main; main()", "calibrate")


def start(dump: Path, out: Path, workers: int) -> subprocess.Popen:
    command = [*COMMAND, str(dump), "--out", str(out), "--workers", str(workers), "--no-report"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def units(out: Path) -> dict[str, int]:
    """Finished units and when each was written."""
    return {str(path): path.stat().st_mtime_ns for path in out.glob("work/*/*.parquet")}


def undisturbed(dump: Path, out: Path, workers: int) -> tuple[float, float, int]:
    """Seconds to the first unit, seconds in all, number of units."""
    begin = time.perf_counter()
    process = start(dump, out, workers)
    while process.poll() is None and not units(out):
        time.sleep(0.01)
    first = time.perf_counter() - begin
    if process.wait():
        raise SystemExit("the undisturbed run failed")
    return first, time.perf_counter() - begin, len(units(out))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dump", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        calm, harsh = Path(folder) / "calm", Path(folder) / "harsh"
        first, whole, count = undisturbed(options.dump, calm, options.workers)
        made_again, moments = 0, []
        for _ in range(options.kills):
            process = start(options.dump, harsh, options.workers)
            time.sleep(
                rng.uniform(0.3, 1.0) * first + rng.uniform(0.0, 1.0) * (whole - first) / options.kills
            )
            before = units(harsh)
            process.send_signal(signal.SIGKILL)
            process.wait()
            moments.append(len(before))
        before = units(harsh)
        if start(options.dump, harsh, options.workers).wait():
            raise SystemExit("the last run failed")
        after = units(harsh)
        made_again = sum(after.get(path) != written for path, written in before.items())
        same = (calm / "installation.json").read_bytes() == (harsh / "installation.json").read_bytes()
        print(f"undisturbed run: {count} units, first after {first:.1f} s, {whole:.1f} s in all")
        print(f"killed {options.kills} times, with so many units on disk: {', '.join(map(str, moments))}")
        print(f"finished units made again: {made_again}; units in the end: {len(after)}")
        print(f"installation.json is {'the same, bit for bit' if same else 'ANOTHER ONE'}")
        shutil.rmtree(harsh)
        if made_again or not same:
            raise SystemExit(1)


if __name__ == "__main__":
    main()
