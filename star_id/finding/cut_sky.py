"""A sky that is cut off at its least value, as consumer cameras clip it at zero: what it was, and how high
its noise rises after a filter.

With the level m sigmas above the cut a pixel is max(m + n, 0), n a unit normal. Its noise is less than before
the cut and is skewed; the mean of several pixels is less skewed. A detection limit follows from the gamma
distribution of the same variance and skewness (Pearson's type III).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainccinv, ndtr, ndtri  # scipy.stats takes 0.2 s to load

from boresight.records.record import Floats, Ints
from boresight.star_id.beyond_chance import NEVER_SIGMA

__all__ = [
    "FARTHEST_SIGMA",
    "LEAST_LEVELS_PER_SIGMA",
    "UNCUT",
    "after_cut",
    "clipped_variance",
    "cut_moments",
    "limit_after_cut",
]

# Height of the sky above the cut, sigmas, from where on nothing of it is cut off: 3e-7 of the pixels.
UNCUT = NEVER_SIGMA
# Farthest height from the level of the sky, sigmas, at which it is measured: 2 % of the pixels are beyond.
FARTHEST_SIGMA = 2.0
# Fewest grey levels for the noise of a pixel: coarser steps show neither its size nor faint stars (set by
# hand).
LEAST_LEVELS_PER_SIGMA = 1.5
# Largest share of a block's pixels at the cut for which quantiles of the rest are taken.
_MOST_CUT = 0.95
# Distance, sigmas, of the two quantiles whose difference gives the noise (set by hand).
_APART = 0.9


def cut_moments(counts: Ints, value: Floats, level: Floats, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """Level and noise (B,), (B,) of blocks whose histograms (B, bins) are cut off at their least `value`
    (bins,): two upper quantiles of the normal distribution that the sky was; and by how many of its sigmas
    its level was above the cut (B,).

    The level is the mean after the cut, the noise that before it. Blocks with too few pixels above the cut
    have the median noise of the others. Blocks whose noise is a few grey levels keep `level` and `noise`:
    their least value is no cut, and so do all where the least value is the last of the histogram: an image
    that is saturated throughout.
    """
    if len(value) < 2:
        return level, noise, np.full(len(level), UNCUT)
    share = np.cumsum(counts, axis=1) / counts.sum(axis=1, keepdims=True)
    least, step = share[:, 0], value[1] - value[0]
    z = ndtri(np.clip(least + 0.05, 0.55, 0.97))
    quantiles = [np.interp([ndtr(at), ndtr(at + _APART)], row, value) for at, row in zip(z, share)]
    lower, upper = np.array(quantiles).T
    sigma, seen = (upper - lower) / _APART, least < _MOST_CUT
    cut = (sigma > LEAST_LEVELS_PER_SIGMA * step) & seen
    if cut.any():
        sigma[~seen] = np.median(sigma[cut])
        cut |= ~seen
    above = (lower - value[0]) / np.maximum(sigma, step) - z
    above[~seen] = -ndtri(np.minimum(least[~seen], ndtr(FARTHEST_SIGMA)))
    mean = value[0] + sigma * _moments(above)[0]
    return np.where(cut, mean, level), np.where(cut, sigma, noise), np.where(cut, above, UNCUT)


def limit_after_cut(above: Floats, sigmas: float, pixels: float) -> Floats:
    """Height over the level (B,), in sigmas of the noise before the cut, that a mean of so many pixels
    exceeds as rarely as a normal variable `sigmas`; `above` as of `cut_moments`. A mean with weights counts
    as that of as many pixels as have the same skewness."""
    _, variance, skewness = _moments(np.clip(above, -FARTHEST_SIGMA, UNCUT))
    shape = 4.0 * pixels / np.maximum(skewness, 1e-3) ** 2
    gamma = (gammainccinv(shape, ndtr(-sigmas)) - shape) / np.sqrt(shape)
    return np.where(above < UNCUT, np.sqrt(variance) * gamma, sigmas)


def after_cut(above: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Mean and variance of max(above + n, 0), n a unit normal, and the derivative of the mean by `above`;
    all of its shape (N, M)."""
    whole, density = ndtr(above), np.exp(-0.5 * above**2) * (1.0 / np.sqrt(2.0 * np.pi))
    mean = above * whole + density
    return mean, (above**2 + 1.0) * whole + above * density - mean**2, whole


def clipped_variance(sigmas: float) -> float:
    """Variance of a unit normal of which nothing farther than so many sigmas from its mean is left."""
    density = np.exp(-0.5 * sigmas**2) / np.sqrt(2.0 * np.pi)
    return float(1.0 - 2.0 * sigmas * density / (2.0 * ndtr(sigmas) - 1.0))


def _moments(above: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean, variance and skewness of max(above + n, 0), n a unit normal."""
    mean, variance, whole = after_cut(above)
    third = (above**2 + 2.0) * mean + above * whole  # mean cube
    return mean, variance, (third - 3.0 * mean * variance - mean**3) / variance**1.5
