"""Sequences of star images: states, errors and processor time of `bs.track` beside one by one.

    python benchmarks/star_sequences.py [--sequences 4] [--frames 60] [--seed 1] [--long 200]

1024² px, 14.6 deg, PSF sigma 1.25 px, 10 frames a second, 0.05 s exposure. Each sequence slews up to its
fastest rate and back; five frames are missing and one shows glare. One by one means `bs.identify` of each
image with its camera, in turn with `bs.track` on the same images; the search index is built before.

The long sequence swings at up to 0.2 deg/s about each axis; its camera is given 0.05 % too long, and its true
focal length drifts by 1e-5 in one second. Every tenth frame is also identified one by one.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from record import ROOT, arguments_of, exit_status, head, judge_share, verdict

sys.path.insert(0, str(ROOT / "tests"))

from rendered_sequences import CAMERA, EXPOSURE_S, errors_of, long_sequence, sequence

import boresight as bs
from boresight.features.sky_images.identify_images import sky_index
from boresight.geometry.constants import ARCSEC
from boresight.star_id.settings import StarSettings

LONG_DEG_S, LONG_DRIFT = 0.2, 1e-5  # fastest rate about an axis, and drift of the focal length in one second
WRONG = 60.0 * ARCSEC  # an error about any axis that no frame has by noise: 10 sigma of roll and more


def main() -> None:
    arguments = arguments_of(
        __doc__,
        ("--sequences", 4, "short ones"),
        ("--frames", 60, "of a short one"),
        ("--long", 200, "frames of the long one"),
        ("--seed", 1, "of all"),
    )
    head("star_id: sequences of 1024 x 1024 px")
    index = sky_index(CAMERA, None, StarSettings())
    if arguments.sequences:
        _short(arguments, index)
    if arguments.long:
        _long(index, arguments.long, arguments.seed)


def judge_mean(what: str, squares: np.ndarray, n: int) -> None:
    """Mean of normalised errors squared of `n` numbers: 0.8 to 1.2, widened by their scatter."""
    scatter, mean = 3.3 * np.sqrt(2.0 / n), float(np.mean(squares))
    low, high = max(0.0, min(0.8, 1.0 - scatter)), max(1.2, 1.0 + scatter)
    verdict(f"{what}: NEES {mean:.2f}", f"{low:.2f} to {high:.2f}", low < mean < high, len(squares))


def _short(arguments, index) -> None:
    squares, wrong, slow_recovery, glare_named = [], 0, 0, 0
    print("fastest deg/s   frames  tracked  anew  lost   NEES   ms a frame: track  one by one  ratio")
    ratios, total = [], np.zeros(2)
    for k in range(arguments.sequences):
        fastest = (0.0, 0.2, 1.0, 2.0)[k % 4]
        made = sequence(index, 1000 * arguments.seed + k, arguments.frames, fastest_deg_s=fastest)
        found = bs.track(made.images, camera=CAMERA, times_s=made.times_s, exposure_s=EXPOSURE_S)
        start = time.process_time()
        for image in made.images:
            bs.identify(image, camera=CAMERA)
        alone_ms = 1e3 * (time.process_time() - start) / len(made.images)
        error, square = errors_of(found, made.truth)
        known = np.isfinite(square)
        squares += [*square[known]]
        wrong += int((np.abs(error[known]) > WRONG).any(axis=1).sum())
        glare_named += sum(found.state[n] != "lost" for n in made.glare)
        lost = [n for n, state in enumerate(found.state) if state == "lost"]
        slow_recovery += sum({n, n + 1, n + 2} <= set(lost) for n in lost)
        counts = [found.state.count(state) for state in ("tracked", "found anew", "lost")]
        total += found.cpu_ms.mean(), alone_ms
        ratios.append(alone_ms / found.cpu_ms.mean())
        print(
            f"{fastest:13.1f}   {len(found):6d}  {counts[0]:7d}  {counts[1]:4d}  {counts[2]:4d}  "
            f"{square[known].mean():5.2f}   {found.cpu_ms.mean():17.1f}  {alone_ms:10.1f}  {ratios[-1]:5.1f}",
            flush=True,
        )
    n = len(squares)
    judge_share("sequences: frames neither right nor lost", wrong + glare_named, n, most=0.0)
    judge_share("sequences: recoveries that take more than two frames", slow_recovery, n, most=0.0)
    judge_mean("sequences: attitude", np.array(squares), n)
    text = f"sequences: {total[1] / total[0]:.1f} times less CPU than one by one, least {min(ratios):.1f}"
    verdict(text, "at least 5", min(ratios) >= 5.0, arguments.sequences)


def _long(index, frames: int, seed: int) -> None:
    """One sequence with a wrong, drifting focal length: attitude, focal length and time of its frames."""
    given = replace(CAMERA, focal_m=1.0005 * CAMERA.focal_m)
    with tempfile.TemporaryDirectory() as name:
        made = long_sequence(
            index, Path(name), seed, frames, fastest_deg_s=LONG_DEG_S, focal_drift=LONG_DRIFT
        )
        found = bs.track(
            made.paths, camera=given, times_s=made.times_s, exposure_s=EXPOSURE_S, focal_drift=LONG_DRIFT
        )
        images, alone_ms = [np.load(path) for path in made.paths[::10]], []
        for image in images:
            start = time.process_time()
            bs.identify(image, camera=CAMERA)
            alone_ms.append(1e3 * (time.process_time() - start))
    error, square = errors_of(found, made.truth)
    known = np.isfinite(square)
    focal = (found.focal_px - made.focal_px) / found.focal_sigma_px
    settled = known & (np.arange(len(known)) >= 10)
    lost = [n for n, state in enumerate(found.state) if state == "lost"]
    slow_recovery = sum(n + 1 < len(found) and n + 1 not in made.glare and n + 1 in lost for n in made.glare)
    wrong = int((np.abs(error[known]) > WRONG).any(axis=1).sum())
    ratio = np.mean(alone_ms) / found.cpu_ms.mean()
    counts = ", ".join(f"{found.state.count(s)} {s}" for s in ("tracked", "found anew", "lost"))
    print(f"\none sequence of {len(found)} frames: {counts}")
    print(
        f"ms a frame: track {found.cpu_ms.mean():.2f}, one by one {np.mean(alone_ms):.2f}, ratio {ratio:.1f}"
    )
    print(f"focal length: given {given.focal_m / given.pixel_m:.2f} px, at last {made.focal_px[-1]:.3f} px,")
    print(f"  found {found.focal_px[-1]:.3f} +- {found.focal_sigma_px[-1]:.3f} px")
    print(f"frames with a misfit of the camera: {int((found.misfit_px[known] > 0.0).sum())}")
    strays = wrong + len(set(lost) - set(made.glare))
    judge_share("long sequence: frames neither right nor lost by glare", strays, len(found), most=0.0)
    judge_share(
        "long sequence: frames after glare that are lost", slow_recovery, max(1, len(made.glare)), most=0.0
    )
    judge_mean("long sequence: attitude", square[known], int(known.sum()))
    judge_mean(
        "long sequence: focal length", focal[settled] ** 2, max(4, int(settled.sum()) // 20)
    )  # correlated
    text = f"long sequence: {ratio:.1f} times less CPU than one by one"
    verdict(text, "at least 5", ratio >= 5.0, len(found))


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
