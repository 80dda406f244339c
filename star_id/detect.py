"""Where in an image a star may be: a coarse search at half resolution, then the matched filter at full
resolution.

The search stretches the sky's noise to a dozen grey levels, halves and blurs the image in 8 bits and keeps
local maxima at a low threshold: every pixel is touched a few times by vector instructions only. What remains,
some thousands of places, is judged one by one with the matched filter of the PSF, whose noise is known, so
the threshold follows from the number of false alarms wished for. A place where one bright pixel explains more
than a star would is a hot pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from star_id.background import Background, extended

__all__ = ["Detections", "candidate_places", "detect", "detection_threshold", "windows_at"]

Array = NDArray[np.float64]

_GREY_LEVELS_PER_SIGMA = 12.0
_LEAST_LEVELS_PER_SIGMA = 2.5  # less than this and rounding to 8 bits costs sensitivity
_SEARCH_SIGMA = 3.7  # a star of SNR 8 midway between coarse pixels still shows 6 in the search image
_COARSE_NOISE_DN = 1.2  # sky noise from which rounding means of four pixels to whole numbers costs little
_EVEN_LEVELS = 3.5  # a threshold that varies by no more over the image is taken as constant
_MAX_CANDIDATES = 20_000
_CROSS_OF_PEAK = 0.35
_LEAST_LONE_SIGMA = 4.0
_LEAST_ABOVE_FRAME = 0.5  # share of a peak that must remain when the level around it is taken away
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_BAND_ROWS = 64  # of the halved image


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Peaks of the matched filter above its threshold, the ones that stand out most from their surroundings
    first."""

    xy_px: NDArray[np.int64]  # (N, 2) whole pixel of the peak
    offset_px: Array  # (N, 2) from there to the peak of a parabola
    snr: Array  # (N,) height of the peak over the filter's noise
    flux_dn: Array  # (N,) flux of a star of the assumed width
    hot_pixels: int  # peaks refused because a single pixel explains them better


def detection_threshold(n_px: int, psf_sigma_px: float, false_alarms: float) -> float:
    """Height, in sigmas of the matched filter, that `false_alarms` peaks of pure noise pass in `n_px` pixels.

    White noise filtered by a Gaussian of width s has peaks above v with density v exp(-v^2/2) / (2 s^2 (2
    pi)^1.5) a pixel (Adler 1981, The Geometry of Random Fields, expected Euler characteristic).
    """
    density = false_alarms / n_px * 2.0 * psf_sigma_px**2 * (2.0 * np.pi) ** 1.5
    v = 5.0
    for _ in range(20):
        v = float(np.sqrt(2.0 * np.log(max(v / density, 1.5))))
    return max(v, 3.0)


def candidate_places(image: NDArray, background: Background, *, halvings: int = 1) -> NDArray[np.int64]:
    """Full-resolution places (N, 2) near the local maxima of the image halved `halvings` times and blurred.

    The image is worked through in bands of rows that stay in the processor's cache.
    """
    source, gain, offset = _stretch(image, background)
    scale = 2**halvings
    # stretching after the first halving costs a quarter, but rounds the means of four to whole numbers before
    late = source is image and (
        image.dtype != np.uint8 or float(background.noise_dn.min()) > _COARSE_NOISE_DN
    )
    early = source is image and not late
    # noise after the mean over scale^2 pixels and after [1 2 1]/4 along both axes (3/8 of the variance each)
    variance = extended(background.noise_dn, continued=False) ** 2 / scale**2
    sigma = gain * 0.375 * np.sqrt(variance + (late and image.dtype == np.uint8) / 12.0 * 4.0 / scale**2)
    level = extended(background.level_dn) * gain + offset if source is image else _PEDESTAL
    threshold = level + _SEARCH_SIGMA * sigma
    rows, columns = image.shape[0] // scale, image.shape[1] // scale
    uneven = None
    if np.ptp(threshold) >= _EVEN_LEVELS:
        uneven = _enlarged(threshold, background, (rows, columns))
    even = np.array([np.ceil(threshold.mean())])
    found, heights = [], []
    for top in range(0, rows, _BAND_ROWS):
        first, last = max(0, top - 2), min(rows, top + _BAND_ROWS + 2)
        band = source[first * scale : last * scale, : columns * scale]
        coarse = cv2.convertScaleAbs(band, alpha=gain, beta=offset) if early else band
        for k in range(halvings):
            size = (coarse.shape[1] // 2, coarse.shape[0] // 2)
            coarse = cv2.resize(coarse, size, interpolation=cv2.INTER_AREA)
            if late and k == 0:
                coarse = cv2.convertScaleAbs(coarse, alpha=gain, beta=offset)
        blurred = cv2.GaussianBlur(coarse, (3, 3), 0)
        floor = cv2.max(cv2.dilate(blurred, _NEIGHBOURS), even if uneven is None else uneven[first:last])
        peak = cv2.compare(blurred, floor, cv2.CMP_GE)
        inner = slice((top - first) * columns, (min(top + _BAND_ROWS, rows) - first) * columns)
        places = np.flatnonzero(peak.ravel()[inner].view(np.bool_))
        heights.append(blurred.ravel()[inner][places])
        found.append(places + top * columns)
    places = np.concatenate(found)
    if len(places) > _MAX_CANDIDATES:
        height = np.concatenate(heights).astype(np.int16)
        places = np.sort(places[np.argpartition(-height, _MAX_CANDIDATES)[:_MAX_CANDIDATES]])
    y, x = np.divmod(places, columns)
    return np.column_stack([x, y]) * scale + (scale // 2 - 1 if halvings else 0)


def detect(
    image: NDArray,
    background: Background,
    places: NDArray[np.int64],
    *,
    psf_sigma_px: float,
    threshold: float,
    reach_px: int = 1,
) -> Detections:
    """Peaks of the matched filter within `reach_px` of the places (and one more pixel towards +x, +y).

    `psf_sigma_px` is the width of a Gaussian star integrated over pixels; noise is the background's.
    """
    taps = _pixel_gaussian(psf_sigma_px)
    margin = len(taps) // 2 + reach_px + 1
    height, width = image.shape
    inside = (places >= margin).all(axis=1)
    inside &= (places[:, 0] < width - margin) & (places[:, 1] < height - margin)
    places = places[inside]
    shifts = 2 * reach_px + 2
    side = len(taps) + shifts - 1
    level, noise = background.at(places.astype(float))
    windows: NDArray = windows_at(image, places - (len(taps) // 2 + reach_px), side)
    windows = windows.reshape(len(places), side * side)
    kernel = _shifted_kernels(taps, shifts)
    unit = float((taps**2).sum())  # flux over this and the noise is the signal-to-noise ratio
    flux = (windows.astype(np.float32) - level[:, None].astype(np.float32)) @ kernel
    best = flux.argmax(axis=1)
    high = np.flatnonzero(flux[np.arange(len(flux)), best] * unit > threshold * noise)
    windows = np.asarray(windows[high], dtype=np.float32)
    flux, best = flux[high], best[high]
    level, noise, places = level[high], noise[high], places[high]
    hot, pixel, excess = _lone_pixels(windows, best, level, noise, shifts)
    flux[hot] -= excess[:, None] * kernel[pixel]  # the lone pixel taken out
    best = flux.argmax(axis=1)
    snr = flux[np.arange(len(flux)), best] * unit / noise
    kept = keep = np.flatnonzero(snr > threshold)
    windows, flux, best, snr = windows[keep], flux[keep], best[keep], snr[keep]
    level, noise, places = level[keep], noise[keep], places[keep]
    frame = _frame_level(windows.reshape(-1, side, side)) - level
    above_frame = snr - frame * (taps.sum() ** 2 / unit) / noise
    sound = above_frame > _LEAST_ABOVE_FRAME * snr
    sound &= ~(hot[keep] & _are_lone(windows, best, level, noise, shifts))
    row, column = np.divmod(best, shifts)
    xy = places + np.column_stack([column, row]) - reach_px
    keep = np.flatnonzero(sound)
    keep = keep[np.argsort(-above_frame[keep], kind="stable")]
    _, first = np.unique(xy[keep] @ np.array([1, width]), return_index=True)
    keep = keep[np.sort(first)]
    return Detections(
        xy[keep],
        _parabola(flux[keep].reshape(-1, shifts, shifts), row[keep], column[keep]),
        snr[keep].astype(float),
        flux[keep, best[keep]].astype(float),
        int(hot.sum() - hot[kept][sound].sum()),
    )


def windows_at(image: NDArray, corners: NDArray[np.int64], side: int) -> NDArray:
    """Square cut-outs (N, side, side) whose first pixels (column, row) are `corners`, which must lie
    inside."""
    view = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    return np.asarray(view[corners[:, 1], corners[:, 0]])


_PEDESTAL = 64.0  # grey level of the sky where it had to be subtracted first


def _stretch(image: NDArray, background: Background) -> tuple[NDArray, float, float]:
    """How to bring the image to 8 bits: itself, to become gain * image + offset, or, where the sky varies too
    much for that, the image less its sky in 8 bits already.
    """
    sigma = float(np.median(background.noise_dn))
    low, high = float(background.level_dn.min()), float(background.level_dn.max())
    gain = min(_GREY_LEVELS_PER_SIGMA / sigma, 255.0 / (high - low + 16.0 * sigma))
    if gain * sigma >= _LEAST_LEVELS_PER_SIGMA and image.dtype in (np.uint8, np.uint16):
        return image, gain, gain * (5.0 * sigma - low)
    sky = _enlarged(extended(background.level_dn), background, image.shape, np.float32)
    gain = _GREY_LEVELS_PER_SIGMA / sigma
    flat = (image - sky) * np.float32(gain) + np.float32(_PEDESTAL)
    return np.clip(flat, 0.0, 255.0).astype(np.uint8), gain, 0.0


def _enlarged(
    ringed: Array, background: Background, shape: tuple[int, ...], dtype: type = np.uint8
) -> NDArray:
    """A grid with its outer ring (`extended`), interpolated to `shape`."""
    rows, columns = background.level_dn.shape
    if dtype is np.uint8:
        ringed = np.clip(np.ceil(ringed), 0, 255)
    y0, x0 = round(shape[0] / rows), round(shape[1] / columns)
    size = (round(shape[1] * (columns + 2) / columns), round(shape[0] * (rows + 2) / rows))
    large = cv2.resize(ringed.astype(dtype), size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large[y0 : y0 + shape[0], x0 : x0 + shape[1]])


def _lone_pixels(
    windows: NDArray[np.float32], best: NDArray, level: Array, noise: Array, shifts: int
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.float32]]:
    """Marks peaks that one pixel makes, and puts the mean of its neighbours in that pixel's place in
    `windows`.

    Returns the mask, and of the marked ones that pixel's place in the window and what it stood above its
    neighbours.
    """
    y, x, cross = _peak_pixels(windows, best, shifts)
    side = _side(windows)
    k = np.arange(len(windows))
    lone = _is_lone(windows[k, y * side + x] - level, cross - 4.0 * level, noise)
    pixel = (y * side + x)[lone]
    mean = (0.25 * cross[lone]).astype(np.float32)
    excess = windows[k[lone], pixel] - mean
    windows[k[lone], pixel] = mean
    return lone, pixel, excess


def _are_lone(
    windows: NDArray[np.float32], best: NDArray, level: Array, noise: Array, shifts: int
) -> NDArray[np.bool_]:
    """Whether one pixel makes each peak."""
    y, x, cross = _peak_pixels(windows, best, shifts)
    peak = windows[np.arange(len(windows)), y * _side(windows) + x] - level
    return _is_lone(peak, cross - 4.0 * level, noise)


def _is_lone(peak: Array, cross: Array, noise: Array) -> NDArray[np.bool_]:
    """The four neighbours of the brightest pixel hold less than any lens puts there, by more than noise
    explains.

    A star of width 0.4 px in the middle of a pixel puts half of its peak into the four neighbours together, a
    wide star three times its peak.
    """
    return np.asarray((cross < _CROSS_OF_PEAK * peak) & (peak > _LEAST_LONE_SIGMA * noise))


def _peak_pixels(windows: NDArray, best: NDArray, shifts: int) -> tuple[NDArray, NDArray, Array]:
    """Row and column of the brightest pixel of the nine about each peak, and the sum of its four
    neighbours."""
    side = _side(windows)
    k = np.arange(len(windows))
    row, column = np.divmod(best, shifts)
    first = (side - shifts) // 2
    y, x = row + first, column + first
    near = (np.arange(-1, 2)[:, None] * side + np.arange(-1, 2)).ravel()
    brightest = near[windows[k[:, None], (y * side + x)[:, None] + near].argmax(axis=1)]
    y, x = np.divmod(y * side + x + brightest, side)
    at = np.clip(y, 1, side - 2) * side + np.clip(x, 1, side - 2)
    cross = windows[k, at + 1] + windows[k, at - 1] + windows[k, at + side] + windows[k, at - side]
    return y, x, cross.astype(float)


def _side(windows: NDArray) -> int:
    return round(float(np.sqrt(windows.shape[1])))


def _parabola(flux: NDArray, row: NDArray, column: NDArray) -> Array:
    """(N, 2) place of the peak between pixels, from the filter's values beside it; 0 where one is missing."""
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


def _frame_level(windows: NDArray) -> Array:
    """(N,) median of the outermost pixels of windows: what a star stands on, be it sky, cloud or a roof."""
    frame = np.concatenate([windows[:, 0], windows[:, -1], windows[:, 1:-1, 0], windows[:, 1:-1, -1]], axis=1)
    return np.asarray(np.median(frame, axis=1), dtype=np.float64)


def _pixel_gaussian(sigma: float) -> Array:
    """A Gaussian centred on a pixel, integrated over pixels, out to 2.5 sigma."""
    radius = max(1, int(np.ceil(2.5 * sigma)))
    edges = (np.arange(2 * radius + 2) - radius - 0.5) / (np.sqrt(2.0) * sigma)
    return np.asarray(0.5 * np.diff(erf(edges)))


def _shifted_kernels(taps: Array, shifts: int) -> NDArray[np.float32]:
    """(side^2, shifts^2): flux of a star at each of shifts x shifts places of a window, least squares."""
    side = len(taps) + shifts - 1
    one = np.zeros((side, shifts))
    for k in range(shifts):
        one[k : k + len(taps), k] = taps / (taps**2).sum()
    return np.asarray(np.kron(one, one), dtype=np.float32)
