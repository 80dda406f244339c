"""Memory of `boresight calibrate` on a large dump: all processes together, over time.

    boresight simulate paper DUMP --seed 3 --set strips.count=7 --set strips.exposure_lead_s=4.7 \\
        --set strips.only_around_targets_px=400
    python benchmarks/archive_memory.py --dump DUMP --workers 2 --limit-mib 2048

Ten times a second the proportional set sizes (PSS: a page shared by n processes counts 1/n for each) of the
command and of all processes below it are summed up, and their resident sizes, which count shared pages
again for each. Linux only.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from end_to_end import machine

from boresight.pipeline.files.dump import open_dump

COMMAND = (sys.executable, "-m", "boresight", "calibrate")
EVERY_S = 0.1


def family(pid: int) -> Iterator[int]:
    """A process and all below it."""
    yield pid
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            below = children.read_text().split()
        except OSError:
            continue
        for child in below:
            yield from family(int(child))


def sizes_mib(pid: int) -> tuple[float, float]:
    """PSS and RSS of one process, 0 for one that has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0, 0.0
    kib = {line.split()[0]: float(line.split()[1]) for line in lines[1:]}
    return kib.get("Pss:", 0.0) / 1024.0, kib.get("Rss:", 0.0) / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dump", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit-mib", type=float, default=2048.0)
    options = parser.parse_args()
    dump = open_dump(options.dump.resolve())
    strip = next(iter(dump.strips))
    lines, samples = strip.images.shape(0)
    print("\n".join(machine()))
    print(
        f"{len(dump.exposures)} exposures of {dump.star_camera.width_px} x {dump.star_camera.height_px} px, "
        f"{len(dump.strips)} strips of {len(strip.images.ccds)} x {samples} x {lines} px: "
        f"{dump.pixels / 1e6:.0f} million pixels"
    )
    peaks, where, count = [0.0, 0.0], [0.0, 0.0], 0
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        command = [*COMMAND, str(options.dump), "--out", folder, "--workers", str(options.workers)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            found = [sizes_mib(pid) for pid in family(process.pid)]
            for n, total in enumerate(map(sum, zip(*found))):
                if total > peaks[n]:
                    peaks[n], where[n] = total, time.perf_counter() - begin
            count = max(count, len(found))
            time.sleep(EVERY_S)
        elapsed, usage = time.perf_counter() - begin, ended[2]
        told = process.stdout.read() if process.stdout else ""
    if ended[1]:
        raise SystemExit(f"calibrate failed: {told}")
    print(
        f"calibrate --workers {options.workers}: {elapsed:.0f} s, "
        f"{usage.ru_utime + usage.ru_stime:.0f} s CPU, up to {count} processes"
    )
    print(f"largest sum of proportional set sizes: {peaks[0]:.0f} MiB, after {where[0]:.0f} s")
    print(f"largest sum of resident set sizes: {peaks[1]:.0f} MiB, after {where[1]:.0f} s")
    print("\n".join("    " + line for line in told.splitlines()))
    if peaks[0] > options.limit_mib:
        raise SystemExit(f"more than {options.limit_mib:.0f} MiB")


if __name__ == "__main__":
    main()
