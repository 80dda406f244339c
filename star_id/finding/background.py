"""Sky background of an image: level and noise by blocks.

A sparse sample of each block gives a histogram; its sigma-clipped mean and standard deviation (three sigmas,
iterated) are the block's level and noise, DN. Between block centres both are interpolated linearly and beyond
the outermost ones extrapolated, so gradients of stray light and vignetting leave no step.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.geometry.record import Floats, array, record, scalar

__all__ = ["Background", "estimate_background"]


_SAMPLES_ACROSS_BLOCK = 64  # 4096 values a block: the level is known to 1/50 of a sigma
_CLIP_SIGMA = 3.0
_CLIPPED_VARIANCE = 0.973337  # variance of a unit normal within 3 sigma of its mean


@record
class Background:
    """Sky level and noise on a grid of R x C blocks that divides the image evenly."""

    level_dn: Floats = array("R, C", "mean of the sky, DN")
    noise_dn: Floats = array("R, C", "standard deviation of a pixel, DN")
    width_px: int = scalar("columns of the image")
    height_px: int = scalar("rows of the image")

    def at(self, xy_px: Floats) -> tuple[Floats, Floats]:
        """Level and noise (N,), (N,) in DN at pixels (N, 2), interpolated between block centres."""
        rows, columns = self.level_dn.shape
        x = np.clip((xy_px[:, 0] + 0.5) * (columns / self.width_px) + 0.5, 0.0, columns + 1.0)
        y = np.clip((xy_px[:, 1] + 0.5) * (rows / self.height_px) + 0.5, 0.0, rows + 1.0)
        i, j = np.minimum(y.astype(int), rows), np.minimum(x.astype(int), columns)
        corner, a, b = i * (columns + 2) + j, y - i, x - j
        weights = ((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b)
        steps = (0, 1, columns + 2, columns + 3)
        grids = extended(self.level_dn).ravel(), extended(self.noise_dn, continued=False).ravel()
        level, noise = (sum(grid[corner + k] * w for k, w in zip(steps, weights)) for grid in grids)
        return level, noise


def estimate_background(image: NDArray) -> Background:
    """Background of a raw image (H, W), integer or floating; stars may cover a third of a block."""
    height, width = image.shape
    side = float(np.clip(min(height, width) / 7.0, 48.0, 512.0))
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
    counts = np.stack(
        [cv2.calcHist([block], [0], None, [bins], [low, high]).ravel() for block in blocks], axis=1
    )
    width_bin = (high - low) / bins
    offset = 0.0 if np.issubdtype(sample.dtype, np.integer) and width_bin == 1.0 else 0.5
    level, noise = _clipped_moments(
        np.asarray(counts.T, dtype=float, order="C"),
        np.asarray(low + (np.arange(bins) + offset) * width_bin),
        width_bin,
    )
    return Background(
        _without_outliers(level.reshape(rows, columns)),
        _without_outliers(noise.reshape(rows, columns)),
        width,
        height,
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


def _histogram_range(sample: NDArray) -> tuple[float, float, int]:
    if sample.dtype == np.uint8:
        return 0.0, 256.0, 256
    few = np.sort(sample.ravel()[:: max(1, sample.size // 20000)])
    low, middle, high = (float(few[int(q * (len(few) - 1))]) for q in (0.002, 0.5, 0.98))
    low, high = np.floor(low - 0.1 * (middle - low)), np.ceil(high + (high - middle) + 1.0)
    bins = 2048
    if np.issubdtype(sample.dtype, np.integer):
        width = max(1.0, np.ceil((high - low) / bins))
        return low, low + width * bins, bins
    return low, max(high, np.nextafter(low, np.inf)), bins


def _clipped_moments(counts: Floats, value: Floats, width: float) -> tuple[Floats, Floats]:
    """Sigma-clipped mean and standard deviation (B,), (B,) of histograms (B, bins); bins at the limits count
    in part."""
    total = np.cumsum(counts, axis=1)
    n = np.maximum(total[:, -1:], 1.0)

    def quantile(q: float) -> Floats:
        k = np.minimum((total < q * n).sum(axis=1), len(value) - 1)
        inside = np.maximum(np.take_along_axis(counts, k[:, None], 1)[:, 0], 1e-9)
        before = np.take_along_axis(total, k[:, None], 1)[:, 0] - inside
        return value[k] + width * ((q * n[:, 0] - before) / inside - 0.5)

    level = quantile(0.5)
    sigma = np.maximum((level - quantile(0.1587)), 0.3 * width)
    used = _bins_within(value, level, 3.0 * _CLIP_SIGMA * sigma)
    counts, value = counts[:, used], value[used]
    for _ in range(4):
        reach = _CLIP_SIGMA * sigma[:, None]
        upper = np.clip((level[:, None] + reach - value) / width + 0.5, 0.0, 1.0)
        lower = np.clip((value - level[:, None] + reach) / width + 0.5, 0.0, 1.0)
        weight = counts * upper * lower
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
    return np.where(off > 6.0 * np.median(off) + 0.02 * np.abs(median), median, grid)
