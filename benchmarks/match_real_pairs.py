"""Matching on real pairs of dates: two of Sentinel-2, five years of NAIP.

    python benchmarks/match_real_pairs.py [--votes 10]

Sentinel-2: chips of one date in the other, around the known offset, beside peers; the figure is the scatter
about a robust affine fit. NAIP: one place in five years, water levels and crops changed. The common offset
of six chips is searched for as a strip's bootstrap does it, in windows that hold them and, to see what
chance does, in windows that do not; fine matches are held against the map.
"""

from __future__ import annotations

from itertools import combinations, product
from pathlib import Path

import cv2
import numpy as np
import rasterio
from match_peers import MARGIN, METHODS, SETTINGS, Array, Outcome, located
from numpy.typing import NDArray
from record import SHARED, arguments_of, exit_status, head, judge_largest, judge_share, not_run, verdict
from rendered_pairs import Pair

from boresight.features.targets.suggest import suggest_targets
from boresight.gct_match.imaging.views import normalised
from boresight.gct_match.search.common_rotation import vote_tolerance_px
from boresight.gct_match.search.correlation import correlation_surface
from boresight.gct_match.search.edge_search import best_positions, search_picture, search_template
from boresight.gct_match.search.search_plan import pyramid_factor
from boresight.gct_match.search.vote import Candidates, Vote, log_chance_of_ranks, vote

SIZE, REACH = 96, 120  # of a NAIP chip and of the search to each side, px
FAR_PX = 3.0  # the files' georeferencing is good to a pixel

Images = dict[str, NDArray]
Place = tuple[int, int]


def main() -> None:
    votes = arguments_of(__doc__, ("--votes", 10, "of each pair of years of NAIP, in wrong windows")).votes
    if not (SHARED / "pairs").is_dir():
        not_run("the pairs of dates are not there (shared/data/pairs)")
    head("Matching on real pairs of dates")
    cv2.setNumThreads(1)
    sentinel()
    naip(votes)


def sentinel() -> None:
    """Two dates of one orbit: chips of the first, looked for in the second around the known offset."""
    a, b = (_band(SHARED / "pairs" / f"s2_{name}.jp2") for name in "ab")
    shift = np.array([(335440 - 330000) / 10.0, (5862000 - 5866490) / 10.0])  # column, row of b's corner in a
    for size in (128, 64):
        places, pairs = [], []
        for y in range(MARGIN + 32, b.shape[0] - size - MARGIN - 32, size):
            for x in range(MARGIN + 32, b.shape[1] - size - MARGIN - 32, size):
                ax, ay = (np.array([x, y]) + shift).astype(int)
                if ax < 0 or ay < 0 or ay + size > a.shape[0] or ax + size > a.shape[1]:
                    continue
                template = a[ay : ay + size, ax : ax + size]
                window = b[y - MARGIN : y + size + MARGIN, x - MARGIN : x + size + MARGIN]
                if (template > 0).all() and (window > 0).mean() > 0.99:
                    places.append((x, y))
                    pairs.append(Pair(template, window, np.full(2, float(MARGIN)), np.eye(2)))
        print(
            f"Sentinel-2 pair, {size} px: {len(pairs)} chips; scatter about a robust affine fit, px per axis"
        )
        print("  method                    accepted   scatter    gross   NEES of pair")
        counts = {}
        for name in (
            "OpenCV NCC + parabola",
            "band-pass NCC + parabola",
            "least squares, plain",
            "boresight",
        ):
            outcomes = [METHODS[name](pair) for pair in pairs]
            if (
                name != "boresight"
            ):  # peers say nothing of a match's worth: the usual test is a correlation of 0.5
                outcomes = [
                    o if o[0] is not None and _correlation(pair, name) > 0.5 else (None, None)
                    for o, pair in zip(outcomes, pairs)
                ]
            accepted, scatter, gross, nees = _scatter(places, outcomes)
            counts[name] = (accepted, scatter, gross)
            print(f"  {name:25s} {accepted:8d} {scatter:9.4f} {100 * gross:7.2f} % {nees:8.2f}", flush=True)
        if size == 128:
            ours, theirs = counts["boresight"], counts["band-pass NCC + parabola"]
            judge_largest("Sentinel-2 pair, 128 px: scatter", ours[1], 0.055, "px", ours[0])
            judge_largest("Sentinel-2 pair, 128 px: share of gross errors", ours[2], 0.01, "", ours[0])
            text = f"Sentinel-2 pair, 128 px: {ours[0]} of {len(pairs)} chips accepted"
            verdict(text, f"more than band-pass NCC, {theirs[0]}", ours[0] > theirs[0], len(pairs))
        print()


def _correlation(pair: Pair, name: str) -> float:
    if name.startswith("band-pass"):
        a, b = (normalised(image, np.ones(image.shape, dtype=bool)) for image in (pair.template, pair.window))
        return float(correlation_surface(a, b).max())
    return float(cv2.matchTemplate(pair.window, pair.template, cv2.TM_CCOEFF_NORMED).max())


def _scatter(places: list[tuple[int, int]], outcomes: list[Outcome]) -> tuple[int, float, float, float]:
    """Accepted, robust rms about an affine fit, share beyond 0.5 px, and normalised error squared."""
    kept = [k for k, (xy, _) in enumerate(outcomes) if xy is not None]
    xy = np.array([outcomes[k][0] for k in kept])
    design = np.column_stack([np.ones(len(kept)), np.array(places, dtype=float)[kept] / 1000.0])
    good = np.abs(xy - np.median(xy, axis=0)).max(axis=1) < 1.0
    for _ in range(10):
        model = np.linalg.lstsq(design[good], xy[good], rcond=None)[0]
        miss = xy - design @ model
        good = np.abs(miss).max(axis=1) < 0.5
    nees = [
        miss[m] @ np.linalg.solve(outcomes[k][1], miss[m]) / 2.0
        for m, k in enumerate(kept)
        if good[m] and outcomes[k][1] is not None
    ]
    rms = float(np.sqrt(np.mean(miss[good] ** 2)))
    return len(kept), rms, float(1.0 - good.mean()), float(np.mean(nees)) if nees else float("nan")


def naip(votes: int) -> None:
    """Five years: the common offset of six chips in a wide window, then fine matches and their closure."""
    images, corner = {}, {}
    for path in sorted((SHARED / "pairs").glob("naip_*.tif")):
        year = path.stem[5:9]
        images[year] = _band(path)
        with rasterio.open(path) as file:
            corner[year] = np.array([file.transform.c, -file.transform.f]) / 5.0
    true = {(one, two): corner[one] - corner[two] for one, two in combinations(images, 2)}
    rng = np.random.default_rng(5)
    print(f"NAIP, {len(images)} years, {len(true)} pairs, {SIZE} px chips, searched ± {REACH} px")
    _offsets(images, true, rng, votes)
    _chance(images, true, rng, votes)
    _fine(images, true)


def _offsets(
    images: Images, true: dict[tuple[str, str], Array], rng: np.random.Generator, votes: int
) -> None:
    """Six chips in windows that hold them."""
    chosen, anywhere = [], []
    for (one, two), offset in true.items():
        a, b = images[one], images[two]
        good = suggest_targets(a, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), a > 0.0, size_px=SIZE, most=6)
        places = [(int(t.column) - SIZE // 2, int(t.row) - SIZE // 2) for t in good]
        chosen.append(_judged(_common_offset(a, b, places), offset))
        for _ in range(votes // 2):
            places = _anywhere(a, b, rng)
            anywhere.append(_judged(_common_offset(a, b, places), offset))
    for text, found in (("that `targets suggest` names", chosen), ("anywhere", anywhere)):
        print(
            f"  common offset of 6 chips {text}: right {found.count('right')} of {len(found)}, "
            f"wrong {found.count('wrong')}, refused {found.count('refused')}"
        )
    judge_share("NAIP: common offset of 6 chips found", chosen.count("right"), len(true), least=1.0)
    every = chosen + anywhere
    judge_share("NAIP: wrong offsets accepted", every.count("wrong"), len(every), most=0.0)


def _chance(images: Images, true: dict[tuple[str, str], Array], rng: np.random.Generator, votes: int) -> None:
    """Six chips in windows that do not hold them: is a vote's probability of chance what it says?"""
    stated = []
    for one, two in list(true) * votes:
        a, b = images[one], images[two]
        aside = np.array([int(rng.choice([-1, 1]) * rng.integers(250, 400)), 0])
        places = [p for p in _anywhere(a, b, rng, 60) if 0 <= p[0] + aside[0] < b.shape[1] - SIZE][:6]
        stated.append(_common_offset(a, b, places, aside).log_probability_chance)
    probability = np.exp(stated)
    shares = ", ".join(f"{np.mean(probability < p):.4f} below {p:g}" for p in (0.1, 0.01, 0.001))
    accepted = int(np.sum(probability < SETTINGS.probability_chance))
    print(
        f"  6 chips in windows of another place: {accepted} of {len(stated)} accepted; stated chance {shares}"
    )
    judge_share("NAIP: votes in windows of another place accepted", accepted, len(stated), most=0.0)
    for p in (0.1, 0.01):
        below = int(np.sum(probability < p))
        judge_share(f"NAIP: stated chance below {p:g} by chance", below, len(stated), most=p)


def _fine(images: Images, true: dict[tuple[str, str], Array]) -> None:
    """Chips on a grid, in a window of a few pixels."""
    fine: dict[tuple[str, str, int, int], Array] = {}
    for one, two in true:
        a, b = images[one], images[two]
        rows, columns = (range(32, min(a.shape[k], b.shape[k]) - SIZE - 32, SIZE) for k in (0, 1))
        for y, x in product(rows, columns):
            window = b[y - MARGIN : y + SIZE + MARGIN, x - MARGIN : x + SIZE + MARGIN]
            place, _ = located(a[y : y + SIZE, x : x + SIZE], window, MARGIN)
            if place is not None:
                fine[one, two, x, y] = place - MARGIN
    far = {key: d - true[key[:2]] for key, d in fine.items() if np.abs(d - true[key[:2]]).max() > FAR_PX}
    print(f"  fine matches in ± {MARGIN} px: {len(fine)} accepted")
    judge_share(f"NAIP: fine matches over {FAR_PX:g} px from the map", len(far), len(fine), most=0.01)


def _anywhere(a: NDArray, b: NDArray, rng: np.random.Generator, count: int = 6) -> list[Place]:
    x = rng.integers(0, min(a.shape[1], b.shape[1]) - SIZE, count)
    y = rng.integers(0, min(a.shape[0], b.shape[0]) - SIZE, count)
    return list(zip(x.tolist(), y.tolist()))


def _judged(outcome: Vote, offset: Array) -> str:
    if outcome.log_probability_chance > np.log(SETTINGS.probability_chance):
        return "refused"
    return "right" if np.abs(outcome.parameters - offset).max() < FAR_PX else "wrong"


def _common_offset(a: NDArray, b: NDArray, places: list[Place], aside: Array | int = 0) -> Vote:
    """The vote of chips of `a` at `places` in windows of `b` around them, or around places as far aside."""
    factor = pyramid_factor(SIZE, REACH, SETTINGS)
    tolerance = vote_tolerance_px(factor, SETTINGS)
    owner, displacement, chance = [], [], []
    for k, (x, y) in enumerate(places):
        window, at = _window(b, np.array([x, y]) + aside)
        template, picture = (_coarse(image, factor) for image in (a[y : y + SIZE, x : x + SIZE], window))
        width, height = np.subtract(picture.shape, template.shape)[::-1].tolist()
        found = best_positions(
            search_template(template), [search_picture(picture)], [(0, 0, width, height)], SETTINGS.candidates
        )
        owner.append(np.full(len(found.xy), k))
        displacement.append(found.xy * factor + at - [x, y] - aside)
        share = np.pi * tolerance**2 / ((width + 1) * (height + 1) * factor**2)
        chance.append(log_chance_of_ranks(len(found.xy), share))
    every = np.concatenate(displacement)
    shift = np.broadcast_to(np.eye(2), (len(every), 2, 2))
    candidates = Candidates(np.concatenate(owner), every, shift, np.concatenate(chance))
    return vote(candidates, np.full(2, REACH / SETTINGS.sigmas), SETTINGS.sigmas, tolerance, 0.5 * factor)


def _window(image: NDArray, place: Array) -> tuple[NDArray, Array]:
    """What lies within the reach of a chip's place, and where its first pixel is."""
    x, y = place
    left, top = max(0, x - REACH), max(0, y - REACH)
    return image[top : y + SIZE + REACH, left : x + SIZE + REACH], np.array([left, top])


def _coarse(image: NDArray, factor: int) -> NDArray:
    h, w = (n // factor for n in image.shape)
    coarse = cv2.resize(image[: h * factor, : w * factor], (w, h), interpolation=cv2.INTER_AREA)
    return np.where(coarse > 0.0, coarse, np.nan)


def _band(path: Path) -> NDArray:
    with rasterio.open(path) as file:
        bands = file.read()
    return bands[:3].mean(axis=0).astype(np.float32)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
