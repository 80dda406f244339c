"""A run killed again and again, at random moments: is anything finished lost, is the result the same?

    python benchmarks/kill_and_resume.py [--dump fixtures/mini] [--kills 6] [--workers 2] [--seed 1]

`boresight calibrate` is started, killed with all its processes by SIGKILL at a random moment, and started
again, until it was killed so many times; then it may finish. The moments are spread over the whole run: each
is a random number of finished units on disk, from none to all, and a random wait after that of up to the
time that a unit took in an undisturbed run. A unit that was on disk when the processes died must not be made
again.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from processes import COMMAND
from record import ROOT, arguments_of, exit_status, head, judge_share, verdict


def start(dump: str, out: Path, workers: int) -> subprocess.Popen:
    command = [*COMMAND, "calibrate", dump, "--out", str(out), "--workers", str(workers), "--no-report"]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


def units(out: Path) -> dict[str, int]:
    """Finished units and when each was written."""
    return {str(path): path.stat().st_mtime_ns for path in out.glob("work/*/*.parquet")}


def undisturbed(dump: str, out: Path, workers: int) -> tuple[float, float]:
    """Seconds to the first unit, seconds in all."""
    begin = time.perf_counter()
    process = start(dump, out, workers)
    while process.poll() is None and not units(out):
        time.sleep(0.01)
    first = time.perf_counter() - begin
    if process.wait():
        raise SystemExit("the undisturbed run failed")
    return first, time.perf_counter() - begin


def killed(dump: str, out: Path, workers: int, count: int, wait_s: float) -> tuple[dict[str, int], bool]:
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


def main() -> int:
    options = arguments_of(
        __doc__,
        ("--dump", str(ROOT / "fixtures" / "mini"), "to be calibrated"),
        ("--kills", 6, "in one run"),
        ("--workers", 2, "processes"),
        ("--seed", 1, "of the moments"),
    )
    head("A run killed again and again")
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        calm, harsh = Path(folder) / "calm", Path(folder) / "harsh"
        first, whole = undisturbed(options.dump, calm, options.workers)
        count = len(units(calm))
        print(f"undisturbed run: {count} units, the first after {first:.1f} s, {whole:.1f} s in all")
        a_unit = options.workers * (whole - first) / count
        made_again, seen, on_disk, moments = 0, 0, {}, []
        for wanted in sorted(rng.randint(0, count) for _ in range(options.kills)):
            before, wait_s = on_disk, rng.uniform(0.0, 1.0) * a_unit
            on_disk, alive = killed(options.dump, harsh, options.workers, wanted, wait_s)
            made_again += sum(on_disk.get(path) != written for path, written in before.items())
            seen += len(before)
            moments.append(f"{len(on_disk)}{'' if alive else ' (had ended)'}")
        if start(options.dump, harsh, options.workers).wait():
            raise SystemExit("the last run failed")
        after = units(harsh)
        made_again += sum(after.get(path) != written for path, written in on_disk.items())
        same = (calm / "installation.json").read_bytes() == (harsh / "installation.json").read_bytes()
    print(f"killed with so many units on disk: {', '.join(moments)}")
    judge_share("finished units made again after a kill", made_again, max(seen, 1), most=0.0)
    verdict(f"{len(after)} units in the end", f"{count}", len(after) == count, options.kills)
    words = "the same, bit for bit" if same else "another one"
    verdict(f"installation.json after kills is {words}", "the same", same, options.kills)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
