"""Weighting filter for the offset of two pictures of one scene, from their coherence.

Each picture has noise, aliasing and changes of its own. The maximum-likelihood estimate of the offset
filters both by |H|² = g² / (1 - g²) / |P_ab| with g² the squared coherence at each frequency (Hannan &
Thomson 1973; Knapp & Carter 1976, for two microphones): a mild low-pass for white noise, a band-pass where
light, season or haze changed the low frequencies. Coherence is estimated from the pair, in rings of equal
frequency.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.spectra import frequency, padded_shape, ring_means, rings
from boresight.gct_match.records import Image
from boresight.records.record import Floats, array, record, scalar

__all__ = ["Weighting", "weighting"]

_STEPS = 512  # of the table from which a filter is read
_HIGHEST = 0.75  # cycles per pixel, beyond the corner of a spectrum


@record
class Weighting:
    """The weighting filter of a pair."""

    amplitude: Image = array("H, W", "packed, for the pair's padded shape; the largest is one")
    spread_px2: float = scalar("second moment of its kernel along an axis, weighted with the common power")


def weighting(template: Image, picture: Image, weight: Image) -> Weighting:
    """Filter of an aligned pair (h, w), at least 8 px a side, with pixel weights `weight` (h, w)."""
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


def _most_likely(power_a: Floats, power_b: Floats, common: Floats, count: Floats) -> Floats:
    """|H|² in each ring, from the mean powers of two pictures and their real cross power."""
    floor = 1e-9 * power_a.max() + 1e-30
    power = (power_a + floor) * (power_b + 1e-9 * power_b.max() + 1e-30)
    chance = 1.0 / count  # squared coherence of unrelated pictures
    g2 = np.clip((common**2 / power - chance) / np.maximum(1.0 - chance, 1e-9), 0.0, 0.999)
    g2[common <= 0.0] = 0.0
    weight = g2 / (1.0 - g2) / (np.abs(common) + floor)
    weight[0] = min(weight[0], weight[1])
    smooth: Floats = 0.5 * weight
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
