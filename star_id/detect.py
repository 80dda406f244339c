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
_SEARCH_SIGMA = 3.5  # a star of SNR 8 midway between coarse pixels still shows 6 in the search image
_MAX_CANDIDATES = 20_000
_CROSS_OF_PEAK = 0.35
_WIDE_SIGMA_PX = 0.9
_LEAST_ABOVE_FRAME = 0.5  # share of a peak that must remain when the level around it is taken away
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Peaks of the matched filter above its threshold, the ones that stand out most from their surroundings
    first."""

    xy_px: NDArray[np.int64]  # (N, 2) whole pixel of the peak
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
    """Full-resolution places (N, 2) near the local maxima of the image halved `halvings` times and
    blurred."""
    stretched, gain, offset = _stretched(image, background)
    coarse = stretched
    for _ in range(halvings):
        rows, columns = coarse.shape[0] // 2, coarse.shape[1] // 2
        coarse = cv2.resize(coarse[: 2 * rows, : 2 * columns], (columns, rows), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(coarse, (3, 3), 0)
    # noise after the mean over 4^halvings pixels and after [1 2 1]/4 along both axes (3/8 of the variance
    # each)
    sigma = extended(background.noise_dn, continued=False) * gain * 0.375 / 2**halvings
    level = extended(background.level_dn) * gain + offset if offset is not None else _PEDESTAL
    threshold = _enlarged(level + _SEARCH_SIGMA * sigma, background, blurred.shape)
    peak = cv2.compare(blurred, cv2.dilate(blurred, _NEIGHBOURS), cv2.CMP_GE)
    cv2.bitwise_and(peak, cv2.compare(blurred, threshold, cv2.CMP_GT), peak)
    found = np.flatnonzero(peak.ravel().view(np.bool_))
    if len(found) > _MAX_CANDIDATES:
        height = blurred.ravel()[found].astype(np.int16)
        found = np.sort(found[np.argpartition(-height, _MAX_CANDIDATES)[:_MAX_CANDIDATES]])
    y, x = np.divmod(found, blurred.shape[1])
    return np.column_stack([x, y]) * 2**halvings + (2**halvings // 2 - 1 if halvings else 0)


def detect(
    image: NDArray,
    background: Background,
    places: NDArray[np.int64],
    *,
    psf_sigma_px: float,
    threshold: float,
    reach_px: int = 1,
    width_known: bool = True,
) -> Detections:
    """Peaks of the matched filter within `reach_px` of the places (and one more pixel towards +x, +y).

    `psf_sigma_px` is the width of a Gaussian star integrated over pixels, measured if `width_known` and a
    first guess otherwise; noise is the background's.
    """
    taps = _pixel_gaussian(psf_sigma_px)
    radius = len(taps) // 2
    offsets = np.arange(-reach_px, reach_px + 2)
    margin = radius + reach_px + 1
    height, width = image.shape
    inside = (
        (places >= margin).all(axis=1) & (places[:, 0] < width - margin) & (places[:, 1] < height - margin)
    )
    places = places[inside]
    side = len(taps) + len(offsets) - 1
    windows = windows_at(image, places - (radius + reach_px), side).reshape(len(places), -1)
    kernel = _shifted_kernels(taps, len(offsets))
    level, noise = background.at(places.astype(float))
    flux = (windows.astype(np.float32) - level[:, None].astype(np.float32)) @ kernel.astype(np.float32)
    best = flux.argmax(axis=1)
    snr = flux[np.arange(len(flux)), best] * np.sqrt((taps**2).sum() ** 2) / noise
    high = snr > threshold
    hot = np.zeros(len(high), dtype=bool)
    hot[high] = _single_pixels(
        windows[high].reshape(-1, side, side),
        level[high],
        noise[high],
        snr[high],
        psf_sigma_px if width_known else 0.0,
    )
    keep = np.flatnonzero(high & ~hot)
    frame = np.asarray(_frame_level(windows[keep].reshape(-1, side, side)) - level[keep])
    of_frame = frame * (taps.sum() / (taps**2).sum()) ** 2  # flux that the filter sees in an even level
    above_frame = snr[keep] * (1.0 - of_frame / np.maximum(flux[keep, best[keep]], 1e-9))
    alone = above_frame > _LEAST_ABOVE_FRAME * snr[keep]
    keep, above_frame = keep[alone], above_frame[alone]
    row, column = np.divmod(best[keep], len(offsets))
    xy = places[keep] + np.column_stack([offsets[column], offsets[row]])
    order = np.argsort(-above_frame, kind="stable")
    _, first = np.unique(xy[order] @ np.array([1, width]), return_index=True)
    order = order[np.sort(first)]
    peak_flux = flux[keep[order], best[keep[order]]].astype(float)
    return Detections(xy[order], snr[keep[order]].astype(float), peak_flux, int(hot.sum()))


def windows_at(image: NDArray, corners: NDArray[np.int64], side: int) -> NDArray:
    """Square cut-outs (N, side, side) whose first pixels (column, row) are `corners`, which must lie
    inside."""
    view = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    return np.asarray(view[corners[:, 1], corners[:, 0]])


_PEDESTAL = 64.0  # grey level of the sky where it had to be subtracted first


def _stretched(image: NDArray, background: Background) -> tuple[NDArray, float, float | None]:
    """The image in 8 bits as gain * image + offset; where the sky varies too much for that, minus the sky."""
    sigma = float(np.median(background.noise_dn))
    low, high = float(background.level_dn.min()), float(background.level_dn.max())
    gain = min(_GREY_LEVELS_PER_SIGMA / sigma, 255.0 / (high - low + 16.0 * sigma))
    if gain * sigma >= _LEAST_LEVELS_PER_SIGMA and image.dtype in (np.uint8, np.uint16):
        offset = gain * (5.0 * sigma - low)
        return cv2.convertScaleAbs(image, alpha=gain, beta=offset), gain, offset
    sky = _enlarged(extended(background.level_dn), background, image.shape, np.float32)
    gain = _GREY_LEVELS_PER_SIGMA / sigma
    flat = (image - sky) * np.float32(gain) + np.float32(_PEDESTAL)
    return np.clip(flat, 0.0, 255.0).astype(np.uint8), gain, None


def _enlarged(
    ringed: Array, background: Background, shape: tuple[int, ...], dtype: type = np.uint8
) -> NDArray:
    """A grid with its outer ring (`extended`), interpolated to `shape`."""
    rows, columns = background.level_dn.shape
    if dtype is np.uint8:
        ringed = np.clip(np.floor(ringed), 0, 255)
    y0, x0 = round(shape[0] / rows), round(shape[1] / columns)
    size = (round(shape[1] * (columns + 2) / columns), round(shape[0] * (rows + 2) / rows))
    large = cv2.resize(ringed.astype(dtype), size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large[y0 : y0 + shape[0], x0 : x0 + shape[1]])


def _single_pixels(
    windows: NDArray, level: Array, noise: Array, snr: Array, sigma: float
) -> NDArray[np.bool_]:
    """Peaks that one pixel makes: its four neighbours hold less than any lens puts there.

    The image of a star of width 0.4 px, centred on a pixel, still puts half of the peak into the neighbours
    together. Where stars are known to be wide the likelihood of a lone pixel, exp(z^2 / 2), is set against
    that of a star, exp(snr^2 / 2).
    """
    n, side = len(windows), windows.shape[1]
    if n == 0:
        return np.empty(0, dtype=bool)
    inner = windows[:, 1:-1, 1:-1].reshape(n, -1)
    y, x = np.divmod(inner.argmax(axis=1), side - 2)
    k = np.arange(n)
    cross = sum(
        windows[k, y + 1 + dy, x + 1 + dx].astype(float) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))
    )
    peak = windows[k, y + 1, x + 1] - level
    lone = cross - 4.0 * level < _CROSS_OF_PEAK * peak
    if sigma > _WIDE_SIGMA_PX:
        lone |= peak / noise > snr
    return np.asarray(lone)


def _frame_level(windows: NDArray) -> Array:
    """(N,) median of the outermost pixels of windows: what a star stands on, be it sky, cloud or a roof."""
    frame = np.concatenate([windows[:, 0], windows[:, -1], windows[:, 1:-1, 0], windows[:, 1:-1, -1]], axis=1)
    return np.asarray(np.median(frame, axis=1), dtype=np.float64)


def _pixel_gaussian(sigma: float) -> Array:
    """A Gaussian centred on a pixel, integrated over pixels, out to 2.5 sigma."""
    radius = max(1, int(np.ceil(2.5 * sigma)))
    edges = (np.arange(2 * radius + 2) - radius - 0.5) / (np.sqrt(2.0) * sigma)
    return np.asarray(0.5 * np.diff(erf(edges)))


def _shifted_kernels(taps: Array, shifts: int) -> Array:
    """(side^2, shifts^2): flux of a star at each of shifts x shifts places of a window, least squares."""
    side = len(taps) + shifts - 1
    one = np.zeros((side, shifts))
    for k in range(shifts):
        one[k : k + len(taps), k] = taps / (taps**2).sum()
    return np.asarray(np.kron(one, one), dtype=np.float64)
