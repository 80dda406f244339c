"""Noise of images that were compressed, enlarged or made of colours: correlated from pixel to pixel.

Means of pixels, as in a matched filter, then scatter more than the scatter of single pixels lets expect: by
the factor 1.3 in a JPEG image of quality 90, by 10 at quality 40, where most blocks of 8 x 8 pixels are flat.
Where adjacent pixels are more alike than pixels some distance apart, this scatter is measured in the filtered
image itself: how far it reaches below the sky, which no star does. The noise that the image is then treated
with is that of independent pixels which would disturb a star as much. Where many blocks were rounded until
they are flat, those with stars were rounded as coarsely, which adds to the noise of their pixels alone.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from boresight.records.record import Bools, Floats
from boresight.star_id.beyond_chance import CLIP_SIGMA, SELDOM_SIGMA
from boresight.star_id.finding.background import NEAR_PX, Background, in_noise, median_of
from boresight.star_id.finding.cut_sky import FARTHEST_SIGMA, UNCUT
from boresight.star_id.finding.psf import USUAL_SIGMA_PX

__all__ = ["as_independent_noise", "rounding_of_blocks"]

# Rows, in which neighbouring pixels are compared (set by hand: the ratio is then known to 1 %).
_LINES = 16
# Mean difference of adjacent pixels over that of pixels apart, below which noise is correlated: 1 for
# independent noise, 0.8 in JPEG of quality 90.
_ALIKE = 0.92
# Largest difference that counts, at least, DN: in fewer grey levels a star's slope is larger.
_LARGEST_DN = 2.0
# Tiles along each side of the image in which it is measured; of all the lower quartile counts, since roofs,
# trees and dark clouds reach below the sky, too.
_TILES, _COUNTED = 4, 0.25
# Side of the blocks of JPEG, px (ITU-T T.81), and share of them that is flat in an image of few other blocks
# (set by hand).
_BLOCK_PX, _MANY_FLAT = 8, 0.3
# Factor from which it is applied: beyond what its own error makes of 1 (0.05).
_LEAST_FACTOR = 1.15


def rounding_of_blocks(image: NDArray[Any]) -> float:
    """Standard deviation, DN, that the rounding of JPEG adds to a pixel of blocks that are not flat, in an
    image (H, W) of many flat ones; 0 if few are.

    The mean of a block is its first cosine coefficient over 8. Coefficients that hold a star's light are
    rounded by about the same step, and an error of all 64 has the same variance in pixels.
    """
    if (column := _begin_of_blocks(image.T)) is None or (row := _begin_of_blocks(image)) is None:
        return 0.0
    image = image[row:, column:]
    rows, columns = (side // _BLOCK_PX for side in image.shape)
    blocks = image[: rows * _BLOCK_PX, : columns * _BLOCK_PX].reshape(rows, _BLOCK_PX, columns, _BLOCK_PX)
    corner, others = blocks[:, 0, :, 0], (blocks[:, 0, :, -1], blocks[:, -1, :, -1])
    if any(np.mean(corner == other) < _MANY_FLAT for other in others):  # in flat ones they are equal
        return 0.0
    least = blocks.min(axis=(1, 3))
    flat = least == blocks.max(axis=(1, 3))
    if np.mean(flat) < _MANY_FLAT:
        return 0.0
    return _BLOCK_PX * _step_of_means(least, flat, blocks.mean(axis=(1, 3))[~flat]) / 12.0**0.5


def _begin_of_blocks(lines: NDArray[Any]) -> int | None:
    """The first of lines (L, N) with which a block begins: there fewest neighbours are equal. None if too few
    are for many flat blocks. Of long lines some 512 pixels are looked at.
    """
    thin = lines[:, :: 1 + lines.shape[1] // 512]
    same = thin[1:] == thin[:-1]
    if np.count_nonzero(same) < 0.5 * _MANY_FLAT * same.size:
        return None
    alike = np.count_nonzero(same, axis=1)
    return int(np.argmin([alike[(line - 1) % _BLOCK_PX :: _BLOCK_PX].mean() for line in range(_BLOCK_PX)]))


def _step_of_means(level_dn: NDArray[Any], flat: Bools, mean_dn: Floats) -> float:
    """Step, DN, to which JPEG rounds the means of blocks; 0 where none is seen.

    Flat blocks (R, C) beside one another have levels that differ by it, in whole counts; the means of the
    other blocks (N,) by it to a twentieth of a count."""
    before, after = level_dn[:, :-1], level_dn[:, 1:]
    seen = flat[:, :-1] & flat[:, 1:] & (before != after)
    levels = np.unique(np.append(before[seen], after[seen]))
    if not len(levels):
        return 0.0
    rough = float(np.median(np.diff(levels)))
    mean_dn = np.sort(mean_dn)
    cluster = np.append(0, np.cumsum(np.diff(mean_dn) > 0.5 * rough))[: len(mean_dn)]
    apart = np.diff(np.bincount(cluster, mean_dn) / np.bincount(cluster))
    single = apart[np.rint(apart / rough) == 1.0]
    return float(np.median(single)) if len(single) else rough


def as_independent_noise(image: NDArray[Any], background: Background) -> Background:
    """The background of an image (H, W) with its noise increased to that of independent pixels that disturb a
    star as much; itself where the noise is not correlated, or where few grey levels do not show it.

    Means of correlated pixels of a sky that is cut off are scattered upwards alone: there the noise is
    measured above the sky, from the median of the means, and the sky is taken as whole."""
    is_cut = background.above_cut is not None
    few_levels = background.above_cut is not None and median_of(background.above_cut) >= UNCUT
    if few_levels or not _is_correlated(image, background):
        return background
    taps = np.asarray(
        cv2.getGaussianKernel(2 * ceil(CLIP_SIGMA * USUAL_SIGMA_PX) + 1, USUAL_SIGMA_PX), dtype=np.float64
    )
    taps = taps / np.linalg.norm(taps)
    height = np.asarray(cv2.sepFilter2D(in_noise(image, background), cv2.CV_32F, taps, taps), np.float32)
    tiles = [tile for band in np.array_split(height, _TILES) for tile in np.array_split(band, _TILES, axis=1)]
    below = CLIP_SIGMA if background.rounding_dn else SELDOM_SIGMA  # farther out: one coefficient is left
    middle, far = np.array(
        [np.quantile(tile, [0.5, ndtr(FARTHEST_SIGMA if is_cut else -below)]) for tile in tiles]
    ).T
    reach = (far - middle) / FARTHEST_SIGMA if is_cut else -far / below
    factor = float(np.quantile(reach, _COUNTED))
    if factor < _LEAST_FACTOR:
        return background
    noise = factor * background.noise_dn
    if is_cut:
        level = background.level_dn + background.noise_dn * float(np.median(middle)) / taps.sum() ** 2
        return replace(background, level_dn=level, noise_dn=noise, above_cut=None, correlation=factor)
    return replace(background, noise_dn=noise, correlation=factor)


def _is_correlated(image: NDArray[Any], background: Background) -> bool:
    """Whether adjacent pixels are more alike than pixels apart."""
    rows = np.linspace(0, len(image) - 1 - NEAR_PX, _LINES).astype(np.int64)
    start, below, far_below = (image[rows + k].astype(np.float32) for k in (0, 1, NEAR_PX))
    largest = max(SELDOM_SIGMA * median_of(background.noise_dn), _LARGEST_DN)

    def mean(difference: NDArray[np.float32]) -> float:
        return float(np.minimum(np.abs(difference), largest).mean())

    near = mean(start[:, 1:] - start[:, :-1]) + mean(below - start)
    apart = mean(start[:, NEAR_PX:] - start[:, :-NEAR_PX]) + mean(far_below - start)
    return near < _ALIKE * apart
