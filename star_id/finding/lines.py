"""Offsets of whole columns and rows (hot columns, bias lines, row noise): found, and subtracted.

Two short parts of each line far apart show its offset alike, which noise and stars do not: the covariance of
the parts, over the lines, is the variance of the offsets, and in a single hot line both parts stand out.
Where the former is significant each line's mean without stars, less the smooth course of these, is
subtracted, where the latter alone is that of the single lines; the level of the sky over the image remains. A
single line that is near saturation, or much noisier or quieter than those around it, shows no stars: it is
replaced by the mean of the lines beside it, and told, so that it has no weight in fits.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats, Ints
from boresight.star_id.beyond_chance import CLIP_SIGMA, MAD_SIGMA, NEVER_SIGMA, NOISIER, SELDOM_SIGMA
from boresight.star_id.finding.cut_sky import LEAST_LEVELS_PER_SIGMA

__all__ = ["PART_PX", "SPARSE", "without_lines"]

# Side, px, of the parts of an image that are summed to one number when offsets of readout or colours are
# looked for (set by hand): of 32 x 32 px the mean of a colour is known to 1/16 of their noise.
PART_PX = 32
# Adjacent lines in the middle of the image that are looked at for offsets of all lines, and pixels of a line
# whose median is taken: known to 1/25 of a pixel's noise.
_LINES = 1024
# Variance of such offsets, as a share of a pixel's, below which they do no harm: 5 % of a pixel's noise.
_LEAST_VARIANCE = 0.003
# Covariance of adjacent steps over their variance, below which steps are a line's own: -0.5 for independent
# offsets, 0.6 where rows of stars make them (set by hand, between both).
_LIKE_NOISE = 0.2
# Lines whose median an outlying line is compared with: odd, longer than a bright star's image.
_AROUND = 51
# Lines over which the level of the sky is a parabola: odd, shorter than clouds and vignetting (set by
# hand).
_SMOOTH = 301
# Share of lines that stand so low that their cut-off is above that of the others.
_RAISED = 0.05
# Standard deviation of a pixel, DN, of 8 bits whose sky is cut off, up to which it has too few grey levels to
# show the offsets of all lines (set by hand: of two real frames in sixteen a seventh of the stars is lost
# otherwise, the others have more).
_LEAST_NOISE_CUT_OFF_DN = 4.0
# Share of the pixels of most lines above the least value from which a sky is not cut off (set by hand).
_WHOLE = 0.99
# Every so many rows and columns are looked at for shares of pixels (set by hand).
SPARSE = 4
# Parts of a line that must all be noisy, or quiet: a bloom or a roof fills some of them.
_QUARTERS = 4
# Most adjacent lines that are replaced: a wider band is no fault of single lines.
_MOST_ADJACENT = 2


def without_lines(image: NDArray[Any], saturation_dn: float) -> tuple[NDArray[Any], Bools | None]:
    """The image (H, W) without offsets of its rows and columns, or itself where there are none, and which of
    its pixels (H, W) lie on lines that show no stars; None: no such line.

    Saturated pixels stay saturated.
    """
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        image = image.astype(np.float32)
    lines = {axis: kind for axis in (0, 1) if (kind := _lines_with_offsets(image, axis)) != "none"}
    if not lines:
        return image, None
    clean = image.astype(np.float32)
    floor = float(image.min())
    above = image[::SPARSE, ::SPARSE] > image.min()  # of dead lines all pixels are at the least value
    whole = max(float(np.median(above.mean(axis=axis))) for axis in (0, 1)) > _WHOLE
    useless = []
    for axis, kind in lines.items():
        seen = clean if axis == 0 else clean.T
        offset, unusable = _offsets(seen, saturation_dn, whole)
        if kind == "single":  # what others have is of the scene: trees, roofs
            parts = _parts(seen, 0)
            others = np.delete(np.arange(len(offset)), _single_lines(parts, _scale(np.diff(parts))))
            offset[others] = 0.0
        floor -= min(0.0, float(np.quantile(offset, _RAISED)))
        seen -= offset[:, None]
        useless.append((seen, unusable))
    np.maximum(clean, floor, out=clean)  # a sky that was cut off is so in all lines alike
    if np.isfinite(saturation_dn):
        clean[image >= saturation_dn] = saturation_dn
    if not any(len(rows) for _, rows in useless):
        return clean, None
    no_stars = np.zeros(image.shape, dtype=bool)
    for axis, (seen, rows) in zip(lines, useless):
        _replace(seen, rows, no_stars if axis == 0 else no_stars.T)
    return clean, no_stars


def _replace(image: NDArray[np.float32], rows: Ints, no_stars: Bools) -> None:
    """Replace single rows of an image (H, W), in place, by the mean of the rows beside them, and mark them in
    `no_stars` (H, W)."""
    for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        if 0 < len(run) <= _MOST_ADJACENT:
            beside = [k for k in (run[0] - 1, run[-1] + 1) if 0 <= k < len(image)]
            image[run], no_stars[run] = image[beside].mean(axis=0), True


def _lines_with_offsets(image: NDArray[Any], axis: int) -> Literal["none", "single", "all"]:
    """Which rows (axis 0) or columns (axis 1) of an image have offsets: none, single ones or all."""
    if axis == 0:  # rows lie apart in memory: some will do
        first = max(0, (len(image) - _LINES) // 2)
        image = image[first : first + _LINES]
    parts = _parts(image, axis)
    steps = np.diff(parts[:, :_LINES], axis=1)
    least_dn = LEAST_LEVELS_PER_SIGMA if np.issubdtype(image.dtype, np.integer) else 0.0
    scale = max(_scale(steps), least_dn / np.sqrt(PART_PX))
    single = _single_lines(parts, scale)
    some = len(single) and _differ(image if axis == 0 else image.T, single, 0.5 * SELDOM_SIGMA * scale)
    if _all_have_offsets(image, parts, steps, scale, least_dn):
        return "all"
    return "single" if some else "none"


def _scale(steps: Floats) -> float:
    """Standard deviation of steps (2, N) between parts of adjacent lines."""
    few = np.sort(np.abs(steps[:, ::3]), axis=None)
    return MAD_SIGMA * float(few[len(few) // 2])


def _single_lines(parts: Floats, scale: float) -> Ints:
    """The lines both of whose parts (2, N) stand out alike from the lines beside them, whose steps have a
    standard deviation `scale`."""
    bump = parts[:, 2:-2] - 0.5 * (parts[:, 4:] + parts[:, :-4])  # 0.87 of the scale of a step
    limit = SELDOM_SIGMA * scale
    return ((np.minimum(*bump) > limit) | (np.maximum(*bump) < -limit)).nonzero()[0] + 2


def _all_have_offsets(
    image: NDArray[Any], parts: Floats, steps: Floats, scale: float, least_dn: float
) -> bool:
    """Whether the steps (2, N) between parts of adjacent lines are alike in both parts by more than
    chance."""
    pixel_dn = scale * np.sqrt(0.5 * PART_PX)
    if pixel_dn <= least_dn:
        return False
    steps = np.clip(steps, -CLIP_SIGMA * scale, CLIP_SIGMA * scale)
    product = steps[0] * steps[1]  # twice the variance of the offsets
    least = max(2.0 * _LEAST_VARIANCE * pixel_dn**2, NEVER_SIGMA * product.std() / np.sqrt(len(product)))
    if (mean := product.mean()) < least or (steps[0, :-1] * steps[1, 1:]).mean() >= _LIKE_NOISE * mean:
        return False
    cut_off = image.dtype == np.uint8 and np.median(parts) < image.min() + SELDOM_SIGMA * pixel_dn
    return bool(not cut_off or pixel_dn > _LEAST_NOISE_CUT_OFF_DN)


def _parts(image: NDArray[Any], axis: int) -> Floats:
    """(2, N) means of two parts of the N rows (axis 0) or columns (axis 1)."""
    along = image.shape[1 - axis]
    means = []
    for s in (along // 3 - PART_PX // 2, 2 * along // 3 - PART_PX // 2):
        s = max(s, 0)
        part = image[:, s : s + PART_PX] if axis == 0 else image[s : s + PART_PX]
        count = part.shape[1 - axis]
        weight = np.full(count, 1.0 / count, dtype=np.float32)
        part = part.astype(np.float32)
        means.append(part @ weight if axis == 0 else weight @ part)
    return np.stack(means)


def _differ(image: NDArray[Any], rows: Ints, limit: float) -> bool:
    """Whether the median of any of `rows` differs from those of the rows beside it: two hot pixels do not
    change it."""
    own, before, after = (np.median(image[rows + d, ::2], axis=1) for d in (0, -2, 2))
    return bool(np.any(np.abs(own - 0.5 * (before + after)) > limit))


def _offsets(image: NDArray[Any], saturation_dn: float, whole: bool) -> tuple[NDArray[np.float32], Ints]:
    """(H,) offsets of the rows of an image, their means without stars less the smooth course of these, and
    the rows that show no stars: near saturation, or, in a `whole` sky, too noisy or dead.

    Of a sky that is cut off at its least value the means move less than the sky, by the share that is above.
    """
    sample = image[:, :: max(1, image.shape[1] // _LINES)]
    median = np.median(sample, axis=1)
    rest = sample - median[:, None]
    noise = MAD_SIGMA * float(np.median(np.abs(rest)))
    limit = CLIP_SIGMA * max(noise, 1.0)
    above = np.mean(sample > sample.min(), axis=1).clip(0.2)
    clipped = np.clip(rest, -limit, limit)
    middle = median + clipped.mean(axis=1) / above
    around = scipy.ndimage.median_filter(middle, _AROUND, mode="nearest")
    off = middle - around
    inlier = np.clip(off, -CLIP_SIGMA * (spread := MAD_SIGMA * np.median(np.abs(off))), CLIP_SIGMA * spread)
    window = min(_SMOOTH, len(middle) // 2 * 2 - 1)
    offset = np.asarray(middle - scipy.signal.savgol_filter(around + inlier, window, 2), dtype=np.float32)
    unusable = median > saturation_dn - SELDOM_SIGMA * noise
    if whole:  # of a sky that is cut off, raised lines show more noise
        unusable |= _unlike_others(clipped)
    return offset, np.flatnonzero(unusable)


def _unlike_others(clipped: NDArray[Any]) -> Bools:
    """(H,) which rows (H, S), less their medians and without stars, are noisier than those around them in
    all their parts, or quieter."""
    parts = np.array_split(clipped, _QUARTERS, axis=1)
    noise = np.array([np.sqrt((part**2).mean(axis=1)) for part in parts])
    usual = scipy.ndimage.median_filter(noise.min(axis=0), _AROUND, mode="nearest")
    noisy = noise.min(axis=0) > NOISIER * np.maximum(usual, 0.3)
    return np.asarray(noisy | (NOISIER * noise.max(axis=0) < usual))  # no light changes those of dead ones
