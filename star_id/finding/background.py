"""Sky background of an image: level and noise by blocks.

A sparse sample of each block gives a histogram; its sigma-clipped mean and standard deviation (three sigmas,
iterated) are the block's level and noise, DN. Between block centres both are interpolated linearly and beyond
the outermost ones extrapolated, so gradients of stray light and vignetting leave no step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import CLIP_SIGMA, MAD_SIGMA, NOISIER
from boresight.star_id.finding.cut_sky import UNCUT, clipped_variance, cut_moments, limit_after_cut

__all__ = [
    "NEAR_PX",
    "Background",
    "background_image",
    "estimate_background",
    "estimate_backgrounds",
    "in_noise",
    "median_of",
]

# Pixels sampled along each side of a block: of 64 x 64 values the median is known to 1/50 of the noise,
# 1.25 / 64.
_SAMPLES_ACROSS_BLOCK = 64
# Side of the small blocks, px, where the sky is uneven within larger ones: nebulae, clouds (set by hand).
_SMALL_BLOCK_PX = 40.0
# Share of neighbouring pixels of one value from which an image has few grey levels, and quartiles of
# differences give no noise (a normal distribution of 2 levels a sigma has 0.14).
_ALIKE = 0.15
# Distance, px, of the pixels whose difference gives the noise: beyond the correlation of interpolated and
# compressed images.
NEAR_PX = 4
# Share of a block's pixels at the least value of the image from which its sky is cut off there; a whole
# normal distribution has far fewer (set by hand).
_CUT_OFF = 0.08
# Variance of a unit normal that is clipped so.
_CLIPPED_VARIANCE = clipped_variance(CLIP_SIGMA)


@record
class Background:
    """Sky level and noise on a grid of R x C blocks that divides the image evenly."""

    level_dn: Floats = array("R, C", "mean of the sky, DN")
    noise_dn: Floats = array(
        "R, C", "standard deviation of a pixel, DN; of independent pixels that disturb a star as much"
    )
    width_px: int = scalar("columns of the image")
    height_px: int = scalar("rows of the image")
    weights: Floats | None = scalar(
        "(2, 2) relative weights of the pixels of each 2 x 2 cell; None: alike", default=None
    )
    above_cut: Floats | None = array(
        "R, C", "sigmas from the least value up to the level; None: no block is cut off there", default=None
    )
    unusable: Bools | None = array(
        "H, W", "pixels that show no light of stars: hot, masked, on dead lines; None: none", default=None
    )
    rounding_dn: float = scalar(
        "standard deviation, DN, that the rounding of JPEG adds to the pixels of stars alone", default=0.0
    )
    correlation: float = scalar(
        "noise_dn over the scatter of single pixels: more than 1 where their noise is correlated", default=1.0
    )

    def at(self, xy_px: Floats) -> tuple[Floats, Floats]:
        """Level and noise (N,), (N,) in DN at pixels (N, 2), interpolated between block centres."""
        level, noise = self._between(xy_px, extended(self.level_dn), extended(self.noise_dn, continued=False))
        return level, noise

    def without(self, pixels: Bools | None) -> Background:
        """The background of an image of which some pixels (H, W), too, show no light of stars."""
        if pixels is None:
            return self
        return replace(self, unusable=pixels if self.unusable is None else self.unusable | pixels)

    @property
    def slope_dn(self) -> tuple[float, float]:
        """Change of the level by column and by row, DN a pixel, over the whole image: the median of that from
        block to block. A fit of a star with a constant sky would be displaced by it.
        """
        rows, columns = self.level_dn.shape
        across, down = (np.diff(self.level_dn, axis=axis) for axis in (1, 0))
        return (
            median_of(across) * columns / self.width_px if across.size else 0.0,
            median_of(down) * rows / self.height_px if down.size else 0.0,
        )

    def limits(self, sigmas: float, pixels: float) -> Floats:
        """(R, C) height over the level, in units of the noise, that a mean of so many pixels exceeds as
        rarely as a normal variable `sigmas`: that, but less where the sky is cut off."""
        if self.above_cut is None:
            return np.full(self.level_dn.shape, sigmas)
        return limit_after_cut(self.above_cut, sigmas, pixels)

    def limits_at(self, xy_px: Floats, sigmas: float, width_px: float) -> Floats:
        """(N,) that height at pixels (N, 2), for a Gaussian of `width_px` as matched filter."""
        if self.above_cut is None:
            return np.full(len(xy_px), sigmas)
        limits = self.limits(sigmas, 2.25 * np.pi * width_px**2)
        return self._between(xy_px, extended(limits, continued=False))[0]

    def above_cut_at(self, xy_px: Floats) -> Floats | None:
        """(N,) sigmas from the least value up to the sky at pixels (N, 2); None where nothing is cut off."""
        if self.above_cut is None:
            return None
        return self._between(xy_px, extended(self.above_cut, continued=False))[0]

    def _between(self, xy_px: Floats, *grids: Floats) -> list[Floats]:
        """Grids with a ring of blocks added (R + 2, C + 2), interpolated to pixels (N, 2): (N,) each."""
        rows, columns = self.level_dn.shape
        x, y = ((xy_px + 0.5) * [columns / self.width_px, rows / self.height_px] + 0.5).T
        x, y = np.minimum(np.maximum(x, 0.0), columns + 1.0), np.minimum(np.maximum(y, 0.0), rows + 1.0)
        i, j = np.minimum(y.astype(np.int64), rows), np.minimum(x.astype(np.int64), columns)
        a, b = y - i, x - j
        weights = np.array([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
        corners = i * (columns + 2) + j + np.array([[0], [1], [columns + 2], [columns + 3]])
        return [(grid.take(corners) * weights).sum(axis=0) for grid in grids]


def median_of(values: Floats) -> float:
    """The median of values (N,); numpy's takes ten times as long for a few hundred."""
    ordered, n = np.sort(values, axis=None), values.size
    return float(0.5 * (ordered[(n - 1) // 2] + ordered[n // 2]))


def estimate_background(image: NDArray[Any]) -> Background:
    """Background of a raw image (H, W), integer or floating; stars may cover a third of a block."""
    return estimate_backgrounds([image])[0]


def estimate_backgrounds(images: Sequence[NDArray[Any]]) -> list[Background]:
    """Backgrounds of raw images (H, W) of one size, all on one grid."""
    side = float(np.clip(min(images[0].shape) / 7.0, 48.0, 512.0))
    coarse = [_by_blocks(image, side) for image in images]
    between = [min(map(_noise_between_neighbours, (image, image.T))) for image in images]
    if all(
        np.sort(sky.noise_dn, axis=None)[int(0.75 * sky.noise_dn.size)] < NOISIER * noise
        for sky, noise in zip(coarse, between)
    ):
        return coarse
    return [_in_small_blocks(image, noise) for image, noise in zip(images, between)]


def _in_small_blocks(image: NDArray[Any], between: float) -> Background:
    """Background where the sky is uneven; `between` is the noise between neighbouring pixels, DN."""
    fine = _by_blocks(image, _SMALL_BLOCK_PX)
    most = np.maximum(NOISIER * between, _noise_in_blocks(image, fine.level_dn.shape))
    return replace(fine, noise_dn=np.minimum(fine.noise_dn, most))


def background_image(grid: Floats, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """A grid of blocks (R, C), level or noise, interpolated to the pixels of an image of `shape` (H, W)."""
    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(grid.astype(np.float32), size, interpolation=cv2.INTER_LINEAR), np.float32)


def in_noise(image: NDArray[Any], background: Background) -> NDArray[np.float32]:
    """The image (H, W) less its background, in units of its noise."""
    flat: NDArray[np.float32] = image.astype(np.float32)
    flat -= background_image(background.level_dn, image.shape)
    flat /= background_image(background.noise_dn, image.shape)
    return flat


def _noise_between_neighbours(image: NDArray[Any]) -> float:
    """Standard deviation of a pixel, DN, from differences of pixels near one another; inf where these do not
    tell, in a sky that is cut off or has few grey levels."""
    down, across = (max(1, size // most) for size, most in zip(image.shape, (64, 128)))
    few = image[::down, :-NEAR_PX:across].astype(np.float32)
    difference = np.abs(image[::down, NEAR_PX::across] - few)
    if np.mean(difference == 0.0) > _ALIKE:
        return np.inf
    middle = difference.size // 2
    return max(np.sqrt(0.5) * MAD_SIGMA * float(np.partition(difference, middle, axis=None)[middle]), 0.3)


def _noise_in_blocks(image: NDArray[Any], blocks: tuple[int, ...]) -> Floats:
    """Standard deviation (R, C) of a pixel, DN, in each of so many blocks, from the same differences: photon
    noise is larger where the sky is brighter."""
    rows, columns = (size // count for size, count in zip(image.shape, blocks))
    parts = image[: blocks[0] * rows, : blocks[1] * columns].astype(np.float32)
    parts = parts.reshape(blocks[0], rows, blocks[1], columns)
    difference = np.abs(parts[..., NEAR_PX:] - parts[..., :-NEAR_PX])
    return np.asarray(np.sqrt(0.5) * MAD_SIGMA * np.median(difference, axis=(1, 3)), dtype=float)


def _by_blocks(image: NDArray[Any], side: float) -> Background:
    """Background in blocks of `side`, px, or a little more."""
    height, width = image.shape
    rows, columns = max(1, round(height / side)), max(1, round(width / side))
    step = max(1, int(min(height / rows, width / columns) // _SAMPLES_ACROSS_BLOCK))
    step_x, step_y = (step // 2, 2 * step) if step >= 4 else (step, step)  # whole cache lines are read
    sample = np.ascontiguousarray(image[step_y // 2 :: step_y, step_x // 2 :: step_x])
    if sample.dtype not in (np.uint8, np.uint16, np.float32):
        sample = sample.astype(np.float32)
    low, high, bins = _histogram_range(sample)
    edges_y = np.linspace(0, sample.shape[0], rows + 1).round().astype(int)
    edges_x = np.linspace(0, sample.shape[1], columns + 1).round().astype(int)
    blocks = (sample[y0:y1, x0:x1] for y0, y1 in pairwise(edges_y) for x0, x1 in pairwise(edges_x))
    counts = [cv2.calcHist([block], [0], None, [bins], [low, high]).ravel() for block in blocks]
    width_bin = (high - low) / bins
    offset = 0.0 if np.issubdtype(sample.dtype, np.integer) and width_bin == 1.0 else 0.5
    by_block: Ints = np.array(counts, dtype=np.int32)  # their sums are ten times as fast as of floats
    value: Floats = np.asarray(low + (np.arange(bins) + offset) * width_bin)
    level, noise = _clipped_moments(by_block, value, width_bin)
    least = int(by_block.any(axis=0).argmax())
    above = None
    if (cut := by_block[:, least] > _CUT_OFF * by_block.sum(axis=1)).any():
        above = np.full(len(cut), UNCUT)
        level[cut], noise[cut], above[cut] = cut_moments(
            by_block[cut, least:], value[least:], level[cut], noise[cut]
        )
    return Background(
        _without_outliers(level.reshape(rows, columns)),
        _without_outliers(noise.reshape(rows, columns)),
        width,
        height,
        above_cut=None if above is None else _without_outliers(above.reshape(rows, columns)),
    )


def extended(grid: Floats, *, continued: bool = True) -> Floats:
    """Grid (R + 2, C + 2) with a ring of blocks added: extrapolated linearly if `continued`, else repeated
    (noise must not become negative)."""
    padded = np.empty((grid.shape[0] + 2, grid.shape[1] + 2))
    padded[1:-1, 1:-1] = grid
    padded[0, 1:-1], padded[-1, 1:-1] = grid[0], grid[-1]
    padded[:, 0], padded[:, -1] = padded[:, 1], padded[:, -2]
    if continued and grid.shape[0] > 1:
        padded[0], padded[-1] = 2 * padded[1] - padded[2], 2 * padded[-2] - padded[-3]
    if continued and grid.shape[1] > 1:
        padded[:, 0], padded[:, -1] = 2 * padded[:, 1] - padded[:, 2], 2 * padded[:, -2] - padded[:, -3]
    return padded


def _histogram_range(sample: NDArray[Any]) -> tuple[float, float, int]:
    if sample.dtype == np.uint8:
        return 0.0, 256.0, 256
    few = np.sort(sample.ravel()[:: max(1, sample.size // 20000)].astype(np.float32))  # faster than integers
    low, middle, high = (float(few[int(q * (len(few) - 1))]) for q in (0.002, 0.5, 0.98))
    low, high = np.floor(low - 0.1 * (middle - low)), np.ceil(high + (high - middle) + 1.0)
    bins = 2048
    if np.issubdtype(sample.dtype, np.integer):
        width = max(1.0, np.ceil((high - low) / bins))
        return low, low + width * bins, bins
    single = np.float32(low)  # the histogram's limits are single precision
    return low, max(high, float(np.nextafter(single, np.float32(np.inf)))), bins


def _clipped_moments(counts: Ints, value: Floats, width: float) -> tuple[Floats, Floats]:
    """Sigma-clipped mean and standard deviation (B,), (B,) of histograms (B, bins); bins at the limits count
    in part."""
    total = np.cumsum(counts, axis=1, dtype=np.int32)
    n = np.maximum(total[:, -1:], 1.0)

    def quantile(q: float) -> Floats:
        k = np.minimum((total < q * n).sum(axis=1), len(value) - 1)
        inside = np.maximum(np.take_along_axis(counts, k[:, None], 1)[:, 0], 1e-9)
        before = np.take_along_axis(total, k[:, None], 1)[:, 0] - inside
        return value[k] + width * ((q * n[:, 0] - before) / inside - 0.5)

    level = quantile(0.5)
    sigma = np.maximum((level - quantile(0.1587)), 0.3 * width)
    used = _bins_within(value, level, 3.0 * CLIP_SIGMA * sigma)
    counts, value = counts[:, used], value[used]
    for _ in range(4):
        inside = (CLIP_SIGMA * sigma[:, None] - np.abs(value - level[:, None])) / width + 0.5
        weight = counts * np.minimum(np.maximum(inside, 0.0), 1.0)
        n_in = np.maximum(weight.sum(axis=1), 1e-9)
        level = weight @ value / n_in
        spread = weight @ value**2 / n_in - level**2
        sigma = np.sqrt(np.maximum(spread, 0.0) / _CLIPPED_VARIANCE)
        sigma = np.maximum(sigma, 0.3 * width)
    return level, sigma


def _bins_within(value: Floats, level: Floats, reach: Floats) -> slice:
    """The bins within `reach` of the level of any block."""
    low, high = np.searchsorted(value, [(level - reach).min(), (level + reach).max()])
    return slice(max(int(low) - 1, 0), int(high) + 1)


def _without_outliers(grid: Floats) -> Floats:
    """The grid with outlying blocks (a bloom, the Moon) replaced by the median of their neighbours."""
    if min(grid.shape) < 3:
        return grid
    median = cv2.medianBlur(extended(grid).astype(np.float32), 3).astype(float)[1:-1, 1:-1]
    off = np.abs(grid - median)
    return np.where(off > 6.0 * median_of(off) + 0.02 * np.abs(median), median, grid)
