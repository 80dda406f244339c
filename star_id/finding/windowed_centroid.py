"""Windowed centroids: the first moment of a star under a Gaussian window as wide as the PSF, iterated.

The window moves to the moment until it is stationary (Bertin & Arnouts 1996; SExtractor's XWIN_IMAGE). A
symmetric image gives no bias, whatever its shape. Where background noise dominates this is as precise as the
fit, where photon noise dominates somewhat less. The covariance is the propagated noise of the pixels: with g
the window's weights, d the pixels' offsets from the centre, I and v their signal and its variance, s the
window's width,

    A = sum g I (1 - d dT / s^2),   C = A^-1 [sum g^2 v d dT] A^-T
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.record import Floats, Ints
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.centroid import Counts, StarFits, covariance_inflation
from boresight.star_id.finding.psf import Psf, psf_images
from boresight.star_id.finding.window_fit import start_state
from boresight.star_id.finding.windows import star_windows

__all__ = ["windowed_centroids"]


# Least width of the window's Gaussian, px: a narrower one on a narrow star is biased by the place within
# the pixel.
_LEAST_WIDTH_PX = 1.1
# Radius of the window in its widths: its weight is 1 % there, and the signal 1 % of the peak.
_WINDOW_SIGMA = 3.0
# Most steps of moving the window to the centroid (set by hand).
_STEPS = 20
# Step, in widths of the window, at which it has converged.
_SMALL_STEP = 0.002


def windowed_centroids(
    image: NDArray[Any], pixels: Ints, offset: Floats, background: Background, psf: Psf, counts: Counts
) -> StarFits:
    """Centroids of stars near `pixels` + `offset` (N, 2), with the arguments of `centroid.fit_stars`.

    Saturated pixels are used as they are, so the covariances of saturated stars are too small.
    """
    sigma = psf.sigma_at(pixels.astype(float))
    width = np.maximum(sigma, _LEAST_WIDTH_PX)
    smear = 0.5 * float(np.hypot(*psf.smear_px))
    radius = max(3, int(np.ceil(_WINDOW_SIGMA * float(width.mean() if len(width) else 1.0) + smear)))
    windows = star_windows(image, pixels, background, radius, counts.saturation_dn)
    centre = windows.offsets(pixels + offset)
    moved = np.full(len(pixels), np.inf)
    for _ in range(_STEPS):
        weight, d = _window(centre, width, radius)
        light = weight * windows.data
        step = 2.0 * (light[:, None] * d).sum(axis=2) / _nonzero(light.sum(axis=1))[:, None]
        step = np.clip(step, -0.5, 0.5)
        moved = np.abs(step).max(axis=1, initial=0.0)
        centre = centre + step
        if (moved < _SMALL_STEP * width).all():
            break
    images = psf_images(centre, sigma, psf.smear_px, radius)
    _, _, flux, sky = start_state(windows, centre, images).T
    unit, noise2 = images.value.astype(float), windows.noise2[:, None]
    signal = flux[:, None] * unit
    variance = noise2 + np.maximum(signal, 0.0) / counts.gain_e_per_dn
    chi2 = ((windows.data - sky[:, None] - signal) ** 2 / variance).sum(axis=1)
    dof = np.full(len(flux), unit.shape[1] - 4.0)
    flux_sigma = np.sqrt(1.0 / np.maximum((unit**2 / noise2).sum(axis=1), 1e-30))
    inflation = covariance_inflation(chi2, dof, np.maximum(flux / flux_sigma, 1.0))
    xy = centre + windows.corner + windows.radius
    near = np.abs(xy - pixels).max(axis=1, initial=0.0) < 2.0
    return StarFits(
        xy_px=xy,
        cov_px=_covariance(centre, signal, variance, width, radius) * inflation[:, None, None],
        flux_dn=flux,
        flux_sigma_dn=flux_sigma,
        chi2=chi2,
        dof=dof,
        saturated=windows.saturated,
        converged=(moved < 0.1) & near & (flux > 0),
    )


def _covariance(centre: Floats, signal: Floats, variance: Floats, width: Floats, radius: int) -> Floats:
    weight, d = _window(centre, width, radius)
    light = weight * signal
    slope = light.sum(axis=1)[:, None, None] * np.eye(2)
    slope -= (light[:, None] * d) @ d.transpose(0, 2, 1) / width[:, None, None] ** 2
    slope += 1e-12 * np.eye(2)
    noise = (weight[:, None] ** 2 * variance[:, None] * d) @ d.transpose(0, 2, 1)
    inverse = np.linalg.inv(slope)
    return np.asarray(inverse @ noise @ inverse.transpose(0, 2, 1))


def _window(centre: Floats, width: Floats, radius: int) -> tuple[Floats, Floats]:
    """Weights (N, M) of a window's pixels, 1 in the middle, and their offsets (N, 2, M) from it."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    d = np.stack([x.ravel(), y.ravel()]) - centre[:, :, None]
    return np.exp(-0.5 * (d**2).sum(axis=1) / width[:, None] ** 2), d


def _nonzero(light: Floats) -> Floats:
    return np.where(np.abs(light) > 1e-9, light, 1e-9)
