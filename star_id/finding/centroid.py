"""Places of stars to a hundredth of a pixel: a maximum-likelihood fit of the PSF, each with its covariance.

All stars of an image are fitted at once, each in its own window, by Gauss-Newton steps on column, row, flux
and local sky. A pixel's variance is the sky's own plus the photon noise of the fitted star; the covariance is
the inverse of the Fisher information (Winick 1986 for the bound). Saturated pixels carry no weight. Where the
residuals are larger than noise allows - a lens is not a Gaussian - the covariance grows with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.finding.background import Background
from boresight.star_id.finding.psf import Psf, PsfImages, psf_images
from boresight.star_id.finding.window_fit import newton_step, start_state
from boresight.star_id.finding.windows import StarWindows, star_windows

__all__ = ["StarFits", "faint_star_inflation", "fit_stars"]

Array = NDArray[np.float64]

_SMALL_STEP = 0.1  # of the standard error: the steps after one so small add less than a twentieth of it
_STEPS = 2  # for all stars
_MORE_STEPS = 5  # for those still on their way
_LARGEST_STEP_PX = 0.8
_GOOD_SHARE = 0.75  # of a window's pixels; where more are full, light is found further out
_SATURATED_WINDOW_SIGMA = 9.0
_WINDOW_SIGMA = 3.0  # and half a pixel or more: 99 % of the information even on a photon-limited star


@dataclass(frozen=True, slots=True, eq=False)
class StarFits:
    """One row a star, in the order of the places that were handed over."""

    xy_px: Array  # (N, 2)
    cov_px: Array  # (N, 2, 2) px^2
    flux_dn: Array  # (N,)
    flux_sigma_dn: Array  # (N,)
    chi2: Array  # (N,) of the window's pixels
    dof: Array  # (N,)
    saturated: NDArray[np.bool_]  # (N,) some pixel of the window is at the top of the range
    converged: NDArray[
        np.bool_
    ]  # (N,) the last step was small, the star within two pixels of where it was seen

    @property
    def snr(self) -> Array:
        """(N,) flux over its own standard error against the sky alone."""
        return self.flux_dn / self.flux_sigma_dn

    def take(self, index: NDArray) -> StarFits:
        return StarFits(*(getattr(self, name)[index] for name in self.__slots__))

    def with_rows(self, index: NDArray[np.int64], rows: StarFits) -> StarFits:
        """The same fits, those at `index` replaced by `rows`."""
        arrays = {name: getattr(self, name).copy() for name in self.__slots__}
        for name, array in arrays.items():
            array[index] = getattr(rows, name)
        return StarFits(**arrays)


def fit_stars(
    image: NDArray,
    places: NDArray[np.int64],
    offset: Array,
    background: Background,
    psf: Psf,
    *,
    gain_e_per_dn: float,
    saturation_dn: float,
) -> StarFits:
    """Fits stars near `places` + `offset` (N, 2), whole pixels and what to add to them to begin with.

    `gain_e_per_dn` may be infinite: no photon noise.
    """
    n = len(places)
    if n == 0:
        return _no_fits()
    smear = 0.5 * float(np.hypot(*psf.smear_px))
    sigma = psf.sigma_at(places.astype(float))
    radius = max(3, int(np.ceil(_WINDOW_SIGMA * sigma.mean() + smear)))
    windows = star_windows(image, places, background, radius, saturation_dn)
    full = windows.saturated & (windows.good.mean(axis=1) < _GOOD_SHARE)
    if not full.any():
        return _fit(windows, places, offset, sigma, psf, gain_e_per_dn)
    large = int(np.ceil(_SATURATED_WINDOW_SIGMA * sigma.mean() + smear))
    wide = star_windows(image, places[full], background, large, saturation_dn)
    parts = [
        _fit(windows.take(~full), places[~full], offset[~full], sigma[~full], psf, gain_e_per_dn),
        _fit(wide, places[full], offset[full], sigma[full], psf, gain_e_per_dn),
    ]
    order = np.argsort(np.concatenate([np.flatnonzero(~full), np.flatnonzero(full)]))
    joined = [np.concatenate([getattr(fit, name) for fit in parts]) for name in StarFits.__slots__]
    return StarFits(*joined).take(order)


def faint_star_inflation(snr: Array) -> Array:
    """(N,) scatter of faint stars' places over the linear covariance at the flux that was measured.

    1 + 3 / SNR^2 is what curvature adds to a fit of noise. Near the threshold stars are seen when noise makes
    them brighter than they are, so that their covariance comes out too small; 230 / SNR^4 is what rendered
    skies show between SNR 5 and 8.
    """
    return np.asarray(1.0 + 3.0 / snr**2 + 230.0 / snr**4)


def _fit(
    windows: StarWindows, places: NDArray[np.int64], start: Array, sigma: Array, psf: Psf, gain: float
) -> StarFits:
    if len(places) == 0:
        return _no_fits()
    offset = windows.offsets(places + start)
    images = psf_images(offset, sigma, psf.smear_px, windows.radius)
    state = start_state(windows, offset, images)
    fit = _iterate(windows, state, images, sigma, psf, gain, steps=_STEPS)
    sound = _without_outliers(fit)
    slow = np.flatnonzero((fit.last > _SMALL_STEP) | (sound != fit.good).any(axis=1))
    if len(slow):
        rest = replace(windows.take(slow), good=sound[slow])
        images = psf_images(fit.state[slow, :2], sigma[slow], psf.smear_px, windows.radius)
        more = _iterate(rest, fit.state[slow], images, sigma[slow], psf, gain, steps=_MORE_STEPS)
        for name in _Fit.__slots__:
            getattr(fit, name)[slow] = getattr(more, name)
    return _stars_of(fit, windows, places)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    state: Array  # (N, 4) after the last step
    normal: Array  # (N, 4, 4)
    residual: NDArray[np.float32]  # (N, M)
    weight: NDArray[np.float32]  # (N, M)
    good: NDArray[np.float32]  # (N, M)
    value: NDArray[np.float32]  # (N, M) unit images
    last: Array  # (N,) largest component of the last step, in standard errors
    last_px: Array  # (N,) the same in pixels


def _iterate(
    windows: StarWindows,
    state: Array,
    images: PsfImages,
    sigma: Array,
    psf: Psf,
    gain: float,
    *,
    steps: int,
) -> _Fit:
    """Gauss-Newton steps on all stars from a state and its images."""
    for k in range(steps):
        if k > 0:
            images = psf_images(state[:, :2], sigma, psf.smear_px, windows.radius)
        step, normal, residual, weight = newton_step(windows, images, state, gain)
        moved = np.abs(step[:, :2])
        last = (moved * np.sqrt(np.einsum("npp->np", normal)[:, :2])).max(axis=1)
        step[:, :2] = np.clip(step[:, :2], -_LARGEST_STEP_PX, _LARGEST_STEP_PX)
        state = state + step
        if last.max() < _SMALL_STEP:
            break
    return _Fit(state, normal, residual, weight, windows.good, images.value, last, moved.max(axis=1))


def _stars_of(fit: _Fit, windows: StarWindows, places: NDArray[np.int64]) -> StarFits:
    cov = _safe_inverse(fit.normal)
    chi2 = np.einsum("nm,nm,nm->n", fit.residual, fit.residual, fit.weight).astype(float)
    dof = np.maximum(np.count_nonzero(fit.weight, axis=1) - 4.0, 1.0)
    ratio = chi2 / dof
    inflation = np.where(ratio > 1.0 + 3.5 * np.sqrt(2.0 / dof), ratio, 1.0)
    sky_information = np.einsum("nm,nm,nm->n", fit.value, fit.value, fit.good) / windows.noise2
    flux_sigma = 1.0 / np.sqrt(np.maximum(sky_information, 1e-30))
    snr = np.maximum(fit.state[:, 2] / flux_sigma, 1.0)
    inflation = inflation * faint_star_inflation(snr)
    xy = fit.state[:, :2] + windows.corner + windows.radius
    near = np.abs(xy - places).max(axis=1) < 2.0 + windows.saturated * 4.0
    return StarFits(
        xy_px=xy,
        cov_px=cov[:, :2, :2] * inflation[:, None, None],
        flux_dn=fit.state[:, 2],
        flux_sigma_dn=flux_sigma,
        chi2=chi2,
        dof=dof,
        saturated=windows.saturated,
        converged=(fit.last_px < 0.1) & near & (fit.state[:, 2] > 0),
    )


def _without_outliers(fit: _Fit) -> NDArray[np.float32]:
    """`good` less up to four pixels that stand 6 sigma above an otherwise good fit: a hot pixel, a
    neighbour's edge."""
    high = (fit.residual > 0) & (fit.residual**2 * fit.weight > 36.0)
    count = np.count_nonzero(high, axis=1)
    return np.where(high & (count <= 4)[:, None], np.float32(0.0), fit.good)


def _safe_inverse(normal: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("npp->np", normal), 1e-30))
    both = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal * both) * both)


def _no_fits() -> StarFits:
    none, flags = np.empty(0), np.empty(0, dtype=bool)
    return StarFits(np.empty((0, 2)), np.empty((0, 2, 2)), none, none, none, none, flags, flags)
