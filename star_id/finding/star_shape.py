"""What the bright stars of an image have in common: width and smear of their images, and the camera's gain.

Each is fitted with a width of its own, without photon noise. The widths give the PSF's, residuals that all
stars share about a round image its smear, and residuals that grow with the signal the gain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.finding.background import Background
from boresight.star_id.finding.psf import Psf, PsfImages, psf_images
from boresight.star_id.finding.window_fit import by_parameter, newton_step, start_state
from boresight.star_id.finding.windows import StarWindows, star_windows

__all__ = ["WidthFits", "fit_widths", "gain_of", "psf_of"]

Array = NDArray[np.float64]

_STEPS = 3
_WINDOW_SIGMA = 4.0
_PSF_MISFIT = 0.15  # residual energy over a star's own that a lens may leave on a Gaussian of free width
_STARS_FOR_GAIN = 5
_LARGEST_STRETCH = 0.6  # of the width's square, in one round of looking for a smear
_UNUSUAL = 40.0  # squared deviation of a star's 1 / gain over half its variance: 4.5 sigma, being skew


@dataclass(frozen=True, slots=True, eq=False)
class WidthFits:
    """Unsaturated stars, each fitted with a width of its own, and what the fits leave over."""

    places: NDArray[np.int64]  # (N, 2)
    windows: StarWindows
    images: PsfImages
    state: Array  # (N, 4) column and row in the window, flux, sky
    sigma_px: Array  # (N,)
    error_px: Array  # (N,) standard error of sigma_px
    normal: Array  # (N, 5, 5)
    residual: NDArray[np.float32]  # (N, M)
    sound: NDArray[np.bool_]  # (N,) a star, as far as one can see

    @property
    def stars(self) -> int:
        """How many of the fits are sound."""
        return int(np.count_nonzero(self.sound))


def fit_widths(
    image: NDArray,
    places: NDArray[np.int64],
    start: Array,
    background: Background,
    psf: Psf,
    *,
    saturation_dn: float,
) -> WidthFits:
    """Fits stars at `places` + `start` (N, 2), beginning with the width of `psf`, whose smear is kept."""
    radius = max(3, int(np.ceil(_WINDOW_SIGMA * psf.sigma_px + 0.5 * np.hypot(*psf.smear_px))))
    windows = star_windows(image, places, background, radius, saturation_dn)
    use = np.flatnonzero(~windows.saturated)
    windows, places = windows.take(use), places[use]
    offset = windows.offsets(places + start[use])
    sigma = np.full(len(use), psf.sigma_px)
    state = np.column_stack([offset, np.zeros((len(use), 2))])
    for k in range(_STEPS):
        images = psf_images(state[:, :2], sigma, psf.smear_px, radius, widths=True)
        if k == 0:
            state = start_state(windows, offset, images)
        step, normal, residual, weight = newton_step(windows, images, state, np.inf)
        flux = state[:, 2]
        state = state + np.column_stack([np.clip(step[:, :2], -0.8, 0.8), step[:, 2:4]])
        sigma = np.clip(sigma * np.exp(np.clip(step[:, 4], -0.3, 0.3)), 0.25, 4.0 * psf.sigma_px)
    error = sigma * np.sqrt(np.linalg.inv(normal)[:, 4, 4])
    moved = state[:, :2] - windows.offsets(places.astype(float))
    sound = (np.abs(moved) < 1.5).all(axis=1) & (state[:, 2] > 0) & (sigma > 0.27) & (error < 0.15 * sigma)
    sound &= sigma < 3.9 * psf.sigma_px
    misfit = (residual**2 * weight).sum(axis=1) - residual.shape[1]
    energy = ((flux[:, None] * images.value) ** 2 * weight).sum(axis=1)
    sound &= misfit < np.maximum(_PSF_MISFIT * energy, 5.0 * np.sqrt(2.0 * residual.shape[1]))
    state = np.column_stack([state[:, :2], flux, state[:, 3]])
    return WidthFits(places, windows, images, state, sigma, error, normal, residual, sound)


def psf_of(fits: WidthFits, start: Psf, *, find_smear: bool) -> Psf:
    """Width of the PSF from three sound stars or more, and smear.

    With `find_smear` the start's smear is improved: stars longer one way than the other, all alike.
    """
    sound = fits.sound
    middle, corner = _width_over_field(
        start, fits.places[sound].astype(float), fits.sigma_px[sound], fits.error_px[sound]
    )
    psf = replace(start, sigma_px=middle, sigma_corner_px=corner)
    return _with_smear(psf, fits) if find_smear else psf


def gain_of(fits: WidthFits) -> float:
    """Electrons a DN, from how the residuals of the stars grow with their signal; infinite if they do not.

    Misfit of the PSF enters too, which makes the stated covariance larger, never smaller.
    """
    if fits.stars < _STARS_FOR_GAIN:
        return np.inf
    unit, noise2 = fits.images.columns[fits.sound], fits.windows.noise2[fits.sound, None]
    scale = by_parameter(fits.state[fits.sound], 5)
    covariance = np.linalg.inv(fits.normal[fits.sound]) * scale[:, :, None] * scale[:, None, :]
    leverage = (np.matmul(covariance.astype(np.float32), unit) * unit).sum(axis=1) / noise2
    model = np.maximum(fits.state[fits.sound, 2:3] * fits.images.value[fits.sound], 0.0)
    freedom = np.clip(1.0 - leverage, 0.1, 1.0)
    residual2 = fits.residual[fits.sound].astype(float) ** 2
    excess = residual2 - noise2 * freedom
    slope = model * freedom
    per_dn = 0.0  # variance per DN of signal, 1 / gain
    for _ in range(3):
        variance = noise2 + per_dn * model
        weighted = (residual2 < 25.0 * variance) / variance**2 * slope
        weight = np.maximum((weighted * slope).sum(axis=1), 1e-30)
        each = (weighted * excess).sum(axis=1) / weight
        middle = _weighted_median(each, weight)
        usual = (each - middle) ** 2 * weight < _UNUSUAL
        per_dn = max(float((each * weight)[usual].sum() / weight[usual].sum()), 0.0)
    return 1.0 / per_dn if per_dn > 0 else np.inf


def _with_smear(psf: Psf, fits: WidthFits) -> Psf:
    """The PSF with the smear that the stars' residuals about a round image show, if it is sure.

    A smear s adds s sT / 12 to the second moments; the round width that was fitted holds half of its trace.
    """
    assert fits.images.d_stretch is not None
    template, residual = fits.images.d_stretch[:, fits.sound], fits.residual[fits.sound]
    flux, noise2 = fits.state[fits.sound, 2], fits.windows.noise2[fits.sound]
    energy = np.einsum("anm,anm->an", template, template) * flux**2 / noise2
    each = np.einsum("anm,nm->an", template, residual) * flux / noise2 / np.maximum(energy, 1e-30)
    plus, cross = (_weighted_median(values, weights) for values, weights in zip(each, energy))
    off = np.abs(each - [[plus], [cross]])
    spread = 1.4826 * max(_median(off[0]), _median(off[1])) / np.sqrt(each.shape[1])
    found = float(np.hypot(plus, cross))
    if found < 6.0 * spread or found < 0.02 * psf.sigma_px**2:
        return psf
    share = min(1.0, _LARGEST_STRETCH * psf.sigma_px**2 / found)  # the rest is left to the next round
    sx, sy = psf.smear_px
    before = (sx**2 + sy**2) / 24.0
    plus, cross = (sx**2 - sy**2) / 24.0 + share * plus, sx * sy / 12.0 + share * cross
    stretch = float(np.hypot(plus, cross))
    length, angle = np.sqrt(24.0 * stretch), 0.5 * np.arctan2(cross, plus)
    factor = float(np.sqrt(max(psf.sigma_px**2 + before - stretch, 0.2 * psf.sigma_px**2))) / psf.sigma_px
    return replace(
        psf,
        sigma_px=psf.sigma_px * factor,
        sigma_corner_px=psf.sigma_corner_px * factor,
        smear_px=(float(length * np.cos(angle)), float(length * np.sin(angle))),
    )


def _median(values: Array) -> float:
    return float(np.sort(values)[len(values) // 2])


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[int(np.searchsorted(below, 0.5 * below[-1]))]])


def _width_over_field(psf: Psf, xy: Array, sigma: Array, error: Array) -> tuple[float, float]:
    """Width in the middle and in the corners; equal unless the stars say otherwise by three standard
    errors."""
    size = np.array([psf.width_px, psf.height_px])
    radius2 = 2.0 * (((xy + 0.5) / size - 0.5) ** 2).sum(axis=1)
    error = np.maximum(error, 0.01 * sigma)
    middle = _median(sigma)
    keep = np.abs(sigma - middle) < 0.35 * middle
    for _ in range(4):
        w = keep / error**2
        mean = (w * sigma).sum() / w.sum()
        spread = max(1.0, 1.4826 * _median(np.abs(sigma - mean)[keep] / error[keep]))
        keep = np.abs(sigma - mean) < 4.0 * spread * error
        if keep.sum() < 3:
            return middle, middle
    if keep.sum() < 12:
        return float(mean), float(mean)
    A = np.column_stack([np.ones(len(sigma)), radius2]) * (keep / (spread * error))[:, None]
    covariance = np.linalg.inv(A.T @ A + 1e-12 * np.eye(2))
    fit = covariance @ (A.T @ (sigma * keep / (spread * error)))
    if abs(fit[1]) < 3.0 * np.sqrt(covariance[1, 1]) or fit[0] + min(fit[1], 0.0) < 0.5 * mean:
        return float(mean), float(mean)
    return float(fit[0]), float(fit[0] + fit[1])
