"""What users wait for: CPU time of commands, of one exposure in each format, and of the stages of a mission.

    boresight simulate paper MISSION --seed 7
    python benchmarks/speed.py --mission MISSION --old ../older-checkout --out speed.png

Commands run alternately in this checkout and in an older one (`--old`), each from nothing, and the least CPU
time of user and system counts; ratios hold on a busy machine, seconds on an idle one. An exposure is compared
with the fastest whole decode of the same PNG among OpenCV, Pillow and, where installed, imagecodecs, and with
what it cannot fall below: the file read, and one pass over its pixels.
"""

from __future__ import annotations

import argparse
import cProfile
import io
import json
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import record  # first: it may start this process anew with one thread

import bench_pushbroom  # isort: skip
import cv2
import numpy as np
import rasterio
from astropy.io import fits
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.images.star_images import read_star_image
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.unit_store import UnitStore
from boresight.pipeline.stages.cached import Cached
from boresight.pipeline.stages.exposure import sight_exposure, star_tasks

HERE = Path(__file__).resolve().parents[1]
STAGES = {
    "exposures": "stages/exposure.py:sight_exposure",
    "  reading and decoding them": "images/star_images.py:read_exposure",
    "matching": "stages/strip.py:match_targets",
    "  reading and decoding strips": "images/tiff.py:read",
    "digests": "work/digests.py:digest",
    "units written": "work/unit_store.py:write",
    "attitudes": "geometry/attitude_estimate.py:fit_exposures",
    "estimate": "calib/calibration.py:calibrate",
}  # of a calibration, by the function that does it
TIFFS: dict[str, dict[str, object]] = {
    "TIFF, raw": {},
    "TIFF, raw, tiles": {"tiled": True, "blockxsize": 512, "blockysize": 512},
    "TIFF, zstd": {"compress": "zstd"},
    "TIFF, zstd, predictor 2": {"compress": "zstd", "predictor": 2},
    "TIFF, LZW": {"compress": "lzw"},
    "TIFF, deflate": {"compress": "deflate"},
    "TIFF, deflate, predictor 2": {"compress": "deflate", "predictor": 2},
    "TIFF, LERC": {"compress": "lerc"},
}


@dataclass(frozen=True)
class Command:
    """A command line, what one of its items may cost, and what it took."""

    name: str
    arguments: tuple[str, ...]
    limit_s: float
    items: int = 1
    cpu_s: dict[Path, list[float]] = field(default_factory=dict)
    out: dict[Path, Path] = field(default_factory=dict)

    def run(self, checkout: Path, scratch: Path) -> None:
        out = Path(tempfile.mkdtemp(dir=scratch)) / "out"
        arguments = [str(out) if one == "OUT" else one for one in self.arguments]
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        process = subprocess.Popen(
            [sys.executable, "-c", record.program(checkout), *arguments],
            cwd=checkout,
            env=environment | {"PYTHONPATH": str(checkout)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"boresight {' '.join(arguments)} failed in {checkout}")
        self.out[checkout] = out
        self.cpu_s.setdefault(checkout, []).append((usage.ru_utime + usage.ru_stime) / self.items)

    def least_s(self, checkout: Path) -> float:
        return min(self.cpu_s[checkout])


def commands(mission: Path | None) -> list[Command]:
    fixture = HERE / "fixtures" / "mini"
    images = [str(path) for path in sorted((fixture / "exposures").glob("*.png"))]
    every = [
        Command("--version", ("--version",), 0.25),
        Command("--help", ("--help",), 0.35),
        Command("identify, one image", ("identify", images[0]), 0.7),
        Command("identify, each of 100 images", ("identify", *(3 * images)[:100]), 0.12, 100),
        Command("demo", ("calibrate", str(fixture), "--out", "OUT", "--workers", "1"), 3.5),
    ]
    if mission is not None:
        every.append(
            Command("paper's mission", ("calibrate", str(mission), "--out", "OUT", "--workers", "1"), 20.0)
        )
    return every


def print_difference(one: Command, new: Path, old: Path) -> None:
    """By how many of its standard errors the matrix of a command differs from the older checkout's."""
    found, before = (json.loads((one.out[c] / "installation.json").read_text()) for c in (new, old))
    sigma = np.sqrt(np.diag(found["covariance_rad2"]))
    most = float(np.max(np.abs(np.subtract(found["theta_rad"], before["theta_rad"])) / sigma))
    text = f"{one.name}: the matrix is the older checkout's to 0.01 sigma: {most:.4f}"
    record.verdict(text, most <= 0.01)


def least_cpu_s(function: Callable[[], Any], times: int = 5) -> float:
    """Least CPU time of some calls, s."""
    taken = []
    for _ in range(times):
        begin = time.process_time()
        function()
        taken.append(time.process_time() - begin)
    return min(taken)


def decoders() -> dict[str, Callable[[bytes], Any]]:
    """Whole decodes of a PNG by libraries."""
    ways: dict[str, Callable[[bytes], Any]] = {
        "OpenCV": lambda raw: cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_UNCHANGED),
        "Pillow": lambda raw: np.asarray(Image.open(io.BytesIO(raw))),
    }
    try:
        import imagecodecs

        ways["imagecodecs"] = imagecodecs.png_decode
    except ImportError:
        print("imagecodecs is not installed; OpenCV and Pillow are compared")
    return ways


def written_formats(image: NDArray[Any], folder: Path) -> dict[str, Path]:
    """The image in each format that an exposure may have."""
    files = {"PNG, OpenCV": folder / "opencv.png", "PNG, Pillow": folder / "pillow.png"}
    cv2.imwrite(str(files["PNG, OpenCV"]), image)
    Image.fromarray(image).save(files["PNG, Pillow"])
    files["FITS, raw"] = folder / "raw.fits"
    fits.PrimaryHDU(image).writeto(files["FITS, raw"])
    for name, options in TIFFS.items():
        files[name] = folder / f"{name.replace(', ', '-').replace(' ', '-')}.tif"
        write_tiff(files[name], image, options)
    return files


def write_tiff(path: Path, image: NDArray[Any], options: dict[str, object]) -> None:
    height, width = image.shape
    profile = {"width": width, "height": height, "count": 1, "dtype": image.dtype.name} | options
    with rasterio.open(path, "w", driver="GTiff", **profile) as target:
        target.write(image, 1)


def print_exposures(dump: Dump, scratch: Path, count: int = 9) -> None:
    """Medians of CPU times (ms) of some exposures, everything counted, beside decoding alone."""
    tasks = star_tasks(dump, dump.star_images[0], Settings().stars)[0][: count + 1]
    step = Cached(sight_exposure, UnitStore(scratch / "units"), "exposures")
    step(tasks[0])  # libraries, index
    of_libraries = decoders()
    taken: dict[str, list[float]] = {}

    def timed(name: str, function: Callable[[], Any]) -> None:
        taken.setdefault(name, []).append(least_cpu_s(function, 1))

    for n, task in enumerate(tasks[1:]):
        raw = task.exposure.path.read_bytes()
        for name, decode in of_libraries.items():
            timed(name, lambda decode=decode, raw=raw: decode(raw))
        timed("everything counted, PNG", lambda task=task: step(task))
        image = read_star_image(task.exposure.path, "e")
        tiff = scratch / f"{n}.tif"
        write_tiff(tiff, image, {})
        other = replace(task, exposure=replace(task.exposure, path=tiff))
        timed("everything counted, raw TIFF", lambda other=other: step(other))
        timed("the file read", task.exposure.path.read_bytes)
        timed("one pass over the pixels", image.max)
    print(
        f"an exposure of {image.shape[1]} x {image.shape[0]} px, {image.dtype}: ms of CPU, median of {count}"
    )
    medians = {name: 1e3 * float(np.median(times)) for name, times in taken.items()}
    for name, median in medians.items():
        print(f"{name:34s}{median:8.1f}")
    fastest = min(of_libraries, key=medians.__getitem__)
    ratio = medians["everything counted, PNG"] / medians[fastest]
    record.verdict(f"everything counted <= 1.3 x {fastest}: {ratio:.2f}", ratio <= 1.3)
    raw_ms = medians["everything counted, raw TIFF"]
    record.verdict(f"raw TIFF, everything counted <= 60 ms: {raw_ms:.1f}", raw_ms <= 60.0)


def print_formats(image: NDArray[Any], folder: Path) -> None:
    """What reading an exposure costs in each format."""
    print("\nformat                           MB     ms to read (least)")
    for name, path in written_formats(image, folder).items():

        def read(path: Path = path) -> None:
            content_cleared()
            read_star_image(path, path.name)

        print(f"{name:28s}{path.stat().st_size / 1e6:8.1f}{1e3 * least_cpu_s(read):14.1f}")


def print_ground() -> None:
    """CPU time of a million pixels to the ground at 30 degrees over 3000 m of relief."""
    rng = np.random.default_rng(0)
    count = bench_pushbroom.N
    sample, line = (
        rng.uniform(0.0, last - 1.0, count) for last in (bench_pushbroom.SAMPLES, bench_pushbroom.LINES)
    )
    model = bench_pushbroom.strip(30.0, 0.0)
    surface = bench_pushbroom.relief(model, 3000.0, False)
    least_s = least_cpu_s(lambda: model.ground_points(2, sample, line, surface), 3)
    text = f"{count:.0e} pixels to the ground at 30 deg over 3000 m of relief <= 1 s: {least_s:.2f}"
    record.verdict(text, least_s <= 1.0)


def content_cleared() -> None:
    """Forget the bytes of the last file, so that it is read again."""
    from boresight.pipeline.files import content

    content._content.cache_clear()


def shares(dump: Dump, scratch: Path) -> dict[str, float]:
    """Share of each stage in the CPU time of a calibration without report."""
    profile = cProfile.Profile(time.process_time)
    begin = time.process_time()
    profile.runcall(calibrate_dump, dump, Settings(), UnitStore(scratch / "shares"))
    total = time.process_time() - begin
    spent: dict[str, float] = {}
    for (file, _, function), (_, _, _, cumulative, _) in pstats.Stats(profile).stats.items():  # type: ignore
        place = f"{'/'.join(Path(file).parts[-2:])}:{function}"
        spent[place] = max(spent.get(place, 0.0), cumulative)
    return {name: spent.get(place, 0.0) / total for name, place in STAGES.items()}


def draw(path: Path, every: list[Command], of_stages: dict[str, float], new: Path, old: Path | None) -> None:
    """Bars of CPU times over their limits, and of the stages' shares."""
    figure = Figure(figsize=(8.0, 0.6 * len(every) + 0.3 * len(of_stages) + 2.0), layout="constrained")
    heights = [0.6 * len(every), max(0.3 * len(of_stages), 0.1)]
    axes, below = figure.subplots(2, 1, height_ratios=heights)
    rows = np.arange(len(every))[::-1]
    if old is not None:
        times = [one.least_s(old) / one.limit_s for one in every]
        axes.barh(rows + 0.2, times, 0.36, color="0.75", edgecolor="0.4", label="older checkout")
    times = [one.least_s(new) / one.limit_s for one in every]
    axes.barh(rows - 0.2, times, 0.36, color="0.35", label="this checkout")
    axes.axvline(1.0, color="black", linewidth=1.0, linestyle="--", label="limit")
    axes.set_yticks(rows, [f"{one.name} ({one.limit_s:g} s)" for one in every])
    axes.set_xlabel("CPU time over its limit")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    stages = np.arange(len(of_stages))[::-1]
    below.barh(stages, [100.0 * share for share in of_stages.values()], 0.6, color="0.35")
    below.set_yticks(stages, [name.strip() for name in of_stages])
    below.set_xlabel("share of a calibration's CPU time, report not counted, %")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mission", type=Path, help="dump of the scenario paper")
    parser.add_argument("--old", type=Path, help="an older checkout to compare with")
    parser.add_argument("--only", default="", help="commands whose name begins so, nothing else")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, help="picture of the commands")
    options = parser.parse_args()
    record.head("What users wait for")
    mission = None if options.mission is None else options.mission.resolve()
    old = None if options.old is None else options.old.resolve()
    every = [one for one in commands(mission) if one.name.startswith(options.only)]
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        for one in every:
            for _ in range(options.repeats):
                for checkout in filter(None, (HERE, old)):
                    one.run(checkout, scratch)
        print(f"{'command':34s}{'CPU s':>8s}{'limit':>8s}{'before':>8s}{'ratio':>7s}")
        for one in every:
            now, before = one.least_s(HERE), one.least_s(old) if old else np.nan
            print(f"{one.name:34s}{now:8.3f}{one.limit_s:8.2f}{before:8.3f}{now / before:7.3f}")
            if old and options.repeats > 2:
                pairs = np.array(one.cpu_s[HERE]) / np.array(one.cpu_s[old])
                middle, least, most = np.median(pairs), pairs.min(), pairs.max()
                print(f"{'':34s}ratios of pairs: median {middle:.3f}, {least:.3f} to {most:.3f}")
        for one in every:
            least_s = one.least_s(HERE)
            record.verdict(f"{one.name} <= {one.limit_s:g} s: {least_s:.3f}", least_s <= one.limit_s)
        if options.only:
            sys.exit(record.exit_status())
        if mission is not None and old is not None:
            print_difference(every[-1], HERE, old)
        print_ground()
        of_stages: dict[str, float] = {}
        if mission is not None:
            dump = open_dump(mission)
            print()
            print_exposures(dump, scratch)
            first = dump.star_images[0].exposures[0]
            print_formats(read_star_image(first.path, first.file), scratch)
            print("\nshare of a calibration's CPU time, without report")
            of_stages = shares(dump, scratch)
            for name, share in of_stages.items():
                print(f"{name:34s}{share:8.1%}")
    if options.out:
        draw(options.out, every, of_stages, HERE, old)
    sys.exit(record.exit_status())


if __name__ == "__main__":
    main()
