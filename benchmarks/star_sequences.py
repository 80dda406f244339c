"""Sequences of star images: states, errors and processor time of `bs.track` beside one by one.

    python benchmarks/star_sequences.py [--sequences 20] [--frames 60] [--seed 1]

1024² px, 14.6 deg, PSF sigma 1.25 px, 10 frames a second, 0.05 s exposure. Each sequence slews up to its
fastest rate and back; five frames are missing and one shows glare. One by one means `bs.identify` of each
image with its camera, in turn with `bs.track` on the same images; the search index is built before.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from record import band_of_mean_nees, exit_status, head, verdict

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from rendered_sequences import CAMERA, EXPOSURE_S, errors_of, sequence

import boresight as bs
from boresight.features.sky_images.identify_images import sky_index
from boresight.geometry.constants import ARCSEC
from boresight.star_id.settings import StarSettings

WRONG = 60.0 * ARCSEC  # an error about any axis that no frame has by noise: 10 sigma of roll and more


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", type=int, default=20)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    head("star_id: sequences of 1024 x 1024 px")
    index = sky_index(CAMERA, None, StarSettings())
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
    n, mean = len(squares), float(np.mean(squares))
    low, high = (band / 3.0 for band in band_of_mean_nees(n))
    print(f"\nmean normalised error squared an axis: {mean:.3f} of {n} frames")
    print(f"its 99.9 % band, were all frames independent: {low:.3f} to {high:.3f}")
    for fastest in (0.0, 0.2, 1.0, 2.0):
        some = [r for k, r in enumerate(ratios) if (0.0, 0.2, 1.0, 2.0)[k % 4] == fastest]
        if some:
            print(
                f"processor time at up to {fastest:.1f} deg/s: {np.mean(some):.1f} times less than one by one"
            )
    verdict("every frame is right or lost", wrong == 0 and glare_named == 0)
    verdict("recovery takes two frames at most", slow_recovery == 0)
    verdict("the normalised error squared is from 0.8 to 1.2", 0.8 < mean < 1.2)
    verdict("all sequences together take 5 times less than one by one", total[1] > 5.0 * total[0])
    verdict("each sequence takes 5 times less than one by one", min(ratios) > 5.0)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
