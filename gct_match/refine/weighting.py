"""Which spatial frequencies of two pictures of one scene say where they lie: the weighting filter.

Two sensors see one scene, each with noise, aliasing and changes of its own. The maximum-likelihood
estimate of their offset filters both by |H|² = g² / (1 - g²) / |P_ab| with g² the squared coherence at
each frequency (Hannan & Thomson 1973; Knapp & Carter 1976, for two microphones). Where only white noise
separates them that is a mild low-pass; where light, season or haze changed the low frequencies, it turns
into a band-pass on its own. Coherence is measured from the pair itself, in rings of equal frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.spectra import frequency, padded_shape, ring_means, rings

__all__ = ["Weighting", "weighting"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_STEPS = 512  # of the table from which a filter is read
_HIGHEST = 0.75  # cycles per pixel, beyond the corner of a spectrum


@dataclass(frozen=True, slots=True, eq=False)
class Weighting:
    """The weighting filter of a pair."""

    amplitude: Image  # packed, for the pair's padded shape; its scale is arbitrary, the largest is one
    spread_px2: float  # second moment of its kernel along an axis, mean over what the pair has in common


def weighting(template: Image, picture: Image, weight: Image) -> Weighting:
    """From an aligned pair (h, w), at least 8 px a side, where `weight` (h, w) lets it count."""
    taper = _taper(*template.shape) * np.sqrt(weight)
    total = taper.sum() + np.float32(1e-12)
    a, b = ((image - np.vdot(image, taper) / total) * taper for image in (template, picture))
    ring, count = rings(template.shape)
    power_a, power_b, common = ring_means(a, b)
    squared = _most_likely(power_a, power_b, common, count)
    amplitude = np.sqrt(squared)
    amplitude /= amplitude.max() + 1e-30
    steps = np.arange(_STEPS) * (_HIGHEST / _STEPS)
    table = np.interp(steps, ring, amplitude).astype(np.float32)
    # a Gaussian of sigma s has the slope -4 pi² s² f times itself
    shared = count * np.maximum(common, 0.0)
    slope = 0.5 * np.gradient(amplitude**2, ring[1] - ring[0])
    spread = -np.sum(shared * ring * slope) / (
        4.0 * np.pi**2 * np.sum(shared * (ring * amplitude) ** 2) + 1e-30
    )
    return Weighting(table.take(_step(padded_shape(template.shape))), float(spread))


def _most_likely(power_a: Array, power_b: Array, common: Array, count: Array) -> Array:
    """|H|² in each ring, from the mean powers of two pictures and their real cross power."""
    floor = 1e-9 * power_a.max() + 1e-30
    power = (power_a + floor) * (power_b + 1e-9 * power_b.max() + 1e-30)
    chance = 1.0 / count  # what nothing but chance would give
    g2 = np.clip((common**2 / power - chance) / (1.0 - chance), 0.0, 0.999)
    g2[common <= 0.0] = 0.0
    weight = g2 / (1.0 - g2) / (np.abs(common) + floor)
    weight[0] = min(weight[0], weight[1])
    smooth: Array = 0.5 * weight
    smooth[1:] += 0.25 * weight[:-1]
    smooth[:-1] += 0.25 * weight[1:]
    smooth[[0, -1]] += 0.25 * weight[[0, -1]]
    return smooth


@lru_cache(maxsize=16)
def _taper(h: int, w: int) -> Image:
    return np.outer(np.hanning(h + 2)[1:-1], np.hanning(w + 2)[1:-1]).astype(np.float32)


@lru_cache(maxsize=32)
def _step(shape: tuple[int, int]) -> NDArray[np.intp]:
    return np.round(frequency(shape) * (_STEPS / _HIGHEST)).astype(np.intp)
