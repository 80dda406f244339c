"""Frames of the sky as sensors and lenses spoil them, with known truth (also of `benchmarks/star_hard.py`).

The renderer shares nothing with the simulator or with `star_id`: the point spread function is a table of
eight points a pixel (a core with the wings of a Moffat function, drawn out to a trail, a ring or a comatic
fan), integrated over pixels and interpolated by cubic splines; electrons are Poisson; sensors add column
offsets, row noise, hot pixels, dead rows, unequal pixels, vignetting, colour filters, captions, a gamma curve
and the black clip of a consumer camera.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.fft import dct
from scipy.ndimage import map_coordinates, spline_filter, uniform_filter1d
from scipy.signal import fftconvolve
from scipy.stats import norm

FINE = 8  # points a pixel
HALF = 24  # px from the middle of a star to the edge of its table
HALVES = (8, 12, 16)  # from the middle of a star to the edge of its image, where what is left out is
LEFT_OUT_E = 1e-3  # fewer electrons in each pixel
ROWS = 12  # of a caption, in 1/240 of the height


@dataclass(frozen=True)
class Blur:
    """What lens and motion make of a point."""

    core_px: float = 2.5  # full width at half maximum of the core
    beta: float = 5.0  # of the Moffat function
    trail_px: tuple[float, float] = (0.0, 0.0)
    ring_px: float = 0.0  # radius of a defocused ring
    coma_px: float = 0.0  # length of the fan at the corner, outwards


@dataclass(frozen=True)
class Sensor:
    """What the detector adds. Electrons where not stated otherwise."""

    e_per_dn: float = 4.0
    sky_e: float = 100.0
    read_e: float = 6.0
    bits: int = 12
    bias_dn: float = 60.0
    hot_columns: int = 0
    hot_pixels: int = 0
    row_noise: float = 0.0  # of the pixel noise
    vignetting: float = 0.0  # loss of light in the corners
    clipped: bool = False  # the median of the sky is subtracted and negative values become zero
    bayer: tuple[float, float, float, float] | None = None  # sensitivity of the four colours
    caption: bool = False
    nebula_e: float = 0.0
    cosmic_rays: int = 0
    jpeg: int | None = None  # quality, of 8 bits
    prnu: float = 0.0  # scatter of the pixels' response, normal
    dead_rows: int = 0  # that read zero
    gamma: float = 1.0  # of the curve from light to numbers, over the full range


@dataclass(frozen=True)
class Stars:
    """What stands in the sky of one frame."""

    xy_px: NDArray = field(default_factory=lambda: np.zeros((0, 2)))
    electrons: NDArray = field(default_factory=lambda: np.zeros(0))


def psf_table(blur: Blur, outwards: NDArray | None = None) -> NDArray:
    """Spline coefficients of the pixel-integrated PSF, `FINE` points a pixel, (2 HALF FINE + 1) squared.

    `outwards` (2,) is the direction (column, row) of a fan, its length the fraction of that in the corner.
    """
    return _psf_table(blur, None if outwards is None else (float(outwards[0]), float(outwards[1])))


@cache
def _psf_table(blur: Blur, outwards: tuple[float, float] | None) -> NDArray:
    n = HALF * FINE
    y, x = np.mgrid[-n : n + 1, -n : n + 1] / FINE
    alpha = 0.5 * blur.core_px / np.sqrt(2.0 ** (1.0 / blur.beta) - 1.0)
    core = (1.0 + (x * x + y * y) / alpha**2) ** -blur.beta
    shape = np.zeros_like(core)
    if blur.ring_px:
        shape += np.exp(-0.5 * ((np.hypot(x, y) - blur.ring_px) / 0.35) ** 2)
    elif any(blur.trail_px):
        steps = np.linspace(-0.5, 0.5, 8 * n + 1)[:, None] * np.array(blur.trail_px)
        _splat(shape, steps, np.ones(len(steps)))
    elif blur.coma_px and outwards is not None and np.hypot(*outwards) > 0.01:
        steps, weight = _fan(blur.coma_px * np.array(outwards))
        _splat(shape, steps, weight)
    else:
        shape[n, n] = 1.0
    table = fftconvolve(core, shape / shape.sum(), mode="same")
    for axis in (0, 1):  # over a pixel, FINE points and halves of those at its edges
        both = (
            uniform_filter1d(table, FINE, axis=axis, origin=0),
            uniform_filter1d(table, FINE, axis=axis, origin=-1),
        )
        table = 0.5 * (both[0] + both[1])
    return np.asarray(spline_filter(table * (FINE**2 / table.sum()), order=3))


def _splat(shape: NDArray, points: NDArray, weight: NDArray) -> None:
    """Add points (N, 2), px from the middle, to a table, shared linearly by the four nearest cells."""
    n = shape.shape[0] // 2
    at = points * FINE + n
    low = np.floor(at).astype(int)
    part = at - low
    for i in (0, 1):
        for j in (0, 1):
            share = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1])
            np.add.at(shape, (low[:, 1] + j, low[:, 0] + i), weight * share)


def _fan(outwards: NDArray) -> tuple[NDArray, NDArray]:
    """Points and weights of third-order coma of length |outwards|: circles from zones of the pupil, each
    displaced by twice its radius (Born & Wolf, 5.3)."""
    length = np.hypot(*outwards)
    zone, angle = np.meshgrid(np.linspace(0.02, 1.0, 60), np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False))
    radius = length / 3.0 * zone**2
    along, across = radius * (2.0 + np.cos(angle)), radius * np.sin(angle)
    unit = outwards / length
    points = along[..., None] * unit + across[..., None] * np.array([-unit[1], unit[0]])
    weight = zone.ravel()
    points = points.reshape(-1, 2)
    return points - (points * weight[:, None]).sum(axis=0) / weight.sum(), weight


def stamps(xy: NDArray, table: NDArray, half: int, shift: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """Whole pixels (N, 2) and unit images (N, S, S) of stars at `xy` (N, 2)."""
    whole = np.rint(xy).astype(int)
    offset = xy - whole if shift is None else xy - whole + shift
    grid = np.arange(-half, half + 1)
    middle = table.shape[0] // 2
    rows = (grid[None, :, None] - offset[:, 1, None, None]) * FINE + middle
    columns = (grid[None, None, :] - offset[:, 0, None, None]) * FINE + middle
    rows, columns = np.broadcast_arrays(rows, columns)
    return whole, map_coordinates(table, [rows, columns], order=3, prefilter=False, mode="constant")


def render(
    stars: Stars, size: tuple[int, int], blur: Blur, sensor: Sensor, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """Raw image (H, W), and the variance of its background in electrons squared (H, W) as it was drawn and
    rounded: without stars and row noise."""
    width, height = size
    light = np.full((height, width), sensor.sky_e)
    if sensor.nebula_e:
        y, x = np.ogrid[0:height, 0:width]
        for _ in range(6):
            a, b, s = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.02, 0.15) * width
            light += (
                sensor.nebula_e * rng.uniform(0.3, 1.0) * np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / s**2)
            )
    sensitivity = response(sensor, size)
    variance = sensor.read_e**2 + light * sensitivity + sensor.e_per_dn**2 / 12.0
    variance += (sensor.prnu * light * sensitivity) ** 2
    add_stars(light, stars, blur)
    light *= sensitivity
    if sensor.prnu:
        light *= rng.normal(1.0, sensor.prnu, light.shape).clip(0.0)
    noise = np.sqrt(sensor.read_e**2 + sensor.sky_e)
    electrons = rng.poisson(light) + rng.normal(0.0, sensor.read_e, light.shape)
    if sensor.hot_pixels:
        where = rng.integers(0, electrons.size, sensor.hot_pixels)
        electrons.ravel()[where] += rng.exponential(40.0 * noise, sensor.hot_pixels)
    for _ in range(sensor.cosmic_rays):
        length, angle = rng.exponential(8.0) + 2.0, rng.uniform(0, np.pi)
        steps = np.arange(0.0, length, 0.5)[:, None] * [np.cos(angle), np.sin(angle)]
        at = np.rint(rng.uniform(0, [width, height]) + steps).astype(int)
        at = np.unique(at[((at >= 0) & (at < [width, height])).all(axis=1)], axis=0)
        electrons[at[:, 1], at[:, 0]] += rng.uniform(10.0, 60.0) * noise
    if sensor.row_noise:
        electrons += rng.normal(0.0, sensor.row_noise * noise, (height, 1))
    if sensor.hot_columns:
        columns = rng.choice(width, sensor.hot_columns, replace=False)
        electrons[:, columns] += rng.uniform(3.0, 30.0, sensor.hot_columns) * noise
    image = electrons / sensor.e_per_dn + sensor.bias_dn
    if sensor.clipped:
        image -= np.median(image)
    top = 2**sensor.bits - 1
    image = np.clip(image, 0, top)
    image = np.rint(top * (image / top) ** (1.0 / sensor.gamma))
    if sensor.dead_rows:
        image[rng.choice(height, sensor.dead_rows, replace=False)] = 0
    if sensor.caption:
        write_caption(image, top)
    image = image.astype(np.uint8 if sensor.bits == 8 else np.uint16)
    if sensor.jpeg:
        _, file = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg])
        image = cv2.imdecode(file, cv2.IMREAD_UNCHANGED)
    return image, variance


def response(sensor: Sensor, size: tuple[int, int]) -> NDArray:
    """Share (H, W) of the light that each pixel sees."""
    width, height = size
    share = np.ones((height, width))
    if sensor.vignetting:
        y, x = np.ogrid[0:height, 0:width]
        share -= sensor.vignetting * 2.0 * ((x / width - 0.5) ** 2 + (y / height - 0.5) ** 2)
    if sensor.bayer is not None:
        share *= np.tile(np.reshape(sensor.bayer, (2, 2)), (height // 2, width // 2))
    return share


def add_stars(light: NDArray, stars: Stars, blur: Blur) -> None:
    """Add stars to an image, in place; a fan is the same within cells of an eighth of the image."""
    height, width = light.shape
    cells = 9 if blur.coma_px else 1
    cell = np.clip((stars.xy_px / [width, height] * cells).astype(int), 0, cells - 1)
    for i in range(cells):
        for j in range(cells):
            rows = np.flatnonzero((cell == [i, j]).all(axis=1))
            if not len(rows):
                continue
            table = psf_table(blur, fan_at(np.array([i, j]), cells))
            half = _halves(table, stars.electrons[rows])
            for size in np.unique(half):
                _add_alike(light, stars, rows[half == size], table, int(size))


def _halves(table: NDArray, electrons: NDArray) -> NDArray:
    """(N,) px from the middle of each star to the edge of the image that holds its light."""
    y, x = np.indices(table.shape) - HALF * FINE
    beyond = [np.abs(table[np.maximum(np.abs(y), np.abs(x)) > (half - 0.5) * FINE]).max() for half in HALVES]
    fits = electrons[:, None] * np.array(beyond) < LEFT_OUT_E
    return np.append(HALVES, HALF - 1)[np.where(fits.any(axis=1), fits.argmax(axis=1), len(HALVES))]


def _add_alike(light: NDArray, stars: Stars, rows: NDArray, table: NDArray, half: int) -> None:
    whole, images = stamps(stars.xy_px[rows], table, half)
    for (a, b), image in zip(whole, images * stars.electrons[rows, None, None]):
        t, q = max(0, b - half), max(0, a - half)
        part = light[t : b + half + 1, q : a + half + 1]
        y, x = t - (b - half), q - (a - half)
        part += np.maximum(image[y : y + part.shape[0], x : x + part.shape[1]], 0.0)


def fan_at(cell: NDArray, cells: int) -> NDArray:
    """Direction outwards of a cell (column, row), as long as the corner's is 1."""
    return np.asarray(((cell + 0.5) / cells - 0.5) * np.sqrt(2.0))


def write_caption(image: NDArray, top: int) -> None:
    """A bar of 5 % of the rows below the image, with bright text: strokes of 2 px in cells of 10 by 16."""
    height, width = image.shape
    bar = image[height - ROWS * height // 240 :]
    bar[:] = 0
    rng = np.random.default_rng(1)  # the same caption below every frame
    for y in range(6, len(bar) - 18, 22):
        for x in range(10, width // 2, 12):
            if rng.random() < 0.15:
                continue
            for _ in range(3):
                a, b = rng.integers(0, 8), rng.integers(0, 14)
                if rng.random() < 0.5:
                    bar[y + b : y + b + 2, x : x + 9] = top
                else:
                    bar[y : y + 15, x + a : x + a + 2] = top


def cramer_rao_px(
    xy: NDArray,
    electrons: NDArray,
    variance_e: NDArray,
    share: NDArray,
    table: NDArray,
    prnu: float = 0.0,
    sky_e: float = 0.0,
) -> NDArray:
    """Bound (N,) of a centroid's error along one axis, px, and the matched filter's SNR (N,), of the rendered
    PSF; column, row, flux and background unknown.

    `variance_e` and `share` (H, W) are the background's variance, electrons squared, and the share of the
    light that each pixel sees, which scatters by `prnu` of it: of the star's light, and of that of the sky,
    `sky_e`, by the same factor, so that their product counts, too."""
    half, step = HALF - 1, 0.05
    whole, image = stamps(xy, table, half)
    images = [image]
    for shift in ([step, 0.0], [0.0, step]):
        more, less = (stamps(xy, table, half, sign * np.array(shift))[1] for sign in (1.0, -1.0))
        images.append((more - less) / (2.0 * step))
    grid = np.arange(-half, half + 1)
    height, width = variance_e.shape
    rows = np.clip(whole[:, 1, None, None] + grid[:, None], 0, height - 1)
    columns = np.clip(whole[:, 0, None, None] + grid, 0, width - 1)
    value, d_x, d_y = ((part * share[rows, columns]).reshape(len(xy), -1) for part in images)
    flux, sky = electrons[:, None], variance_e[rows, columns].reshape(len(xy), -1)
    J = np.stack([flux * d_x, flux * d_y, value, np.ones_like(value)], axis=1)
    star = np.maximum(flux * value, 0.0)
    seen = star + 2.0 * sky_e * share[rows, columns].reshape(len(xy), -1)
    information = (J / (sky + star + prnu**2 * star * seen)[:, None]) @ J.transpose(0, 2, 1)
    scale = 1.0 / np.sqrt(np.einsum("npp->np", information))
    covariance = np.linalg.inv(information * scale[:, :, None] * scale[:, None, :])
    covariance *= scale[:, :, None] * scale[:, None, :]
    bound = np.sqrt(0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]))
    return np.column_stack([bound, electrons * np.sqrt((value**2 / sky).sum(axis=1))])


def jpeg_steps(quality: int) -> NDArray:
    """(8, 8) steps, DN, to whose multiples JPEG rounds the cosine coefficients of a grey block."""
    _, file = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.array(Image.open(io.BytesIO(file.tobytes())).quantization[0], dtype=float).reshape(8, 8)


def bound_after_jpeg_px(
    xy: NDArray, electrons: NDArray, variance_e: NDArray, sensor: Sensor, table: NDArray
) -> NDArray:
    """Bound (N,) of a centroid's error along one axis, px, in the compressed frame: information of the cosine
    coefficients of nine blocks, each normal before it was rounded. Column, row and flux are unknown; of the
    background's variance, as in `cramer_rao_px`, the median counts."""
    assert sensor.jpeg is not None
    gain, half = sensor.e_per_dn, HALF - 1
    steps = np.tile(jpeg_steps(sensor.jpeg), (3, 3)).reshape(3, 8, 3, 8)
    sky_e, bound = float(np.median(variance_e)), np.empty(len(xy))
    level = sensor.sky_e / gain + sensor.bias_dn - 128.0
    for n, (place, flux) in enumerate(zip(xy, electrons)):
        inside = place - (8 * np.floor((place + 0.5) / 8) - 8)

        def image(at: NDArray) -> NDArray:
            whole, stamp = stamps(at[None], table, half)
            frame = np.zeros((24 + 4 * half, 24 + 4 * half))
            column, row = whole[0] + half
            frame[row : row + 2 * half + 1, column : column + 2 * half + 1] = stamp[0]
            return frame[2 * half : 2 * half + 24, 2 * half : 2 * half + 24]

        value, step = image(inside), 0.05 * np.eye(2)
        slopes = [(image(inside + d) - image(inside - d)) / 0.1 for d in step]
        J = np.stack([_cosines(part * scale) for part, scale in zip([*slopes, value], (flux, flux, 1.0))])
        variance = _cosines((sky_e + flux * value) / gain**2, squared=True)
        mean = _cosines(value * flux / gain + level)
        weighed = (J / gain).reshape(3, -1)
        weights = rounded_information(mean, np.sqrt(variance), steps).ravel()
        bound[n] = _mean_error((weighed * weights) @ weighed.T)
    return bound


def _mean_error(information: NDArray) -> float:
    return float(np.sqrt(0.5 * np.trace(np.linalg.inv(information)[:2, :2])))


def _cosines(pixels: NDArray, squared: bool = False) -> NDArray:
    """Cosine coefficients (3, 8, 3, 8) of nine blocks of pixels (24, 24), or of their variances."""
    factors = dct(np.eye(8), norm="ortho", axis=0)
    factors = factors**2 if squared else factors
    return np.einsum("ki,aibj,lj->akbl", factors, pixels.reshape(3, 8, 3, 8), factors)


def rounded_information(mean: NDArray, sigma: NDArray, step: NDArray) -> NDArray:
    """Fisher information of the mean of a normal value that is rounded to multiples of `step`; all alike."""
    nearest, information = np.rint(mean / step), np.zeros_like(mean)
    for k in range(-8, 9):
        low, high = (((nearest + k + side) * step - mean) / sigma for side in (-0.5, 0.5))
        chance = norm.cdf(high) - norm.cdf(low)
        change = (norm.pdf(low) - norm.pdf(high)) / sigma
        information += np.where(chance > 1e-14, change**2 / np.maximum(chance, 1e-14), 0.0)
    return information
