"""Detection of stars at candidate pixels by the matched filter at full resolution.

The filter is a Gaussian integrated over pixels; its noise is known, so the threshold follows from the
accepted number of false alarms. Rejected are: peaks that a single bright pixel explains (hot pixels), peaks
on a plateau as bright as their surroundings (a roof, a cloud), and peaks in the wings of a brighter star.

Hot and dead pixels of a sensor that has many are found before stars are, replaced, and without weight in the
fits. The median of a pixel's four neighbours is not far below it wherever a star lies, since the optics
spread its light. A pixel that is higher than any star makes it beside such neighbours is hot; one far below
the sky is dead.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import erf

from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import CLIP_SIGMA, NEVER_SIGMA, SELDOM_SIGMA
from boresight.star_id.finding.background import Background, background_image
from boresight.star_id.finding.lines import SPARSE
from boresight.star_id.finding.windows import AT_ONCE, windows_at

__all__ = [
    "WINGS",
    "Detections",
    "detect",
    "detection_threshold",
    "has_many_dead_pixels",
    "without_bad_pixels",
]

Pixels = NDArray[np.float32]

# Radius of the matched filter, widths of the PSF: holds 99 % of the signal-to-noise ratio.
_TAPS_SIGMA = 1.8
# Light of a pixel's four neighbours together over its own, below which it is hot: of stars only those
# narrower than 0.35 px have less.
_CROSS_OF_PEAK = 0.35
# Share of a peak that must remain above the level of the ring around it: else it is structure of the sky
# (set by hand).
_LEAST_ABOVE_RING = 0.5
# Radius of that ring, widths of the PSF: a star's own light is 0.2 % of its peak there.
_RING_SIGMA = 3.5
# A peak lower than so many times a brighter star's wings at its place is part of them (set by hand).
WINGS = 1.3
# Factor on the height that a star in the middle of a pixel has beside its neighbours: pixels differ in
# response (set by hand).
_UNEVEN = 1.4


@record
class Detections:
    """Peaks of the matched filter above its threshold, the highest above their surroundings first."""

    xy_px: Ints = array("N, 2", "pixel of the peak as (column, row)")
    offset_px: Floats = array("N, 2", "from there to the vertex of a parabola, px")
    hot_pixels: int = scalar("peaks rejected because a single pixel explains them")


@record
class _Filtered:
    """Windows around candidates, and their filtered values at `shifts` x `shifts` positions each."""

    windows: Pixels  # (N, side^2) DN above the background
    flux: Pixels  # (N, shifts^2) DN, least squares
    kernel: Pixels  # (side^2, shifts^2)
    noise: Floats  # (N,) of a pixel
    shifts: int

    def peaks(self, rows: Ints | slice) -> tuple[Ints, Pixels]:
        """Position and value of the maximum in each of `rows`."""
        flux = self.flux[rows]
        best = flux.argmax(axis=1)
        return best, flux[np.arange(len(flux)), best]


def detection_threshold(n_px: int, psf_sigma_px: float, false_alarms: float) -> float:
    """Height, in sigmas of the matched filter, that `false_alarms` peaks of pure noise exceed in `n_px`
    pixels.

    White noise filtered by a Gaussian of width s has peaks above v with density v exp(-v^2/2) / (2 s^2 (2
    pi)^1.5) per pixel (Adler 1981, The Geometry of Random Fields, expected Euler characteristic).
    """
    density = false_alarms / n_px * 2.0 * psf_sigma_px**2 * (2.0 * np.pi) ** 1.5
    v = 5.0
    for _ in range(20):
        v = math.sqrt(2.0 * math.log(max(v / density, 1.5)))
    return max(v, 3.0)


def detect(
    image: NDArray[Any],
    background: Background,
    candidates: Ints,
    *,
    psf_sigma_px: float,
    threshold: float,
    reach_px: int = 1,
) -> Detections:
    """Peaks of the matched filter within `reach_px` of `candidates` (N, 2), or one more towards +x or +y.

    `psf_sigma_px` is the width of a Gaussian star integrated over pixels; the noise is the background's, and
    `threshold` in its sigmas, lower where the sky is cut off.
    """
    taps = _pixel_gaussian(psf_sigma_px)
    first, shifts = len(taps) // 2 + reach_px, 2 * reach_px + 2
    side = len(taps) + shifts - 1
    candidates = candidates[_inside(candidates, image, first, side - first)]
    level, noise = background.at(candidates.astype(float))
    windows: Pixels = windows_at(image, candidates - first, side).reshape(-1, side**2).astype(np.float32)
    windows -= level[:, None].astype(np.float32)
    kernel = _shifted_kernels(taps, shifts)
    filtered = _Filtered(windows, _product(windows, kernel), kernel, noise, shifts)
    unit = float((taps**2).sum())  # flux times this over the noise is the signal-to-noise ratio
    best, peak = filtered.peaks(slice(None))
    least = background.limits_at(candidates.astype(float), threshold, psf_sigma_px) * noise
    high = np.flatnonzero(peak * unit > least)
    hot = high[_repair_hot_pixels(filtered, high, best[high])]
    best[hot], peak[hot] = filtered.peaks(hot)
    keep = high[peak[high] * unit > least[high]]
    is_hot = np.zeros(len(candidates), dtype=bool)
    is_hot[hot] = True
    repaired = is_hot[keep]
    best, peak = best[keep], peak[keep]
    snr = peak * unit / noise[keep]
    row, column = np.divmod(best, shifts)
    xy = candidates[keep] + np.column_stack([column, row]) - reach_px
    around = _ring_dn(image, xy, psf_sigma_px) - level[keep]
    above_ring = snr - around * (taps.sum() ** 2 / unit) / noise[keep]
    good = (above_ring > _LEAST_ABOVE_RING * snr) & ~(repaired & _hot_pixels(filtered, keep, best)[0])
    order = np.flatnonzero(good)
    order = order[np.argsort(-above_ring[order], kind="stable")]
    order = order[_outside_wings(xy[order], snr[order], psf_sigma_px)]
    return Detections(
        xy[order],
        _parabola(filtered.flux[keep[order]].reshape(-1, shifts, shifts), row[order], column[order]),
        len(hot) - int(np.count_nonzero(good & repaired)),
    )


def _inside(xy: Ints, image: NDArray[Any], before: int, after: int) -> Bools:
    """(N,) whether the image has so many pixels before and from each pixel on, along both axes."""
    x, y = xy.T
    height, width = image.shape
    return np.asarray((x >= before) & (y >= before) & (x <= width - after) & (y <= height - after))


def _product(windows: Pixels, kernel: Pixels) -> Pixels:
    """Matrix product a few rows at a time: they stay in the cache, and are too few for BLAS to start
    threads."""
    flux = np.empty((len(windows), kernel.shape[1]), dtype=np.float32)
    for k in range(0, len(windows), AT_ONCE):
        np.matmul(windows[k : k + AT_ONCE], kernel, out=flux[k : k + AT_ONCE])
    return flux


def _repair_hot_pixels(filtered: _Filtered, rows: Ints, best: Ints) -> Bools:
    """Which of the peaks at `best` of `rows` a hot pixel makes; it is replaced, in place, by the mean of its
    neighbours in the windows and so in the filtered values."""
    hot, pixel, mean = _hot_pixels(filtered, rows, best)
    rows, pixel, mean = rows[hot], pixel[hot], mean[hot]
    excess = filtered.windows[rows, pixel] - mean
    filtered.windows[rows, pixel] = mean
    filtered.flux[rows] -= excess[:, None] * filtered.kernel[pixel]
    return hot


def _hot_pixels(filtered: _Filtered, rows: Ints, best: Ints) -> tuple[Bools, Ints, Pixels]:
    """Whether one pixel makes each peak, the brightest of the nine around it; its position in the window; the
    mean of its four neighbours.

    A star of width 0.4 px in the middle of a pixel puts half of its peak into the four neighbours together, a
    wide star three times its peak.
    """
    side = math.isqrt(filtered.windows.shape[1])
    flat, start = filtered.windows.ravel(), rows * side**2
    row, column = np.divmod(best, filtered.shifts)
    middle = (side - filtered.shifts) // 2
    near = (np.arange(-1, 2)[:, None] * side + np.arange(-1, 2)).ravel()
    pixel = (row + middle) * side + column + middle
    pixel += near[flat[(start + pixel)[:, None] + near].argmax(axis=1)]
    at = start + pixel
    peak, cross = flat[at], flat[at + 1] + flat[at - 1] + flat[at + side] + flat[at - side]
    hot = (cross < _CROSS_OF_PEAK * peak) & (peak > SELDOM_SIGMA * filtered.noise[rows])
    return hot, pixel, np.float32(0.25) * cross


def _ring_dn(image: NDArray[Any], xy: Ints, sigma: float) -> Floats:
    """(N,) median of a square ring of pixels around each pixel: the level that a star stands on."""
    radius = min(int(np.ceil(_RING_SIGMA * sigma)), (min(image.shape) - 1) // 2)
    height, width = image.shape
    x, y = np.clip(xy - radius, 0, [width - 2 * radius - 1, height - 2 * radius - 1]).T
    away = np.abs(np.arange(-radius, radius + 1))
    row, column = (np.maximum(away[:, None], away) == radius).nonzero()
    ring = image.ravel()[(y * width + x)[:, None] + row * width + column].astype(np.float32)
    ring.sort(axis=1)
    return ring[:, ring.shape[1] // 2].astype(float)


def _outside_wings(xy: Ints, snr: Floats, sigma: float) -> Ints:
    """Rows of the peaks that the wings of no higher one explain: the filtered image of a star falls as
    exp(-d^2 / 4 s^2)."""
    if len(xy) < 2:
        return np.arange(len(xy))
    pairs = cKDTree(xy).query_pairs(4.0 * sigma, output_type="ndarray")
    low = np.where(snr[pairs[:, 0]] < snr[pairs[:, 1]], pairs[:, 0], pairs[:, 1])
    d2 = ((xy[pairs[:, 0]] - xy[pairs[:, 1]]) ** 2).sum(axis=1)
    wings = snr[pairs].max(axis=1) * np.exp(-d2 / (4.0 * sigma**2))
    drop = np.zeros(len(xy), dtype=bool)
    drop[low[snr[low] < WINGS * wings]] = True
    return np.flatnonzero(~drop)


def _parabola(flux: NDArray[Any], row: NDArray[Any], column: NDArray[Any]) -> Floats:
    """(N, 2) offset of the peak from the filter's values beside it; 0 if one of them is missing."""
    n, shifts = len(flux), flux.shape[1]
    offset = np.zeros((n, 2))
    k = np.arange(n)
    for axis, at, other in ((0, column, row), (1, row, column)):
        inner = np.clip(at, 1, shifts - 2)
        if axis == 0:
            before, here, after = (flux[k, other, inner + d] for d in (-1, 0, 1))
        else:
            before, here, after = (flux[k, inner + d, other] for d in (-1, 0, 1))
        curve = np.maximum(2.0 * here - before - after, 1e-6)
        offset[:, axis] = np.where(at == inner, np.clip(0.5 * (after - before) / curve, -0.6, 0.6), 0.0)
    return offset


def _pixel_gaussian(sigma: float) -> Floats:
    """A Gaussian centred on a pixel, integrated over pixels."""
    radius = max(2, round(_TAPS_SIGMA * sigma))
    edges = (np.arange(2 * radius + 2) - radius - 0.5) / (np.sqrt(2.0) * sigma)
    return np.asarray(0.5 * np.diff(erf(edges)))


def _shifted_kernels(taps: Floats, shifts: int) -> Pixels:
    """(side^2, shifts^2): flux of a star at each of shifts x shifts positions in a window, least squares."""
    side = len(taps) + shifts - 1
    one = np.zeros((side, shifts))
    for k in range(shifts):
        one[k : k + len(taps), k] = taps / (taps**2).sum()
    both = one[:, None, :, None] * one[None, :, None, :]
    return np.asarray(both.reshape(side**2, shifts**2), dtype=np.float32)


def has_many_dead_pixels(image: NDArray[Any], background: Background, share: float) -> bool:
    """Whether more than a `share` of the pixels of an image (H, W) are far below the darkest sky."""
    darkest = background.level_dn.min() - NEVER_SIGMA * background.noise_dn.max()
    sample = image[:: SPARSE**2]  # rows lie together in memory
    return bool(sample.min() < darkest and np.count_nonzero(sample < darkest) > share * sample.size)


def without_bad_pixels(
    image: NDArray[Any], background: Background, sigma_px: float
) -> tuple[NDArray[Any], Background, int]:
    """The image (H, W) with hot and dead pixels replaced by the median of their neighbours, its background,
    which holds where they are, and the number of hot ones. Stars have the width `sigma_px`."""
    level = background_image(background.level_dn, image.shape)
    noise = background_image(background.noise_dn, image.shape)
    height = image.astype(np.float32) - level
    rows, columns = (height[:-2, 1:-1], height[2:, 1:-1]), (height[1:-1, :-2], height[1:-1, 2:])
    lower = np.maximum(np.minimum(*rows), np.minimum(*columns))  # the second and third of four
    middle = 0.5 * (lower + np.minimum(np.maximum(*rows), np.maximum(*columns)))
    steepest = _UNEVEN * float(np.exp(0.5 / (sigma_px**2 + 1.0 / 12.0)))  # with the pixel's own width
    above = np.zeros(image.shape, dtype=np.float32)  # what a star beside such neighbours leaves
    above[1:-1, 1:-1] = height[1:-1, 1:-1] - steepest * np.maximum(middle, 0.0)
    hot = above > CLIP_SIGMA * noise  # as are by chance one good pixel in 700
    bad = hot | (height < -NEVER_SIGMA * noise)
    clean = image.copy()
    clean[1:-1, 1:-1][bad[1:-1, 1:-1]] = (middle + level[1:-1, 1:-1])[bad[1:-1, 1:-1]]
    return clean, background.without(bad), int(np.count_nonzero(above > NEVER_SIGMA * noise))
