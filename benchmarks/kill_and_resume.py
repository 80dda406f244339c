"""A run killed again and again, at random moments: is anything finished lost, is the result the same?

    python benchmarks/kill_and_resume.py --dump DUMP --kills 20 --workers 2 --seed 1

`boresight calibrate` is started, killed with all its processes by SIGKILL at a random moment, and started
again, until it was killed so many times; then it may finish. The moments are spread over the whole run: each
is a random number of finished units on disk, from none to all, and a random wait after that of up to the
time that a unit took in an undisturbed run. A unit that was on disk when the processes died must not be made
again.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from end_to_end import machine

COMMAND = (sys.executable, "-m", "boresight", "calibrate")


def start(dump: Path, out: Path, workers: int) -> subprocess.Popen:
    command = [*COMMAND, str(dump), "--out", str(out), "--workers", str(workers), "--no-report"]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


def units(out: Path) -> dict[str, int]:
    """Finished units and when each was written."""
    return {str(path): path.stat().st_mtime_ns for path in out.glob("work/*/*.parquet")}


def undisturbed(dump: Path, out: Path, workers: int) -> tuple[float, float]:
    """Seconds to the first unit, seconds in all."""
    begin = time.perf_counter()
    process = start(dump, out, workers)
    while process.poll() is None and not units(out):
        time.sleep(0.01)
    first = time.perf_counter() - begin
    if process.wait():
        raise SystemExit("the undisturbed run failed")
    return first, time.perf_counter() - begin


def killed(dump: Path, out: Path, workers: int, count: int, wait_s: float) -> tuple[dict[str, int], bool]:
    """Units on disk when a run died that was killed so long after it had so many; whether it was alive."""
    process = start(dump, out, workers)
    while process.poll() is None and len(units(out)) < count:
        time.sleep(0.002)
    time.sleep(wait_s)
    alive = process.poll() is None
    if alive:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return units(out), alive


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dump", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    print("\n".join(machine()))
    with tempfile.TemporaryDirectory() as folder:
        calm, harsh = Path(folder) / "calm", Path(folder) / "harsh"
        first, whole = undisturbed(options.dump, calm, options.workers)
        count = len(units(calm))
        print(f"undisturbed run: {count} units, the first after {first:.1f} s, {whole:.1f} s in all")
        a_unit = options.workers * (whole - first) / count
        made_again, on_disk, moments, alive_all = 0, {}, [], True
        for wanted in sorted(rng.randint(0, count) for _ in range(options.kills)):
            before = on_disk
            on_disk, alive = killed(
                options.dump, harsh, options.workers, wanted, rng.uniform(0.0, 1.0) * a_unit
            )
            made_again += sum(on_disk.get(path) != written for path, written in before.items())
            alive_all &= alive
            moments.append(len(on_disk))
        if start(options.dump, harsh, options.workers).wait():
            raise SystemExit("the last run failed")
        after = units(harsh)
        made_again += sum(after.get(path) != written for path, written in on_disk.items())
        same = (calm / "installation.json").read_bytes() == (harsh / "installation.json").read_bytes()
    print(f"killed {options.kills} times, with so many units on disk: {', '.join(map(str, moments))}")
    print(f"all {options.kills} died of it: {'yes' if alive_all else 'NO'}")
    print(f"finished units made again: {made_again}; units in the end: {len(after)}")
    print(f"installation.json is {'the same, bit for bit' if same else 'ANOTHER ONE'}")
    if made_again or not same or not alive_all or len(after) != count:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
