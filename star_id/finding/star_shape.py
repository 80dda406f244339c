"""Width and smear of the PSF, and the camera's gain, from the bright stars of an image.

Each star is fitted with a width of its own, without photon noise. The widths give the PSF's, residuals common
to all stars about a round image its smear, and residuals that grow with the signal the gain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats, Ints, array, inner, record, scalar
from boresight.star_id.beyond_chance import (
    CLIP_SIGMA,
    FEW_STARS,
    LEAST_STARS,
    MAD_SIGMA,
    NEVER_SIGMA,
    SELDOM_SIGMA,
)
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.psf import (
    LARGEST_STEP_PX,
    Psf,
    PsfImages,
    by_parameter,
    newton_step,
    psf_images,
    start_state,
)
from boresight.star_id.finding.windows import StarWindows, star_windows

__all__ = ["PSF_MISFIT", "STARS_FOR_WIDTH", "WidthFits", "fit_widths", "gain_from_widths", "psf_of"]


# Brightest unsaturated stars that the width is measured of.
STARS_FOR_WIDTH = 40
# Residual over a star's energy that a real PSF may leave on a Gaussian of free width (set by hand).
PSF_MISFIT = 0.15
# Squared deviation of a star's 1 / gain from the median over half its variance, above which it is left out:
# 4.5 sigma, for a skewed distribution.
_OUTLIER = 40.0
# Largest change of the squared width in a round, as a share of it; the next round finds the rest.
_LARGEST_STRETCH = 0.6


@record(kw_only=True)
class WidthFits:
    """Unsaturated stars, each fitted with a width of its own, with the residuals."""

    pixels: Ints = array("N, 2", "pixels as (column, row)")
    windows: StarWindows = scalar("windows of M pixels")
    images: PsfImages = scalar("unit-flux images of the fits")
    state: Floats = array("N, 4", "column and row in the window, flux, background")
    sigma_px: Floats = array("N", "fitted widths, px")
    error_px: Floats = array("N", "standard errors of the widths, px")
    normal: Floats = array("N, 5, 5", "normal matrices of the fits")
    residual: NDArray[np.float32] = array("N, M", "measured minus fitted, DN")
    good: Bools = array(
        "N", "whether a fit has come to rest near its pixel and leaves no more than a star does"
    )
    stars = inner[int]("good", "number of good fits", of=np.count_nonzero)


def fit_widths(
    image: NDArray[Any],
    pixels: Ints,
    start: Floats,
    background: Background,
    psf: Psf,
    *,
    saturation_dn: float,
) -> WidthFits:
    """Fits of stars near `pixels` + `start` (N, 2), from the width of `psf`, whose smear is kept."""
    radius = max(3, int(np.ceil(SELDOM_SIGMA * psf.sigma_px + 0.5 * np.hypot(*psf.smear_px))))
    windows = star_windows(image, pixels, background, radius, saturation_dn)
    use = np.flatnonzero(~windows.saturated)
    windows, pixels = windows.take(use), pixels[use]
    offset = windows.offsets(pixels + start[use])
    sigma = np.full(len(use), psf.sigma_px)
    state = np.column_stack([offset, np.zeros((len(use), 2))])
    for k in range(3):
        images = psf_images(state[:, :2], sigma, psf.smear_px, radius, widths=True)
        if k == 0:
            state = start_state(windows, offset, images)
        step, normal, residual, weight = newton_step(windows, images, state, np.inf)
        flux = state[:, 2]
        state = state + np.column_stack(
            [np.clip(step[:, :2], -LARGEST_STEP_PX, LARGEST_STEP_PX), step[:, 2:4]]
        )
        sigma = np.clip(sigma * np.exp(np.clip(step[:, 4], -0.3, 0.3)), 0.25, 4.0 * psf.sigma_px)
    variance = np.linalg.inv(normal)[:, 4, 4]  # negative by rounding where the window shows no width
    error = sigma * np.sqrt(np.where(variance > 0.0, variance, np.inf))
    moved = state[:, :2] - windows.offsets(pixels.astype(float))
    settled = (np.abs(moved) < 1.5).all(axis=1) & (state[:, 2] > 0) & (sigma > 0.27) & (error < 0.15 * sigma)
    settled &= sigma < 3.9 * psf.sigma_px
    misfit = (residual**2 * weight).sum(axis=1) - residual.shape[1]
    energy = ((flux[:, None] * images.value) ** 2 * weight).sum(axis=1)
    good = settled & (
        misfit < np.maximum(PSF_MISFIT * energy, NEVER_SIGMA * np.sqrt(2.0 * residual.shape[1]))
    )
    state = np.column_stack([state[:, :2], flux, state[:, 3]])
    return WidthFits(
        pixels=pixels,
        windows=windows,
        images=images,
        state=state,
        sigma_px=sigma,
        error_px=error,
        normal=normal,
        residual=residual,
        good=good,
    )


def psf_of(fits: WidthFits, start: Psf, *, find_smear: bool) -> Psf:
    """PSF with the width of three good stars or more, and with `find_smear` the smear they have in common."""
    good = fits.good
    middle, corner = _width_over_field(
        start, fits.pixels[good].astype(float), fits.sigma_px[good], fits.error_px[good]
    )
    psf = replace(start, sigma_px=middle, sigma_corner_px=corner)
    return _with_smear(psf, fits) if find_smear else psf


def gain_from_widths(fits: WidthFits, correlation: float = 1.0) -> float:
    """Electrons per DN, from the growth of residuals with the signal; infinite if they do not grow.

    What the PSF leaves of all stars alike, at each distance from their middles, is no noise and subtracted.
    Residuals are those of single pixels, whose noise is that of the windows over `correlation`.
    """
    if fits.stars < FEW_STARS:
        return np.inf
    unit, in_fits = fits.images.columns[fits.good], fits.windows.noise2[fits.good, None]
    scale = by_parameter(fits.state[fits.good], 5)
    covariance = np.linalg.inv(fits.normal[fits.good]) * scale[:, :, None] * scale[:, None, :]
    leverage = (np.matmul(covariance.astype(np.float32), unit) * unit).sum(axis=1) / in_fits
    noise2 = fits.windows.sky2[fits.good, None] / correlation**2 + fits.windows.rounding2
    model = np.maximum(fits.state[fits.good, 2:3] * fits.images.value[fits.good], 0.0)
    freedom = np.clip(1.0 - leverage, 0.1, 1.0)
    residual2 = _without_common_misfit(fits).astype(float) ** 2
    excess = residual2 - noise2 * freedom
    slope = model * freedom
    per_dn = 0.0  # variance per DN of signal, 1 / gain
    for _ in range(3):
        variance = noise2 + per_dn * model
        weighted = (residual2 < 25.0 * variance) / variance**2 * slope
        weight = np.maximum((weighted * slope).sum(axis=1), 1e-30)
        each = (weighted * excess).sum(axis=1) / weight
        middle = _weighted_median(each, weight)
        inlier = (each - middle) ** 2 * weight < _OUTLIER
        per_dn = max(float((each * weight)[inlier].sum() / weight[inlier].sum()), 0.0)
    return 1.0 / per_dn if per_dn > 0 else np.inf


def _without_common_misfit(fits: WidthFits) -> NDArray[np.float32]:
    """Residuals (K, M) of the good stars less the mean, in units of the flux, at each distance from a star's
    middle."""
    state, residual = fits.state[fits.good], fits.residual[fits.good]
    side = np.arange(-fits.windows.radius, fits.windows.radius + 1.0)
    x, y = side - state[:, :1], side - state[:, 1:2]
    ring = np.sqrt(y[:, :, None] ** 2 + x[:, None, :] ** 2).reshape(residual.shape)
    ring = (2.0 * ring).astype(np.int64).ravel()  # two a px
    flux = state[:, 2:3]
    weight = flux / fits.windows.noise2[fits.good, None]
    total = np.bincount(ring, (weight * flux).repeat(residual.shape[1])) + 1e-30
    mean = np.bincount(ring, (weight * residual).ravel()) / total
    return np.asarray(residual - flux * mean[ring].reshape(residual.shape))


def _with_smear(psf: Psf, fits: WidthFits) -> Psf:
    """PSF with the smear that the residuals about a round image show, if it is significant.

    A smear s adds s sT / 12 to the second moments; the fitted round width contains half of its trace.
    """
    assert fits.images.d_stretch is not None
    template, residual = fits.images.d_stretch[:, fits.good], fits.residual[fits.good]
    flux, noise2 = fits.state[fits.good, 2], fits.windows.noise2[fits.good]
    energy = np.einsum("anm,anm->an", template, template) * flux**2 / noise2
    each = np.einsum("anm,nm->an", template, residual) * flux / noise2 / np.maximum(energy, 1e-30)
    plus, cross = (_weighted_median(values, weights) for values, weights in zip(each, energy))
    off = np.abs(each - [[plus], [cross]])
    spread = MAD_SIGMA * max(_median(off[0]), _median(off[1])) / np.sqrt(each.shape[1])
    found = float(np.hypot(plus, cross))
    if found < 6.0 * spread or found < 0.02 * psf.sigma_px**2:
        return psf
    step = min(1.0, _LARGEST_STRETCH * psf.sigma_px**2 / found)  # the next round finds the rest
    sx, sy = psf.smear_px
    before = (sx**2 + sy**2) / 24.0
    plus, cross = (sx**2 - sy**2) / 24.0 + step * plus, sx * sy / 12.0 + step * cross
    stretch = float(np.hypot(plus, cross))
    length, angle = np.sqrt(24.0 * stretch), 0.5 * np.arctan2(cross, plus)
    factor = float(np.sqrt(max(psf.sigma_px**2 + before - stretch, 0.2 * psf.sigma_px**2))) / psf.sigma_px
    return replace(
        psf,
        sigma_px=psf.sigma_px * factor,
        sigma_corner_px=psf.sigma_corner_px * factor,
        smear_px=(float(length * np.cos(angle)), float(length * np.sin(angle))),
    )


def _median(values: Floats) -> float:
    return float(np.sort(values)[len(values) // 2])


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return float(values[order[int(np.searchsorted(below, 0.5 * below[-1]))]])


def _width_over_field(psf: Psf, xy: Floats, sigma: Floats, error: Floats) -> tuple[float, float]:
    """Width in the centre and in the corners, px; equal unless they differ by three standard errors."""
    size = np.array([psf.width_px, psf.height_px])
    radius2 = 2.0 * (((xy + 0.5) / size - 0.5) ** 2).sum(axis=1)
    error = np.maximum(error, 0.01 * sigma)
    middle = _median(sigma)
    keep = np.abs(sigma - middle) < 0.35 * middle
    for _ in range(4):
        w = keep / error**2
        mean = (w * sigma).sum() / w.sum()
        spread = max(1.0, MAD_SIGMA * _median(np.abs(sigma - mean)[keep] / error[keep]))
        keep = np.abs(sigma - mean) < SELDOM_SIGMA * spread * error
        if keep.sum() < LEAST_STARS:
            return middle, middle
    if keep.sum() < 12:
        return float(mean), float(mean)
    A = np.column_stack([np.ones(len(sigma)), radius2]) * (keep / (spread * error))[:, None]
    covariance = np.linalg.inv(A.T @ A + 1e-12 * np.eye(2))
    fit = covariance @ (A.T @ (sigma * keep / (spread * error)))
    if abs(fit[1]) < CLIP_SIGMA * np.sqrt(covariance[1, 1]) or fit[0] + min(fit[1], 0.0) < 0.5 * mean:
        return float(mean), float(mean)
    return float(fit[0]), float(fit[0] + fit[1])
