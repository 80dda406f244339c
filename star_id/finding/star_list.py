"""One raw image in, its stars out: background, detection, width of the PSF, centroids, and what is not a
star."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boresight.star_id.finding.background import Background, estimate_background
from boresight.star_id.finding.candidates import find_candidates
from boresight.star_id.finding.centroid import StarFits, fit_stars
from boresight.star_id.finding.detect import Detections, detect, detection_threshold
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_shape import WidthFits, fit_widths, gain_of, psf_of
from boresight.star_id.finding.windowed_centroid import windowed_centroids
from boresight.star_id.settings import StarSettings

__all__ = ["StarList", "find_stars"]

Array = NDArray[np.float64]

_START_SIGMA_PX = 1.2
_STARS_FOR_PSF = 40
_FEW_STARS = 8
_LEAST_STARS = 3  # fewer tell nothing of the width
_ROUNDS = 6  # of detection and width
_LARGEST_SIGMA_AT_HALF = 1.8  # wider stars are searched at a quarter of the resolution
_SMALL_CHANGE = 0.2  # of the width: a filter that far off still sees 98 % of the signal-to-noise ratio
_SKIRT_MISFIT = 4.0  # standard deviations of chi2: one sound saturated star in 10 000 is lost
_MISFIT_LIMIT = 0.3  # residual energy over the star's own: more is a cosmic ray, a trail, a bloom's arm


@dataclass(frozen=True, slots=True, eq=False)
class StarList:
    """Stars of one image, brightest first. Row n of every array speaks of the same star."""

    xy_px: Array  # (N, 2) centroid
    cov_px: Array  # (N, 2, 2) px^2
    flux_dn: Array  # (N,)
    snr: Array  # (N,) flux over the error that the sky alone gives it
    saturated: NDArray[np.bool_]  # (N,)
    blended: NDArray[np.bool_]  # (N,) displaced by a neighbour, more than a fifth of its error, or by a bloom
    psf: Psf
    psf_stars: int  # stars that the width rests on; 0: it was assumed
    background: Background
    gain_e_per_dn: float
    threshold: float  # sigmas of the matched filter
    hot_pixels: int  # refused
    misshapen: int  # refused: cosmic rays, trails, arms of blooms
    saturation_dn: float  # raw value from which a pixel counts as full; infinite if none does

    def take(self, index: NDArray) -> StarList:
        names = ("xy_px", "cov_px", "flux_dn", "snr", "saturated", "blended")
        picked = {name: getattr(self, name)[index] for name in names}
        rest = {name: getattr(self, name) for name in self.__slots__ if name not in names}
        return StarList(**picked, **rest)


def find_stars(image: NDArray, settings: StarSettings, dark: NDArray | None = None) -> StarList:
    """Stars of a raw image (H, W), 8 or 16 bits or floating, with the dark frame of the camera if there is
    one.

    Raises `ValueError` for an image that is not two-dimensional or smaller than 32 pixels.
    """
    if image.ndim != 2 or min(image.shape) < 32:
        raise ValueError(f"image must be (H, W), both at least 32, got {image.shape}")
    saturation = settings.saturation_dn or _top_of_range(image)
    if dark is not None:
        image, saturation = _minus_dark(image, dark, saturation)
    background = estimate_background(image)
    found, psf, psf_stars, gain, threshold = _detections(image, background, settings, saturation)
    places, offset = found.xy_px[: settings.max_stars], found.offset_px[: settings.max_stars]
    places, offset = _once_per_saturated_star(image, places, offset, saturation)
    place = fit_stars if settings.centroid_method == "fit" else _windowed_or_fitted
    fits = place(image, places, offset, background, psf, gain_e_per_dn=gain, saturation_dn=saturation)
    star_like = fits.chi2 - fits.dof < np.maximum(_MISFIT_LIMIT * fits.snr**2, 6.0 * np.sqrt(2 * fits.dof))
    good = fits.converged & (star_like | fits.saturated) & (fits.snr > 0.75 * threshold)
    fits = fits.take(_distinct(fits, np.flatnonzero(good), psf))
    return StarList(
        fits.xy_px,
        fits.cov_px,
        fits.flux_dn,
        fits.snr,
        fits.saturated,
        _blended(fits, psf),
        psf,
        psf_stars,
        background,
        gain,
        threshold,
        found.hot_pixels,
        int((~good).sum()),
        saturation,
    )


def _windowed_or_fitted(
    image: NDArray,
    places: NDArray[np.int64],
    offset: Array,
    background: Background,
    psf: Psf,
    *,
    gain_e_per_dn: float,
    saturation_dn: float,
) -> StarFits:
    """Windowed centroids, but of saturated stars, whose middles are lost, fits."""
    camera = {"gain_e_per_dn": gain_e_per_dn, "saturation_dn": saturation_dn}
    stars = windowed_centroids(image, places, offset, background, psf, **camera)
    full = np.flatnonzero(stars.saturated)
    return stars.with_rows(full, fit_stars(image, places[full], offset[full], background, psf, **camera))


def _detections(
    image: NDArray, background: Background, settings: StarSettings, saturation: float
) -> tuple[Detections, Psf, int, float, float]:
    """Detections; the PSF and the number of stars it rests on, 0 if it was given or there are too few; gain;
    threshold."""
    height, width = image.shape
    sigma = settings.psf_sigma_px or _START_SIGMA_PX
    psf, psf_stars = Psf(sigma, sigma, settings.smear_px or (0.0, 0.0), width, height), 0
    halvings, places = 0, np.array([], np.int64)
    for _ in range(_ROUNDS):
        if halvings < (needed := 1 if psf.sigma_px <= _LARGEST_SIGMA_AT_HALF else 2):
            halvings, places = needed, find_candidates(image, background, halvings=needed)
        threshold = detection_threshold(image.size, psf.sigma_px, settings.false_alarms_per_frame)
        found = detect(
            image,
            background,
            places,
            psf_sigma_px=psf.sigma_px,
            threshold=threshold,
            reach_px=2**halvings - 1,
        )
        shapes = _shapes(image, found, background, psf, saturation)
        if settings.psf_sigma_px is not None or shapes.stars < _LEAST_STARS:
            break
        before, psf_stars = psf, shapes.stars
        psf = psf_of(shapes, before, find_smear=settings.smear_px is None)
        moved = np.hypot(psf.smear_px[0] - before.smear_px[0], psf.smear_px[1] - before.smear_px[1])
        if abs(np.log(psf.sigma_px / before.sigma_px)) < _SMALL_CHANGE and moved < 0.5 * psf.sigma_px:
            break
    return found, psf, psf_stars, settings.gain_e_per_dn or gain_of(shapes), threshold


def _shapes(
    image: NDArray, found: Detections, background: Background, psf: Psf, saturation: float
) -> WidthFits:
    """The brightest detections, or, where they are trails or roofs, the ones that come after them."""
    column, row = found.xy_px.T
    below = np.flatnonzero(image[row, column] < saturation)[: 6 * _STARS_FOR_PSF]
    for some in (below[:_STARS_FOR_PSF], below[_STARS_FOR_PSF:]):
        places, offset = found.xy_px[some], found.offset_px[some]
        shapes = fit_widths(image, places, offset, background, psf, saturation_dn=saturation)
        if shapes.stars >= _FEW_STARS:
            break
    return shapes


def _top_of_range(image: NDArray) -> float:
    """Grey value from which a pixel counts as full: the top of the type, or a plateau of the brightest
    value."""
    if not np.issubdtype(image.dtype, np.integer):
        return np.inf
    top = int(np.iinfo(image.dtype).max)
    if image.dtype == np.uint8:
        return float(top)
    brightest = int(image.max())
    for bits in (8, 10, 12, 14, 16):
        if brightest <= 2**bits - 1:
            return float(0.995 * (2**bits - 1)) if bits < 16 else float(0.98 * top)
    return float(top)


def _minus_dark(image: NDArray, dark: NDArray, saturation: float) -> tuple[NDArray, float]:
    """The image less its dark frame; a pixel that was full stays full."""
    if dark.shape != image.shape:
        raise ValueError(f"dark frame is {dark.shape}, image is {image.shape}")
    corrected = image.astype(np.float32) - dark.astype(np.float32) + np.float32(np.median(dark))
    corrected[image >= saturation] = saturation
    return corrected, saturation


def _once_per_saturated_star(
    image: NDArray, places: NDArray[np.int64], offset: Array, saturation: float
) -> tuple[NDArray[np.int64], Array]:
    """Peaks on one plateau of full pixels are one star, placed in the plateau's middle."""
    full = image[places[:, 1], places[:, 0]] >= saturation if len(places) else np.empty(0, dtype=bool)
    if full.sum() < 2:
        return places, offset
    plateau = places[full]
    pairs = cKDTree(plateau).query_pairs(4.5, output_type="ndarray")
    label = np.arange(len(plateau))
    for _ in range(len(plateau)):
        low = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
        new = label.copy()
        np.minimum.at(new, pairs[:, 0], low)
        np.minimum.at(new, pairs[:, 1], low)
        if np.array_equal(new, label):
            break
        label = new
    middles = [np.rint(plateau[label == k].mean(axis=0)).astype(np.int64) for k in np.unique(label)]
    offset = np.vstack([np.zeros((len(middles), 2)), offset[~full]])
    return np.vstack([np.array(middles), places[~full]]), offset


def _distinct(fits: StarFits, good: NDArray[np.int64], psf: Psf) -> NDArray[np.int64]:
    """Indices of good fits, brightest first; of two that ended on one spot the brighter stays."""
    order = good[np.argsort(-fits.flux_dn[good], kind="stable")]
    if len(order) < 2:
        return order
    reach = max(1.0, float(psf.sigma_at(fits.xy_px[order]).mean()))
    pairs = cKDTree(fits.xy_px[order]).query_pairs(reach, output_type="ndarray")
    drop = np.zeros(len(order), dtype=bool)
    drop[pairs.max(axis=1)] = True
    return np.asarray(order[~drop])


def _blended(fits: StarFits, psf: Psf) -> NDArray[np.bool_]:
    """A neighbour of flux F2 at distance d displaces a Gaussian fit by about (F2 / F1) d exp(-d^2 / 4 s^2).

    One too close to be found by itself shows as a misfit that the other stars do not have. Of a saturated
    star only the skirt is seen, on one side more than on the other: any misfit displaces it.
    """
    if len(fits.xy_px) < 2:
        return np.zeros(len(fits.xy_px), dtype=bool)
    misfit = (fits.chi2 - fits.dof) / np.maximum(fits.snr**2, 1.0)
    plain = np.sort(misfit[~fits.saturated])
    usual = float(plain[len(plain) // 4]) if len(plain) else 0.0
    blended = ~fits.saturated & (fits.chi2 > fits.dof + 6.0 * np.sqrt(2.0 * fits.dof))
    blended &= misfit > 3.0 * max(usual, 0.0) + 0.003
    blended |= fits.saturated & (fits.chi2 > fits.dof + _SKIRT_MISFIT * np.sqrt(2.0 * fits.dof))
    sigma = float(psf.sigma_at(fits.xy_px).mean())
    pairs = cKDTree(fits.xy_px).query_pairs(10.0 * sigma, output_type="ndarray")
    for a, b in (pairs.T, pairs.T[::-1]):
        d2 = ((fits.xy_px[a] - fits.xy_px[b]) ** 2).sum(axis=1)
        shift = fits.flux_dn[b] / fits.flux_dn[a] * np.sqrt(d2) * np.exp(-d2 / (4.0 * sigma**2))
        own = np.sqrt(0.5 * np.trace(fits.cov_px[a], axis1=1, axis2=2))
        blended[a[shift > 0.2 * own]] = True
    return blended
