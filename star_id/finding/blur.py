"""Coma of the lens and trails of motion: PSFs of few parameters, fitted to the images of bright stars.

A Gaussian fitted to a comatic fan lies between the fan's tip and the middle of its light, the farther from
either the longer the fan: the field of view seems to be another. Where widths grow towards the corners, two
lengths, outwards and inwards, explain the growth; the one that fits the stars' images better is refined
together with the width and the wings of its Gaussians: light far from a fan is nearer to its middle than to
its tip, and would displace the stars in which it is seen, the bright ones. Their errors, from the scatter of
what single stars say, are one of the scale of all places. An even trail has sharp ends that an empirical
image of few stars shows with their noise: where a smeared Gaussian explains the stars as well, it is the PSF.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats
from boresight.star_id.beyond_chance import CLIP_SIGMA, MAD_SIGMA, NEVER_SIGMA, SELDOM_SIGMA
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.psf import (
    LARGEST_STEP_PX,
    Psf,
    PsfImages,
    by_parameter,
    images_at,
    newton_step,
    shape_images,
    start_state,
)
from boresight.star_id.finding.windows import StarWindows, star_windows

__all__ = ["explains_better", "find_coma", "find_trail"]

# Squared length of a comatic fan over half the trace of its second moments: turns the growth of widths into
# the length to start from.
_LENGTH2 = 27.0
# Fourth moment of a star's image over a Gaussian's, 1 + wings^2, to start from: wings of 0.3.
_PEAKED = 1.09
# Least and largest width (px), length (px) and 1 + wings^2 of a fitted PSF: fans point outwards or inwards,
# wings are at most 0.9.
_BOUNDS = ([0.0, -np.inf, 1.0], [np.inf, np.inf, 1.8])
# Relative step of a parameter for numerical derivatives (set by hand).
_STEP = 0.02
# Fewest bright stars that a coma or trail is fitted to (set by hand; four a parameter).
_FEWEST = 12
# Share of a pixel's light by which real stars differ from a fan of Gaussians; added to the noise of fits of
# coma (set by hand).
_UNLIKE = 0.1
# Chi-square in excess of its degrees of freedom over that of the other PSF, below which a PSF is better
# (set by hand).
_BETTER = 0.8
# Gain of chi-square that is beyond chance: three parameters gain 3 with a standard deviation of 2.4, and
# pixels' noise is not quite normal.
_BEYOND_CHANCE = 50.0
# Share of the peak below which pixels of an empirical image do not enter its second moments: they are
# noise.
_LIGHT = 0.1


def find_coma(
    image: NDArray[Any], xy_px: Floats, background: Background, psf: Psf, *, saturation_dn: float
) -> tuple[Psf, float] | None:
    """PSF with coma, and the gain, e-/DN, that the residuals about it show; None where it explains the images
    of the stars at `xy_px` (N, 2) no better than `psf`."""
    growth2 = psf.sigma_corner_px**2 - psf.sigma_px**2
    if growth2 <= 0.0 or len(xy_px) < _FEWEST:
        return None
    length = float(np.sqrt(_LENGTH2 * growth2))
    radius = int(np.ceil(3.0 * psf.sigma_px + 0.5 * length)) + 1
    windows = star_windows(image, np.rint(xy_px).astype(np.int64), background, radius, saturation_dn)
    start = windows.offsets(xy_px)

    def growing(theta: Floats) -> Psf:
        wings = float(np.sqrt(theta[2] - 1.0))
        return replace(psf, sigma_px=float(theta[0]), sigma_corner_px=float(theta[1]), wings=wings)

    def comatic(theta: Floats) -> Psf:
        return replace(growing(theta[[0, 0, 2]]), coma_px=float(theta[1]))

    tries = [np.array([psf.sigma_px, sign * length, _PEAKED]) for sign in (1.0, -1.0)]
    best = min(tries, key=lambda theta: _chi2_of_stars(windows, start, comatic(theta)).sum())
    theta, covariance = _refined(windows, start, comatic, best, _UNLIKE, _BOUNDS)
    found = comatic(theta)
    if not _is_better(windows, start, found, psf, _UNLIKE):
        return None
    widths = np.array([psf.sigma_px, psf.sigma_corner_px, _PEAKED])
    grown = growing(_refined(windows, start, growing, widths, _UNLIKE, _BOUNDS)[0])
    if not _is_better(windows, start, found, grown, _UNLIKE):
        return None
    gain, outwards = _gain_about(windows, start, found), xy_px - found.middle_px

    def places(theta: Floats) -> Floats:
        return _fitted(windows, start, comatic(theta), gain=gain)[1][:, :2]

    moved = [(places(theta + step) - places(theta)) / step.sum() for step in np.diag(_STEP * theta)]
    slope = np.array([(outwards * each).sum() for each in moved]) / (outwards**2).sum()
    return replace(found, scale_sigma=float(np.sqrt(slope @ covariance @ slope))), gain


def explains_better(
    image: NDArray[Any], xy_px: Floats, background: Background, psf: Psf, other: Psf, *, saturation_dn: float
) -> bool:
    """Whether the empirical PSF `psf` explains the images of the stars at `xy_px` (N, 2) better than
    `other`."""
    if not len(xy_px):
        return False
    pixels, radius = np.rint(xy_px).astype(np.int64), psf.shape_radius_px
    windows = star_windows(image, pixels, background, radius, saturation_dn)
    return _is_better(windows, windows.offsets(xy_px), psf, other)


def _is_better(windows: StarWindows, start: Floats, psf: Psf, other: Psf, unlike: float = 0.0) -> bool:
    """Whether `psf` explains the windows better than `other`, from places `start` (N, 2) in them on; stars'
    images may differ from both by `unlike` of the light in a pixel. Stars that stand out by both do not
    count: what neither explains is a neighbour's."""
    after, before = (_chi2_of_stars(windows, start, each, unlike) for each in (psf, other))
    usual = _do_not_stand_out(np.minimum(after, before))
    dof = np.count_nonzero(usual) * windows.data.shape[1]
    excess, other_excess = float(after[usual].sum()) - dof, float(before[usual].sum()) - dof
    return excess < _BETTER * other_excess and other_excess - excess > _BEYOND_CHANCE


def _do_not_stand_out(chi2: Floats) -> Bools:
    """(N,) stars whose chi-square (N,) is not far above the usual one: a neighbour's light adds to it."""
    middle = np.median(chi2)
    return np.asarray(chi2 <= middle + NEVER_SIGMA * MAD_SIGMA * np.median(np.abs(chi2 - middle)))


def _chi2_of_stars(windows: StarWindows, start: Floats, psf: Psf, unlike: float = 0.0) -> Floats:
    """Chi-square (N,) of each star, from places `start` (N, 2) in the windows on, about its image by a PSF
    that stars differ from by `unlike` of the light in a pixel."""
    residual = _fitted(windows, start, psf, unlike)[0]
    return np.asarray((residual**2).reshape(len(start), -1).sum(axis=1))


def find_trail(
    image: NDArray[Any], xy_px: Floats, background: Background, psf: Psf, *, saturation_dn: float
) -> tuple[Psf, float] | None:
    """Smeared Gaussian in place of the PSF `psf`, empirical or a Gaussian smeared by second moments, and the
    gain, e-/DN, that the residuals about it show; None where it explains the images of the stars at `xy_px`
    (N, 2) less well, or there is no trail."""
    width, smear = (psf.sigma_px, np.array(psf.smear_px)) if psf.shape is None else _trail_of(psf)
    # shorter than that, it is a Gaussian of other second moments
    if np.hypot(*smear) < CLIP_SIGMA * width or len(xy_px) < _FEWEST:
        return None
    radius = psf.shape_radius_px or int(np.ceil(3.0 * width + psf.reach_px)) + 1
    windows = star_windows(image, np.rint(xy_px).astype(np.int64), background, radius, saturation_dn)
    start = windows.offsets(xy_px)

    def smeared(theta: Floats) -> Psf:
        sigma, smear = float(np.exp(theta[0])), (float(theta[1]), float(theta[2]))
        return replace(
            psf, sigma_px=sigma, sigma_corner_px=sigma, smear_px=smear, shape=None, error_factor=None
        )

    found = smeared(_refined(windows, start, smeared, np.array([np.log(width), *smear]))[0])
    before, after = (float(_chi2_of_stars(windows, start, each).sum()) for each in (psf, found))
    dof = windows.data.size
    if _BETTER * (after - dof) > max(before - dof, 0.0) + _BEYOND_CHANCE:
        return None
    return found, _gain_about(windows, start, found)


def _trail_of(psf: Psf) -> tuple[float, Floats]:
    """Width and smear (2,), px, by the second moments of an empirical image."""
    assert psf.shape is not None
    radius = psf.shape_radius_px
    value = shape_images(psf.shape, np.zeros((1, 2)), radius).value.reshape(2 * radius + 1, -1).astype(float)
    light = np.where(value > _LIGHT * value.max(), value, 0.0)
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    moments = np.array([[(light * x * x).sum(), (light * x * y).sum()], [0.0, (light * y * y).sum()]])
    (across2, along2), axes = np.linalg.eigh(moments / light.sum(), UPLO="U")
    return float(np.sqrt(across2)), np.sqrt(12.0 * (along2 - across2)) * axes[:, 1]


def _refined(
    windows: StarWindows,
    start: Floats,
    psf_of: Callable[[Floats], Psf],
    theta: Floats,
    unlike: float = 0.0,
    bounds: tuple[float | list[float], float | list[float]] = (-np.inf, np.inf),
) -> tuple[Floats, Floats]:
    """Parameters (P,) of the PSF that explains the windows best, from `theta` on, and their covariance
    (P, P) by the scatter of single stars' parts in it."""

    def residuals(theta: Floats) -> Floats:
        return _fitted(windows, start, psf_of(theta), unlike)[0]

    fit = scipy.optimize.least_squares(
        residuals, theta, diff_step=_STEP, max_nfev=8, x_scale="jac", bounds=bounds
    )
    parts = (fit.jac * fit.fun[:, None]).reshape(len(start), -1, len(theta)).sum(axis=1)
    inverse = np.linalg.pinv(fit.jac.T @ fit.jac)
    return fit.x, inverse @ (parts.T @ parts) @ inverse


def _gain_about(windows: StarWindows, start: Floats, psf: Psf) -> float:
    """Electrons per DN of the photon noise that the residuals about a PSF show, of stars near `start` (N, 2)
    in their windows; infinite if they show none.

    What the PSF is wrong by is a share of the light, and of its slopes over the PSF's width where a fan has
    another length at each star: its square grows with theirs. Stars that stand out (their neighbours do) are
    left out.
    """
    _, state, images = _fitted(windows, start, psf)
    _, normal, residual, weight = newton_step(windows, images, state, np.inf)
    columns = images.columns * by_parameter(state, 4)[:, :, None]
    leverage = (np.matmul(np.linalg.inv(normal), columns) * columns).sum(axis=1) * weight
    freedom, square = np.clip(1.0 - leverage, 0.1, 1.0), residual.astype(float) ** 2
    noise2, signal = windows.noise2[:, None] * freedom, np.maximum(state[:, 2:3] * images.value, 0.0)
    unlike2 = signal.astype(float) ** 2
    if psf.coma_px != 0.0:
        unlike2 += psf.sigma_px**2 * (columns[:, :2] ** 2).sum(axis=1)
    terms, size = np.stack([signal * freedom, unlike2]), np.zeros(2)
    usual = np.ones(len(start), dtype=bool)
    for _ in range(8):  # estimating the gain, leaving out stars that stand out
        variance = noise2 + np.tensordot(size, terms, 1)
        used = (square < NEVER_SIGMA**2 * variance) & (weight > 0.0) & usual[:, None]
        target = (square - noise2) / variance
        size = scipy.optimize.nnls((terms[:, used] / variance[used]).T, target[used])[0]
        chi2 = (square / (noise2 + np.tensordot(size, terms, 1))).mean(axis=1)
        usual = chi2 < 1.0 + SELDOM_SIGMA * np.sqrt(2.0 / square.shape[1])
    return float(1.0 / size[0]) if size[0] > 0.0 else np.inf


def _fitted(
    windows: StarWindows, start: Floats, psf: Psf, unlike: float = 0.0, gain: float = np.inf
) -> tuple[Floats, Floats, PsfImages]:
    """Residuals over the noise, all in one row, states (N, 4) and unit images (N, M) of the stars with a PSF
    that their images differ from by `unlike` of the light in a pixel."""
    pixels = windows.middles
    sigma, offset = psf.sigma_at(pixels.astype(float)), start
    state: Floats = np.empty((len(start), 4))
    weighted = windows
    for k in range(3):
        images = images_at(psf, pixels, offset, sigma, windows.radius)
        if k == 0:
            state = start_state(windows, offset, images)
        if unlike:
            light2 = (images.value * state[:, 2:3]) ** 2 / windows.noise2[:, None]
            weighted = replace(windows, good=(windows.good / (1.0 + unlike**2 * light2)).astype(np.float32))
        step, _, residual, weight = newton_step(weighted, images, state, gain)
        state = state + np.column_stack(
            [np.clip(step[:, :2], -LARGEST_STEP_PX, LARGEST_STEP_PX), step[:, 2:]]
        )
        offset = state[:, :2]
    off: Floats = np.asarray((residual * np.sqrt(weight)).ravel(), dtype=float)
    return off.clip(-NEVER_SIGMA, NEVER_SIGMA) if unlike else off, state, images
