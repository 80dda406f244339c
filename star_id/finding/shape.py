"""Empirical PSF of an image whose stars are no small Gaussians: trails, defocused rings, coma.

The pixels of many bright stars, each divided by its flux and put where it lies in its star, are samples of
one image, oversampled twice (Anderson & King 2000). Positions and fluxes are then fitted with that image, and
the two steps repeated. The image is made symmetric about its middle, and a star's place is where that fits
best: the noise of the image then displaces no star. (Its first moment would displace all stars alike, by
several times the error that they make together.)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, spline_filter
from scipy.spatial import cKDTree

from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import FEW_STARS, MAD_SIGMA, NEVER_SIGMA, SELDOM_SIGMA
from boresight.star_id.finding.background import Background, in_noise
from boresight.star_id.finding.detect import WINGS
from boresight.star_id.finding.psf import (
    FINE,
    USUAL_SIGMA_PX,
    PsfImages,
    newton_step,
    noise_gain,
    shape_images,
    start_state,
)
from boresight.star_id.finding.windows import NINE, StarWindows, star_windows

__all__ = ["ShapeEstimate", "detect_shape", "estimate_shape", "filter_width_px", "flat_image"]

# Most stars of which an empirical PSF is made: the noise of its mean is 1/8 of a star's.
_STARS = 60
# Largest and least radius of an empirical PSF, px, whatever the patches of light (set by hand).
_LARGEST_RADIUS, _LEAST_RADIUS = 20, 5
# Width of that smoothing, px: joins the parts of rings and trails (set by hand).
_SMOOTHING_PX = 2.0
# Rows that are worked on at a time: pictures of a whole image of 20 million pixels in floating point are 80
# MB each.
_BAND = 256


@record
class ShapeEstimate:
    """Empirical image of a star."""

    shape: NDArray[Any] = array("T, T", "spline coefficients of the unit image, FINE points a pixel")
    sigma_px: float = scalar("standard deviation of the light along one axis, px")
    error_factor: Floats = array("2, 2", "of centroids, over that of stars that look like `shape`")
    stars: int = scalar("stars that it is the mean of")
    gain_e_per_dn: float = scalar("from residuals that grow with the signal; infinite if they do not")


def flat_image(image: NDArray[Any], background: Background) -> NDArray[np.float32]:
    """The image (H, W) less its background, in units of its noise, without hot pixels."""
    flat = in_noise(image, background)
    around = cv2.medianBlur(flat, 3)
    for band, _ in _bands(len(flat), 0):
        hot = flat[band] - around[band] > np.maximum(NEVER_SIGMA, 0.5 * np.abs(around[band]))
        np.copyto(flat[band], around[band], where=hot)
    return flat


def _bands(rows: int, reach: int) -> Iterator[tuple[slice, slice]]:
    """Bands of an image's rows, one after another, each with the rows around it to which a filter reaches."""
    for first in range(0, rows, _BAND):
        last = min(first + _BAND, rows)
        yield slice(first, last), slice(max(0, first - reach), min(rows, last + reach))


def estimate_shape(
    image: NDArray[Any], flat: NDArray[np.float32], background: Background, saturation_dn: float
) -> ShapeEstimate | None:
    """Image of a star, the mean of many bright ones; None without enough of them.

    `image` (H, W) is raw, `flat` (H, W) the same without background (`flat_image`).
    """
    pixels, radius = _blobs(image, flat, saturation_dn)
    if len(pixels) < FEW_STARS:
        return None
    windows = replace(star_windows(image, pixels, background, radius, saturation_dn), above_cut=None)
    offset, flux = _moments(windows)
    sky: Floats = np.zeros(len(flux))
    for _ in range(4):  # measuring places, averaging the stars' images
        shape = _stacked(windows, offset, flux, sky)
        offset, flux, sky, good = _fitted(windows, offset, shape)
        if good.sum() < FEW_STARS:
            return None
        windows, offset, flux, sky = windows.take(good), offset[good], flux[good], sky[good]
    value = shape_images(shape, np.zeros((1, 2)), windows.radius).value[0].astype(float).clip(0.0)
    y, x = _grid(windows.radius)
    sigma = float(np.sqrt(0.5 * (value @ (x * x + y * y)) / value.sum()))
    images = shape_images(shape, offset, windows.radius)
    gain = noise_gain(windows, images.value, flux, sky)
    factor = _error_factor(windows, offset, flux, sky, images)
    return ShapeEstimate(shape, sigma, factor, len(flux), gain)


def _error_factor(
    windows: StarWindows, offset: Floats, flux: Floats, sky: Floats, images: PsfImages
) -> Floats:
    """(2, 2) errors of centroids fitted with the stars' common image over those that its slopes alone let
    expect.

    The image is smoothed, stars are sharper, and its noise has slopes of its own. With t the image, p a star,
    a fit moves by  (sum dt dp)^-1 sum dt noise  instead of  (sum dt dt)^-1 sum dt noise;  sum dt dp =
    -sum p ddt, of each half of the stars with the image of the other half, whose noise is not theirs.
    """
    weight, step = flux**2 / windows.noise2, 0.25
    slopes = images.columns[:, :2] * windows.good[:, None]
    of_image = np.einsum("n,nam,nbm->ab", weight, slopes, slopes)
    of_stars = np.zeros((2, 2))
    light = windows.good * (windows.data - sky[:, None]) / flux[:, None]
    odd = np.arange(len(flux)) % 2 == 1
    for half in (odd, ~odd):
        shape = _stacked(windows.take(~half), offset[~half], flux[~half], sky[~half])
        for a, move in enumerate(step * np.eye(2)):
            more, less = (
                shape_images(shape, offset[half] + m, windows.radius).columns for m in (move, -move)
            )
            curved = (more - less)[:, :2] / (2.0 * step)
            of_stars[a] -= np.einsum("n,nbm,nm->b", weight[half], curved, light[half])
    return np.asarray(np.linalg.solve(0.5 * (of_stars + of_stars.T), of_image))


def filter_width_px(shape: NDArray[Any]) -> float:
    """Width of the Gaussian whose matched filter has as many noise peaks as that of `shape` (T, T).

    The density of peaks depends on the mean squared slope of the filter's noise (Adler 1981), 1 / (2 s^2) for
    a Gaussian.
    """
    kernel = _kernel(shape)
    slopes = [((np.roll(kernel, 1, axis) - np.roll(kernel, -1, axis)) ** 2).sum() / 4.0 for axis in (0, 1)]
    return float(np.mean(slopes) ** -0.5 / np.sqrt(2.0))


def _kernel(shape: NDArray[Any]) -> NDArray[Any]:
    """Matched filter (S, S) whose sum of squares is one."""
    radius = (shape.shape[0] // FINE - 1) // 2
    unit: NDArray[Any] = (
        shape_images(shape, np.zeros((1, 2)), radius).value.reshape(2 * radius + 1, -1).clip(0.0)
    )
    return np.asarray(unit / np.sqrt((unit**2).sum()))


def detect_shape(flat: NDArray[np.float32], shape: NDArray[Any], threshold: float) -> Ints:
    """Pixels (N, 2) of the peaks of the matched filter above `threshold` sigmas, the highest first.

    `flat` (H, W) is the image of `flat_image`, `shape` (T, T) that of `ShapeEstimate`. A peak near a higher
    one has to exceed what that star's wings make of it by the threshold.
    """
    kernel = _kernel(shape)
    radius = kernel.shape[0] // 2
    height: NDArray[np.float32] = np.asarray(
        cv2.filter2D(np.minimum(flat, 1e4), cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT), np.float32
    )
    low, high = np.quantile(height[::4, ::4], [0.1587, 0.8413])
    height /= max(1.0, 0.5 * (high - low))  # faint stars, too, make the filtered image uneven
    y, x = _peaks(height, threshold)
    order = np.argsort(-height[y, x], kind="stable")
    xy, snr = np.column_stack([x, y])[order], height[y, x][order].astype(float)
    wings = cv2.filter2D(np.pad(kernel, 2 * radius), cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)[
        radius:-radius, radius:-radius
    ]
    pairs = (
        cKDTree(xy).query_pairs(2.0 * radius, output_type="ndarray") if len(xy) > 1 else np.empty((0, 2), int)
    )
    pairs = np.sort(pairs, axis=1)  # the higher first
    d = np.clip(xy[pairs[:, 1]] - xy[pairs[:, 0]], -2 * radius, 2 * radius) + 2 * radius
    d = np.clip(d, 1, wings.shape[0] - 2)
    near = cv2.dilate(wings, NINE)[d[:, 1], d[:, 0]]
    drop = np.zeros(len(xy), dtype=bool)
    above = snr[pairs[:, 1]] - WINGS * near * snr[pairs[:, 0]]
    drop[pairs[above < threshold * np.sqrt(1.0 - np.minimum(near, 1.0) ** 2), 1]] = True
    return xy[~drop]


def _peaks(height: NDArray[np.float32], threshold: float) -> tuple[Ints, Ints]:
    """Rows (N,) and columns (N,) of pixels above a threshold that none of the 24 around exceeds."""
    found = []
    for band, around in _bands(len(height), 2):
        highest = cv2.dilate(height[around], NINE, iterations=2)[band.start - around.start :]
        peak = (height[band] > threshold) & (height[band] == highest[: band.stop - band.start])
        row, column = np.nonzero(peak)
        found.append((row + band.start, column))
    y, x = np.concatenate(found, axis=1)
    return y, x


def _blobs(image: NDArray[Any], flat: NDArray[np.float32], saturation: float) -> tuple[Ints, int]:
    """Middles (N, 2) of bright patches of one size, far from others, and the radius that holds one, px."""
    above, light = np.empty(flat.shape, dtype=np.uint8), []
    for band, around in _bands(len(flat), int(4.0 * _SMOOTHING_PX)):
        smooth = cv2.GaussianBlur(flat[around], (0, 0), _SMOOTHING_PX)[band.start - around.start :]
        smooth = smooth[: band.stop - band.start]
        above[band] = smooth > NEVER_SIGMA / (2.0 * np.sqrt(np.pi) * _SMOOTHING_PX)
        light.append(smooth[above[band] > 0])
    count, label, stats, middle = cv2.connectedComponentsWithStats(above)
    stats, middle = stats[1:], middle[1:]
    area = stats[:, cv2.CC_STAT_AREA]
    total = np.bincount(label[above > 0], np.concatenate(light), minlength=count)[1:]
    top = np.argsort(-total, kind="stable")[: 4 * _STARS]
    top = top[area[top] > 4]
    if len(top) < FEW_STARS:
        return np.empty((0, 2), dtype=np.int64), 0
    side = stats[top][:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    radius = int(np.clip(0.7 * np.median(side) + 3.0, _LEAST_RADIUS, _LARGEST_RADIUS))
    alike = (side < 1.6 * np.median(side)) & (side > 0.5 * np.median(side))
    pixels = np.rint(middle[top]).astype(np.int64)
    inside = ((pixels > radius) & (pixels < np.array(image.shape[::-1]) - 1 - radius)).all(axis=1)
    near = cKDTree(middle).query(middle[top], k=2)[0][:, 1]
    bright = np.array([image[y - 2 : y + 3, x - 2 : x + 3].max(initial=0) for x, y in pixels])
    good = alike & inside & (near > 1.6 * radius) & (bright < saturation)
    return pixels[good][:_STARS], radius


def _moments(windows: StarWindows) -> tuple[Floats, Floats]:
    """First moments (N, 2) of the windows, px from their middles, and sums (N,), of what is well above
    noise."""
    y, x = _grid(windows.radius)
    light = np.where(windows.data > 1.5 * np.sqrt(windows.noise2)[:, None], windows.data, 0.0) * windows.good
    flux = np.maximum(light.sum(axis=1), 1e-6)
    return np.column_stack([light @ x, light @ y]) / flux[:, None], flux


def _grid(radius: int) -> tuple[Floats, Floats]:
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(float)
    return y.ravel(), x.ravel()


def _stacked(windows: StarWindows, offset: Floats, flux: Floats, sky: Floats) -> NDArray[Any]:
    """Spline coefficients of the stars' common image: weighted means in the cells of an oversampled grid,
    pixels that stand out left out."""
    radius = windows.radius
    y, x = _grid(radius)
    half = radius * FINE + FINE // 2
    side = 2 * half + 1
    column = np.rint((x - offset[:, :1]) * FINE).astype(np.int64) + half
    row = np.rint((y - offset[:, 1:]) * FINE).astype(np.int64) + half
    inside = (column >= 0) & (column < side) & (row >= 0) & (row < side) & (windows.good > 0)
    value = (windows.data - sky[:, None]) / flux[:, None]
    weight = np.broadcast_to((flux**2 / windows.noise2)[:, None], value.shape)
    cell = (row * side + column)[inside]
    value, weight = value[inside], weight[inside]
    keep = np.ones(len(cell), dtype=bool)
    for _ in range(3):
        whole = np.bincount(cell[keep], weight[keep], side * side).reshape(side, side)
        summed = np.bincount(cell[keep], (weight * value)[keep], side * side).reshape(side, side)
        whole, summed = (gaussian_filter(part, 0.5 * FINE * USUAL_SIGMA_PX) for part in (whole, summed))
        mean = summed / np.maximum(whole, 1e-9)
        off = np.abs(value - mean.ravel()[cell]) * np.sqrt(weight)
        keep = off < SELDOM_SIGMA * max(1.0, MAD_SIGMA * float(np.median(off)))
    edge = np.concatenate([mean[:FINE].ravel(), mean[-FINE:].ravel()])
    mean = mean - np.median(edge)
    mean = 0.5 * (mean + mean[::-1, ::-1])
    return np.asarray(spline_filter(mean * (FINE**2 / mean.sum()), order=3))


def _fitted(
    windows: StarWindows, offset: Floats, shape: NDArray[Any]
) -> tuple[Floats, Floats, Floats, NDArray[Any]]:
    """Positions, fluxes and skies of the stars with a given shape, and which of them it fits."""
    images: PsfImages = shape_images(shape, offset, windows.radius)
    state = start_state(windows, offset, images)
    for _ in range(3):
        step, _, residual, weight = newton_step(windows, images, state, np.inf)
        state = state + np.column_stack([np.clip(step[:, :2], -1.0, 1.0), step[:, 2:]])
        images = shape_images(shape, state[:, :2], windows.radius)
    energy = (state[:, 2:3] ** 2 * images.value.astype(float) ** 2 * weight).sum(axis=1)
    misfit = (residual**2 * weight).sum(axis=1) - residual.shape[1]
    share = misfit / np.maximum(energy, 1e-9)
    good = (state[:, 2] > 0) & (share < max(3.0 * float(np.median(share)), 0.05))
    return state[:, :2], state[:, 2], state[:, 3], good
