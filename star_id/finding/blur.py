"""Coma of the lens and trails of motion: PSFs of few parameters, fitted to the images of bright stars.

A Gaussian fitted to a comatic fan lies between the fan's tip and the middle of its light, the farther from
either the longer the fan: the field of view seems to be another. Where widths grow towards the corners, two
lengths, outwards and inwards, explain the growth; the one that fits the stars' images better is refined
together with the width. An even trail has sharp ends that an empirical image of few stars shows with their
noise: where a smeared Gaussian explains the stars as well, it is the PSF.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.record import Floats
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.psf import Psf, PsfImages, images_at, shape_images
from boresight.star_id.finding.window_fit import newton_step, noise_gain, start_state
from boresight.star_id.finding.windows import StarWindows, star_windows

__all__ = ["explains_better", "find_coma", "find_trail"]

_GROWTH = 1.05  # of the widths from the centre to the corners: less is no matter
_LENGTH2 = 27.0  # squared length of a fan over half the trace of its second moments
_FEWEST = 12
_LONGEST_PX = 24.0
_STEPS = 3
_BETTER = 0.8  # times the misfit of the widths alone
_BEYOND_CHANCE = 50.0  # of chi2: 6 standard errors, three parameters
_TRAIL_SIGMA = 3.0  # a shorter one is found by its second moments alone
_LIGHT = 0.1  # of the peak: what is fainter is left out of an empirical image's moments
_AS_GOOD = 1.2  # times the misfit of the empirical image, which is fitted to the same stars


def find_coma(
    image: NDArray, xy_px: Floats, background: Background, psf: Psf, *, saturation_dn: float
) -> tuple[Psf, float] | None:
    """PSF with coma, and the gain, e-/DN, that the residuals about it show; None where it explains the images
    of the stars at `xy_px` (N, 2) no better than `psf`."""
    growth2 = psf.sigma_corner_px**2 - psf.sigma_px**2
    if psf.sigma_corner_px < _GROWTH * psf.sigma_px or len(xy_px) < _FEWEST:
        return None
    length = float(np.sqrt(_LENGTH2 * growth2))
    if length > _LONGEST_PX:
        return None
    radius = int(np.ceil(3.0 * psf.sigma_px + 0.5 * length)) + 1
    windows = star_windows(image, np.rint(xy_px).astype(np.int64), background, radius, saturation_dn)
    start = windows.offsets(xy_px)

    def comatic(theta: Floats) -> Psf:
        sigma = float(np.exp(theta[0]))
        return replace(psf, sigma_px=sigma, sigma_corner_px=sigma, coma_px=float(theta[1]))

    tries = [np.array([np.log(psf.sigma_px), sign * length]) for sign in (1.0, -1.0)]
    best = min(tries, key=lambda theta: _chi2(windows, start, comatic(theta)))
    found = _refined(windows, start, comatic, best)
    return (found, _gain(windows, start, found)) if _is_better(windows, start, found, psf) else None


def explains_better(
    image: NDArray, xy_px: Floats, background: Background, psf: Psf, other: Psf, *, saturation_dn: float
) -> bool:
    """Whether the empirical PSF `psf` explains the images of the stars at `xy_px` (N, 2) better than
    `other`."""
    if not len(xy_px):
        return False
    pixels, radius = np.rint(xy_px).astype(np.int64), psf.shape_radius_px
    windows = star_windows(image, pixels, background, radius, saturation_dn)
    return _is_better(windows, windows.offsets(xy_px), psf, other)


def _is_better(windows: StarWindows, start: Floats, psf: Psf, other: Psf) -> bool:
    after, before = (_chi2(windows, start, each) for each in (psf, other))
    dof = windows.data.size
    return after - dof < _BETTER * (before - dof) and before - after > _BEYOND_CHANCE


def find_trail(
    image: NDArray, xy_px: Floats, background: Background, psf: Psf, *, saturation_dn: float
) -> tuple[Psf, float] | None:
    """Smeared Gaussian in place of the empirical PSF `psf`, and the gain, e-/DN, that the residuals about it
    show; None where it explains the images of the stars at `xy_px` (N, 2) less well."""
    assert psf.shape is not None
    radius = psf.shape_radius_px
    value = shape_images(psf.shape, np.zeros((1, 2)), radius).value.reshape(2 * radius + 1, -1).astype(float)
    light = np.where(value > _LIGHT * value.max(), value, 0.0)
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    moments = np.array([[(light * x * x).sum(), (light * x * y).sum()], [0.0, (light * y * y).sum()]])
    (across2, along2), axes = np.linalg.eigh(moments / light.sum(), UPLO="U")
    length, width = np.sqrt(12.0 * (along2 - across2)), np.sqrt(across2)
    if length < _TRAIL_SIGMA * width or len(xy_px) < _FEWEST:
        return None
    windows = star_windows(image, np.rint(xy_px).astype(np.int64), background, radius, saturation_dn)
    start = windows.offsets(xy_px)

    def smeared(theta: Floats) -> Psf:
        sigma, smear = float(np.exp(theta[0])), (float(theta[1]), float(theta[2]))
        return replace(psf, sigma_px=sigma, sigma_corner_px=sigma, smear_px=smear, shape=None)

    found = _refined(windows, start, smeared, np.array([np.log(width), *(length * axes[:, 1])]))
    before, after = (_chi2(windows, start, each) for each in (psf, found))
    dof = windows.data.size
    if after - dof > _AS_GOOD * max(before - dof, 0.0) + _BEYOND_CHANCE:
        return None
    return found, _gain(windows, start, found)


def _refined(windows: StarWindows, start: Floats, psf_of: Callable[[Floats], Psf], theta: Floats) -> Psf:
    """PSF with the parameters (P,) that explain the windows best: a logarithmic width, and lengths in px."""
    from scipy.optimize import least_squares  # 0.1 s to load, and seldom needed

    def residuals(theta: Floats) -> Floats:
        return _fitted(windows, start, psf_of(theta))[0]

    scale = np.append(0.1, np.full(len(theta) - 1, np.abs(theta[1:]).max()))
    return psf_of(least_squares(residuals, theta, diff_step=0.02, max_nfev=8, x_scale=scale).x)


def _chi2(windows: StarWindows, start: Floats, psf: Psf) -> float:
    return float((_fitted(windows, start, psf)[0] ** 2).sum())


def _gain(windows: StarWindows, start: Floats, psf: Psf) -> float:
    _, state, images = _fitted(windows, start, psf)
    return noise_gain(windows, images.value, state[:, 2], state[:, 3])


def _fitted(windows: StarWindows, start: Floats, psf: Psf) -> tuple[Floats, Floats, PsfImages]:
    """Residuals over the noise, all in one row, states (N, 4) and unit images (N, M) of the stars with a
    PSF."""
    pixels = windows.corner + windows.radius
    sigma, offset = psf.sigma_at(pixels.astype(float)), start
    state: Floats = np.empty((len(start), 4))
    for k in range(_STEPS):
        images = images_at(psf, pixels, offset, sigma, windows.radius)
        if k == 0:
            state = start_state(windows, offset, images)
        step, _, residual, weight = newton_step(windows, images, state, np.inf)
        state = state + np.column_stack([np.clip(step[:, :2], -0.8, 0.8), step[:, 2:]])
        offset = state[:, :2]
    return np.asarray((residual * np.sqrt(weight)).ravel(), dtype=float), state, images
