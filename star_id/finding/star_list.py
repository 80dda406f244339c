"""Stars of a raw image: background, candidates, detection, PSF, centroids, and rejection of what is not a
star."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boresight.records.record import Bools, Floats, Ints, array, inner, record, scalar
from boresight.star_id.beyond_chance import CLIP_SIGMA, FEW_STARS, LEAST_STARS, SELDOM_SIGMA
from boresight.star_id.centroids import Centroids
from boresight.star_id.finding.background import Background, estimate_background
from boresight.star_id.finding.blur import explains_better, find_coma, find_trail
from boresight.star_id.finding.candidates import find_candidates
from boresight.star_id.finding.centroid import Counts, StarFits, fit_stars
from boresight.star_id.finding.correlated_noise import as_independent_noise, rounding_of_blocks
from boresight.star_id.finding.detect import (
    Detections,
    detect,
    detection_threshold,
    has_many_dead_pixels,
    without_bad_pixels,
)
from boresight.star_id.finding.lines import without_lines
from boresight.star_id.finding.mosaic import cell_response, even_image, has_mosaic, merged_cells
from boresight.star_id.finding.own_scale import in_own_counts
from boresight.star_id.finding.psf import USUAL_SIGMA_PX, Psf
from boresight.star_id.finding.shape import detect_shape, estimate_shape, filter_width_px, flat_image
from boresight.star_id.finding.star_shape import (
    PSF_MISFIT,
    STARS_FOR_WIDTH,
    WidthFits,
    fit_widths,
    gain_from_widths,
    psf_of,
)
from boresight.star_id.settings import StarSettings

__all__ = ["BRIGHT_SNR", "StarList", "list_stars"]

# Most stars that coma and trails are fitted to, and their least SNR: below it noise hides shapes and bias.
_STARS_FOR_BLUR, BRIGHT_SNR = 80, 15.0
# Widths, px, up to which stars are searched at full and at half the resolution; wider ones at a quarter.
_SIGMA_AT_RESOLUTION = (0.65, 1.8)
# Relative change of the width that ends the rounds: a filter that far off still has 98 % of the
# signal-to-noise ratio.
_SMALL_CHANGE = 0.2
# Share of misshapen detections above which the PSF may be no Gaussian, or captions and noise fill the list
# (set by hand).
_MISSHAPEN_SHARE = 0.15
# Misshapen detections by an empirical PSF over those by the Gaussian, below which it is right (set by
# hand).
_FEWER_MISSHAPEN = 0.6
# Stars found by an empirical PSF over those by the Gaussian that it must exceed: it may reject false stars,
# not real ones (set by hand).
_LEAST_KEPT = 0.7
# Detections fitted, in units of `max_stars`, where captions or noise fill the list (set by hand; bounds the
# time).
_TRIED = 3
# Share of hot or of dead pixels from which they are looked for before stars are: one star in twenty has one
# within 3 px.
_MANY_BAD = 1e-3
# Cells along each side of the image over which the stars that are kept are spread.
_CELLS = 8
# Fields of `StarList` that have a row a star, and those that detection gives.
_COLUMNS = ("xy_px", "cov_px", "flux_dn", "snr", "saturated", "blended")
_GRIDS = ("level_dn", "noise_dn", "above_cut", "unusable")  # of `Background`
_OF_IMAGE = ("psf", "psf_stars", "gain_e_per_dn", "threshold", "hot_pixels")


@record(kw_only=True)
class StarList:
    """Stars of one image, brightest first. Row n of every array is the same star."""

    xy_px: Floats = array("N, 2", "centroids as (column, row)")
    cov_px: Floats = array("N, 2, 2", "covariances of the centroids, px^2")
    flux_dn: Floats = array("N", "total above the background, DN")
    snr: Floats = array("N", "flux over its standard error by background noise alone")
    saturated: Bools = array("N", "whether a pixel of the star is saturated")
    blended: Bools = array("N", "whether a neighbour or a bloom displaces it by over a fifth of its error")
    psf: Psf = scalar("point spread function")
    psf_stars: int = scalar("stars that the PSF was estimated from; 0: it was assumed")
    background: Background = scalar("level and noise of the sky")
    gain_e_per_dn: float = scalar("as set, or estimated; infinite if photon noise is not seen")
    threshold: float = scalar("detection limit, sigmas of the matched filter")
    hot_pixels: int = scalar("detections rejected as hot pixels")
    misshapen_px: Floats = array("M, 2", "detections rejected as cosmic rays, trails, arms of blooms, text")
    saturation_dn: float = scalar("raw value from which a pixel counts as saturated; infinite if none does")
    misshapen = inner[int]("misshapen_px", "number of detections rejected for their shape", of=len)

    @classmethod
    def of_centroids(cls, stars: Centroids, flux_dn: Floats, size: tuple[int, int]) -> StarList:
        """The list of centroids, fluxes (N,), DN, that another program found in an image of `size` (width,
        height), px; of the sky nothing is known."""
        nothing, none = np.full((1, 1), np.nan), np.zeros(len(stars.xy_px), dtype=bool)
        return cls(
            xy_px=stars.xy_px,
            cov_px=stars.cov_px,
            flux_dn=flux_dn,
            snr=stars.snr,
            saturated=none,
            blended=stars.blended,
            psf=Psf(stars.psf_sigma_px, stars.psf_sigma_px, (0.0, 0.0), *size),
            psf_stars=len(none),
            background=Background(nothing, nothing, *size),
            gain_e_per_dn=np.inf,
            threshold=0.0,
            hot_pixels=0,
            misshapen_px=np.empty((0, 2)),
            saturation_dn=np.inf,
        )

    @property
    def centroids(self) -> Centroids:
        """What identification and calibration need of the list."""
        return Centroids(
            xy_px=self.xy_px,
            cov_px=self.cov_px,
            blended=self.blended,
            snr=self.snr,
            psf_sigma_px=float(np.hypot(self.psf.sigma_px, self.psf.smear_sigma_px)),
        )

    def take(self, index: NDArray[Any]) -> StarList:
        """List of the stars at indices (M,) or of a mask (N,), everything else unchanged."""
        return replace(self, **{name: getattr(self, name)[index] for name in _COLUMNS})

    def joined(self, other: StarList) -> StarList:
        """List of the stars of both, of the same image, brightest first; everything else as here."""
        both = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _COLUMNS}
        return replace(self, **both).take(np.argsort(-both["flux_dn"], kind="stable"))

    def in_units(self, unit: float, zero: float) -> StarList:
        """The list of the image whose values are `zero` and so many units more."""
        sky = self.background
        scaled = {name: unit * getattr(sky, name) for name in ("level_dn", "noise_dn", "rounding_dn")}
        sky = replace(sky, **scaled | {"level_dn": zero + scaled["level_dn"]})
        return replace(
            self,
            flux_dn=unit * self.flux_dn,
            background=sky,
            gain_e_per_dn=self.gain_e_per_dn / unit,
            saturation_dn=zero + unit * self.saturation_dn,
        )

    def mirrored(self, width_px: int) -> StarList:
        """The list of the image of `width_px` columns with their order reversed."""
        (xy, other), cov = (self.xy_px.copy(), self.misshapen_px.copy()), self.cov_px.copy()
        for places in (xy, other):
            places[:, 0] = width_px - 1.0 - places[:, 0]
        cov[:, [0, 1], [1, 0]] *= -1.0
        smear_x, smear_y = self.psf.smear_px
        old = {name: getattr(self.background, name) for name in _GRIDS}
        grids: dict[str, Any] = {name: None if one is None else one[:, ::-1] for name, one in old.items()}
        sky = replace(self.background, **grids)
        psf = replace(self.psf, smear_px=(-smear_x, smear_y))
        return replace(self, xy_px=xy, cov_px=cov, misshapen_px=other, psf=psf, background=sky)


def list_stars(
    image: NDArray[Any],
    settings: StarSettings,
    dark: NDArray[Any] | None = None,
    unusable: Bools | None = None,
) -> StarList:
    """Stars of a raw image with centroids, covariances and fluxes.

    Parameters
    ----------
    image : (H, W) array
        Raw image, 8 or 16 bits or floating, DN.
    settings : StarSettings
        Detection limit, saturation, gain, PSF and method, where they are not to be estimated.
    dark : (H, W) array, optional
        Dark frame of the camera, subtracted first.
    unusable : (H, W) array, optional
        Pixels that are known to show nothing, at about the level of the sky: they have no weight in fits.

    Returns
    -------
    StarList
        Brightest first; pixel (0, 0) is the centre of the first pixel.

    Raises
    ------
    ValueError
        If the image is not two-dimensional or smaller than 32 pixels, the dark frame has another size, or a
        star by the stated PSF is wider than half of the image.
    """
    if image.ndim != 2 or min(image.shape) < 32:
        raise ValueError(f"image must be (H, W), both at least 32, got {image.shape}")
    sigma, smear = settings.psf_sigma_px or 0.0, np.hypot(*(settings.smear_px or (0.0, 0.0)))
    if 2.0 * CLIP_SIGMA * sigma + smear > (most := 0.5 * min(image.shape)):
        limit = f"psf_sigma_px times {2.0 * CLIP_SIGMA:g} and smear_px together at most {most:g} px"
        raise ValueError(f"settings: found {sigma:g} px and {smear:g} px, expected {limit} in this image")
    saturation = settings.saturation_dn or _saturation_level(image)
    if dark is not None:
        image = _subtract_dark(image, dark, saturation)
        return _stars_of_counts(image, settings, saturation, unusable)
    own, gain = in_own_counts(image), settings.gain_e_per_dn
    of_counts = settings if gain is None else replace(settings, gain_e_per_dn=gain * own.unit)
    stars = _stars_of_counts(own.counts, of_counts, (saturation - own.zero) / own.unit, unusable)
    return stars if own.unit == 1.0 and own.zero == 0.0 else stars.in_units(own.unit, own.zero)


def _stars_of_counts(
    image: NDArray[Any], settings: StarSettings, saturation: float, unusable: Bools | None
) -> StarList:
    """Stars of an image (H, W) of counts, its dark frame subtracted."""
    if not has_mosaic(image):
        clean, no_stars = without_lines(image, saturation)
        background = estimate_background(clean).without(no_stars).without(unusable)
        background = replace(background, rounding_dn=rounding_of_blocks(image))
        return _list_stars(_Frame(clean, background, settings, saturation))
    bright = _bright_stars(merged_cells(image, saturation), settings, saturation)
    response = cell_response(image, np.asarray(2.0 * bright + 0.5, dtype=float))
    even, background, even_saturation = even_image(image, response, saturation)
    return replace(
        _list_stars(_Frame(even, background.without(unusable), settings, even_saturation)),
        saturation_dn=saturation,
    )


@record
class _Frame:
    """An image of one colour, its dark frame subtracted, and what stars are looked for with."""

    image: NDArray[Any] = array("H, W", "DN")
    background: Background = scalar("level and noise of the sky")
    settings: StarSettings = scalar("detection limit, and what is not to be estimated")
    saturation_dn: float = scalar("value from which a pixel is saturated; infinite if none is")


@record(kw_only=True)
class _Found:
    """Detections, and what they were made with."""

    xy_px: Ints = array("N, 2", "pixels of the peaks as (column, row)")
    offset_px: Floats = array("N, 2", "from there to the star, px")
    psf: Psf = scalar("point spread function")
    psf_stars: int = scalar("stars that it was estimated from; 0: given, or too few")
    gain_e_per_dn: float = scalar("as set, or estimated")
    threshold: float = scalar("detection limit, sigmas of the matched filter")
    hot_pixels: int = scalar("detections rejected as hot pixels")


def _bright_stars(cells: NDArray[Any], settings: StarSettings, saturation: float) -> Ints:
    """Pixels (N, 2) of bright unsaturated stars in an image of merged 2 x 2 cells."""
    sigma, smear = settings.psf_sigma_px, settings.smear_px
    of_cells = replace(
        settings,
        psf_sigma_px=None if sigma is None else 0.5 * sigma,
        smear_px=None if smear is None else (0.5 * smear[0], 0.5 * smear[1]),
    )
    xy: Ints = _detections(_Frame(cells, estimate_background(cells), of_cells, saturation)).xy_px
    return xy[cells[xy[:, 1], xy[:, 0]] < saturation][:STARS_FOR_WIDTH]


def _list_stars(frame: _Frame) -> StarList:
    """Stars by a Gaussian PSF, or where it does not fit by one with coma, a trail or an empirical one."""
    frame = replace(frame, background=as_independent_noise(frame.image, frame.background))
    found = _detections(frame)
    many = _MANY_BAD * frame.image.size
    if found.hot_pixels > many or has_many_dead_pixels(frame.image, frame.background, _MANY_BAD):
        image, background, hot = without_bad_pixels(frame.image, frame.background, found.psf.sigma_px)
        frame = replace(frame, image=image, background=background)
        found = _detections(frame)
        found = replace(found, hot_pixels=found.hot_pixels + hot)
    stars = _measured(frame, found)
    if frame.settings.psf_sigma_px is None and frame.settings.smear_px is None:
        return _with_blur(find_coma, frame, found, stars) or _trailed_or_shaped(frame, found, stars)
    return stars


def _trailed_or_shaped(frame: _Frame, found: _Found, stars: StarList) -> StarList:
    """The stars by a trail, or by an empirical PSF where many detections are misshapen; as they are where
    neither explains them better.
    """
    trailed = _with_blur(find_trail, frame, found, stars)
    if not trailed and stars.misshapen <= FEW_STARS + _MISSHAPEN_SHARE * len(stars.xy_px):
        return stars
    shaped = _detections_by_shape(frame, found.hot_pixels)
    if shaped is None:
        return trailed or stars
    others = _measured(frame, shaped)
    by_image = _with_blur(find_trail, frame, shaped, others)
    if trails := [one for one in (trailed, by_image) if one]:
        return max(trails, key=lambda one: len(one.xy_px))  # where more are found
    return _by_better_psf(frame, stars, others)


def _by_better_psf(frame: _Frame, stars: StarList, others: StarList) -> StarList:
    """Of the stars by a Gaussian and the others by an empirical PSF those by the better one; where that is
    not plain, the former that both find.
    """
    fewer_misshapen = others.misshapen < _FEWER_MISSHAPEN * stars.misshapen
    if not fewer_misshapen or len(others.xy_px) <= _LEAST_KEPT * len(stars.xy_px):
        return stars
    bright = others.xy_px[~others.saturated & ~others.blended][:_STARS_FOR_BLUR]
    of_frame = frame.image, bright, frame.background
    if explains_better(*of_frame, others.psf, stars.psf, saturation_dn=frame.saturation_dn):
        return others
    distance_px, _ = cKDTree(others.xy_px).query(stars.xy_px)
    return stars.take(distance_px < 2.0)  # the places by two PSFs are those of one star


def _with_blur(
    find_blur: Callable[..., tuple[Psf, float] | None], frame: _Frame, found: _Found, stars: StarList
) -> StarList | None:
    """The stars measured again with the PSF and gain that `find_blur` finds from the bright ones, if any."""
    bright = ~stars.saturated & ~stars.blended & (stars.snr > BRIGHT_SNR)
    xy, top = stars.xy_px[bright][:_STARS_FOR_BLUR], frame.saturation_dn
    answer = find_blur(frame.image, xy, frame.background, stars.psf, saturation_dn=top)
    if answer is None:
        return None
    psf, gain = answer
    return _measured(frame, replace(found, psf=psf, gain_e_per_dn=frame.settings.gain_e_per_dn or gain))


def _measured(frame: _Frame, found: _Found) -> StarList:
    """List of the detections that are stars, with centroids."""
    shape, most = frame.image.shape, frame.settings.max_stars
    first = np.arange(min(len(found.xy_px), most))
    fits, good = _fits_of(frame, found, first)
    if len(found.xy_px) > len(first) and np.mean(~good) > _MISSHAPEN_SHARE:
        fits, good = _fits_of(frame, found, _spread_over_image(found.xy_px, _TRIED * most, shape))
    psf = found.psf
    rows = _distinct(fits, np.flatnonzero(good), psf)
    if len(fits.snr) > most:
        rows = rows[_spread_over_image(fits.xy_px[rows], most, shape)]
    misshapen, fits = fits.xy_px[~good], fits.take(rows)
    of_stars = {name: getattr(fits, name) for name in _COLUMNS if name != "blended"}
    of_image = {name: getattr(found, name) for name in _OF_IMAGE}
    return StarList(
        **of_stars,
        **of_image,
        blended=_blended(fits, psf),
        background=frame.background,
        misshapen_px=misshapen,
        saturation_dn=frame.saturation_dn,
    )


def _fits_of(frame: _Frame, found: _Found, rows: Ints) -> tuple[StarFits, Bools]:
    """Fits of the detections `rows`, those on one plateau of saturated pixels merged, and which are stars."""
    image, background, psf = frame.image, frame.background, found.psf
    pixels, offset = _merge_saturated_peaks(
        image, found.xy_px[rows], found.offset_px[rows], frame.saturation_dn
    )
    counts = Counts(found.gain_e_per_dn, frame.saturation_dn)
    fits = fit_stars(image, pixels, offset, background, psf, counts)
    # a larger share of the energy (squared SNR) is that of a cosmic ray, a trail, or the arm of a bloom
    largest = np.maximum(2.0 * PSF_MISFIT * fits.snr**2, 6.0 * np.sqrt(2 * fits.dof))
    star_like = fits.chi2 - fits.dof < largest
    share = 1.0 if background.rounding_dn else 0.75  # a coefficient left by rounding is a peak, but no star
    least_snr = share * background.limits_at(fits.xy_px, found.threshold, psf.sigma_px)
    return fits, fits.converged & (star_like | fits.saturated) & (fits.snr > least_snr)


def _detections_by_shape(frame: _Frame, hot_pixels: int) -> _Found | None:
    """Detections by an empirical PSF; None where the image shows none."""
    image, settings = frame.image, frame.settings
    flat = flat_image(image, frame.background)
    estimate = estimate_shape(image, flat, frame.background, frame.saturation_dn)
    if estimate is None:
        return None
    size = (image.shape[1], image.shape[0])
    width, shape = estimate.sigma_px, estimate.shape
    psf = Psf(width, width, (0.0, 0.0), *size, shape=shape, error_factor=estimate.error_factor)
    threshold = detection_threshold(image.size, filter_width_px(shape), settings.false_alarms_per_frame)
    xy = detect_shape(flat, shape, threshold)
    return _Found(
        xy_px=xy,
        offset_px=np.zeros((len(xy), 2)),
        psf=psf,
        psf_stars=estimate.stars,
        gain_e_per_dn=settings.gain_e_per_dn or estimate.gain_e_per_dn,
        threshold=threshold,
        hot_pixels=hot_pixels,
    )


def _spread_over_image(xy_px: NDArray[Any], most: int, shape: tuple[int, ...]) -> Ints:
    """Rows of at most so many places (N, 2), px, brightest first: of the brightest of each cell of the image,
    then the second brightest, and so on."""
    if len(xy_px) <= most:
        return np.arange(len(xy_px))
    cell = (xy_px * (_CELLS / np.array(shape[::-1]))).astype(np.int64).clip(0, _CELLS - 1) @ [1, _CELLS]
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(_CELLS**2))
    rank = np.empty(len(cell), dtype=np.int64)
    rank[order] = np.arange(len(cell)) - first[cell[order]]
    return np.sort(np.argsort(rank, kind="stable")[:most])


def _detections(frame: _Frame) -> _Found:
    """Detections by a Gaussian PSF, smeared or not.

    Detection and PSF are repeated until the filter is as wide as the stars.
    """
    image, background, settings = frame.image, frame.background, frame.settings
    height, width = image.shape
    sigma = settings.psf_sigma_px or USUAL_SIGMA_PX
    psf, psf_stars = Psf(sigma, sigma, settings.smear_px or (0.0, 0.0), width, height), 0
    halvings, candidates = -1, np.array([], np.int64)
    for _ in range(6):  # detection and width in turn; two are usual
        needed = int(np.searchsorted(_SIGMA_AT_RESOLUTION, psf.sigma_px))
        if halvings != needed:
            halvings, candidates = needed, find_candidates(image, background, halvings=needed)
        threshold = detection_threshold(image.size, psf.sigma_px, settings.false_alarms_per_frame)
        reach = 2**halvings - 1
        found = detect(
            image, background, candidates, psf_sigma_px=psf.sigma_px, threshold=threshold, reach_px=reach
        )
        shapes = _shapes(frame, found, psf)
        if settings.psf_sigma_px is not None or shapes.stars < LEAST_STARS:
            break
        before, psf_stars = psf, shapes.stars
        psf = psf_of(shapes, before, find_smear=settings.smear_px is None)
        change = np.hypot(psf.smear_px[0] - before.smear_px[0], psf.smear_px[1] - before.smear_px[1])
        if abs(np.log(psf.sigma_px / before.sigma_px)) < _SMALL_CHANGE and change < 0.5 * psf.sigma_px:
            break
    gain = gain_from_widths(shapes, background.correlation)
    return _Found(
        xy_px=found.xy_px,
        offset_px=found.offset_px,
        psf=psf,
        psf_stars=psf_stars,
        gain_e_per_dn=settings.gain_e_per_dn or gain,
        threshold=threshold,
        hot_pixels=found.hot_pixels,
    )


def _shapes(frame: _Frame, found: Detections, psf: Psf) -> WidthFits:
    """Width fits of the 40 brightest unsaturated detections; if fewer than 8 are point-like, of the next
    200."""
    (column, row), top = found.xy_px.T, frame.saturation_dn
    below = np.flatnonzero(frame.image[row, column] < top)[: 6 * STARS_FOR_WIDTH]
    for some in (below[:STARS_FOR_WIDTH], below[STARS_FOR_WIDTH:]):
        pixels, offset = found.xy_px[some], found.offset_px[some]
        shapes = fit_widths(frame.image, pixels, offset, frame.background, psf, saturation_dn=top)
        if shapes.stars >= FEW_STARS:
            break
    return shapes


def _saturation_level(image: NDArray[Any]) -> float:
    """Value from which a pixel counts as saturated: the top of the bit depth that the brightest value
    suggests."""
    if not np.issubdtype(image.dtype, np.integer):
        return np.inf
    top = int(np.iinfo(image.dtype).max)
    if image.dtype == np.uint8:
        return float(top)
    brightest = int(image.max())
    for bits in (8, 10, 12, 14):
        if brightest <= 2**bits - 1:
            return float(0.995 * (2**bits - 1))
    return float(0.98 * top) if brightest <= 2**16 - 1 else float(top)


def _subtract_dark(image: NDArray[Any], dark: NDArray[Any], saturation: float) -> NDArray[Any]:
    """The image less its dark frame, plus the dark frame's median; saturated pixels stay saturated."""
    if dark.shape != image.shape:
        raise ValueError(f"dark frame is {dark.shape}, image is {image.shape}")
    corrected = image.astype(np.float32) - dark.astype(np.float32) + np.float32(np.median(dark))
    corrected[image >= saturation] = saturation
    return corrected


def _merge_saturated_peaks(
    image: NDArray[Any], pixels: Ints, offset: Floats, saturation: float
) -> tuple[Ints, Floats]:
    """Pixels and offsets with the peaks on one plateau of saturated pixels replaced by its middle."""
    full = image[pixels[:, 1], pixels[:, 0]] >= saturation if len(pixels) else np.empty(0, dtype=bool)
    if full.sum() < 2:
        return pixels, offset
    plateau = pixels[full]
    pairs = cKDTree(plateau).query_pairs(4.5, output_type="ndarray")
    label, before = np.arange(len(plateau)), np.empty(0, dtype=np.int64)
    while not np.array_equal(label, before):  # connected peaks take the lowest row among them
        before, low = label, label[pairs].min(axis=1)
        label = label.copy()
        np.minimum.at(label, pairs, low[:, None])
    middles = [np.rint(plateau[label == k].mean(axis=0)).astype(np.int64) for k in np.unique(label)]
    offset = np.vstack([np.zeros((len(middles), 2)), offset[~full]])
    return np.vstack([np.array(middles), pixels[~full]]), offset


def _distinct(fits: StarFits, good: Ints, psf: Psf) -> Ints:
    """Rows of good fits, brightest first; of two that converged to the same position the brighter one."""
    order = good[np.argsort(-fits.flux_dn[good], kind="stable")]
    if len(order) < 2:
        return order
    reach = max(1.0, _width_px(fits.xy_px[order], psf))
    pairs = cKDTree(fits.xy_px[order]).query_pairs(reach, output_type="ndarray")
    drop = np.zeros(len(order), dtype=bool)
    drop[pairs.max(axis=1)] = True
    return np.asarray(order[~drop])


def _width_px(xy_px: Floats, psf: Psf) -> float:
    """Mean standard deviation along one axis, px, of the light of stars at pixels (N, 2)."""
    return float(np.hypot(psf.sigma_at(xy_px).mean(), psf.smear_sigma_px))


def _blended(fits: StarFits, psf: Psf) -> Bools:
    """(N,) which stars are displaced by a neighbour, detected or not.

    A neighbour of flux F2 at distance d displaces a Gaussian fit by about (F2 / F1) d exp(-d^2 / 4 s^2). One
    too close to be detected shows as a misfit larger than that of the other stars. Of a saturated star only
    the wings are measured, on one side more than on the other, so any misfit displaces it.
    """
    if len(fits.xy_px) < 2:
        return np.zeros(len(fits.xy_px), dtype=bool)
    misfit = (fits.chi2 - fits.dof) / np.maximum(fits.snr**2, 1.0)
    unsaturated = np.sort(misfit[~fits.saturated])
    usual = float(unsaturated[len(unsaturated) // 4]) if len(unsaturated) else 0.0
    blended = ~fits.saturated & (fits.chi2 > fits.dof + 6.0 * np.sqrt(2.0 * fits.dof))
    blended &= misfit > 3.0 * max(usual, 0.0) + 0.003
    blended |= fits.saturated & (fits.chi2 > fits.dof + SELDOM_SIGMA * np.sqrt(2.0 * fits.dof))
    sigma = _width_px(fits.xy_px, psf)
    pairs = cKDTree(fits.xy_px).query_pairs(10.0 * sigma, output_type="ndarray")
    for a, b in (pairs.T, pairs.T[::-1]):
        d2 = ((fits.xy_px[a] - fits.xy_px[b]) ** 2).sum(axis=1)
        shift = fits.flux_dn[b] / fits.flux_dn[a] * np.sqrt(d2) * np.exp(-d2 / (4.0 * sigma**2))
        own = np.sqrt(0.5 * np.trace(fits.cov_px[a], axis1=1, axis2=2))
        blended[a[shift > 0.2 * own]] = True
    return blended
