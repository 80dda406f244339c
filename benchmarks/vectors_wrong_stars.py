"""Wrong stars and targets among vectors: is the matrix right within its stated errors, or refuted?

Sets of 20 stars and 20 targets a frame, half of the sets of one frame, half of four; of one frame 0, 1 or 3
stars, or targets, are wrong: misidentified, or displaced by 12 sigma to 6 degrees. A set holds if theta lies
within 4 stated sigma of the truth about each axis, or the verdict is `refuted` or `not checkable`, or an
error is raised. The clean ones show whether the covariance holds. In further sets all vectors are random.

    python benchmarks/vectors_wrong_stars.py [--sets 200]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from record import ROOT, arguments_of, exit_status, head, judge_nees, judge_share

import boresight as bs

sys.path.insert(0, str(ROOT / "tests"))
from wrong_vectors import R_TRUE, drawn_vectors, nees_of

KINDS = {  # share of the sets, and the wrong ones in each
    "no wrong one": (0.4, {}),
    "1 wrong star": (0.15, {"stars": 1}),
    "3 wrong stars": (0.15, {"stars": 3}),
    "1 wrong target": (0.15, {"targets": 1}),
    "3 wrong targets": (0.15, {"targets": 3}),
}
MOST_SIGMAS = 4.0


def main() -> int:
    n_sets = arguments_of(__doc__, ("--sets", 200, "of vectors; a tenth as many are random")).sets
    n_random = max(10, n_sets // 10)
    head("calibrate_vectors: wrong stars and targets of 20")
    print(f"{n_sets} sets, half of 1 and half of 4 frames\n")
    print(f"{'kind':18s}{'within 4 sigma':>15s}{'refuted':>9s}{'refused':>9s}{'wrong':>7s}{'NEES':>7s}")
    begun_s, nees = time.process_time(), {}
    total_wrong = 0
    for kind, (share, wrong) in KINDS.items():
        counts = dict.fromkeys(("right", "refuted", "refused", "wrong"), 0)
        squared = []
        for n in range(round(share * n_sets)):
            rng = np.random.default_rng([n, *wrong.values(), len(wrong)])
            outcome, value = tried(bs, drawn_vectors(rng, frames=1 if n % 2 else 4, **wrong))
            counts[outcome] += 1
            squared += [] if outcome != "right" else [value]
        nees[kind] = squared
        total_wrong += counts["wrong"]
        print(f"{kind:18s}" + "".join(f"{c:>{w}d}" for c, w in zip(counts.values(), (15, 9, 9, 7))), end="")
        print(f"{np.mean(squared):7.2f}", flush=True)
    unseen = sum(
        tried(bs, drawn_vectors(np.random.default_rng(n), frames=1 + 3 * (n % 2), all_random=True))[0]
        not in ("refuted", "refused")
        for n in range(n_random)
    )
    print(f"all vectors random: {n_random - unseen} of {n_random} refused")
    print(f"{time.process_time() - begun_s:.0f} s of processor time")
    judge_share("vectors with wrong ones: off by 4 sigma without a word", total_wrong, n_sets, most=0.0)
    judge_nees("vectors without a wrong one", nees["no wrong one"], asked=(2.7, 3.3))
    judge_share("random vectors with an answer", unseen, n_random, most=0.0)
    return exit_status()


def tried(bs, given) -> tuple[str, float]:
    """Outcome of one set, and its NEES."""
    try:
        found = bs.calibrate_vectors(*given)
    except (ValueError, bs.DataNotSufficientError):
        return "refused", np.nan
    if found.verdict in ("refuted", "not checkable"):
        return "refuted", np.nan
    sigma = np.sqrt(np.diag(found.cov_theta))
    error = np.abs((found.R_cs * R_TRUE.inv()).as_rotvec()) / sigma
    return "right" if error.max() < MOST_SIGMAS else "wrong", nees_of(found.R_cs, found.cov_theta)


if __name__ == "__main__":
    sys.exit(main())
