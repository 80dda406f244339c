"""Centroids of stars to a hundredth of a pixel, with covariances: maximum-likelihood fit of the PSF.

All stars of an image are fitted at once, each in its own window, by Gauss-Newton steps on column, row, flux
and local background. The variance of a pixel is the background's plus the photon noise of the fitted star;
the covariance is the inverse of the Fisher information (Winick 1986 for the bound). Saturated pixels have no
weight. Where the residuals exceed the noise, because the PSF is not a Gaussian, the covariance is scaled by
chi2 / dof.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import CLIP_SIGMA
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.psf import LARGEST_STEP_PX, Psf, PsfImages, images_at, newton_step, start_state
from boresight.star_id.finding.windows import StarWindows, star_windows

__all__ = ["Counts", "StarFits", "covariance_inflation", "fit_stars"]


# Step, in standard errors, at which a fit has converged: those after it add less than a twentieth of one.
_SMALL_STEP = 0.1
# Further steps of those that have not converged (set by hand; twice as many with a flat PSF).
_MORE_STEPS = 5
# Factor of each step with a PSF that is flat (rings, trails): full steps swing about the place (set by
# hand).
_DAMPING = 0.6
# Step, in standard errors, at which a fit that has not converged is good enough with a flat PSF (set by
# hand).
_SETTLED = 0.3
# Share of a window's pixels that are not saturated, below which the window is enlarged to the star's wings
# (set by hand).
_UNSATURATED = 0.75
# Radius of that window, widths of the PSF (set by hand).
_SATURATED_WINDOW_SIGMA = 9.0
# Share of a star's light that is missing in a dead pixel, at least (set by hand: a fit 1 px off misses less).
_DEAD = 0.8
# Excess of chi-square, in its standard deviations, from which a covariance is scaled by chi2 / dof: 1 good
# star in 4000.
_MISFIT_SIGMA = 3.5


@record(kw_only=True)
class StarFits:
    """Fitted stars, in the order of the pixels handed over. Row n of every array is the same star."""

    xy_px: Floats = array("N, 2", "centroids as (column, row)")
    cov_px: Floats = array("N, 2, 2", "covariances of the centroids, px^2")
    flux_dn: Floats = array("N", "total above the background, DN")
    flux_sigma_dn: Floats = array("N", "standard error of the flux by background noise alone, DN")
    chi2: Floats = array("N", "of the window's pixels")
    dof: Floats = array("N", "degrees of freedom of chi2")
    saturated: Bools = array("N", "whether some pixel of the window is saturated")
    converged: Bools = array("N", "whether the last step was small and the star is near its pixel")

    @property
    def snr(self) -> Floats:
        """(N,) flux over its standard error by background noise alone."""
        return self.flux_dn / self.flux_sigma_dn

    def take(self, index: NDArray[Any]) -> StarFits:
        """The fits at indices (M,) or of a mask (N,)."""
        return StarFits(**{name: getattr(self, name)[index] for name in _COLUMNS})


# Fields of `StarFits`, which all have a row a star.
_COLUMNS = tuple(field.name for field in fields(StarFits))


@record
class Counts:
    """What the counts of an image mean."""

    gain_e_per_dn: float = scalar("infinite: no photon noise")
    saturation_dn: float = scalar("value from which a pixel is saturated")


def fit_stars(
    image: NDArray[Any],
    pixels: Ints,
    offset: Floats,
    background: Background,
    psf: Psf,
    counts: Counts,
    *,
    one_step: bool = False,
) -> StarFits:
    """Fits of stars near `pixels` + `offset` (N, 2), whole pixels and starting offsets, as (column, row).

    Saturated pixels have no weight. With `one_step` the start is the star's place to a tenth of a pixel: the
    model is linear between both, and one step is enough.
    """
    if len(pixels) == 0:
        return _no_fits()
    sigma, gain = psf.sigma_at(pixels.astype(float)), counts.gain_e_per_dn
    # holds 99 % of the information on the place even of a star whose photons are all the noise
    radius = psf.shape_radius_px or max(3, int(np.ceil(CLIP_SIGMA * sigma.mean() + psf.reach_px)))
    windows = star_windows(image, pixels, background, radius, counts.saturation_dn)
    full = windows.saturated
    if full.any():
        full = full & (windows.good.mean(axis=1) < _UNSATURATED)
    if not full.any():
        return _fit(windows, pixels, offset, sigma, psf, gain, one_step)
    large = int(np.ceil(_SATURATED_WINDOW_SIGMA * sigma.mean() + psf.reach_px))
    wide = star_windows(image, pixels[full], background, large, counts.saturation_dn)
    parts = [
        _fit(windows.take(~full), pixels[~full], offset[~full], sigma[~full], psf, gain, one_step),
        _fit(wide, pixels[full], offset[full], sigma[full], psf, gain, one_step),
    ]
    order = np.argsort(np.concatenate([np.flatnonzero(~full), np.flatnonzero(full)]), kind="stable")
    joined = {name: np.concatenate([getattr(fit, name) for fit in parts]) for name in _COLUMNS}
    return StarFits(**joined).take(order)


def covariance_inflation(chi2: Floats, dof: Floats, snr: Floats) -> Floats:
    """Factors (N,) by which the covariances of centroids exceed the linearised ones of the noise.

    The first is chi2 / dof if the misfit is significant. The second is for faint stars: 1 + 3 / SNR^2 is the
    effect of curvature on a fit of noise. Near the threshold stars are detected when noise makes them
    brighter than they are, so that their covariance is too small; 230 / SNR^4 is found on rendered skies
    between SNR 5 and 8.
    """
    ratio = chi2 / dof
    misfit = np.where(ratio > 1.0 + _MISFIT_SIGMA * np.sqrt(2.0 / dof), ratio, 1.0)
    return np.asarray(misfit * (1.0 + 3.0 / snr**2 + 230.0 / snr**4))


def _fit(
    windows: StarWindows, pixels: Ints, start: Floats, sigma: Floats, psf: Psf, gain: float, one_step: bool
) -> StarFits:
    if len(pixels) == 0:
        return _no_fits()
    offset = windows.offsets(pixels + start)
    images = images_at(psf, windows.middles, offset, sigma, windows.radius)
    state = start_state(windows, offset, images)
    fit = _iterate(windows, state, images, sigma, psf, gain, steps=1 if one_step else 2)
    good = _without_outliers(fit, windows.saturated)
    slow = np.flatnonzero(((fit.last > _SMALL_STEP) & (not one_step)) | (good != fit.good).any(axis=1))
    if len(slow):
        rest = replace(windows.take(slow), good=good[slow])
        images = images_at(psf, rest.middles, fit.state[slow, :2], sigma[slow], windows.radius)
        steps = 1 if one_step else 2 * _MORE_STEPS if psf.is_flat else _MORE_STEPS
        more = _iterate(rest, fit.state[slow], images, sigma[slow], psf, gain, steps=steps)
        for name in [field.name for field in fields(fit)]:
            getattr(fit, name)[slow] = getattr(more, name)
    return _stars_of(fit, windows, pixels, psf, settled_px=LARGEST_STEP_PX if one_step else _SMALL_STEP)


@record
class _Fit:
    """State of all fits after the last step, and what it was computed from."""

    state: Floats  # (N, 4) after the last step
    normal: Floats  # (N, 4, 4)
    residual: NDArray[np.float32]  # (N, M)
    weight: NDArray[np.float32]  # (N, M)
    good: NDArray[np.float32]  # (N, M)
    value: NDArray[np.float32]  # (N, M) unit images
    last: Floats  # (N,) largest component of the last step, in standard errors
    last_px: Floats  # (N,) largest component of the last step, px


def _iterate(
    windows: StarWindows,
    state: Floats,
    images: PsfImages,
    sigma: Floats,
    psf: Psf,
    gain: float,
    *,
    steps: int,
) -> _Fit:
    """Up to `steps` Gauss-Newton steps on all stars from a state (N, 4) and its images."""
    for k in range(steps):
        if k > 0:
            images = images_at(psf, windows.middles, state[:, :2], sigma, windows.radius)
        step, normal, residual, weight = newton_step(windows, images, state, gain)
        moved = np.abs(step[:, :2])
        last = (moved * np.sqrt(np.einsum("npp->np", normal)[:, :2])).max(axis=1)
        step[:, :2] = np.minimum(np.maximum(step[:, :2], -LARGEST_STEP_PX), LARGEST_STEP_PX)
        if psf.is_flat:
            step *= _DAMPING
        state = state + step
        if last.max() < _SMALL_STEP:
            break
    return _Fit(state, normal, residual, weight, windows.good, images.value, last, moved.max(axis=1))


def _stars_of(fit: _Fit, windows: StarWindows, pixels: Ints, psf: Psf, *, settled_px: float) -> StarFits:
    settled = _SETTLED if psf.is_flat else 0.0
    cov = _safe_inverse(fit.normal)
    chi2 = np.einsum("nm,nm,nm->n", fit.residual, fit.residual, fit.weight).astype(float)
    dof = np.maximum(np.count_nonzero(fit.weight, axis=1) - 4.0, 1.0)
    sky_information = np.einsum("nm,nm,nm->n", fit.value, fit.value, fit.good) / windows.sky2
    flux_sigma = 1.0 / np.sqrt(np.maximum(sky_information, 1e-30))
    inflation = covariance_inflation(chi2, dof, np.maximum(fit.state[:, 2] / flux_sigma, 1.0))
    cov = cov[:, :2, :2] * inflation[:, None, None]
    if psf.error_factor is not None:
        cov = psf.error_factor @ cov @ psf.error_factor.T
    xy = fit.state[:, :2] + windows.middles
    reach = 2.0 if settled == 0.0 else 0.25 * windows.radius
    near = np.abs(xy - pixels).max(axis=1) < reach + windows.saturated * 4.0
    return StarFits(
        xy_px=xy,
        cov_px=cov,
        flux_dn=fit.state[:, 2],
        flux_sigma_dn=flux_sigma,
        chi2=chi2,
        dof=dof,
        saturated=windows.saturated,
        converged=((fit.last_px < settled_px) | (fit.last < settled)) & near & (fit.state[:, 2] > 0),
    )


def _without_outliers(fit: _Fit, saturated: Bools) -> NDArray[np.float32]:
    """`good` (N, M) without up to four pixels 6 sigma above the fit (a hot pixel, the edge of a neighbour) or
    below it, with hardly any of the light of a star that is not `saturated` (N,) (a dead pixel)."""
    star, pixel = (fit.residual**2 * fit.weight > 36.0).nonzero()
    residual, light = fit.residual[star, pixel], fit.state[star, 2] * fit.value[star, pixel]
    off = (residual > 0) | ((residual < -_DEAD * np.maximum(light, 0.0)) & ~saturated[star])
    star, pixel = star[off], pixel[off]
    few = np.bincount(star, minlength=len(fit.good))[star] <= 4
    good = fit.good.copy()
    good[star[few], pixel[few]] = 0.0
    return good


def _safe_inverse(normal: Floats) -> Floats:
    """Inverses (N, P, P) of normal matrices, scaled to unit diagonals first."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("npp->np", normal), 1e-30))
    both = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal * both) * both)


def _no_fits() -> StarFits:
    none: dict[str, Any] = dict.fromkeys(_COLUMNS, np.empty(0))
    none |= dict.fromkeys(("saturated", "converged"), np.empty(0, dtype=bool))
    return StarFits(**none | {"xy_px": np.empty((0, 2)), "cov_px": np.empty((0, 2, 2))})
