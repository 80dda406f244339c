"""Where in an image a star may be: a coarse search whose vector instructions touch each pixel a few times.

The image is halved, brought to 8 bits with the noise at a level or two, and summed over squares of two by two
of its pixels: for stars as wide as a pixel or two that is close to the matched filter. Local maxima at a low
threshold remain, some thousands of places for `detect` to judge. All goes band by band of rows that stay in
the processor's cache.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.star_id.finding.background import Background, extended

__all__ = ["find_candidates"]

Array = NDArray[np.float64]

_SEARCH_SIGMA = 3.7  # a star of SNR 8 midway between coarse pixels still shows 5.5 in one of four sums
_LEVELS_PER_SIGMA = 4.0  # grey levels for the noise of a pixel, half as many for the mean of four
_LEAST_LEVELS_PER_SIGMA = 1.5  # less than this and rounding to 8 bits costs sensitivity
_SKY_SIGMA = 4.0  # the darkest sky stands so many sigmas of a pixel above 0
_ROOM_SIGMA = 28.0  # sigmas of a pixel that a sum of four has room for: 16 below the sky, 12 above
_DARK_LEVELS = 128.0  # a sum of four from a sky darker than this has room enough as it is
_COARSE_NOISE_DN = 1.2  # sky noise from which rounding means of four pixels to whole numbers costs little
_EVEN_SIGMA = 1.0  # a threshold that varies by no more over the image is taken as constant
_TILES_ACROSS_BLOCK = 32  # of the background: as many steps an uneven threshold takes
_MAX_CANDIDATES = 20_000
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_BAND_ROWS = 64  # of the halved image


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """How grey values become 8 bits with the sky near the bottom: gain * (value - sky) + offset."""

    gain: float
    offset: float
    halvings: int
    after: int  # how many of the halvings come before
    sky_dn: NDArray[np.float32] | None  # of the coarse image; None: a number, held in the offset, will do
    threshold: NDArray[np.uint8]  # that sums of four must exceed: (1,), or as large as the coarse image


def find_candidates(image: NDArray, background: Background, *, halvings: int = 1) -> NDArray[np.int64]:
    """Full-resolution places (N, 2) near the local maxima of the image halved `halvings` times and summed
    over 2 x 2 of its pixels: a star's middle lies within 2^halvings - 1 pixels of one, or one more towards
    +x or +y.
    """
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        image = image.astype(np.float32)
    scale = 2**halvings
    rows, columns = image.shape[0] // scale, image.shape[1] // scale
    stretch = _stretch(image, background, halvings)
    pairs, sums, crests = (np.zeros((_BAND_ROWS + 2, columns), np.uint8) for _ in range(3))
    where, heights, around = [], [], []
    for top in range(0, rows - 1, _BAND_ROWS):
        first, last = max(0, top - 1), min(rows, top + _BAND_ROWS + 2)
        n = last - first - 1  # of sums
        coarse = _grey(image[first * scale : last * scale, : columns * scale], stretch, first)
        cv2.add(coarse[1:], coarse[:-1], pairs[:n])
        cv2.add(pairs[:n, 1:], pairs[:n, :-1], sums[:n, :-1])
        level = stretch.threshold
        if len(level) > 1:
            level = level[first : first + n, :columns]
        cv2.subtract(sums[:n], level, sums[:n])  # what stays below the threshold becomes 0, and that is most
        cv2.dilate(sums[:n], _NEIGHBOURS, crests[:n])
        own = slice(top - first, top - first + _BAND_ROWS)
        sums[n:] = 0  # below the image
        height, crest = _words(sums[own]), _words(crests[own])
        (filled,) = (height != 0).nonzero()
        where.append(filled + top * columns // 8)
        heights.append(height[filled])
        around.append(crest[filled])
    height, crest = (np.concatenate(words).view(np.uint8) for words in (heights, around))
    (k,) = ((height > 0) & (height == crest)).nonzero()
    y, x = np.divmod(np.concatenate(where)[k // 8] * 8 + k % 8, columns)
    places = np.column_stack([x, y]) * scale + (scale - 1)
    return places if len(places) <= _MAX_CANDIDATES else places[_highest(height[k])]


def _stretch(image: NDArray, background: Background, halvings: int) -> _Stretch:
    scale = 2**halvings
    noise = float(np.median(background.noise_dn))
    low, high = float(background.level_dn.min()), float(background.level_dn.max())
    # means of four are rounded to whole DN where noise covers that; 16 bits are always fine enough
    whole = image.dtype == np.uint8 and float(background.noise_dn.min()) > _COARSE_NOISE_DN
    after = 1 if whole or image.dtype == np.uint16 else 0
    gain = min(_LEVELS_PER_SIGMA / noise, 255.0 / (4.0 * (high - low) + _ROOM_SIGMA * noise))
    if whole and halvings == 1:
        gain = min(gain, 1.0)  # finer steps than whole DN would tell nothing
    steep = image.dtype == np.float32 or gain * noise < _LEAST_LEVELS_PER_SIGMA
    if steep:
        gain, low, after = _LEVELS_PER_SIGMA / noise, 0.0, halvings
    offset = gain * (_SKY_SIGMA * noise - low)
    if gain == 1.0:
        offset = 0.0 if 4.0 * high < _DARK_LEVELS else float(np.floor(offset))
    noise2 = gain**2 * extended(background.noise_dn, continued=False) ** 2 / scale**2
    rounding2 = (gain**2 * 4.0 / scale**2 * whole + (gain != 1.0)) / 12.0
    sigma = 2.0 * np.sqrt(noise2 + rounding2)
    level = np.zeros(1) if steep else gain * extended(background.level_dn)
    threshold = 4.0 * (level + offset) + 0.5 + _SEARCH_SIGMA * sigma  # 0.5: halves are rounded up
    shape = image.shape[0] // scale, image.shape[1] // scale
    limit = _limit(threshold, _EVEN_SIGMA * float(sigma.mean()), shape)
    sky = _enlarged(extended(background.level_dn), shape) if steep else None
    return _Stretch(gain, offset, halvings, after, sky, limit)


def _limit(threshold: Array, tolerance: float, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """The thresholds at blocks, with their outer ring, as one number or one for each pixel."""
    inner = np.clip(threshold[1:-1, 1:-1], 0.0, 255.0)
    if np.ptp(inner) < tolerance:
        return np.full(1, inner.mean()).astype(np.uint8)
    rows, columns = inner.shape
    tile = max(1, min(shape[0] // rows, shape[1] // columns) // _TILES_ACROSS_BLOCK)
    limit: NDArray = np.clip(_enlarged(threshold, shape, tile), 0.0, 255.0).astype(np.uint8)
    large = (limit.shape[1] * tile, limit.shape[0] * tile)
    return np.asarray(cv2.resize(limit, large, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _grey(band: NDArray, stretch: _Stretch, first: int) -> NDArray:
    """Rows of the coarse image, from `first` on, in 8 bits."""
    coarse: NDArray = band if stretch.sky_dn is None else band.astype(np.float32)
    for k in range(stretch.halvings + 1):
        if k > 0:
            size = (coarse.shape[1] // 2, coarse.shape[0] // 2)
            coarse = cv2.resize(coarse, size, interpolation=cv2.INTER_AREA)
        if k == stretch.after:
            coarse = _eight_bits(coarse, stretch, first)
    return coarse


def _eight_bits(coarse: NDArray, stretch: _Stretch, first: int) -> NDArray:
    if coarse.dtype == np.uint8 and stretch.gain == 1.0:
        return coarse if stretch.offset == 0.0 else cv2.subtract(coarse, np.full(1, -stretch.offset))
    if stretch.sky_dn is not None:
        darkest = -stretch.offset / stretch.gain
        coarse = np.maximum(coarse - stretch.sky_dn[first : first + len(coarse)], darkest)
    return cv2.convertScaleAbs(coarse, alpha=stretch.gain, beta=stretch.offset)


def _enlarged(ringed: Array, shape: tuple[int, int], tile: int = 1) -> NDArray[np.float32]:
    """A grid with its outer ring (`extended`), interpolated to one value for each tile of an image of
    `shape`."""
    down, across = (
        _shares(size, blocks - 2, tile).astype(np.float32) for size, blocks in zip(shape, ringed.shape)
    )
    return np.asarray(down @ ringed.astype(np.float32) @ across.T)


def _shares(size: int, blocks: int, tile: int) -> Array:
    """(tiles, blocks + 2) shares of the blocks in the value of each tile, linear between their middles."""
    middles = tile * (np.arange(-(-size // tile)) + 0.5)
    at = np.minimum(middles * blocks / size, blocks) + 0.5
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(blocks + 2))))


def _words(rows: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """The same memory, eight pixels a word; `_BAND_ROWS` is a multiple of eight."""
    return rows.ravel().view(np.uint64)


def _highest(height: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Rows of the highest, in order."""
    return np.sort(np.argpartition(-height.astype(np.int16), _MAX_CANDIDATES)[:_MAX_CANDIDATES])
