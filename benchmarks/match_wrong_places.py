"""How often a window elsewhere is accepted as the target's, and how often the right one is rejected.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/match_wrong_places.py [pairs a row, 100]

Chips and windows are rendered as in match_peers.py (tests/gct_match/rendered_pairs.py): 64 and 128 px, noise
alone and another date. Chips come from one half of a picture, wrong windows from the other. Pictures: two
real ones of 10 cm, and invented ones that repeat themselves: fields in rows, an estate of houses, a
plantation of trees. Last, and not counted, houses that are copies of one another on a lattice wider than the
window: there one window alone cannot tell; the strip's other targets do (`gct_match/match.py`). An error of
a right one of more than 0.5 px is gross.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from itertools import product

import cv2
import numpy as np
from match_peers import MARGIN, located
from numpy.typing import NDArray
from record import exit_status, head, verdict
from rendered_pairs import RATIO, load_picture, make_pair
from scipy import ndimage

SIZES = (64, 128)
SIDE = 2200  # of an invented picture, picture pixels
GROSS_PX = 0.5
REAL = ("aerial", "aerial b")


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    head("Windows of another place")
    cv2.setNumThreads(1)
    start, total, real = time.process_time(), Counter[str](), Counter[str]()
    print("  picture       side  condition   wrong windows  accepted   right windows  refused  gross")
    for name, picture in pictures().items():
        for size, condition in product(SIZES, ("clean", "date")):
            if len(picture) // 2 > (size + 2 * MARGIN + 12) * RATIO:  # else no half of it holds a window
                row = told(name, picture, n, size, condition)
                total += row
                real += row if name in REAL else Counter()
    print(
        f"  all: {total['accepted']} of {total['wrong']} wrong windows accepted; of {total['right']} right "
        f"ones {total['refused']} refused, {total['gross']} gross; {time.process_time() - start:.0f} s CPU"
    )
    for where, row in (("real pictures", real), ("all pictures", total)):
        none = row["accepted"] == 0 and row["wrong"] >= 2000
        verdict(f"wrong matches accepted in {where}: 0 in at least 2000 ({row['wrong']})", none)
    verdict("of the right ones none gross", total["gross"] == 0)
    copies = houses(np.random.default_rng(2), alike=True)
    for size, condition in product(SIZES, ("clean", "date")):
        told("copies", copies, n // 4, size, condition)


def told(name: str, picture: NDArray, n: int, size: int, condition: str) -> Counter[str]:
    """One row of the table."""
    row = counted(picture, np.random.default_rng([17, size]), n, size, condition)
    print(
        f"  {name:12s} {size:5d}  {condition:9s} {row['wrong']:14d} {row['accepted']:9d} "
        f"{row['right']:15d} {row['refused']:8d} {row['gross']:6d}",
        flush=True,
    )
    return row


def counted(picture: NDArray, rng: np.random.Generator, n: int, size: int, condition: str) -> Counter[str]:
    """n chips, each in its own window and in two windows of the picture's other half."""
    here, there = (
        [make_pair(half, rng, size_px=size, margin_px=MARGIN, condition=condition) for _ in range(n)]
        for half in np.array_split(picture, 2)
    )
    out = Counter(right=n)
    for k, pair in enumerate(here):
        xy, _ = located(pair.template, pair.window, MARGIN)
        out["refused"] += xy is None
        out["gross"] += xy is not None and np.abs(xy - pair.offset_px).max() > GROSS_PX
        for other in (there[k], there[k - 1]):
            out["wrong"] += 1
            out["accepted"] += located(pair.template, other.window, MARGIN)[0] is not None
    return out


def pictures() -> dict[str, NDArray]:
    """Grey values 0 to 255, 10 cm to a pixel."""
    rng = np.random.default_rng(1)
    second = load_picture("neon_yell_b_10cm.png")
    return {
        "aerial": load_picture("neon_yell_10cm.png"),
        "aerial b": second if len(second) > len(second.T) else second.T,
        "fields": fields(rng),
        "houses": houses(rng),
        "plantation": plantation(rng),
    }


def fields(rng: np.random.Generator) -> NDArray:
    """Parcels of 60 m with rows of crop, 0.8 to 2 m apart."""
    out = np.empty((SIDE, SIDE), np.float32)
    y, x = np.mgrid[0:600, 0:600].astype(np.float32)
    for top in range(0, SIDE, 600):
        for left in range(0, SIDE, 600):
            across = np.cos(a := rng.uniform(0.0, np.pi)) * x + np.sin(a) * y
            rows = 25.0 * np.cos(2.0 * np.pi * across / rng.uniform(8.0, 20.0))
            cut = out[top : top + 600, left : left + 600]
            cut[...] = (rng.uniform(60.0, 150.0) + rows)[: cut.shape[0], : cut.shape[1]]
    return grained(out, rng)


def houses(rng: np.random.Generator, *, alike: bool = False) -> NDArray:
    """A roof of two slopes every 14 m: of various tones, sizes and places in its plot, or copies of one."""
    out = np.full((SIDE, SIDE), 80.0, np.float32)
    for top in range(20, SIDE - 100, 140):
        for left in range(20, SIDE - 100, 140):
            tone, high, wide, y, x = 150.0, 90, 90, top, left
            if not alike:
                tone = rng.normal(150.0, 25.0)
                high, wide = rng.integers(75, 110, 2)
                y, x = np.array([top, left]) + rng.integers(0, 15, 2)
            out[y : y + high // 2, x : x + wide] = tone
            out[y + high // 2 : y + high, x : x + wide] = 0.6 * tone
    return grained(out, rng)


def plantation(rng: np.random.Generator) -> NDArray:
    """A crown every 5 m, of much the same size, some decimetres off the lattice."""
    out = np.full((SIDE, SIDE), 130.0, np.float32)
    for y in range(25, SIDE, 50):
        for x in range(25, SIDE, 50):
            at = np.round(np.array([x, y]) + rng.normal(0.0, 2.0, 2)).astype(int)
            cv2.circle(out, at.tolist(), int(rng.integers(15, 19)), float(rng.normal(60.0, 6.0)), -1)
    return grained(out, rng)


def grained(image: NDArray, rng: np.random.Generator) -> NDArray:
    """With the fine texture of any ground."""
    grain = ndimage.gaussian_filter(rng.standard_normal(image.shape).astype(np.float32), 3.0)
    return np.clip(image + 5.0 / grain.std() * grain, 0.0, 255.0).astype(np.float32)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
