"""Stars of a strip of the sky, from its raw images: where and when each crosses a detector, with covariance.

    blocks of rows -> candidates (matched filter) -> windows -> width of the optics, gain -> fits

A strip has hundreds of millions of pixels, so it is read in blocks; only the windows are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import lambertw

from boresight.geometry.line_camera import StripImage
from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import LEAST_STARS
from boresight.star_id.finding.candidates import MAX_CANDIDATES
from boresight.star_id.finding.star_shape import STARS_FOR_WIDTH
from boresight.star_id.finding.windows import AT_ONCE, StarWindows
from boresight.star_id.strip_stars.column_blocks import Columns, candidates, column_levels
from boresight.star_id.strip_stars.fit import TraceFits, fit_traces, gain_from_windows, width_of
from boresight.star_id.strip_stars.settings import StripStarSettings
from boresight.star_id.strip_stars.trace import Motion, trace_images, trace_radius

__all__ = ["StripMotion", "StripStars", "find_strip_stars"]

# Rows read at a time, which bounds memory; rows with one level and noise of each column.
_ROWS_READ, _ROWS_ALIKE = 1024, 256
# Most stars that the gain is estimated from.
_STARS_FOR_GAIN = 300
# SNR of stars that give width and gain: of the first limit that three stars reach.
_BRIGHT_SNR = (30.0, 10.0)
# Largest chi2 / dof of a star: the first, plus the square of the second times its SNR, since jitter and
# uneven pixels show in bright ones (set by hand).
_MISFIT, _MISFIT_OF_SNR = 2.0, 0.05
# Distance, px, within which two detections are one star (set by hand).
_SAME_STAR_PX = 1.8
# Light of a detection beside a saturated star over that star's, below which it is part of it (set by hand).
_GHOST = 0.03
# Light of a neighbour over the star's own from which it displaces it.
_DISTURBING = 0.01


@record
class StripMotion:
    """How image points move over K lines of C CCDs."""

    lines: Floats = array("K", "at which it is given, increasing")
    rate: Floats = array("C, K", "pixels in a row period along the motion of the charge")
    drift: Floats = array("C, K", "samples in a row period")
    stages: int = scalar("TDI stages")

    def of(self, ccd: int, line: Floats) -> Motion:
        """The motion at lines (N,) of a CCD."""
        rate, drift = (np.interp(line, self.lines, values[ccd]) for values in (self.rate, self.drift))
        return Motion(rate, drift, self.stages)

    @property
    def usual(self) -> Motion:
        """The motion in the middle of the strip, of every CCD (C,)."""
        middle = len(self.lines) // 2
        return Motion(self.rate[:, middle], self.drift[:, middle], self.stages)


@record(kw_only=True)
class StripStars:
    """Detections in a strip, brightest first. Row n of every array is the same detection."""

    ccd: Ints = array("N", "CCD of the camera, from 0")
    xy_px: Floats = array("N, 2", "(sample, line) where the star crosses the middle of the detector")
    cov_px: Floats = array("N, 2, 2", "covariance, px²")
    flux_dn: Floats = array("N", "whole image above the background, DN")
    snr: Floats = array("N", "flux over its error by background noise alone")
    saturated: Bools = array("N", "some pixel is saturated")
    blended: Bools = array("N", "displaced by a neighbour")
    psf_sigma_px: float = scalar("width of the optics' Gaussian, px")
    gain_e_per_dn: float = scalar("infinite where no photon noise is seen")
    misshapen: int = scalar("detections that are no trace of a star: cosmic rays, defects")

    def take(self, index: NDArray[Any]) -> StripStars:
        """The detections at indices (M,) or of a mask (N,)."""
        return replace(self, **{name: getattr(self, name)[index] for name in _COLUMNS})


# Fields of `SkyDetections` with a row a star.
_COLUMNS = tuple(
    f.name for f in fields(StripStars) if f.name not in ("psf_sigma_px", "gain_e_per_dn", "misshapen")
)


@record
class _Found:
    """Candidates with their windows."""

    ccd: Ints = array("N", "CCD")
    windows: StarWindows = scalar("(N,) raw pixels above the level of their columns")
    start: Floats = array("N, 2", "place from the middle of the window, px")
    motion: Motion = scalar("(N,)")

    def take(self, index: NDArray[Any]) -> _Found:
        return _Found(self.ccd[index], self.windows.take(index), self.start[index], self.motion.take(index))


def find_strip_stars(
    images: StripImage, motion: StripMotion, settings: StripStarSettings, saturation_dn: float
) -> StripStars:
    """Stars of a strip with places, covariances and charges.

    Parameters
    ----------
    images : StripImage
        The raw images of the CCDs, DN. Panels of one value hold nothing.
    motion : StripMotion
        Motion of the image points, from the attitudes of the star camera.
    settings : StripStarSettings
        Threshold, and width and gain where they are not to be estimated.
    saturation_dn : float
        Counts from which a pixel is saturated.

    Returns
    -------
    StripStars
        Brightest first.
    """
    sigma = settings.psf_sigma_px or 0.6  # until the stars have given it
    limit = _snr_limit(images, motion, settings, sigma)
    found = _candidates(images, motion, sigma, limit, saturation_dn)
    if not len(found.ccd):
        return _no_stars(sigma)
    rough = _fits(found, found.start, sigma, np.inf)
    inside = _on_detector(found, rough, images)
    gain = settings.gain_e_per_dn or np.inf
    few = _bright(found, rough, inside, _BRIGHT_SNR, STARS_FOR_WIDTH)
    if settings.psf_sigma_px is None and len(few):
        chosen = found.take(few)
        sigma = width_of(chosen.windows, rough.offset[few], chosen.motion)
    many = _bright(found, rough, inside, _BRIGHT_SNR[1:], _STARS_FOR_GAIN)
    if settings.gain_e_per_dn is None and len(many):
        chosen = found.take(many)
        gain = gain_from_windows(chosen.windows, rough.offset[many], chosen.motion, sigma)
    fits = _fits(found, rough.offset, sigma, gain)
    seen = _on_detector(found, fits, images) & (fits.snr > limit)
    return _listed(found, fits, seen, sigma, gain)


def _snr_limit(
    images: StripImage, motion: StripMotion, settings: StripStarSettings, sigma_px: float
) -> float:
    """SNR that as many fits to a strip of noise exceed as the settings allow.

    A fit finds a maximum of the star's charge, a Gaussian field, over places: A sqrt(det L) (2 pi)^(-3/2) u
    exp(-u^2 / 2) of them exceed u sigma in A pixels (Adler, The Geometry of Random Fields, 1981, theorem
    6.3.1), L the covariance of the field's gradient. One sigma is more than that of `snr`, since the
    background is fitted too.
    """
    usual = motion.usual
    images_of = trace_images(np.zeros((len(usual.rate), 2)), usual, sigma_px, trace_radius(usual, sigma_px))
    free = images_of.columns[:, :3] - images_of.columns[:, :3].mean(axis=2, keepdims=True)
    energy = np.einsum("npm,nqm->npq", free, free).astype(float)
    density = np.sqrt(np.linalg.det(energy[:, :2, :2])) / energy[:, 2, 2] / (2.0 * np.pi) ** 1.5
    maxima = sum(float(density[ccd]) * np.prod(images.shape(ccd)) for ccd in images.ccds)
    # u exp(-u^2 / 2) = c where -u^2 is Lambert's function of -c^2
    share = min(settings.false_alarms_per_strip / maxima, 0.6)
    u = float(np.sqrt(-lambertw(-(share**2), -1).real))
    return u * float(np.sqrt((images_of.value**2).sum(axis=1) / energy[:, 2, 2]).mean())


def _candidates(
    images: StripImage, motion: StripMotion, sigma_px: float, limit: float, saturation_dn: float
) -> _Found:
    """Peaks of the filter that may be stars of an SNR above `limit`: at the corner of four pixels a star's
    peak is lower."""
    radius = trace_radius(motion.usual, sigma_px)
    ccds: list[int] = []
    corners, data, good, noise2, starts = [], [], [], [], []
    for ccd in images.ccds:
        usual = motion.usual.take(np.array([ccd]))
        middle, corner = (
            trace_images(np.full((1, 2), at), usual, sigma_px, radius).value[0] for at in (0.0, 0.5)
        )
        threshold = limit * float(middle @ corner / (np.linalg.norm(middle) * np.linalg.norm(corner)))
        image = middle.reshape(2 * radius + 1, -1)
        for first, block, columns, inner in _blocks(images, ccd, 2 * radius + 2):
            peaks = candidates(block, columns, image, threshold)
            own = (peaks[:, 1] >= inner.start - 1) & (peaks[:, 1] <= inner.stop)  # at a seam in both
            for column, row in peaks[own].tolist():
                side = 2 * radius + 1
                if min(block.shape) < side or len(ccds) >= MAX_CANDIDATES:
                    continue
                left = int(np.clip(column - radius, 0, block.shape[1] - side))
                top = int(np.clip(row - radius, 0, block.shape[0] - side))
                part = slice(left, left + side)
                raw = block[top : top + side, part]
                ccds.append(ccd)
                corners.append((left, first + top))
                starts.append((column - left - radius, row - top - radius))
                data.append((raw - columns.level_dn[part]).astype(np.float32).ravel())
                good.append(((raw < saturation_dn) & columns.good[part]).astype(np.float32).ravel())
                noise2.append(float(np.median(columns.noise_dn[part])) ** 2)
    n, size = len(ccds), (2 * radius + 1) ** 2
    corner = np.array(corners, dtype=np.int64).reshape(n, 2)
    start = np.array(starts, dtype=float).reshape(n, 2)
    windows = StarWindows(
        corner=corner,
        radius=radius,
        data=np.array(data, dtype=np.float32).reshape(n, size),
        good=np.array(good, dtype=np.float32).reshape(n, size),
        noise2=np.array(noise2),
        saturated=np.zeros(n, dtype=bool),
    )
    return _with_motion(np.array(ccds, dtype=np.int64), windows, start, motion)


def _with_motion(ccd: Ints, windows: StarWindows, start: Floats, motion: StripMotion) -> _Found:
    line = windows.corner[:, 1] + windows.radius + start[:, 1]
    rate, drift = np.ones(len(ccd)), np.zeros(len(ccd))
    for one in np.unique(ccd).tolist():
        here = ccd == one
        own = motion.of(one, line[here])
        rate[here], drift[here] = own.rate, own.drift
    return _Found(ccd, windows, start, Motion(rate, drift, motion.stages))


def _blocks(images: StripImage, ccd: int, margin: int) -> Iterator[tuple[int, NDArray[Any], Columns, slice]]:
    """First line, rows, level and noise of the columns, and the rows (of the block) that are its own."""
    lines, samples = images.shape(ccd)
    for first in range(0, lines, _ROWS_READ):
        last = min(first + _ROWS_READ, lines)
        begin, end = max(first - margin, 0), min(last + margin, lines)
        read = images.read(ccd, begin, end, 0, samples)
        for top in range(first, last, _ROWS_ALIKE):
            bottom = min(top + _ROWS_ALIKE, last)
            own = read[top - begin : bottom - begin]
            if own.min() == own.max():
                continue
            low, high = max(top - margin, begin), min(bottom + margin, end)
            yield low, read[low - begin : high - begin], column_levels(own), slice(top - low, bottom - low)


def _fits(found: _Found, offset: Floats, sigma_px: float, gain: float) -> TraceFits:
    parts = []
    for first in range(0, len(offset), AT_ONCE):
        rows = np.arange(first, min(first + AT_ONCE, len(offset)))
        part = found.take(rows)
        parts.append(fit_traces(part.windows, offset[rows], part.motion, sigma_px, gain))
    names = [f.name for f in fields(TraceFits)]
    return TraceFits(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _bright(found: _Found, fits: TraceFits, inside: Bools, limits: tuple[float, ...], most: int) -> Ints:
    """Rows of the stars that give width and gain, `most` at most: bright, unsaturated, near their pixel, and
    inside the image: of a star beside it only a part of the trace is seen."""
    whole = (found.windows.good > 0.0).all(axis=1)
    near = np.abs(fits.offset - found.start).max(axis=1) < 1.5
    for limit in limits:
        rows = np.flatnonzero(inside & whole & near & (fits.snr > limit))
        if len(rows) >= LEAST_STARS:
            break
    return rows[np.argsort(-fits.snr[rows], kind="stable")][:most]


def _on_detector(found: _Found, fits: TraceFits, images: StripImage) -> Bools:
    """(N,) whether the middle of a star lies in the image of its CCD."""
    xy_px = fits.offset + found.windows.corner + found.windows.radius
    ends = np.array([images.shape(ccd)[::-1] for ccd in found.ccd.tolist()]) - 0.5
    return np.asarray(((xy_px >= -0.5) & (xy_px < ends)).all(axis=1))


def _listed(found: _Found, fits: TraceFits, seen: Bools, sigma: float, gain: float) -> StripStars:
    """The fits that are stars, bright enough and inside their CCD's image (`seen`), each once, brightest
    first."""
    windows = found.windows
    # Near the saturation every count is masked; what remains of the image still gives the place.
    saturated = np.asarray(
        ((windows.good == 0.0) & (windows.data > 5.0 * np.sqrt(windows.noise2)[:, None])).any(axis=1)
    )
    near = np.abs(fits.offset - found.start).max(axis=1) < np.where(saturated, 4.0, 2.0)
    shaped = (fits.chi2 / fits.dof < _MISFIT + (_MISFIT_OF_SNR * fits.snr) ** 2) | saturated
    kept = np.flatnonzero(seen & near & np.isfinite(fits.cov_px).all(axis=(1, 2)))
    kept = kept[np.argsort(-fits.flux_dn[kept], kind="stable")]
    stars = StripStars(
        ccd=found.ccd[kept],
        xy_px=fits.offset[kept] + windows.corner[kept] + windows.radius,
        cov_px=fits.cov_px[kept],
        flux_dn=fits.flux_dn[kept],
        snr=fits.snr[kept],
        saturated=saturated[kept],
        blended=np.zeros(len(kept), dtype=bool),
        psf_sigma_px=sigma,
        gain_e_per_dn=gain,
        misshapen=int(np.count_nonzero(seen & near & ~shaped)),
    )
    shaped = shaped[kept]
    stars, own = _each_once(stars, windows.radius)
    return stars.take(shaped[own])


def _each_once(stars: StripStars, radius: int) -> tuple[StripStars, Bools]:
    """Without second detections of a star, and with those marked that a neighbour displaces; which are
    kept.
    """
    place = np.column_stack([stars.xy_px, 1e6 * stars.ccd])
    own, blended = np.ones(len(place), dtype=bool), np.zeros(len(place), dtype=bool)
    pairs = (
        cKDTree(place).query_pairs(2.0 * radius, output_type="ndarray")
        if len(place)
        else np.empty((0, 2), int)
    )
    for i, j in sorted((min(a, b), max(a, b)) for a, b in pairs.tolist()):  # i is the brighter one
        if not own[i]:
            continue
        share = stars.flux_dn[j] / stars.flux_dn[i]
        distance = float(np.hypot(*(stars.xy_px[i] - stars.xy_px[j])))
        if distance < _SAME_STAR_PX or (stars.saturated[i] and share < _GHOST):
            own[j] = False
        else:
            blended[j], blended[i] = True, blended[i] or share > _DISTURBING
    return replace(stars, blended=blended).take(own), own


def _no_stars(sigma: float) -> StripStars:
    none, flags = np.empty(0), np.zeros(0, dtype=bool)
    return StripStars(
        ccd=np.zeros(0, dtype=np.int64),
        xy_px=np.empty((0, 2)),
        cov_px=np.empty((0, 2, 2)),
        flux_dn=none,
        snr=none,
        saturated=flags,
        blended=flags,
        psf_sigma_px=sigma,
        gain_e_per_dn=np.inf,
        misshapen=0,
    )
