"""Sub-pixel matching beside other packages on rendered pairs of known truth, and windows of another place.

    python benchmarks/match_peers.py [--pairs 40] [--wrong 40]

Rendered: 10 cm aerial pictures blurred to MTF 0.15 at Nyquist and sampled every fourth pixel at known
fractions, noise of 2 grey values on both members of a pair (tests/gct_match/rendered_pairs.py). The bound
is Cramér-Rao's for the two noises, everything else known. Every method gets the same window, ± 16 px
around the template; errors of more than 0.5 px are gross, they are counted and excluded from the rms.

Windows of another place: chips come from one half of a picture, wrong windows from the other.
Accepted is what `locate` does not refuse. Real pairs of dates: match_real_pairs.py.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from record import ROOT, SHARED, arguments_of, exit_status, head, judge_largest, judge_share, not_run, verdict
from scipy import ndimage
from scipy.stats import chi2

sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "gct_match")]

from rendered_pairs import RATIO, Pair, load_picture, make_pair  # noqa: E402

from boresight.gct_match.imaging.views import normalised, view_of  # noqa: E402
from boresight.gct_match.locate import locate  # noqa: E402
from boresight.gct_match.records import TemplateMatch  # noqa: E402
from boresight.gct_match.search.correlation import correlation_surface, peaks_of  # noqa: E402
from boresight.gct_match.settings import MatchSettings  # noqa: E402
from boresight.records.ledger import Entry  # noqa: E402

Array = NDArray[np.float64]
Outcome = tuple[Array | None, Array | None]  # place (2,) and covariance (2, 2), None where there is none
MARGIN = 16
MOST_MS, ECC_MS = 5.0, 1.6  # CPU of a 128 px chip, on a machine where OpenCV's ECC of a translation takes 1.6
SETTINGS = MatchSettings()


def main() -> None:
    options = arguments_of(
        __doc__,
        ("--pairs", 40, "of each condition and size"),
        ("--wrong", 40, "chips of each picture, condition and size, each in two wrong windows"),
    )
    if not (SHARED / "high_resolution").is_dir():
        not_run("the pictures are not there (shared/data/high_resolution)")
    head("Sub-pixel matching and its peers")
    print(f"OpenCV {cv2.__version__}\n")
    print(f"load average {os.getloadavg()[0]:.1f}; CPU is the median over pairs\n")
    cv2.setNumThreads(1)
    rendered(options.pairs)
    wrong_places(options.wrong)


def rendered(n: int) -> None:
    pictures = [load_picture("neon_yell_10cm.png"), load_picture("neon_yell_b_10cm.png")]
    ours: dict[tuple[int, str], dict[str, float]] = {}
    ecc_ms: dict[tuple[int, str], float] = {}
    for size in (128, 64):
        for condition in ("clean", "date", "affine"):
            rng = np.random.default_rng(11)
            pairs = [
                make_pair(pictures[k % 4 == 3], rng, size_px=size, margin_px=MARGIN, condition=condition)
                for k in range(n)
            ]
            bound = np.sqrt(np.mean([np.trace(p.cov_bound_px) / 2.0 for p in pairs]))
            print(f"{size} px, {condition}: {n} pairs, bound {bound:.4f} px per axis")
            print("  method                     rms px   x bound  locking   gross  refused   NEES   ms CPU")
            for name, method in METHODS.items():
                row = _measured(method, pairs, bound)
                print(
                    f"  {name:25s} {row['rms']:8.4f} {row['ratio']:8.2f} {row['locking']:8.4f} "
                    f"{row['gross']:6.1f} % {row['refused']:5.1f} % {row['nees']:7.2f} {row['ms']:7.2f}",
                    flush=True,
                )
                if name == "OpenCV ECC translation":
                    ecc_ms[size, condition] = row["ms"]
            ours[size, condition] = row
            print()
    for size, condition, most in ((128, "clean", 0.003), (128, "date", 0.010), (128, "affine", 0.003)):
        judge_largest(f"{size} px {condition}: rms error", ours[size, condition]["rms"], most, "px", n)
    judge_largest("128 px clean: rms over the bound", ours[128, "clean"]["ratio"], 1.5, "", n)
    locking = max(ours[size, "clean"]["locking"] for size in (128, 64))
    judge_largest("clean, both sizes: locking to whole pixels", locking, 0.002 + 3e-3 / np.sqrt(n), "px", n)
    gross = round(ours[64, "date"]["gross"] / 100.0 * (kept := ours[64, "date"]["kept"]))
    judge_share("64 px date: gross errors among those accepted", gross, int(kept), most=0.02)
    low, high = (chi2(2 * n).ppf(p) / (2 * n) for p in (0.0005, 0.9995))
    low, high = min(low, 0.8), max(high, 1.2)
    for key, row in ours.items():
        text = f"{key[0]} px {key[1]}: mean NEES a degree of freedom {row['nees']:.2f}"
        verdict(text, f"{low:.2f} to {high:.2f}", low <= row["nees"] <= high, n)
    ratio = max(row["ms"] / ecc_ms[key] for key, row in ours.items() if key[0] == 128)
    judge_largest("CPU of a 128 px chip over OpenCV's ECC of a translation", ratio, MOST_MS / ECC_MS, "", n)
    print()


def _measured(method: Callable[[Pair], Outcome], pairs: list[Pair], bound: float) -> dict[str, float]:
    outcomes, cpu_s = [], []
    for pair in pairs:
        start = time.process_time()
        outcomes.append(method(pair))
        cpu_s.append(time.process_time() - start)
    kept = [k for k, (xy, _) in enumerate(outcomes) if xy is not None]
    error = np.array([outcomes[k][0] - pairs[k].offset_px for k in kept]).reshape(-1, 2)
    gross = np.abs(error).max(axis=1) > 0.5
    fine, phase = error[~gross], np.array([pairs[k].offset_px for k in kept])[~gross]
    nees = [
        fine[m] @ np.linalg.solve(outcomes[k][1], fine[m]) / 2.0
        for m, k in enumerate(np.array(kept)[~gross])
        if outcomes[k][1] is not None
    ]
    wave = np.exp(-2j * np.pi * phase)
    rms = float(np.sqrt(np.mean(fine**2)))
    return {
        "rms": rms,
        "ratio": rms / bound,
        "locking": float(np.abs(2.0 * np.mean(fine * wave, axis=0)).max()),
        "gross": 100.0 * float(gross.mean()),
        "refused": 100.0 * (1.0 - len(kept) / len(pairs)),
        "nees": float(np.mean(nees)) if nees else float("nan"),
        "ms": 1e3 * float(np.median(cpu_s)),
        "kept": float(len(kept)),
    }


def ncc(pair: Pair) -> Outcome:
    """Grey values as they are, TM_CCOEFF_NORMED, a parabola through the peak: what most programs do."""
    surface = cv2.matchTemplate(pair.window, pair.template, cv2.TM_CCOEFF_NORMED)
    return peak(surface), None


def band_pass_ncc(pair: Pair) -> Outcome:
    a, b = (normalised(image, np.ones(image.shape, dtype=bool)) for image in (pair.template, pair.window))
    return peak(correlation_surface(a, b)), None


def peak(surface: NDArray) -> Array:
    row, column = np.unravel_index(np.argmax(surface), surface.shape)
    peaks = peaks_of(surface, 1, 1)
    return peaks.xy[0] if len(peaks.value) else np.array([column, row], dtype=float)


def _start(pair: Pair) -> tuple[NDArray, Array]:
    whole = np.round(ncc(pair)[0]).astype(int)
    h, w = pair.template.shape
    return pair.window[whole[1] : whole[1] + h, whole[0] : whole[0] + w], whole


def ecc(pair: Pair) -> Outcome:
    _, whole = _start(pair)
    warp = np.array([[1.0, 0.0, whole[0]], [0.0, 1.0, whole[1]]], dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
    try:
        _, warp = cv2.findTransformECC(
            pair.template, pair.window, warp, cv2.MOTION_TRANSLATION, criteria, None, 5
        )
    except cv2.error:
        return None, None
    middle = (len(pair.template) - 1) / 2.0
    return warp[:, :2] @ np.array([middle, middle]) + warp[:, 2] - middle, None


def plain_least_squares(pair: Pair) -> Outcome:
    """Gauss-Newton for shift, gain and offset after a Gaussian of 0.7 px; no weights, one start."""
    _, whole = _start(pair)
    T, J = (ndimage.gaussian_filter(image.astype(float), 0.7) for image in (pair.template, pair.window))
    ty, tx = np.gradient(T)
    inner = np.s_[3:-3, 3:-3]
    columns = np.column_stack([part[inner].ravel() for part in (tx, ty, T, np.ones_like(T))])
    coefficients = ndimage.spline_filter(J, order=3)
    y, x = np.mgrid[0 : len(T), 0 : len(T)]
    d = whole.astype(float)
    inverse = np.linalg.pinv(columns)
    for _ in range(10):
        seen = ndimage.map_coordinates(coefficients, [y + d[1], x + d[0]], order=3, prefilter=False)
        solution = inverse @ seen[inner].ravel()
        step = solution[:2] / solution[2]
        d -= step
        if np.abs(step).max() < 1e-4:
            break
    return d, None


def boresight(pair: Pair) -> Outcome:
    return located(pair.template, pair.window, MARGIN)


def located(template: NDArray, window: NDArray, radius: int) -> Outcome:
    outcome = match_of(template, window, radius)
    if isinstance(outcome, Entry):
        return None, None
    return outcome.xy_px - _middle(template), outcome.cov_px


def match_of(template: NDArray, window: NDArray, radius: int) -> TemplateMatch | Entry:
    views = (view_of(image, image > 0.0) for image in (template, window))
    return locate(*views, (MARGIN, MARGIN), radius, _middle(template), SETTINGS)


def _middle(template: NDArray) -> Array:
    return (np.array(template.shape[::-1]) - 1.0) / 2.0


METHODS: dict[str, Callable[[Pair], Outcome]] = {
    "OpenCV NCC + parabola": ncc,
    "band-pass NCC + parabola": band_pass_ncc,
    "OpenCV ECC translation": ecc,
    "least squares, plain": plain_least_squares,
    "boresight": boresight,
}


# ---- windows of another place ----


def wrong_places(n: int) -> None:
    """How often a window elsewhere is accepted, and how often the right one is rejected or gross."""
    total: Counter[str] = Counter()
    print("  picture       side  condition   wrong windows  accepted   right windows  refused  gross")
    for name, picture in pictures().items():
        for size, condition in product((64, 128), ("clean", "date")):
            if len(picture) // 2 > (size + 2 * MARGIN + 12) * RATIO:  # else no half of it holds a window
                row = counted(picture, np.random.default_rng([17, size]), n, size, condition)
                total += row
                print(
                    f"  {name:12s} {size:5d}  {condition:9s} {row['wrong']:14d} {row['accepted']:9d} "
                    f"{row['right']:15d} {row['refused']:8d} {row['gross']:6d}",
                    flush=True,
                )
    judge_share("windows of another place accepted", total["accepted"], total["wrong"], most=0.0)
    judge_share("right windows with a gross error", total["gross"], total["right"], most=0.0)


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
        out["gross"] += xy is not None and np.abs(xy - pair.offset_px).max() > 0.5
        for other in (there[k], there[k - 1]):
            out["wrong"] += 1
            out["accepted"] += located(pair.template, other.window, MARGIN)[0] is not None
    return out


def pictures() -> dict[str, NDArray]:
    """Grey values 0 to 255, 10 cm to a pixel; the longer side along the rows."""
    second = load_picture("neon_yell_b_10cm.png")
    first = load_picture("neon_yell_10cm.png")
    return {"aerial": first, "aerial b": second if len(second) > len(second.T) else second.T}


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
