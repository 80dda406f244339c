"""Places of stars in images whose blocks of 8 x 8 pixels were rounded: JPEG of low quality.

JPEG rounds the cosine coefficients of each block to multiples of steps that its table gives. Where steps are
wider than the noise, most coefficients become zero: what they lose is no noise that is seen in the sky, and
pixels are no measurements of a star any more. What the file tells of a coefficient is the interval that it
lay in. The steps are seen in the decoded image itself, the noise before the compression in the share of
coefficients of sky that are not zero. Column, row, flux and level of each star are then those of the largest
likelihood of all intervals, by Fisher scoring, with the covariance of that bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.special import ndtr, ndtri

from boresight.geometry.record import Bools, Floats, Ints
from boresight.star_id.finding.centroid import covariance_inflation
from boresight.star_id.finding.psf import Psf, images_at

__all__ = ["places_in_rounded_blocks", "rounding_steps"]

# Side of a block, px, and middle of the values, DN, that JPEG subtracts before its cosines (ITU-T T.81).
_BLOCK, _MIDDLE_DN = 8, 128.0
# Cosines (8, 8) of a block, orthonormal.
_COSINES = np.asarray(dct(np.eye(_BLOCK), norm="ortho", axis=0))
# Least coefficient, DN, that is not zero: decoded pixels are whole numbers, which scatters coefficients by
# 0.29 DN, and more where few are not zero.
_NOT_ZERO_DN = 1.5
# Coefficients of a block, not zero, from which that scatter is random (set by hand).
_BUSY = 6
# Fewest coefficients that show a step, and the share of them that must be its multiples within four standard
# deviations of that scatter.
_FEWEST, _MULTIPLES, _ROUNDING_DN = 30, 0.85, 1.2
# Steps, DN, between which they are looked for: of lower ones all coefficients are multiples; the largest of 8
# bits.
_LEAST_STEP_DN, _LARGEST_STEP_DN = 4.0, 256.0
# Fewest frequencies with a step, and how many there must be for each that has coefficients but no step (set
# by hand).
_FEWEST_STEPS, _MOST_OTHERS = 4, 4
# Largest number of coefficients of a block of sky that are not zero: hot pixels have more (set by hand).
_SKY_COEFFICIENTS = 12
# Distance, px, of a block of sky from a detection.
_SKY_PX = 16.0
# Noise over the narrowest step from which pixels are measurements well enough (set by hand).
_FINE = 0.5
# Noise over the step from which the step adds its variance, 1/12 of its square.
_LINEAR = 0.67
# Radius of a star's image, px: it then lies in nine blocks.
_RADIUS = 8
# Rounds of scoring, and its longest step along an axis, px.
_ROUNDS, _LARGEST_STEP_PX = 5, 0.4
# Largest deviation of a coefficient from its model, sigmas, that counts.
_LARGEST_SIGMA = 5.0
# Distance, px, from the place by pixels beyond which a star is another one.
_SAME_PX = 1.5
# Least SNR that the covariance is stated for: below it a place is no measurement.
_LEAST_SNR = 3.0


def places_in_rounded_blocks(
    image: NDArray[Any], xy_px: Floats, flux_dn: Floats, sky_dn: Floats, psf: Psf, gain_e_per_dn: float
) -> tuple[Floats, Floats, Bools] | None:
    """Places (N, 2), px, of stars of an image (H, W) of 8 bits, covariances (N, 2, 2), px^2, and which were
    found (N,), from approximate places (N, 2), fluxes (N,) and sky levels (N,), DN; None where the image has
    no blocks that are rounded by more than the noise."""
    if image.dtype != np.uint8 or len(xy_px) == 0:
        return None
    height, width = (side // _BLOCK * _BLOCK for side in image.shape)
    whole_blocks = image[:height, :width]
    blocks = _cosines_of(whole_blocks.astype(np.float32) - _MIDDLE_DN)
    steps = rounding_steps(blocks, _are_cut(whole_blocks))
    if steps is None:
        return None
    noise_dn = _noise_before(blocks, steps, xy_px)
    if noise_dn is None or noise_dn > _FINE * float(np.sort(steps.ravel())[1:4].mean()):
        return None
    pixels = np.rint(xy_px).astype(np.int64)
    first = pixels // _BLOCK - 1  # of nine blocks, the star in the middle one
    whole = ((first >= 0) & (first + 3 <= [width // _BLOCK, height // _BLOCK])).all(axis=1)
    xy, cov, found = xy_px.copy(), np.zeros((len(xy_px), 2, 2)), np.zeros(len(xy_px), dtype=bool)
    rows = np.flatnonzero(whole)
    at = first[rows, :, None] + np.arange(3)
    measured = blocks[at[:, 1, :, None], at[:, 0, None, :]]
    # widths of rounded stars do not tell the gain, but the sky has no more photon noise than all its noise
    gain_e_per_dn = max(gain_e_per_dn, float(np.median(sky_dn)) / noise_dn**2)
    stars = _Stars(pixels[rows], first[rows] * _BLOCK, measured, steps, noise_dn, psf, gain_e_per_dn)
    start = np.column_stack([xy_px[rows] - pixels[rows], flux_dn[rows], sky_dn[rows] - _MIDDLE_DN])
    state, covariance = stars.likeliest(start)
    snr = state[:, 2] / np.sqrt(covariance[:, 2, 2])
    factor = covariance_inflation(np.ones(len(snr)), np.ones(len(snr)), np.maximum(snr, _LEAST_SNR))
    xy[rows], cov[rows] = state[:, :2] + pixels[rows], covariance[:, :2, :2] * factor[:, None, None]
    moved = np.abs(state[:, :2] - start[:, :2]).max(axis=1, initial=0.0)
    found[rows] = (moved < _SAME_PX) & (state[:, 2] > 0.0) & np.isfinite(covariance).all(axis=(1, 2))
    return xy, cov, found


def _are_cut(image: NDArray[np.uint8]) -> Bools:
    """(R, C) blocks with a pixel of the least or the largest value: their coefficients are no multiples."""
    height, width = (side // _BLOCK for side in image.shape)
    blocks = image.reshape(height, _BLOCK, width, _BLOCK)
    return np.asarray((blocks.min(axis=(1, 3)) == 0) | (blocks.max(axis=(1, 3)) == np.iinfo(np.uint8).max))


def rounding_steps(blocks: NDArray[np.float32], cut: Bools) -> Floats | None:
    """(8, 8) steps, DN, of cosine coefficients (R, C, 8, 8), infinite where all are zero; None where the
    blocks were not rounded. Those that are `cut` (R, C) do not count.

    Blocks with few coefficients do not count: that their pixels are whole numbers changes all alike.
    """
    busy = blocks[((np.abs(blocks) > _NOT_ZERO_DN).sum(axis=(2, 3)) >= _BUSY) & ~cut]
    steps, others = np.full((_BLOCK, _BLOCK), np.inf), 0
    for k in range(_BLOCK * _BLOCK):
        row, column = divmod(k, _BLOCK)
        size = np.abs(busy[:, row, column])
        size = np.sort(size[size > _NOT_ZERO_DN])
        if len(size) < _FEWEST:
            continue
        tried = np.arange(_LEAST_STEP_DN, _LARGEST_STEP_DN)[:, None]
        off = np.abs(size - tried * np.rint(size / tried))
        multiples = (off < _ROUNDING_DN).mean(axis=1) > _MULTIPLES
        if multiples.any():
            steps[row, column] = tried[np.flatnonzero(multiples)[-1], 0]
        else:
            others += 1
    known = np.count_nonzero(np.isfinite(steps))
    rounded = known >= max(_FEWEST_STEPS, _MOST_OTHERS * others) and np.isfinite(steps[0, 0])
    return steps if rounded else None


def _noise_before(blocks: NDArray[np.float32], steps: Floats, xy_px: Floats) -> float | None:
    """Noise, DN, of a pixel before the blocks were rounded, by the shares of coefficients of sky that are not
    zero; None where all are."""
    rows, columns = blocks.shape[:2]
    sky = np.ones((rows, columns), dtype=bool)
    reach = int(np.ceil(_SKY_PX / _BLOCK))
    for column, row in (xy_px / _BLOCK).astype(np.int64):
        sky[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1] = False
    some = np.abs(blocks[sky]) > 0.5 * steps
    some[:, 0, 0] = False
    some = some[some.sum(axis=(1, 2)) <= _SKY_COEFFICIENTS]
    count = some.sum(axis=0)
    known = np.isfinite(steps) & (count >= _FEWEST // 3)
    if not known.any():
        return None
    share = count[known] / len(some)
    return float(np.median(0.5 * steps[known] / -ndtri(0.5 * share)))


@dataclass(frozen=True, slots=True, eq=False)
class _Stars:
    """Coefficients of the nine blocks about each of N stars, and what they are held against."""

    pixels: Ints  # (N, 2)
    corner: Ints  # (N, 2) pixel of the first block's corner
    measured: Floats  # (N, 3, 3, 8, 8)
    steps: Floats  # (8, 8)
    noise_dn: float
    psf: Psf
    gain_e_per_dn: float

    def likeliest(self, state: Floats) -> tuple[Floats, Floats]:
        """States (N, 4), column and row from the pixel, flux and level, of the largest likelihood of the
        intervals, and their covariances (N, 4, 4)."""
        known = np.zeros((len(state), 4, 4))
        # levels are known to the rounding of a block's mean
        start, known[:, 3, 3] = state, 12.0 * (_BLOCK / self.steps[0, 0]) ** 2
        for _ in range(_ROUNDS):
            gradient, normal = self._score(state)
            normal = normal + known
            step = np.linalg.solve(
                normal, (gradient + (known @ (start - state)[:, :, None])[:, :, 0])[..., None]
            )
            step = step[:, :, 0]
            step[:, :2] = np.clip(step[:, :2], -_LARGEST_STEP_PX, _LARGEST_STEP_PX)
            state = state + step
        return state, np.asarray(np.linalg.inv(normal), dtype=np.float64)

    def _score(self, state: Floats) -> tuple[Floats, Floats]:
        """Derivatives (N, 4) of the log likelihood by the state (N, 4), and the expected information
        (N, 4, 4)."""
        n, side = len(state), 3 * _BLOCK
        sigma = self.psf.sigma_at(self.pixels.astype(float))
        images = images_at(self.psf, self.pixels, state[:, :2], sigma, _RADIUS).columns[:, :4]
        window = np.zeros((n, 4, side, side), dtype=np.float32)
        across = (self.pixels - self.corner - _RADIUS)[:, :, None] + np.arange(2 * _RADIUS + 1)
        rows, columns = across[:, 1, :, None], across[:, 0, None, :]
        window[np.arange(n)[:, None, None], :3, rows, columns] = (
            images[:, :3].reshape(n, 3, 2 * _RADIUS + 1, 2 * _RADIUS + 1).transpose(0, 2, 3, 1)
        )
        window[:, 3] = 1.0
        signal = np.maximum(state[:, 2, None, None] * window[:, 2], 0.0)
        J = _cosines_of(window).astype(float)
        J[:, :2] *= state[:, 2, None, None, None, None, None]
        mean = state[:, 2, None, None, None, None] * J[:, 2] + state[:, 3, None, None, None, None] * J[:, 3]
        variance = _cosines_of(self.noise_dn**2 + signal / self.gain_e_per_dn, _COSINES**2)
        slope, information = _of_interval(self.measured, mean, np.sqrt(variance), self.steps)
        J = J.reshape(n, 4, -1)
        gradient = (J @ slope.reshape(n, -1, 1))[:, :, 0]
        return gradient, np.asarray((J * information.reshape(n, 1, -1)) @ J.transpose(0, 2, 1))


def _cosines_of(pixels: NDArray[Any], factors: Floats = _COSINES) -> NDArray[Any]:
    """Cosine coefficients (..., R, C, 8, 8) of the blocks of pixels (..., 8 R, 8 C)."""
    *lead, height, width = pixels.shape
    blocks = pixels.reshape(*lead, height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK).swapaxes(-3, -2)
    factors = factors.astype(pixels.dtype)
    return np.asarray(factors @ blocks @ factors.T)


def _of_interval(measured: Floats, mean: Floats, sigma: Floats, step: Floats) -> tuple[Floats, Floats]:
    """Derivatives of the log likelihood by the mean, and its expected information, of coefficients with
    normal errors `sigma` that were rounded to multiples of `step`; all of one shape but for `step` (8, 8)."""
    step = np.broadcast_to(step, mean.shape)
    fine = sigma > _LINEAR * step
    total = sigma**2 + step**2 / 12.0
    slope, information = (measured - mean) / total, 1.0 / total
    use = np.flatnonzero((~fine & np.isfinite(step)).ravel())
    slope[~fine], information[~fine] = 0.0, 0.0
    q, s, m, c = (values.ravel()[use] for values in (step, sigma, mean, measured))
    nearest = np.rint(m / q)
    edges = ((nearest[:, None] + np.arange(-2.5, 3.0)) * q[:, None] - m[:, None]) / s[:, None]
    below, density = ndtr(edges), np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi)
    chance, change = np.diff(below, axis=1), -np.diff(density, axis=1) / s[:, None]
    expected = (change**2 / np.maximum(chance, 1e-12)).sum(axis=1)
    low, high = (((np.rint(c / q) + half) * q - m) / s for half in (-0.5, 0.5))
    of_seen = np.exp(-0.5 * low**2) - np.exp(-0.5 * high**2)
    of_seen /= np.sqrt(2.0 * np.pi) * np.maximum(ndtr(high) - ndtr(low), 1e-12)
    far = np.maximum(np.maximum(low, -high), 0.0)  # sigmas outside the interval
    of_seen = np.where(far > _LARGEST_SIGMA, np.sign(low) * _LARGEST_SIGMA, of_seen)
    slope.ravel()[use] = of_seen / s
    information.ravel()[use] = expected
    return slope, information
