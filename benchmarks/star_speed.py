"""CPU time of finding, measuring and identifying stars, beside an older checkout, in turn on the same frames.

    python benchmarks/star_speed.py --old CHECKOUT [--frames 8] [--rounds 16]

Clean frames of the paper's camera (5120 x 3840 px, 8 bit, as in `star_accuracy.py`) and lists of stars (as in
`star_naming.py`). Two processes do the same work
alternately, frame by frame, once untimed and once timed; of each frame the least of all rounds counts, of the
frames the median of the ratios. The older checkout may be one from before the package `boresight`, with its
folders at the top.
"""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from record import commit, exit_status, head, verdict

HERE = Path(__file__).resolve()
# what is timed: title, most of the older checkout's CPU time (None: told, not limited)
WORK = (
    ("find and place", 1.05),
    ("identify 138 stars", 1.05),
    ("identify 138 stars, 50 false", 1.05),
    ("identify 8 stars, 3 false", 1.05),
    ("image's list to attitude, camera given", None),
    ("image's list to field, camera unknown", None),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--old", type=Path, required=True, help="an older checkout")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=16)
    arguments = parser.parse_args()
    head("star_id: CPU time beside an older checkout")
    print(f"older: {commit(arguments.old)}; {arguments.frames} frames, {arguments.rounds} rounds\n")
    roots = (arguments.old.resolve(), HERE.parents[1])
    workers = [_started(root, arguments.frames) for root in roots]
    ms = np.empty((arguments.rounds, arguments.frames, len(WORK), 2))
    for turn in range(arguments.rounds):
        for frame in range(arguments.frames):
            for which in (0, 1) if turn % 2 else (1, 0):
                ms[turn, frame, :, which] = _asked(workers[which], frame)
    print(f"{'CPU ms, median of the frames least':42s} {'older':>8s} {'now':>8s}   ratio")
    least = ms.min(axis=0)
    for k, (title, most) in enumerate(WORK):
        old, new = least[:, k].T
        ratio = float(np.median(new / old))
        print(f"{title:42s} {np.median(old):8.2f} {np.median(new):8.2f} {ratio:7.2f}")
        if most is not None:
            verdict(f"{title}: {ratio:.3f} of the older checkout's CPU time, at most {most}", ratio <= most)


def _started(root: Path, frames: int) -> subprocess.Popen[str]:
    """A process that does the work with the code of a checkout, ready."""
    command = [sys.executable, str(HERE), "--worker", str(root), str(frames)]
    worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert worker.stdout is not None
    worker.stdout.readline()
    return worker


def _asked(worker: subprocess.Popen[str], frame: int) -> list[float]:
    assert worker.stdin is not None and worker.stdout is not None
    print(frame, file=worker.stdin, flush=True)
    return [float(value) for value in worker.stdout.readline().split()]


def _work(root: Path, frames: int) -> None:
    """Answer each number of a frame with the CPU ms of the work on it."""
    sys.path[:0] = [str(root), str(root / "tests"), str(root / "tests" / "star_id"), str(HERE.parent)]
    package = "boresight." if (root / "boresight").is_dir() else ""

    def room(name: str) -> ModuleType:
        return importlib.import_module(f"{package}{name}")

    triangles = room("star_id.identification.triangle_index" if package else "star_id.naming.triangles")
    build_index, equivalent_fov = triangles.build_index, triangles.equivalent_fov
    solve_list, solve_stars = room("star_id.field").solve_list, room("star_id.field").solve_stars
    find_stars, hipparcos_stars = (
        room("star_id.finding.star_list").find_stars,
        room("star_id.catalogue").hipparcos_stars,
    )
    StarSettings = room("star_id.settings").StarSettings
    import cv2
    from frames import PAPER_CAMERA as camera
    from frames import Sensor, star_frame, stars_in_view
    from scipy.spatial.transform import Rotation

    cv2.setNumThreads(1)
    size, places, settings = (camera.width_px, camera.height_px), hipparcos_stars(8.0).places, StarSettings()
    index = build_index(places, places.epoch_jyear, equivalent_fov(*size, camera.focal_m / camera.pixel_m))

    def list_of(frame: int, stars: int, false: int):
        """Places of stars and of false ones among them, brightest first."""
        rng = np.random.default_rng([4, frame])
        rows, xy = stars_in_view(camera, Rotation.random(random_state=rng), places)
        bright = np.argsort(places.v_mag[rows])[:stars]
        v = places.v_mag[rows[bright]] + rng.normal(0, 0.15, len(bright))
        xy = np.vstack(
            [xy[bright] + rng.normal(0, 0.2, (len(bright), 2)), rng.uniform([0, 0], size, (false, 2))]
        )
        return xy[np.argsort(np.append(v, rng.choice(v, false)))]

    def frame_of(frame: int):
        rng = np.random.default_rng([1, frame])
        attitude = Rotation.random(random_state=rng)
        return star_frame(camera, attitude, places, Sensor(hot_pixels=2000), rng)[0]

    images = [frame_of(k) for k in range(frames)]
    found = [find_stars(image, settings) for image in images]
    lists = [[list_of(k, *sizes) for sizes in ((138, 0), (138, 50), (8, 3))] for k in range(frames)]

    def steps(k: int) -> Iterator[Callable[[], object]]:
        yield lambda: find_stars(images[k], settings)
        for xy in lists[k]:
            yield lambda xy=xy: solve_stars(xy, size, index, settings, camera=camera)
        yield lambda: solve_list(found[k], size, index, settings, camera=camera)
        yield lambda: solve_list(found[k], size, index, settings)

    print("ready", flush=True)
    for line in sys.stdin:
        spent = []
        for step in steps(int(line)):
            step()  # in the caches, as in an archive of images
            start = time.process_time()
            step()
            spent.append(1e3 * (time.process_time() - start))
        print(*spent, flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        _work(Path(sys.argv[2]), int(sys.argv[3]))
    else:
        main()
        raise SystemExit(exit_status())
