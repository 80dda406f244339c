"""What users wait for: CPU time of commands, of one exposure in each format, and of the tests of inputs.

    python benchmarks/speed.py [--repeats 2] [--old ../older-checkout] [--mission MISSION] [--only demo]

Commands run alternately in this checkout and in an older one (`--old`), each from nothing, and the least CPU
time of user and system counts; ratios hold on a busy machine, seconds on an idle one: limits of seconds are
those of an idle AMD EPYC. MISSION is a dump of the scenario `paper` (`boresight simulate paper MISSION`). The
exposure is a frame of 5120 x 3840 px; it is compared with the fastest whole decode of the same PNG among
OpenCV, Pillow and, where installed, imagecodecs. Without the tests of inputs no hypothesis is computed or
tested, no loss is counted and nothing is searched again: on and off in turn in one process.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import rasterio
import record  # first: it may start this process anew with one thread
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(record.ROOT / "tests"))

from frames import PAPER_CAMERA, Sensor, star_frame

from boresight.calib.reliability import Reliability
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files import content
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.star_images import read_star_image
from boresight.star_id.catalogue import hipparcos_stars

MINI = record.ROOT / "fixtures" / "mini"
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
MOST_TESTS = 1.05  # processor time of a calibration with the tests of inputs over that without
STAGE = "boresight.pipeline.calibration.assessment."
WITHOUT = {
    "examined": Reliability((), (), ()),
    "moved_inputs": (),
    "losses.ground_ledger": None,
    "losses.star_ledger": None,
    "_explanations": [],
    "input_findings.input_findings": [],
}


@dataclass(frozen=True)
class Command:
    """A command line, what one of its items may cost, and what it took."""

    name: str
    arguments: tuple[str, ...]
    limit_s: float
    items: int = 1
    cpu_s: dict[Path, list[float]] = field(default_factory=dict)

    def run(self, checkout: Path) -> None:
        with tempfile.TemporaryDirectory() as folder:
            arguments = [f"{folder}/out" if part == "OUT" else part for part in self.arguments]
            environment = {
                key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"
            }
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
        self.cpu_s.setdefault(checkout, []).append((usage.ru_utime + usage.ru_stime) / self.items)


def commands(mission: str) -> list[Command]:
    images = [str(path) for path in sorted((MINI / "exposures").glob("*.png"))]
    every = [
        Command("--version", ("--version",), 0.25),
        Command("--help", ("--help",), 0.35),
        Command("identify, one image", ("identify", images[0]), 0.7),
        Command("identify, each of 100 images", ("identify", *(3 * images)[:100]), 0.12, 100),
        Command("demo", ("calibrate", str(MINI), "--out", "OUT", "--workers", "1"), 3.5),
    ]
    if mission:
        every.append(
            Command("paper's mission", ("calibrate", mission, "--out", "OUT", "--workers", "1"), 20.0)
        )
    return every


def time_commands(every: list[Command], old: Path | None, repeats: int) -> None:
    """All commands in turn, in either checkout."""
    for command in every:
        for _ in range(repeats):
            for checkout in filter(None, (record.ROOT, old)):
                command.run(checkout)
    for command in every:
        now = command.cpu_s[record.ROOT]
        if old:
            pairs = np.array(now) / np.array(command.cpu_s[old])
            before = f"{min(command.cpu_s[old]):.3f} s before, ratios of pairs"
            print(f"{command.name}: {before} {pairs.min():.3f} to {pairs.max():.3f}")
        record.judge_largest(command.name, min(now), command.limit_s, "s CPU", repeats)


def least_cpu_s(function: Callable[[], Any], times: int = 3) -> float:
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
        height, width = image.shape
        profile = {"width": width, "height": height, "count": 1, "dtype": image.dtype.name} | options
        with rasterio.open(files[name], "w", driver="GTiff", **profile) as target:
            target.write(image, 1)
    return files


def time_formats(folder: Path) -> None:
    """What reading an exposure costs in each format, and beside whole decodes of its PNG."""
    rng = np.random.default_rng(1)
    image, _ = star_frame(
        PAPER_CAMERA, Rotation.random(random_state=rng), hipparcos_stars(8.0).places, Sensor(), rng
    )
    files, taken = written_formats(image, folder), {}
    print("format                           MB     ms to read (least)")
    for name, path in files.items():

        def read(path: Path = path) -> None:
            content._content.cache_clear()  # forget the bytes of the last file, so that it is read again
            read_star_image(path, path.name)

        taken[name] = 1e3 * least_cpu_s(read)
        print(f"{name:28s}{path.stat().st_size / 1e6:8.1f}{taken[name]:14.1f}")
    raw = files["PNG, OpenCV"].read_bytes()
    others = {name: 1e3 * least_cpu_s(lambda way=way: way(raw)) for name, way in decoders().items()}
    fastest = min(others, key=others.__getitem__)
    print(", ".join(f"{name} {ms:.1f} ms" for name, ms in others.items()))
    text = f"a PNG of 20 million pixels read, over its decode by {fastest}:"
    record.judge_largest(text, taken["PNG, OpenCV"] / others[fastest], 1.0, samples=3)
    record.judge_largest("a raw TIFF of 20 million pixels read", taken["TIFF, raw"], 20.0, "ms CPU", 3)


@contextmanager
def without_tests() -> Iterator[None]:
    """The program without the tests of inputs."""
    with ExitStack() as stack:
        for name, nothing in WITHOUT.items():
            stack.enter_context(patch(f"{STAGE}{name}", lambda *_, nothing=nothing, **__: nothing))
        stack.enter_context(patch(f"{STAGE}_sighted", lambda basis, first, last, *_: last.strips))
        yield


def time_tests(times: int) -> None:
    """A calibration of `fixtures/mini` with and without the tests of inputs, in turn."""

    def seconds() -> float:
        return least_cpu_s(lambda: calibrate_dump(open_dump(MINI)), 1)

    seconds()  # all modules and tables loaded
    on, off = [], []
    for _ in range(times):
        with without_tests():
            off.append(seconds())
        on.append(seconds())
    for name, values in (("with the tests", on), ("without", off)):
        print(f"{name:16s} median {np.median(values):.2f} s: {min(values):.2f} to {max(values):.2f}")
    text = "a calibration with the tests of inputs over one without:"
    record.judge_largest(text, float(np.median(on) / np.median(off)), MOST_TESTS, samples=times)


def main() -> int:
    options = record.arguments_of(
        __doc__,
        ("--mission", "", "dump of the scenario paper"),
        ("--old", "", "an older checkout to compare with"),
        ("--only", "", "commands whose name begins so, nothing else"),
        ("--repeats", 2, "runs of each command; the least counts"),
        ("--tests", 5, "calibrations with and without the tests of inputs"),
    )
    record.head("What users wait for")
    old = Path(options.old).resolve() if options.old else None
    every = [one for one in commands(options.mission) if one.name.startswith(options.only)]
    time_commands(every, old, options.repeats)
    if not options.only:
        with tempfile.TemporaryDirectory() as folder:
            time_formats(Path(folder))
        time_tests(options.tests)
    return record.exit_status()


if __name__ == "__main__":
    sys.exit(main())
