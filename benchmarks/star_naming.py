"""How often stars are named, rightly or wrongly, whatever is known of the camera: random attitudes of the
paper's camera.

    python benchmarks/star_naming.py [--attitudes 150] [--seeds 4 201] [--noise 1000]

CPU times are those of all frames, scenarios in turn. Lists of places drawn at random must not be named.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from record import ROOT, arguments_of, exit_status, head, judge_largest, judge_share
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(ROOT / "tests"))

from frames import PAPER_CAMERA, stars_in_view

from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import FieldSolution, solve_stars
from boresight.star_id.identification.triangle_index import build_index, equivalent_fov
from boresight.star_id.settings import StarSettings

SIZE = (5120, 3840)
# title, stars, false stars, error of the field of view (None: unknown)
SCENARIOS = (
    ("calibrated camera", 138, 0, 0.0),
    ("calibrated camera, 50 false stars", 138, 50, 0.0),
    ("calibrated camera, 200 false stars", 138, 200, 0.0),
    ("calibrated camera, 8 stars, 3 false", 8, 3, 0.0),
    ("field of view 7 % wrong, lens not calibrated", 138, 0, 0.07),
    ("field of view unknown, lens not calibrated", 138, 0, None),
    ("field of view unknown, 50 false stars", 138, 50, None),
)
MOST_MS = 1.0  # median CPU time of a frame of the calibrated camera, distortion removed, solution made


def main() -> None:
    arguments = arguments_of(
        __doc__,
        ("--attitudes", 40, "of each scenario and seed"),
        ("--seeds", (4, 201), "of the attitudes"),
        ("--noise", 200, "lists of random places"),
    )
    places, settings = hipparcos_stars(8.0).places, StarSettings()
    fov = 2.0 * np.arctan(0.5 * SIZE[0] * PAPER_CAMERA.pixel_m / PAPER_CAMERA.focal_m)
    own = build_index(places, 1991.25, equivalent_fov(*SIZE, PAPER_CAMERA.focal_m / PAPER_CAMERA.pixel_m))
    every = build_index(places, 1991.25, (np.radians(5.0), np.radians(60.0)))
    head("star_id: naming")
    runs: dict[str, list] = {title: [] for title, *_ in SCENARIOS}
    for seed in arguments.seeds:  # scenarios in turn: the machine's slow minutes fall on all alike
        for title, stars, false, error in SCENARIOS:
            if error == 0.0:
                index, known = own, {"camera": PAPER_CAMERA}
            else:
                index, known = every, {} if error is None else {"fov_x_rad": (1.0 + error) * fov}
            runs[title].append(
                _named(places, settings, index, known, seed, arguments.attitudes, stars, false)
            )
    frames = arguments.attitudes * len(arguments.seeds)
    for title, _, _, error in SCENARIOS:
        spent = np.concatenate([run[2] for run in runs[title]])
        print(f"{title}: CPU ms {spent.min():.2f} to {spent.max():.1f}, median {np.median(spent):.2f}")
        judge_share(f"{title}: named", sum(run[0] for run in runs[title]), frames, least=1.0)
        judge_share(f"{title}: named wrongly", sum(run[1] for run in runs[title]), frames, most=0.0)
        if error == 0.0:
            judge_largest(f"{title}: median", float(np.median(spent)), MOST_MS, "ms CPU", frames)
    rng, named = np.random.default_rng(5), 0
    for _ in range(arguments.noise):
        xy = rng.uniform([0, 0], np.array(SIZE) - 1, (int(rng.integers(4, 350)), 2))
        named += isinstance(solve_stars(xy, SIZE, own, settings, camera=PAPER_CAMERA), FieldSolution)
    judge_share("lists of random places named", named, arguments.noise, most=0.0)


def _named(places, settings, index, known, seed, attitudes, stars, false):
    """How many frames of a seed are named rightly, wrongly; the CPU time of each, ms."""
    right, wrong, spent = 0, 0, []
    for k in range(attitudes):
        rng = np.random.default_rng([seed, k])
        R_si = Rotation.random(random_state=rng)
        xy, hip = _detections(R_si, places, rng, stars, false)
        start = time.process_time()
        found = solve_stars(xy, SIZE, index, settings, **known)
        spent.append(1e3 * (time.process_time() - start))
        if isinstance(found, FieldSolution):
            good = (found.hip == hip[found.detections]).mean() > 0.9
            right, wrong = right + good, wrong + (not good)
    return right, wrong, spent


def _detections(R_si, places, rng, stars, false):
    rows, xy = stars_in_view(PAPER_CAMERA, R_si, places)
    bright = np.argsort(places.v_mag[rows], kind="stable")[:stars]
    v = places.v_mag[rows[bright]] + rng.normal(0, 0.15, len(bright))
    xy = xy[bright] + rng.normal(0, 0.2, (len(bright), 2))
    xy = np.vstack([xy, rng.uniform([0, 0], SIZE, (false, 2))])
    order = np.argsort(np.append(v, rng.choice(v, false)), kind="stable")
    return xy[order], np.append(places.hip[rows[bright]], np.zeros(false, dtype=np.int64))[order]


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
