"""Candidate pixels for stars: a coarse, fast search that touches each pixel a few times.

The image is binned 2 x 2 or 4 x 4, converted to 8 bits with the sky's noise at a few grey levels, and summed
over squares of 2 x 2 of its pixels, which for stars one or two pixels wide is close to the matched filter.
The local maxima above a low threshold, some thousands, are the candidates that `detect` examines. The search
runs in bands of rows that stay in the processor's cache, with OpenCV's vector instructions:

    band -> _binned_to_8_bits -> sums of 2 x 2 -> less the threshold -> equal to their 3 x 3 maximum?
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Floats, Ints, record
from boresight.star_id.beyond_chance import SELDOM_SIGMA
from boresight.star_id.finding.background import Background, extended, median_of
from boresight.star_id.finding.cut_sky import LEAST_LEVELS_PER_SIGMA
from boresight.star_id.finding.windows import NINE

__all__ = ["MAX_CANDIDATES", "find_candidates"]

# Threshold of a sum of four binned pixels, sigmas: a star of SNR 8 midway between coarse pixels still
# reaches 5.5 in one of four sums, and noise passes it 1e-4 times a pixel; `detect` tests all.
_THRESHOLD_SIGMA = 3.7
# Grey levels of the 8-bit image for the noise of a pixel, half as many for the mean of four: rounding adds
# 0.5 % to the variance.
_LEVELS_PER_SIGMA = 4.0
# Range of a sum of four, sigmas of a pixel, that has to fit into 255 levels beside the sky's own: 16 below
# it, 12 above.
_RANGE_SIGMA = 28.0
# Level of a sum of four of the sky below which no offset is subtracted: half of the range is left.
_DARK_LEVELS = 128.0
# Noise of the sky, DN, from which the mean of four pixels may be rounded to whole numbers: that adds 1/12
# DN^2 to 0.36.
_COARSE_NOISE_DN = 1.2
# Steps of an uneven threshold within a block of the background (set by hand).
_TILES_PER_BLOCK = 32
# Most candidates that are tested, the highest: an image with more shows no sky. Bounds time and memory.
MAX_CANDIDATES = 20_000
# Rows of the binned image that are worked on at a time, so that they stay in the processor's cache; a
# multiple of 8 (`_words`).
_BAND_ROWS = 96


@record
class _GreyScale:
    """Conversion of the image to 8 bits, gain * (value - sky) + offset, and the threshold on that scale."""

    gain: float
    offset: float
    binnings: int  # by a factor of two each
    converted_after: int  # binnings done before the conversion to 8 bits
    sky_dn: NDArray[np.float32] | None  # sky of each binned pixel; None: a constant, held in the offset
    threshold: NDArray[np.uint8]  # for sums of four: (1,), or one for each binned pixel


def find_candidates(image: NDArray[Any], background: Background, *, halvings: int = 1) -> Ints:
    """Pixels (N, 2) as (column, row) near the local maxima of the image binned by 2 ** `halvings`.

    The centre of a star lies within 2 ** `halvings` - 1 pixels of one, or one more towards +x or +y.
    """
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        image = image.astype(np.float32)
    scale = 2**halvings
    rows, columns = image.shape[0] // scale, image.shape[1] // scale
    grey = _grey_scale(image, background, halvings)
    pairs, sums, maxima = (np.zeros((_BAND_ROWS + 2, columns), np.uint8) for _ in range(3))
    at_word, sum_words, maximum_words = [], [], []
    for top in range(0, rows - 1, _BAND_ROWS):
        first, last = max(0, top - 1), min(rows, top + _BAND_ROWS + 2)
        n = last - first - 1  # rows of sums
        coarse = _binned_to_8_bits(image[first * scale : last * scale, : columns * scale], grey, first)
        cv2.add(coarse[1:], coarse[:-1], pairs[:n])
        cv2.add(pairs[:n, 1:], pairs[:n, :-1], sums[:n, :-1])
        if len(grey.threshold) > 1:  # most sums become 0
            cv2.subtract(sums[:n], grey.threshold[first : first + n, :columns], sums[:n])
        else:
            cv2.threshold(sums[:n], float(grey.threshold[0]), 0.0, cv2.THRESH_TOZERO, sums[:n])
        cv2.dilate(sums[:n], NINE, maxima[:n])
        own = slice(top - first, top - first + _BAND_ROWS)
        sums[n:] = 0  # below the image
        words, around = _words(sums[own]), _words(maxima[own])
        (filled,) = (words != 0).nonzero()
        at_word.append(filled + top * columns // 8)
        sum_words.append(words[filled])
        maximum_words.append(around[filled])
    height, maximum = (np.concatenate(words).view(np.uint8) for words in (sum_words, maximum_words))
    (peak,) = ((height > 0) & (height == maximum)).nonzero()
    y, x = np.divmod(np.concatenate(at_word)[peak // 8] * 8 + peak % 8, columns)
    pixels = np.column_stack([x, y]) * scale + (scale - 1)
    return pixels if len(pixels) <= MAX_CANDIDATES else pixels[_highest(height[peak])]


def _grey_scale(image: NDArray[Any], background: Background, halvings: int) -> _GreyScale:
    """Scale for an image and its background: as many grey levels per sigma as the sky's range leaves room
    for.

    A sky too uneven for that is subtracted pixel by pixel, in floating point.
    """
    scale = 2**halvings
    noise = median_of(background.noise_dn)
    low, high = float(background.level_dn.min()), float(background.level_dn.max())
    # means of four may be rounded to whole DN if the noise is larger; 16 bits are always fine enough
    whole = halvings > 0 and image.dtype == np.uint8 and float(background.noise_dn.min()) > _COARSE_NOISE_DN
    converted_after = min(halvings, 1) if whole or image.dtype == np.uint16 else 0
    gain = min(_LEVELS_PER_SIGMA / noise, 255.0 / (4.0 * (high - low) + _RANGE_SIGMA * noise))
    if whole and halvings == 1:
        gain = min(gain, 1.0)  # steps finer than whole DN add nothing
    uneven = image.dtype == np.float32 or gain * noise < LEAST_LEVELS_PER_SIGMA
    if uneven:
        gain, low, converted_after = _LEVELS_PER_SIGMA / noise, 0.0, halvings
    offset = gain * (SELDOM_SIGMA * noise - low)
    if gain == 1.0:
        offset = 0.0 if 4.0 * high < _DARK_LEVELS else float(np.floor(offset))
    noise2 = gain**2 * extended(background.noise_dn, continued=False) ** 2 / scale**2
    rounding2 = (gain**2 * 4.0 / scale**2 * whole + (gain != 1.0)) / 12.0
    sigma = 2.0 * np.sqrt(noise2 + rounding2)
    limits = extended(background.limits(_THRESHOLD_SIGMA, 4.0 * scale**2), continued=False)
    level = np.zeros(1) if uneven else gain * extended(background.level_dn)
    threshold = 4.0 * (level + offset) + 0.5 + limits * sigma  # 0.5: halves are rounded up
    shape = image.shape[0] // scale, image.shape[1] // scale
    limit = _threshold_levels(threshold, float(sigma.mean()), shape)  # varies by less: taken as constant
    sky = _enlarged(extended(background.level_dn), shape) if uneven else None
    return _GreyScale(gain, offset, halvings, converted_after, sky, limit)


def _threshold_levels(threshold: Floats, tolerance: float, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Thresholds of blocks (with their outer ring) as one grey level if they agree within `tolerance`,
    otherwise one for each pixel of `shape`, or a few more."""
    inner = np.clip(threshold[1:-1, 1:-1], 0.0, 255.0)
    if np.ptp(inner) < tolerance:
        return np.full(1, inner.mean()).astype(np.uint8)
    rows, columns = inner.shape
    tile = max(1, min(shape[0] // rows, shape[1] // columns) // _TILES_PER_BLOCK)
    limit: NDArray[Any] = np.clip(_enlarged(threshold, shape, tile), 0.0, 255.0).astype(np.uint8)
    large = (limit.shape[1] * tile, limit.shape[0] * tile)
    return np.asarray(cv2.resize(limit, large, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _binned_to_8_bits(band: NDArray[Any], grey: _GreyScale, first: int) -> NDArray[Any]:
    """A band of full-resolution rows as rows of the binned image, from `first` on, in 8 bits."""
    coarse: NDArray[Any] = band if grey.sky_dn is None else band.astype(np.float32)
    for k in range(grey.binnings + 1):
        if k > 0:
            size = (coarse.shape[1] // 2, coarse.shape[0] // 2)
            coarse = cv2.resize(coarse, size, interpolation=cv2.INTER_AREA)
        if k == grey.converted_after:
            coarse = _to_8_bits(coarse, grey, first)
    return coarse


def _to_8_bits(coarse: NDArray[Any], grey: _GreyScale, first: int) -> NDArray[Any]:
    if coarse.dtype == np.uint8 and grey.gain == 1.0:
        return coarse if grey.offset == 0.0 else cv2.subtract(coarse, np.full(1, -grey.offset))
    darkest = -grey.offset / grey.gain  # below, the conversion takes absolute values
    if grey.sky_dn is not None:
        coarse = np.maximum(coarse - grey.sky_dn[first : first + len(coarse)], darkest)
    elif darkest > 0.0:
        coarse = cv2.max(coarse, np.full(1, np.ceil(darkest)))
    return cv2.convertScaleAbs(coarse, alpha=grey.gain, beta=grey.offset)


def _enlarged(ringed: Floats, shape: tuple[int, int], tile: int = 1) -> NDArray[np.float32]:
    """A grid with its outer ring (`extended`), interpolated to one value per tile of an image of `shape`."""
    down, across = (
        _interpolation_weights(size, blocks - 2, tile).astype(np.float32)
        for size, blocks in zip(shape, ringed.shape)
    )
    return np.asarray(down @ ringed.astype(np.float32) @ across.T)


def _interpolation_weights(size: int, blocks: int, tile: int) -> Floats:
    """(tiles, blocks + 2) weights of the blocks in the value of each tile, linear between block centres."""
    middles = tile * (np.arange(-(-size // tile)) + 0.5)
    at = np.minimum(middles * blocks / size, blocks) + 0.5
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(blocks + 2))))


def _words(rows: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """The same memory, eight pixels per word: empty words are skipped at once."""
    return rows.ravel().view(np.uint64)


def _highest(height: NDArray[np.uint8]) -> Ints:
    """Rows of the `MAX_CANDIDATES` highest, ascending."""
    return np.sort(np.argsort(-height.astype(np.int16), kind="stable")[:MAX_CANDIDATES])
