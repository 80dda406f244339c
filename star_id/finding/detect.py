"""Which of the places where a star may be hold one: the matched filter at full resolution.

The filter is a Gaussian integrated over pixels; its noise is known, so the threshold follows from the number
of false alarms wished for. A place where one bright pixel explains more than a star would is a hot pixel, one
whose light is that of its surroundings a roof or a cloud, and one that a brighter star's skirt explains is
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import erf

from boresight.star_id.finding.background import Background
from boresight.star_id.finding.windows import windows_at

__all__ = ["Detections", "detect", "detection_threshold"]

Array = NDArray[np.float64]
Pixels = NDArray[np.float32]

_TAPS_SIGMA = 1.8  # reach of the filter in widths: 99 % of the signal-to-noise ratio
_CROSS_OF_PEAK = 0.35
_LEAST_LONE_SIGMA = 4.0
_AT_ONCE = 128  # windows
_LEAST_ABOVE_FRAME = 0.5  # share of a peak that must remain when the level around it is taken away
_FRAME_SIGMA = 3.5  # distance, in widths, of the pixels that tell that level
_SKIRT = 1.3  # a lesser peak may stand so much above a brighter star's skirt and still be part of it


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
    first, shifts = len(taps) // 2 + reach_px, 2 * reach_px + 2
    side = len(taps) + shifts - 1
    places = places[_inside(places, image, first, side - first)]
    level, noise = background.at(places.astype(float))
    windows: Pixels = windows_at(image, places - first, side).reshape(len(places), side**2).astype(np.float32)
    windows -= level[:, None].astype(np.float32)
    kernel = _shifted_kernels(taps, shifts)
    unit = float((taps**2).sum())  # flux over this and the noise is the signal-to-noise ratio
    flux = _filtered(windows, kernel)
    best, peak = _peaks(flux)
    high = np.flatnonzero(peak * unit > threshold * noise)
    lone = high[_without_lone_pixels(windows, flux, noise, kernel, high, best[high])]
    best[lone], peak[lone] = _peaks(flux[lone])
    keep = high[peak[high] * unit > threshold * noise[high]]
    flux, level, noise, best, peak = flux[keep], level[keep], noise[keep], best[keep], peak[keep]
    snr = peak * unit / noise
    row, column = np.divmod(best, shifts)
    xy = places[keep] + np.column_stack([column, row]) - reach_px
    frame = _frame_dn(image, xy, psf_sigma_px) - level
    above_frame = snr - frame * (taps.sum() ** 2 / unit) / noise
    sound = above_frame > _LEAST_ABOVE_FRAME * snr
    held_lone = np.zeros(len(places), dtype=bool)
    held_lone[lone] = True
    spared = held_lone[keep]
    sound &= ~(spared & _lone_pixels(windows, noise, shifts, keep, best)[0])
    order = np.flatnonzero(sound)
    order = order[np.argsort(-above_frame[order], kind="stable")]
    order = order[_apart(xy[order], snr[order], psf_sigma_px)]
    return Detections(
        xy[order],
        _parabola(flux[order].reshape(-1, shifts, shifts), row[order], column[order]),
        snr[order].astype(float),
        peak[order].astype(float),
        len(lone) - int(np.count_nonzero(sound & spared)),
    )


def _inside(places: NDArray[np.int64], image: NDArray, before: int, after: int) -> NDArray[np.bool_]:
    """Places with so many pixels of the image before and from them on, along both axes."""
    x, y = places.T
    height, width = image.shape
    return np.asarray((x >= before) & (y >= before) & (x <= width - after) & (y <= height - after))


def _filtered(windows: Pixels, kernel: Pixels) -> Pixels:
    """Their product, a few rows at a time: these stay in the cache, and are too few for BLAS to wake
    threads."""
    flux = np.empty((len(windows), kernel.shape[1]), dtype=np.float32)
    for k in range(0, len(windows), _AT_ONCE):
        np.matmul(windows[k : k + _AT_ONCE], kernel, out=flux[k : k + _AT_ONCE])
    return flux


def _peaks(flux: Pixels) -> tuple[NDArray[np.int64], Pixels]:
    """Place in its row, and value, of each row's maximum."""
    best = flux.argmax(axis=1)
    return best, flux[np.arange(len(flux)), best]


def _without_lone_pixels(
    windows: Pixels,
    flux: Pixels,
    noise: Array,
    kernel: Pixels,
    rows: NDArray[np.int64],
    best: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Which of the peaks at `best` of the windows `rows` one pixel makes; there the mean of its neighbours is
    put in its place, in `windows` and so in `flux`."""
    lone, pixel, mean = _lone_pixels(windows, noise[rows], _side(flux), rows, best)
    rows, pixel, mean = rows[lone], pixel[lone], mean[lone]
    excess = windows[rows, pixel] - mean
    windows[rows, pixel] = mean
    flux[rows] -= excess[:, None] * kernel[pixel]
    return lone


def _lone_pixels(
    windows: Pixels, noise: Array, shifts: int, rows: NDArray[np.int64], best: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64], Pixels]:
    """Whether one pixel makes each peak, the brightest of the nine about it; that pixel's place in the
    window; the mean of its four neighbours.

    A star of width 0.4 px in the middle of a pixel puts half of its peak into the four neighbours together, a
    wide star three times its peak.
    """
    side = _side(windows)
    flat, start = windows.ravel(), rows * side**2
    row, column = np.divmod(best, shifts)
    middle = (side - shifts) // 2
    near = (np.arange(-1, 2)[:, None] * side + np.arange(-1, 2)).ravel()
    pixel = (row + middle) * side + column + middle
    pixel += near[flat[(start + pixel)[:, None] + near].argmax(axis=1)]
    at = start + pixel
    peak, cross = flat[at], flat[at + 1] + flat[at - 1] + flat[at + side] + flat[at - side]
    lone = (cross < _CROSS_OF_PEAK * peak) & (peak > _LEAST_LONE_SIGMA * noise)
    return lone, pixel, np.float32(0.25) * cross


def _frame_dn(image: NDArray, xy: NDArray[np.int64], sigma: float) -> Array:
    """(N,) median of a square frame of pixels about each place: what a star stands on, be it sky, cloud or a
    roof."""
    radius = int(np.ceil(_FRAME_SIGMA * sigma))
    side = 2 * radius + 1
    cut = windows_at(image, np.clip(xy - radius, 0, np.array(image.shape[::-1]) - side), side)
    frame = np.concatenate([cut[:, 0], cut[:, -1], cut[:, 1:-1, 0], cut[:, 1:-1, -1]], axis=1)
    frame.sort(axis=1)
    return frame[:, frame.shape[1] // 2].astype(float)


def _apart(xy: NDArray[np.int64], snr: Array, sigma: float) -> NDArray[np.int64]:
    """Rows of peaks that no higher one's skirt explains: the filtered image of a star falls as
    exp(-d^2 / 4 s^2)."""
    if len(xy) < 2:
        return np.arange(len(xy))
    pairs = cKDTree(xy).query_pairs(4.0 * sigma, output_type="ndarray")
    low = np.where(snr[pairs[:, 0]] < snr[pairs[:, 1]], pairs[:, 0], pairs[:, 1])
    d2 = ((xy[pairs[:, 0]] - xy[pairs[:, 1]]) ** 2).sum(axis=1)
    skirt = snr[pairs].max(axis=1) * np.exp(-d2 / (4.0 * sigma**2))
    drop = np.zeros(len(xy), dtype=bool)
    drop[low[snr[low] < _SKIRT * skirt]] = True
    return np.flatnonzero(~drop)


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


def _pixel_gaussian(sigma: float) -> Array:
    """A Gaussian centred on a pixel, integrated over pixels."""
    radius = max(2, round(_TAPS_SIGMA * sigma))
    edges = (np.arange(2 * radius + 2) - radius - 0.5) / (np.sqrt(2.0) * sigma)
    return np.asarray(0.5 * np.diff(erf(edges)))


def _shifted_kernels(taps: Array, shifts: int) -> Pixels:
    """(side^2, shifts^2): flux of a star at each of shifts x shifts places of a window, least squares."""
    side = len(taps) + shifts - 1
    one = np.zeros((side, shifts))
    for k in range(shifts):
        one[k : k + len(taps), k] = taps / (taps**2).sum()
    both = one[:, None, :, None] * one[None, :, None, :]
    return np.asarray(both.reshape(side**2, shifts**2), dtype=np.float32)
