"""Places of stars without a fit: the first moment of their light under a Gaussian window as wide as the PSF.

The window is moved to the moment until it stays (Bertin & Arnouts 1996; SExtractor's XWIN_IMAGE). An image
that is symmetrical gives no bias, whatever its shape. Where the sky's noise rules this is as good as the fit,
where the star's own rules somewhat worse. The covariance is the pixels' noise propagated: with g the window's
weights, d the pixels' distances from the centre, I and v their light and its variance, s the window's width,

    A = sum g I (1 - d dT / s^2),   C = A^-1 [sum g^2 v d dT] A^-T
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.finding.background import Background
from boresight.star_id.finding.centroid import StarFits, faint_star_inflation
from boresight.star_id.finding.psf import Psf, psf_images
from boresight.star_id.finding.window_fit import start_state
from boresight.star_id.finding.windows import star_windows

__all__ = ["windowed_centroids"]

Array = NDArray[np.float64]

_LEAST_WIDTH_PX = 1.1  # a narrower window on a narrow star would feel the pixels
_WINDOW_SIGMA = 3.0  # the window's weight there is 1 %, of light that is 1 % of the peak
_STEPS = 20
_SMALL_STEP = 0.002  # of the window's width


def windowed_centroids(
    image: NDArray,
    places: NDArray[np.int64],
    offset: Array,
    background: Background,
    psf: Psf,
    *,
    gain_e_per_dn: float,
    saturation_dn: float,
) -> StarFits:
    """Centroids near `places` + `offset` (N, 2), as `star_id.finding.centroid.fit_stars` gives them.

    Full pixels count as they are, so the covariances of saturated stars are too small.
    """
    sigma = psf.sigma_at(places.astype(float))
    width = np.maximum(sigma, _LEAST_WIDTH_PX)
    smear = 0.5 * float(np.hypot(*psf.smear_px))
    radius = max(3, int(np.ceil(_WINDOW_SIGMA * float(width.mean() if len(width) else 1.0) + smear)))
    windows = star_windows(image, places, background, radius, saturation_dn)
    centre = windows.offsets(places + offset)
    moved = np.full(len(places), np.inf)
    for _ in range(_STEPS):
        weight, d = _window(centre, width, radius)
        light = weight * windows.data
        step = 2.0 * (light[:, None] * d).sum(axis=2) / _not_zero(light.sum(axis=1))[:, None]
        step = np.clip(step, -0.5, 0.5)
        moved = np.abs(step).max(axis=1, initial=0.0)
        centre = centre + step
        if (moved < _SMALL_STEP * width).all():
            break
    images = psf_images(centre, sigma, psf.smear_px, radius)
    _, _, flux, sky = start_state(windows, centre, images).T
    unit, noise2 = images.value.astype(float), windows.noise2[:, None]
    signal = flux[:, None] * unit
    variance = noise2 + np.maximum(signal, 0.0) / gain_e_per_dn
    chi2 = ((windows.data - sky[:, None] - signal) ** 2 / variance).sum(axis=1)
    dof = np.full(len(flux), unit.shape[1] - 4.0)
    flux_sigma = np.sqrt(1.0 / np.maximum((unit**2 / noise2).sum(axis=1), 1e-30))
    ratio = chi2 / dof
    inflation = np.where(ratio > 1.0 + 3.5 * np.sqrt(2.0 / dof), ratio, 1.0)
    inflation = inflation * faint_star_inflation(np.maximum(flux / flux_sigma, 1.0))
    xy = centre + windows.corner + windows.radius
    near = np.abs(xy - places).max(axis=1, initial=0.0) < 2.0
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


def _covariance(centre: Array, signal: Array, variance: Array, width: Array, radius: int) -> Array:
    weight, d = _window(centre, width, radius)
    light = weight * signal
    slope = light.sum(axis=1)[:, None, None] * np.eye(2)
    slope -= (light[:, None] * d) @ d.transpose(0, 2, 1) / width[:, None, None] ** 2
    slope += 1e-12 * np.eye(2)
    noise = (weight[:, None] ** 2 * variance[:, None] * d) @ d.transpose(0, 2, 1)
    inverse = np.linalg.inv(slope)
    return np.asarray(inverse @ noise @ inverse.transpose(0, 2, 1))


def _window(centre: Array, width: Array, radius: int) -> tuple[Array, Array]:
    """Weights (N, M) of a window's pixels, 1 in the middle, and their distances (N, 2, M) from it."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    d = np.stack([x.ravel(), y.ravel()]) - centre[:, :, None]
    return np.exp(-0.5 * (d**2).sum(axis=1) / width[:, None] ** 2), d


def _not_zero(light: Array) -> Array:
    return np.where(np.abs(light) > 1e-9, light, 1e-9)
