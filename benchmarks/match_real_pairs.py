"""Matching on real pairs of dates: NAIP, one place in five years, water levels and crops changed.

    python benchmarks/match_real_pairs.py [--cases plain inverted]

The common offset of six chips is searched for as a strip's bootstrap does it. Chips in a narrow window,
spoilt in many ways, are held against what band-pass NCC above 0.4 finds (the whole stated error), and over
triples of years (the part of it that no date has by itself).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import combinations, product

import cv2
import numpy as np
import rasterio
from match_peers import MARGIN, SETTINGS, Array, located, match_of, peak
from numpy.typing import NDArray
from record import SHARED, arguments_of, exit_status, head, judge_nees, judge_share, not_run
from skimage.registration import phase_cross_correlation

from boresight.features.targets.suggest import suggest_targets
from boresight.gct_match.search.common_rotation import vote_tolerance_px
from boresight.gct_match.search.edge_search import best_positions, search_picture, search_template
from boresight.gct_match.search.search_plan import pyramid_factor
from boresight.gct_match.search.vote import Candidates, Vote, log_chance_of_ranks, vote

SIZE, REACH = 96, 120  # of a NAIP chip and of the search to each side, px
CHIP = 128  # px, of what is looked for in a narrow window
FAR_PX = 3.0  # the files' georeferencing is good to a pixel

Images = dict[str, NDArray]
Place = tuple[int, int]
Spoil = Callable[[np.random.Generator, NDArray, NDArray], tuple[NDArray, NDArray]]


def main() -> None:
    cases = arguments_of(__doc__, ("--cases", tuple(CASES), "ways to spoil chips")).cases
    if not (SHARED / "pairs").is_dir():
        not_run("the pairs of dates are not there (shared/data/pairs)")
    head("Matching on real pairs of dates")
    cv2.setNumThreads(1)
    images, infrared, corner = {}, {}, {}
    for path in sorted((SHARED / "pairs").glob("naip_*.tif")):
        year = path.stem[5:9]
        with rasterio.open(path) as file:
            *pan, infrared[year] = file.read().astype(np.float32)
            images[year] = np.mean(pan, axis=0)
            corner[year] = np.array([file.transform.c, -file.transform.f]) / 5.0
    true = {(one, two): corner[one] - corner[two] for one, two in combinations(images, 2)}
    print(f"NAIP, {len(images)} years, {len(true)} pairs, {SIZE} px chips, searched ± {REACH} px")
    _offsets(images, true)
    _cases(images, infrared, cases)
    _closure(images)


def _offsets(images: Images, true: dict[tuple[str, str], Array]) -> None:
    """Six chips that `targets suggest` names in windows that hold them."""
    count = Counter[bool]()
    for (one, two), offset in true.items():
        a, b = images[one], images[two]
        good = suggest_targets(a, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), a > 0.0, size_px=SIZE, most=6)
        places = [(int(t.column) - SIZE // 2, int(t.row) - SIZE // 2) for t in good]
        found = _common_offset(a, b, places)
        if found.log_probability_chance <= np.log(SETTINGS.probability_chance):
            count[bool(np.abs(found.parameters - offset).max() < FAR_PX)] += 1
    judge_share("NAIP: common offset of 6 chips found", count[True], len(true), least=1.0)
    judge_share("NAIP: wrong offsets accepted", count[False], len(true), most=0.0)


def _cases(images: Images, infrared: Images, cases: Sequence[str]) -> None:
    """Chips on a grid of all pairs of years, spoilt; places are held against a common offset by two others.

    NCC above 0.4 finds 4 to 35 chips of a pair, scattered by half a pixel: their median errs by up to 0.6 px.
    Phase correlation finds 20 to 46 within a pixel of it, scattered by 0.2 px. These medians, added over
    three years, miss zero by up to 0.4 px: the truth are offsets of years fitted to them.
    """
    offsets, chips_near = {}, {}
    for pair in combinations(images, 2):
        chips_of_pair = [_chip_and_window(images, pair, at) for at in _grid(images, pair)]
        found = [_ncc(*one) for one in chips_of_pair]
        near = np.median([place for place, height in found if height > 0.4], axis=0)
        whole = np.array([_phase(*one) for one in chips_of_pair])
        whole = whole[np.abs(whole - near).max(axis=1) < 1.0]
        offsets[pair], chips_near[pair] = np.median(whole, axis=0), len(whole)
    offsets = _closing(offsets, np.sqrt([*chips_near.values()]))
    print(
        "  case             chips  NCC right  kept of these  kept  > 1 px, 3 sigma  NCC there  > 3 px   NEES "
        "  ms  scikit-image right  > 3 px    ms"
    )
    for name in cases:
        spoil, chips = CASES[name], infrared if name == "infrared on pan" else images
        rng, count, ms, squares = np.random.default_rng(7), Counter[str](), np.zeros(2), []
        for pair, at in ((years, at) for years in offsets for at in _grid(images, years)):
            window = _chip_and_window(images, pair, at)[1]
            template, window = spoil(rng, _chip_and_window(chips, pair, at)[0], window)
            start = time.process_time()
            place, cov = located(template, window, MARGIN)
            middle = time.process_time()
            whole = _phase(template, window)
            ms += 1e3 * np.diff([start, middle, time.process_time()])
            peer, height = _ncc(template, window)
            count["phase"] += np.abs(whole - offsets[pair]).max() < 1.0
            count["phase gross"] += np.abs(whole - offsets[pair]).max() > FAR_PX
            right = height > 0.4 and np.abs(peer - offsets[pair]).max() < 1.0
            count.update(chips=1, right=right, both=right and place is not None, kept=place is not None)
            if place is not None:
                miss = np.abs(place - offsets[pair])
                squares.append((place - offsets[pair]) @ np.linalg.solve(cov, place - offsets[pair]))
                far = bool(((miss > 1.0) & (miss > 3.0 * np.sqrt(np.diag(cov)))).any())
                count["far"] += far
                count["moved"] += far and np.abs(place - peer).max() < 0.5  # it was moved
                count["gross"] += bool(miss.max() > FAR_PX)
        ms, n = ms / count["chips"], count["kept"]
        print(
            f"  {name:17s}{count['chips']:5d} {count['right']:10d} {count['both']:14d} {n:5d} "
            f"{count['far']:16d} {count['moved']:10d} {count['gross']:7d} {np.mean(squares):6.2f} "
            f"{ms[0]:4.0f} {count['phase']:19d} {count['phase gross']:7d} {ms[1]:5.1f}"
        )
        if count["right"]:
            what = f"NAIP, {name}: kept of what band-pass NCC above 0.4 finds right"
            judge_share(what, count["both"], count["right"], least=0.9)
        judge_share(f"NAIP, {name}: over {FAR_PX:g} px off", count["gross"], max(n, 1), most=0.001)
        if name == "plain":
            judge_nees("NAIP, plain: against the common offset, two axes", squares, 2, asked=(1.6, 2.6))


def _closing(offsets: dict[tuple[str, str], Array], weight: Array) -> dict[tuple[str, str], Array]:
    """Offsets of pairs by places of years, which least squares with a `weight` a pair finds."""
    years = sorted({year for pair in offsets for year in pair})
    A = np.array([[(year == two) - float(year == one) for year in years] for one, two in offsets])
    shifts = np.array([*offsets.values()]) - MARGIN
    places = np.linalg.lstsq(weight[:, None] * A, weight[:, None] * shifts, rcond=None)[0]
    return dict(zip(offsets, MARGIN + A @ places))


def _closure(images: Images) -> None:
    """From year to year and back: what matches have of their own, beside ground that has moved.

    Of the sum of errors a -> b, b -> c and c -> a what belongs to a single date cancels: the ground that has
    moved until then, and all else of a, whose chip is the template of two matches; a date has half of a
    match's variance. That of b and c stays, as it enters by other templates (docs/notes/ground-half.md).
    """
    squares = []
    for one, two, three in combinations(images, 3):
        for at in _grid(images, (one, two)):
            ab, ac = (match_of(*_chip_and_window(images, (one, to), at), MARGIN) for to in (two, three))
            if not ab or not ac:
                continue
            middle = 0.5 * (CHIP - 1.0)
            x, y = (np.round(ab.xy_px - middle - MARGIN) + at).astype(int).tolist()
            bc = match_of(*_chip_and_window(images, (two, three), (x, y)), MARGIN)
            if bc:
                error = ab.xy_px + bc.xy_px - ac.xy_px - MARGIN - middle
                parts = ((0.5, ab), (1.0, bc), (0.5, ac))
                own = sum(part * (match.cov_px - match.cov_moved_px) for part, match in parts)
                squares.append(error @ np.linalg.solve(own, error))
    judge_nees("NAIP: closure of triples of years, two axes, own noise", squares, 2, asked=(1.6, 2.6))


def _grid(images: Images, pair: tuple[str, str]) -> list[Place]:
    shape = np.min([images[year].shape for year in pair], axis=0)
    rows, columns = (range(40, n - CHIP - 40, 96) for n in shape.tolist())
    return [(x, y) for y, x in product(rows, columns)]


def _chip_and_window(images: Images, pair: tuple[str, str], at: Place) -> tuple[NDArray, NDArray]:
    (x, y), around = at, CHIP + MARGIN
    window = images[pair[1]][y - MARGIN : y + around, x - MARGIN : x + around]
    return images[pair[0]][y : y + CHIP, x : x + CHIP], window


def _ncc(template: NDArray, window: NDArray) -> tuple[Array, float]:
    """Place of the highest normalised correlation in the band from 1 to 4 px, and its height."""
    bands = [cv2.GaussianBlur(p, (0, 0), 1.0) - cv2.GaussianBlur(p, (0, 0), 4.0) for p in (window, template)]
    surface = cv2.matchTemplate(*bands, cv2.TM_CCOEFF_NORMED)
    return peak(surface), float(surface.max())


def _phase(template: NDArray, window: NDArray) -> Array:
    """Place by scikit-image's phase correlation, which refuses nothing."""
    around = window[MARGIN:-MARGIN, MARGIN:-MARGIN]
    return MARGIN + phase_cross_correlation(around, template, upsample_factor=100)[0][::-1]


def _turned(angle_deg: float, scale: float) -> Spoil:
    def spoil(rng: np.random.Generator, t: NDArray, w: NDArray) -> tuple[NDArray, NDArray]:
        middle = 0.5 * (len(w) - 1)
        M = cv2.getRotationMatrix2D((middle, middle), float(rng.choice([-1, 1])) * angle_deg, scale)
        return t, cv2.warpAffine(w, M, w.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)

    return spoil


def _hidden(value: float) -> Spoil:
    def spoil(rng: np.random.Generator, t: NDArray, w: NDArray) -> tuple[NDArray, NDArray]:
        field = cv2.GaussianBlur(rng.normal(size=w.shape), (0, 0), 15.0)
        return t, np.where(field > np.quantile(field, 0.7), value, w).astype(np.float32)

    return spoil


def _jpeg(image: NDArray) -> NDArray:
    _, coded = cv2.imencode(".jpg", image.clip(1, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 20])
    return cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE).astype(np.float32).clip(1.0)


def _coarse_reference(t: NDArray) -> NDArray:
    small = cv2.resize(t, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    return cv2.resize(small, t.shape, interpolation=cv2.INTER_CUBIC)


CASES: dict[str, Spoil] = {
    "plain": lambda rng, t, w: (t, w),
    "cloud 30 %": _hidden(235.0),
    "no data 30 %": _hidden(0.0),
    "noise of 6": lambda rng, t, w: (t, (w + rng.normal(0.0, 6.0, w.shape)).clip(1.0).astype(np.float32)),
    "JPEG q20": lambda rng, t, w: (_jpeg(t), _jpeg(w)),
    "turn 1.15 deg": _turned(1.15, 1.0),
    "scale 2 %": _turned(0.0, 1.02),
    "veil": lambda rng, t, w: (t, 0.3 * w + 150.0),
    "infrared on pan": lambda rng, t, w: (t, w),
    "inverted": lambda rng, t, w: (t, 256.0 - w),
    "4 x coarser": lambda rng, t, w: (_coarse_reference(t), w),
}


def _common_offset(a: NDArray, b: NDArray, places: list[Place]) -> Vote:
    """The vote of chips of `a` at `places` in windows of `b` around them."""
    factor = pyramid_factor(SIZE, REACH, SETTINGS)
    tolerance = vote_tolerance_px(factor, SETTINGS)
    owner, displacement, chance = [], [], []
    for k, (x, y) in enumerate(places):
        at = np.array([max(0, x - REACH), max(0, y - REACH)])
        window = b[at[1] : y + SIZE + REACH, at[0] : x + SIZE + REACH]
        template, picture = (_coarse(image, factor) for image in (a[y : y + SIZE, x : x + SIZE], window))
        width, height = np.subtract(picture.shape, template.shape)[::-1].tolist()
        found = best_positions(
            search_template(template), [search_picture(picture)], [(0, 0, width, height)], SETTINGS.candidates
        )
        owner.append(np.full(len(found.xy), k))
        displacement.append(found.xy * factor + at - [x, y])
        share = np.pi * tolerance**2 / ((width + 1) * (height + 1) * factor**2)
        chance.append(log_chance_of_ranks(len(found.xy), share))
    every = np.concatenate(displacement)
    shift = np.broadcast_to(np.eye(2), (len(every), 2, 2))
    candidates = Candidates(np.concatenate(owner), every, shift, np.concatenate(chance))
    return vote(candidates, np.full(2, REACH / SETTINGS.sigmas), SETTINGS.sigmas, tolerance, 0.5 * factor)


def _coarse(image: NDArray, factor: int) -> NDArray:
    h, w = (n // factor for n in image.shape)
    coarse = cv2.resize(image[: h * factor, : w * factor], (w, h), interpolation=cv2.INTER_AREA)
    return np.where(coarse > 0.0, coarse, np.nan)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
