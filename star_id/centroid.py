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

from star_id.background import Background
from star_id.detect import windows_at
from star_id.psf import Psf, PsfImages, psf_images

__all__ = ["StarFits", "estimate_gain", "estimate_psf", "fit_stars"]

Array = NDArray[np.float64]

_SMALL_STEP_PX = 0.004
_LARGEST_STEP_PX = 0.8
_SECOND_ORDER = 6.0  # scatter of the fits over the Fisher covariance: 1 + 6 / SNR^2, seen from SNR 6 to 20
_PSF_MISFIT = 0.15  # residual energy over a star's own that a lens may leave on a Gaussian of free width
_LARGEST_STRETCH = 0.6  # of the width's square, in one round of looking for a smear
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


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    corner: NDArray[np.int64]  # (N, 2) first pixel
    radius: int
    data: NDArray[np.float32]  # (N, side * side), sky level subtracted
    good: NDArray[np.float32]  # (N, side * side) 1 or 0
    noise2: Array  # (N,) variance of a pixel of sky
    saturated: NDArray[np.bool_]


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
    radius = max(3, int(np.ceil(_WINDOW_SIGMA * np.median(sigma) + smear)))
    windows = _cut(image, places, background, radius, saturation_dn)
    wide = np.flatnonzero(windows.saturated)
    plain = np.flatnonzero(~windows.saturated)
    parts = [
        (plain, _fit(_pick(windows, plain), places[plain], offset[plain], sigma[plain], psf, gain_e_per_dn))
    ]
    if len(wide):
        large = int(np.ceil(_SATURATED_WINDOW_SIGMA * np.median(sigma) + smear))
        cut = _cut(image, places[wide], background, large, saturation_dn)
        parts.append((wide, _fit(cut, places[wide], offset[wide], sigma[wide], psf, gain_e_per_dn)))
    order = np.argsort(np.concatenate([index for index, _ in parts]), kind="stable")
    joined = [np.concatenate([getattr(fit, name) for _, fit in parts]) for name in StarFits.__slots__]
    return StarFits(*joined).take(order)


def estimate_psf(
    image: NDArray,
    places: NDArray[np.int64],
    start: Array,
    background: Background,
    *,
    start_sigma_px: float,
    smear_px: tuple[float, float],
    find_smear: bool,
    saturation_dn: float,
) -> tuple[Psf, int]:
    """Width and smear of the PSF, and the number of stars they rest on (0: the starting values come back).

    With `find_smear` the smear is improved: stars longer one way than the other, all alike.
    """
    height, width = image.shape
    psf = Psf(start_sigma_px, start_sigma_px, smear_px, width, height)
    radius = max(3, int(np.ceil(4.0 * start_sigma_px + 0.5 * np.hypot(*smear_px))))
    windows = _cut(image, places, background, radius, saturation_dn)
    use = np.flatnonzero(~windows.saturated)
    if len(use) == 0:
        return psf, 0
    windows, places, start = _pick(windows, use), places[use], start[use]
    sigma = np.full(len(use), start_sigma_px)
    state = _start(windows, places + start)
    for k in range(4):
        images = _images(windows, state, sigma, psf, widths=True)
        if k == 0:
            state = _linear(windows, state, images)
        step, normal, residual, weight = _newton(windows, images, state, np.inf)
        flux = state[:, 2]
        state = state + np.concatenate([np.clip(step[:, :2], -0.8, 0.8), step[:, 2:4]], axis=1)
        sigma = np.clip(sigma * np.exp(np.clip(step[:, 4], -0.3, 0.3)), 0.25, 4.0 * start_sigma_px)
    error = sigma * np.sqrt(np.linalg.inv(normal)[:, 4, 4])
    offset = state[:, :2] - (places - windows.corner - windows.radius)
    sound = (np.abs(offset) < 1.5).all(axis=1) & (state[:, 2] > 0) & (sigma > 0.27) & (error < 0.15 * sigma)
    sound &= sigma < 3.9 * start_sigma_px
    misfit = (residual**2 * weight).sum(axis=1) - residual.shape[1]
    energy = ((flux[:, None] * images.value) ** 2 * weight).sum(axis=1)
    sound &= misfit < np.maximum(_PSF_MISFIT * energy, 5.0 * np.sqrt(2.0 * residual.shape[1]))
    if sound.sum() < 3:
        return psf, 0
    middle, corner = _width_over_field(psf, places[sound].astype(float), sigma[sound], error[sound])
    psf = replace(psf, sigma_px=middle, sigma_corner_px=corner)
    if find_smear:
        psf = _with_smear(psf, images, residual[sound], flux[sound], windows.noise2[sound], sound)
    return psf, int(sound.sum())


def _with_smear(
    psf: Psf, images: PsfImages, residual: NDArray, flux: Array, noise2: Array, sound: NDArray[np.bool_]
) -> Psf:
    """The PSF with the smear that the stars' residuals about a round image show, if it is sure.

    A smear s adds s sT / 12 to the second moments; the round width that was fitted holds half of its trace.
    """
    template = images.d_stretch[:, sound] if images.d_stretch is not None else np.zeros((2, 0, 0))
    energy = (template**2).sum(axis=2, dtype=float) * flux**2 / noise2
    each = (template * residual).sum(axis=2, dtype=float) * flux / noise2 / np.maximum(energy, 1e-30)
    plus, cross = (_weighted_median(values, weights) for values, weights in zip(each, energy))
    spread = 1.4826 * np.median(np.abs(each - [[plus], [cross]]), axis=1) / np.sqrt(max(each.shape[1], 1))
    found = float(np.hypot(plus, cross))
    if found < 6.0 * float(spread.max()) or found < 0.02 * psf.sigma_px**2:
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


def estimate_gain(
    image: NDArray,
    places: NDArray[np.int64],
    start: Array,
    background: Background,
    psf: Psf,
    *,
    saturation_dn: float,
) -> float:
    """Electrons a DN, from how the residuals of unsaturated stars grow with their signal; infinite if they do
    not.

    Misfit of the PSF enters too, which makes the stated covariance larger, never smaller.
    """
    sigma = psf.sigma_at(places.astype(float))
    radius = max(3, int(np.ceil(3.0 * np.median(sigma)))) if len(sigma) else 3
    windows = _cut(image, places, background, radius, saturation_dn)
    use = np.flatnonzero(~windows.saturated)
    if len(use) < 5:
        return np.inf
    windows, places, start, sigma = _pick(windows, use), places[use], start[use], sigma[use]
    state = _start(windows, places + start)
    for k in range(2):
        images = _images(windows, state, sigma, psf)
        if k == 0:
            state = _linear(windows, state, images)
        step, normal, residual, _ = _newton(windows, images, state, np.inf)
        state = state + step
    J: NDArray = _columns(images, state)
    leverage = (np.matmul(np.linalg.inv(normal).astype(np.float32), J) * J).sum(axis=1) / windows.noise2[
        :, None
    ]
    model = np.maximum(state[:, 2:3] * images.value, 0.0)
    freedom = np.clip(1.0 - leverage, 0.1, 1.0)
    excess = residual.astype(float) ** 2 - windows.noise2[:, None] * freedom
    slope = model * freedom
    per_dn = 0.0  # variance per DN of signal, 1 / gain
    for _ in range(4):
        variance = windows.noise2[:, None] + per_dn * model
        w = windows.good * (residual**2 < 25.0 * variance) / variance**2
        weight = np.maximum((w * slope**2).sum(axis=1), 1e-30)
        each = (w * slope * excess).sum(axis=1) / weight
        middle = _weighted_median(each, weight)
        sound = (each - middle) ** 2 * weight < 12.0
        per_dn = max(float((each * weight)[sound].sum() / weight[sound].sum()), 0.0)
    return 1.0 / per_dn if per_dn > 0 else np.inf


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[int(np.searchsorted(below, 0.5 * below[-1]))]])


def _fit(
    windows: _Windows, places: NDArray[np.int64], start: Array, sigma: Array, psf: Psf, gain: float
) -> StarFits:
    if len(places) == 0:
        return _no_fits()
    state = _start(windows, places + start)
    fit = _iterate(windows, state, sigma, psf, gain, steps=3, fresh=True)
    slow = np.flatnonzero(fit.last > _SMALL_STEP_PX)
    if len(slow):
        more = _iterate(
            _pick(replace(windows, good=fit.good), slow),
            fit.state[slow],
            sigma[slow],
            psf,
            gain,
            steps=6,
            fresh=False,
        )
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
    last: Array  # (N,) largest component of the last step, px


def _iterate(
    windows: _Windows, state: Array, sigma: Array, psf: Psf, gain: float, *, steps: int, fresh: bool
) -> _Fit:
    """Gauss-Newton steps on all stars; a fresh fit finds its flux first and drops outlying pixels on its
    way."""
    for k in range(steps):
        images = _images(windows, state, sigma, psf)
        if fresh and k == 0:
            state = _linear(windows, state, images)
        step, normal, residual, weight = _newton(windows, images, state, gain)
        if fresh and k == 1:
            windows = _without_outliers(windows, residual, weight)
        last = np.abs(step[:, :2]).max(axis=1)
        step[:, :2] = np.clip(step[:, :2], -_LARGEST_STEP_PX, _LARGEST_STEP_PX)
        state = state + step
        if last.max() < _SMALL_STEP_PX:
            break
    return _Fit(state, normal, residual, weight, windows.good.copy(), images.value, last)


def _stars_of(fit: _Fit, windows: _Windows, places: NDArray[np.int64]) -> StarFits:
    cov = _safe_inverse(fit.normal)
    chi2 = (fit.residual**2 * fit.weight).sum(axis=1, dtype=float)
    dof = np.maximum((fit.weight > 0).sum(axis=1) - 4.0, 1.0)
    ratio = chi2 / dof
    inflation = np.where(ratio > 1.0 + 3.5 * np.sqrt(2.0 / dof), ratio, 1.0)
    sky_information = (fit.value**2 * fit.good).sum(axis=1, dtype=float) / windows.noise2
    flux_sigma = 1.0 / np.sqrt(np.maximum(sky_information, 1e-30))
    snr = np.maximum(fit.state[:, 2] / flux_sigma, 1.0)
    inflation = inflation * (1.0 + _SECOND_ORDER / snr**2)
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
        converged=(fit.last < 0.1) & near & (fit.state[:, 2] > 0),
    )


def _cut(
    image: NDArray, places: NDArray[np.int64], background: Background, radius: int, saturation: float
) -> _Windows:
    height, width = image.shape
    side = 2 * radius + 1
    corner = np.clip(places - radius, 0, [width - side, height - side])
    raw = windows_at(image, corner, side)
    level, noise = background.at(places.astype(float))
    full = raw >= saturation
    saturated = np.asarray(full.any(axis=(1, 2)))
    good = np.ones(raw.shape, dtype=np.float32)
    if saturated.any():
        spoilt = full.copy()  # a bloom ends in a pixel that is not full but does not belong to the star alone
        spoilt[:, 1:] |= full[:, :-1]
        spoilt[:, :-1] |= full[:, 1:]
        good[spoilt] = 0.0
    n = len(raw)
    data = raw.reshape(n, side * side) - level[:, None].astype(np.float32)
    return _Windows(corner, radius, data, good.reshape(n, side * side), noise**2, saturated)


def _pick(windows: _Windows, index: NDArray) -> _Windows:
    return replace(
        windows,
        corner=windows.corner[index],
        data=windows.data[index],
        good=windows.good[index],
        noise2=windows.noise2[index],
        saturated=windows.saturated[index],
    )


def _start(windows: _Windows, places: Array) -> Array:
    """(N, 4) column and row from the window's middle; flux and sky follow from the first images."""
    state = np.zeros((len(places), 4))
    state[:, :2] = places - windows.corner - windows.radius
    return state


def _linear(windows: _Windows, state: Array, images: PsfImages) -> Array:
    """The state with flux and sky by unweighted least squares, column and row held."""
    p, g, d = images.value, windows.good, windows.data
    gp = g * p
    n, sp, spp = g.sum(1, dtype=float), gp.sum(1, dtype=float), (gp * p).sum(1, dtype=float)
    sd, spd = (g * d).sum(1, dtype=float), (gp * d).sum(1, dtype=float)
    determinant = np.maximum(n * spp - sp**2, 1e-12)
    state[:, 2] = (n * spd - sp * sd) / determinant
    state[:, 3] = (spp * sd - sp * spd) / determinant
    return state


def _images(windows: _Windows, state: Array, sigma: Array, psf: Psf, *, widths: bool = False) -> PsfImages:
    return psf_images(state[:, :2], sigma, psf.smear_px, windows.radius, widths=widths)


def _columns(images: PsfImages, state: Array) -> NDArray[np.float32]:
    """(N, P, M) derivatives of the model with respect to column, row, flux, sky and, if wanted, log width."""
    n, m = images.value.shape
    flux = state[:, 2:3].astype(np.float32)
    J = np.empty((n, 4 if images.d_log_sigma is None else 5, m), dtype=np.float32)
    np.multiply(images.d_x, flux, out=J[:, 0])
    np.multiply(images.d_y, flux, out=J[:, 1])
    J[:, 2] = images.value
    J[:, 3] = 1.0
    if images.d_log_sigma is not None:
        np.multiply(images.d_log_sigma, flux, out=J[:, 4])
    return J


def _newton(
    windows: _Windows, images: PsfImages, state: Array, gain: float
) -> tuple[Array, Array, NDArray[np.float32], NDArray[np.float32]]:
    """One Gauss-Newton step: (N, P) step, (N, P, P) normal matrix, (N, M) residuals, (N, M) weights."""
    signal = images.value * state[:, 2:3].astype(np.float32)
    variance: NDArray = windows.noise2[:, None].astype(np.float32)
    if np.isfinite(gain):
        variance = variance + np.maximum(signal, np.float32(0.0)) * np.float32(1.0 / gain)
    weight = windows.good / variance
    residual = windows.data - signal - state[:, 3:4].astype(np.float32)
    J = _columns(images, state)
    JW = J * weight[:, None, :]
    normal = np.matmul(JW, J.transpose(0, 2, 1)).astype(float)
    gradient = np.matmul(JW, residual[:, :, None]).astype(float)
    scale = np.maximum(np.einsum("npp->np", normal), 1e-30)
    normal += 1e-9 * scale[:, :, None] * np.eye(normal.shape[1])
    return np.linalg.solve(normal, gradient)[:, :, 0], normal, residual, weight


def _without_outliers(windows: _Windows, residual: NDArray, weight: NDArray) -> _Windows:
    """Takes out up to four pixels that stand 6 sigma above an otherwise good fit: a hot pixel, a neighbour's
    edge."""
    high = (residual > 0) & (residual**2 * weight > 36.0)
    count = high.sum(axis=1)
    drop = high & ((count > 0) & (count <= 4))[:, None]
    return replace(windows, good=np.where(drop, 0.0, windows.good)) if drop.any() else windows


def _width_over_field(psf: Psf, xy: Array, sigma: Array, error: Array) -> tuple[float, float]:
    """Width in the middle and in the corners; equal unless the stars say otherwise by three standard
    errors."""
    size = np.array([psf.width_px, psf.height_px])
    radius2 = 2.0 * (((xy + 0.5) / size - 0.5) ** 2).sum(axis=1)
    error = np.maximum(error, 0.01 * sigma)
    keep = np.abs(sigma - np.median(sigma)) < 0.35 * np.median(sigma)
    for _ in range(4):
        w = keep / error**2
        mean = (w * sigma).sum() / w.sum()
        spread = max(1.0, 1.4826 * float(np.median(np.abs(sigma - mean)[keep] / error[keep])))
        keep = np.abs(sigma - mean) < 4.0 * spread * error
        if keep.sum() < 3:
            return float(np.median(sigma)), float(np.median(sigma))
    if keep.sum() < 12:
        return float(mean), float(mean)
    A = np.column_stack([np.ones(len(sigma)), radius2]) * (keep / (spread * error))[:, None]
    covariance = np.linalg.inv(A.T @ A + 1e-12 * np.eye(2))
    fit = covariance @ (A.T @ (sigma * keep / (spread * error)))
    if abs(fit[1]) < 3.0 * np.sqrt(covariance[1, 1]) or fit[0] + min(fit[1], 0.0) < 0.5 * mean:
        return float(mean), float(mean)
    return float(fit[0]), float(fit[0] + fit[1])


def _safe_inverse(normal: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("npp->np", normal), 1e-30))
    return (
        np.linalg.inv(normal * scale[:, :, None] * scale[:, None, :]) * scale[:, :, None] * scale[:, None, :]
    )


def _no_fits() -> StarFits:
    none, flags = np.empty(0), np.empty(0, dtype=bool)
    return StarFits(np.empty((0, 2)), np.empty((0, 2, 2)), none, none, none, none, flags, flags)
