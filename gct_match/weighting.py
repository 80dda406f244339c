"""Which spatial frequencies of two pictures of one scene say where they lie: the weighting filter.

Two sensors see one scene, each with noise, aliasing and changes of its own. The maximum-likelihood
estimate of their offset filters both by |H|² = g² / (1 - g²) / |P_ab| with g² the squared coherence at
each frequency (Hannan & Thomson 1973; Knapp & Carter 1976, for two microphones). Where only white noise
separates them that is a mild low-pass; where light, season or haze changed the low frequencies, it turns
into a band-pass on its own. Coherence is measured from the pair itself, in rings of equal frequency.
Frequencies are in cycles per pixel.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

__all__ = [
    "band_pass",
    "change_px2",
    "coherence_filter",
    "derivatives",
    "inverse_spectrum",
    "point_spread",
    "spectrum",
]

Image = NDArray[Any]  # single precision
Spectrum = NDArray[Any]  # single precision, complex

_REGULAR = 0.005
_RING = 1.0 / 32.0  # width of a ring, cycles per pixel: hundreds of coefficients each on a 64 px chip


def spectrum(image: Image) -> Spectrum:
    """Half spectrum of a real picture, single precision."""
    return scipy.fft.rfft2(image)


def inverse_spectrum(half: Spectrum, shape: tuple[int, ...]) -> Image:
    """The real picture of a half spectrum."""
    return scipy.fft.irfft2(half, s=shape)


@lru_cache(maxsize=32)
def band_pass(shape: tuple[int, ...], low_px: float, high_px: float) -> Image:
    """Amplitude of a band-pass: a Gaussian of `low_px`, less its mean over a Gaussian of `high_px`; half
    spectrum.
    """
    f2 = _frequency(shape) ** 2
    low = np.exp(-2.0 * np.pi**2 * low_px**2 * f2)
    return (low * (1.0 - np.exp(-2.0 * np.pi**2 * high_px**2 * f2))).astype(np.float32)


@lru_cache(maxsize=32)
def point_spread(shape: tuple[int, ...], sigma_px: float) -> tuple[Image, Image]:
    """Half spectra of a Gaussian camera and of its regularised inverse."""
    blur = np.exp(-2.0 * np.pi**2 * sigma_px**2 * _frequency(shape) ** 2)
    return blur.astype(np.float32), (blur / (blur**2 + _REGULAR)).astype(np.float32)


def coherence_filter(a: Image, b: Image, shape: tuple[int, ...]) -> Image:
    """Amplitude of the weighting filter on the half spectrum of `shape`, measured from an aligned, tapered
    pair.

    Its scale is arbitrary: the largest amplitude is one.
    """
    A, B = scipy.fft.rfft2(a), scipy.fft.rfft2(b)
    ring = _ring(a.shape)
    count = _ring_count(a.shape)
    n = len(count)
    power_a = np.bincount(ring, _double(np.abs(A) ** 2).ravel(), n) / count
    power_b = np.bincount(ring, _double(np.abs(B) ** 2).ravel(), n) / count
    cross = np.bincount(ring, _double((A.conj() * B).real).ravel(), n) / count
    floor = 1e-9 * power_a.max() + 1e-30
    coherence = cross**2 / ((power_a + floor) * (power_b + 1e-9 * power_b.max() + 1e-30))
    chance = 1.0 / count  # a squared coherence of nothing but chance is one over the number of coefficients
    coherence = np.clip((coherence - chance) / (1.0 - chance), 0.0, 0.999)
    coherence[cross <= 0.0] = 0.0
    weight = coherence / (1.0 - coherence) / (np.abs(cross) + floor)
    weight[0] = min(weight[0], weight[1]) if n > 1 else weight[0]
    amplitude = np.sqrt(np.convolve(np.pad(weight, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid"))
    amplitude /= amplitude.max() + 1e-30
    centres = (np.arange(n) + 0.5) * _RING
    return np.interp(_frequency(shape), centres, amplitude).astype(np.float32)


def change_px2(residual: Image, template: Image) -> float:
    """How much the scene itself has changed, against its gradients, in px²: a measure of mismatch, not an
    error.

    Noise and aliasing fill the residual's high frequencies; what the low ones hold beyond them is change.
    Both pictures come tapered.
    """
    ring, count = _ring(residual.shape), _ring_count(residual.shape)
    n = len(count)
    frequency = (np.arange(n) + 0.5) * _RING
    power, of_template = (
        np.bincount(ring, _double(np.abs(scipy.fft.rfft2(image)) ** 2).ravel(), n) / count
        for image in (residual, template)
    )
    low, high = frequency < 0.25, (frequency > 0.3) & (frequency < 0.5)
    square = count[low] * (2.0 * np.pi * frequency[low]) ** 2
    excess = np.maximum(power[low] - power[high].min(), 0.0)
    return float(np.sum(square * excess) / (0.5 * np.sum(square * of_template[low]) + 1e-30))


@lru_cache(maxsize=32)
def derivatives(shape: tuple[int, ...]) -> tuple[Spectrum, Spectrum, Image]:
    """Multipliers of the half spectrum for d/dx, d/dy and the Laplacian."""
    fy = scipy.fft.fftfreq(shape[0])[:, None]
    fx = scipy.fft.rfftfreq(shape[1])[None, :]
    return (
        (2j * np.pi * fx * (np.abs(fx) < 0.5)).astype(np.complex64),
        (2j * np.pi * fy * (np.abs(fy) < 0.5)).astype(np.complex64),
        (-4.0 * np.pi**2 * (fx**2 + fy**2)).astype(np.float32),
    )


@lru_cache(maxsize=32)
def _frequency(shape: tuple[int, ...]) -> Image:
    fy = scipy.fft.fftfreq(shape[0])[:, None]
    fx = scipy.fft.rfftfreq(shape[1])[None, :]
    return np.hypot(fx, fy).astype(np.float32)


@lru_cache(maxsize=32)
def _ring(shape: tuple[int, ...]) -> NDArray[np.int64]:
    return (_frequency((shape[0], shape[1])) / _RING).astype(np.int64).ravel()


@lru_cache(maxsize=32)
def _ring_count(shape: tuple[int, ...]) -> NDArray[np.float64]:
    ones = np.ones((shape[0], shape[1] // 2 + 1))
    return np.maximum(np.bincount(_ring(shape), _double(ones).ravel()), 1.0)


def _double(half: NDArray) -> NDArray:
    """Weight of each coefficient of a half spectrum in the full one."""
    out = half.copy()
    out[:, 1:] *= 2.0
    return out
