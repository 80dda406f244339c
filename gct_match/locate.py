"""Position of one template in one picture: search by correlation, fit by least squares, tests of the result.

Every correlation peak of nearly the highest value is refined; the fit with the highest robust correlation is
kept. A result that fails a test is returned as an `Entry` with its reason.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boresight.gct_match.imaging.views import View, filled_with_mean, in_counts, view_of, window
from boresight.gct_match.records import Image, TemplateMatch, not_matched
from boresight.gct_match.refine.changed import REACH_PX, fit_changed, resampled
from boresight.gct_match.refine.least_squares import PositionFit, fit_position, usable_pixels
from boresight.gct_match.search import correlation
from boresight.gct_match.search.edges import agreeing_parts, distinct_edges, edge_similarity
from boresight.gct_match.settings import MatchSettings
from boresight.records.ledger import Entry, Reason
from boresight.records.record import Floats, record

__all__ = ["locate", "locate_template"]

# Height of a correlation peak over that of the highest from which its position is refined, too, and may
# make the place ambiguous (set by hand).
_SECOND_PEAK = 0.7
_SELF_SIMILAR = 0.4  # of 441 false matches that passed every other test, one had a template below this
_SURE_PX = 0.02  # a standard error that fits to parts which have moved do not have
_UNCHANGED_PX = 0.1  # a larger one: the weights may have chosen what agrees with the template
_UNSURE_CORRELATION = 0.4  # below, most of the chip has changed
_LEAST_ALIKE = 0.3  # a lower peak leads to no sure fit (the lowest of one was 0.34)
_SURE_CORRELATION = 0.95  # fits to parts which have moved reach 0.9
_TURNED_PX = 0.5  # by which a chip's rim is displaced by a map that must be shown
_LOG_MAPS = 4.0  # log of the number of maps of which the most likely one is fitted
_DATES_PX = 0.07  # by which places of two dates differ where nothing seems to have changed (targets suggest)
_OF_DATES = 0.6  # share of the spread that has moved with the ground of a date (closure of triples of years)
_LEAST_VALID = 0.4  # share of the template that clouds and the picture's edges must leave
_LEAST_RADIUS_PX = 4  # smaller windows hold too few values to estimate how probable a false match is
_DEFAULTS = MatchSettings()  # for the functions of this module that take single settings


def locate_template(
    template: ArrayLike,
    picture: ArrayLike,
    start_px: tuple[float, float],
    radius_px: int = 8,
    *,
    settings: MatchSettings = _DEFAULTS,
) -> TemplateMatch | Entry:
    """Position of a template in a picture, to a few thousandths of a pixel, with its covariance.

    Both arrays show the same scene at the same scale and orientation (an affine difference of up to 5 % is
    estimated); illumination, blur and part of the content may differ. Points are (x, y) = (column, row),
    (0, 0) is the centre of the first pixel. The position is that of the template's centre,
    ((w - 1) / 2, (h - 1) / 2) in its own pixels.

    Parameters
    ----------
    template : (h, w) array
        Grey values, at least `settings.smallest_template_px` (32) a side; NaN marks pixels not to be used.
    picture : (H, W) array
        Grey values of any scale; NaN marks pixels not to be used. It should show the template and
        `radius_px` + 8 px on every side of it.
    start_px : (x, y)
        Expected position of the template's centre in the picture, px.
    radius_px : int
        Half-width of the square search window around `start_px`, at least 4 px.
    settings : MatchSettings
        Limits of the tests.

    Returns
    -------
    TemplateMatch
        `xy_px` (2,) and `cov_px` (2, 2) of the centre in the picture, `correlation`, `probability_wrong`.
    Entry
        False in a condition; `.reason` names the failed test, `.text` gives its numbers.

    Raises
    ------
    ValueError
        If an array is not two-dimensional, the template is too small, or `radius_px` is below 4.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> noise = np.random.default_rng(1).normal(size=(200, 240))
    >>> picture = 100 + 400 * gaussian_filter(noise, 1.5)
    >>> template = picture[60:124, 80:144]  # its centre is at (111.5, 91.5)
    >>> match = match_template(template, picture, start_px=(114, 90))
    >>> bool(match), np.round(match.xy_px, 3).tolist()
    (True, [111.5, 91.5])
    """
    one, two = _view(np.asarray(template), "template"), _view(np.asarray(picture), "picture")
    shape, least = one.grey.shape, settings.smallest_template_px
    if min(shape) < least:
        raise ValueError(f"template has shape {shape}, at least {least} px are needed on each side")
    if radius_px < _LEAST_RADIUS_PX:
        raise ValueError(f"radius_px is {radius_px}, at least {_LEAST_RADIUS_PX} px are needed")
    centre = (np.array(shape[::-1]) - 1.0) / 2.0
    x, y = np.round(np.asarray(start_px, dtype=float) - centre).astype(int).tolist()
    return locate(one, two, (x, y), radius_px, centre, settings)


def locate(
    template: View,
    picture: View,
    start_px: tuple[int, int],
    radius_px: int,
    reference_px: Floats,
    settings: MatchSettings,
) -> TemplateMatch | Entry:
    """Position of the template's point `reference_px` (x, y) in a picture, or the test that refused it.

    `template` is (h, w), `picture` (H, W) should show `radius_px` + 8 px on every side of it; what is missing
    counts as not valid. `start_px` (x, y) is the expected position of the template's first pixel in the
    picture, whole px, and `radius_px` the half-width of the search window.
    """
    h, w = template.grey.shape
    x, y = start_px
    share = float((window(picture.valid, x, y, w, h) & template.valid).mean())
    if share < _LEAST_VALID:
        return not_matched(Reason.FEW_VALID_PIXELS, share, _LEAST_VALID)
    around = x - radius_px, y - radius_px, w + 2 * radius_px, h + 2 * radius_px
    grey = window(picture.grey, *around)[window(picture.valid, *around)]
    if np.ptp(grey) == 0.0:
        return not_matched(Reason.ONE_GREY_VALUE, float(grey[0]))
    sure = _of_unchanged(template, picture, start_px, radius_px, reference_px, settings)
    either = sure or _of_changed(template, picture, start_px, radius_px, reference_px)
    found = _tested(either, radius_px, template, settings)
    if isinstance(found, Entry):
        return found
    best = found.fit
    return TemplateMatch(
        xy_px=best.xy_px,
        cov_px=best.cov_px,
        cov_moved_px=found.moved,
        correlation=best.correlation,
        probability_wrong=found.wrong,
        affine=best.affine,
        found=best.found,
        residual=best.residual,
        surface=found.surface,
    )


@record
class _Found:
    """A fit, and the correlation from which it began."""

    fit: PositionFit
    surface: Image  # (R, C) correlation in the search window
    peak_xy: Floats  # (2,) peak of the fit, (column, row) of the surface, whole px
    highest: float  # correlation of the highest peak
    wrong: float  # probability that the true position is not under that peak
    moved: Floats  # (2, 2) part of the fit's covariance by what has moved with its surroundings, px²


def _of_unchanged(
    template: View,
    picture: View,
    start_px: tuple[int, int],
    radius_px: int,
    reference_px: Floats,
    settings: MatchSettings,
) -> _Found | None:
    """The best fit to those parts of the template that are as the picture shows them, if it is sure."""
    (h, w), (x, y) = template.grey.shape, start_px
    around = x - radius_px, y - radius_px, w + 2 * radius_px, h + 2 * radius_px
    surface = correlation.correlation_surface(template.normalised, window(picture.normalised, *around))
    peaks, best, best_peak = correlation.peaks_of(surface, 3, 3), None, np.zeros(2)
    for peak, value in zip(peaks.xy, peaks.value, strict=True):
        if value < max(_LEAST_ALIKE, _SECOND_PEAK * peaks.value[0]):
            break
        at = peak + start_px - radius_px
        fit = fit_position(template, picture, at, reference_px, settings.mtf_at_nyquist)
        if fit.converged and (best is None or fit.correlation > best.correlation):
            best, best_peak = fit, np.round(peak)
    if best is None or not _is_sure(best):
        return None
    wrong = correlation.probability_wrong(surface, best_peak)
    return _Found(best, surface, best_peak, float(peaks.value[0]), wrong, np.zeros((2, 2)))


def _is_sure(fit: PositionFit) -> bool:
    """Whether so much agrees with the template that its weights cannot have been chosen by a displacement."""
    alike = fit.sigma_px <= _UNCHANGED_PX and fit.correlation >= _UNSURE_CORRELATION
    return alike and (fit.sigma_px < _SURE_PX or fit.correlation > _SURE_CORRELATION)


def _of_changed(
    template: View, picture: View, start_px: tuple[int, int], radius_px: int, reference_px: Floats
) -> _Found | Entry:
    """The fit to the whole template by the directions of its edges, which outlast crops, season and light,
    whichever side is brighter.

    Shores, crops and shadows that have moved displace it: the position is the mean of those that the edges
    leave possible about it, and its covariance grows by their spread and by what dates differ where nothing
    seems to.
    """
    (h, w), (x, y) = template.grey.shape, start_px
    around = x - radius_px, y - radius_px, w + 2 * radius_px, h + 2 * radius_px
    one = distinct_edges(template.grey, template.valid)
    two = distinct_edges(picture.grey, picture.valid, coarser=template)
    surface = edge_similarity(one, window(two, *around))
    peaks = correlation.peaks_of(surface, 1, 3)
    if len(peaks.value) == 0:
        return not_matched(Reason.NO_CORRELATION)
    corner, peak = np.array(around[:2]), np.round(peaks.xy[0])
    usable = usable_pixels(template.valid, picture.valid, peaks.xy[0] + corner)
    fit_pair = partial(fit_changed, one, two, usable, peaks.xy[0] + corner, reference_px)
    fit = fit_pair(affine=True)
    xy, likelihood = correlation.positions_under(surface, peak, REACH_PX, turned=False)
    shown = False
    if 0.5 * max(h, w) * np.abs(fit.affine).max() > _TURNED_PX:
        A, at = np.eye(2) + fit.affine, np.round(fit.xy_px - reference_px - corner)
        seen = resampled(two, np.column_stack([A, fit.xy_px - A @ fit.xy_px]), two.shape[1:])
        other = edge_similarity(one, window(seen, *around))
        other_xy, other_likelihood = correlation.positions_under(other, at, REACH_PX, turned=True)
        other_likelihood -= _LOG_MAPS
        shown = bool(np.logaddexp.reduce(other_likelihood) > np.logaddexp.reduce(likelihood))
        if shown:
            two, surface, peak = seen, other, at
        xy, likelihood = np.hstack([xy, other_xy]), np.hstack([likelihood, other_likelihood])
    if not shown:
        fit = shifted if (shifted := fit_pair(affine=False)).converged else fit
    if not fit.converged:
        return not_matched(Reason.NOT_CONVERGED, more=(1.0,))
    own = edge_similarity(one, window(one, -radius_px, -radius_px, w + 2 * radius_px, h + 2 * radius_px))
    left, top = (peak + corner).astype(int).tolist()
    parts = agreeing_parts(one, window(two, left, top, w, h))  # one cloud's edge is like that of a field
    wrong = max(correlation.probability_wrong(surface, peak, REACH_PX, own), float(np.exp(-0.5 * parts)))
    mean, spread = correlation.mean_and_spread(xy, likelihood)
    dates = _DATES_PX**2 * np.eye(2)
    A = np.eye(2) + fit.affine
    of_corner = np.column_stack([A, fit.xy_px - A @ reference_px])
    seen = resampled(picture.grey[None], of_corner, (h, w))[0]
    xy_px, moved = mean + reference_px + corner, _OF_DATES * spread + dates
    fit = replace(fit, xy_px=xy_px, cov_px=fit.cov_px + spread + dates, found=seen)
    return _Found(fit, surface, peak, float(peaks.value[0]), wrong, moved)


def _tested(found: _Found | Entry, radius_px: int, template: View, settings: MatchSettings) -> _Found | Entry:
    """A fit, or the first test that it fails; `radius_px` is the half-width of the search window."""
    if isinstance(found, Entry):
        return found
    fit, sigma, wrong = found.fit, found.fit.sigma_px, found.wrong
    if wrong > settings.probability_wrong:
        return not_matched(Reason.PROBABLY_WRONG, wrong, settings.probability_wrong, (found.highest,))
    if not sigma <= settings.sigma_px:
        return not_matched(Reason.UNCERTAIN_POSITION, sigma, settings.sigma_px)
    if radius_px <= np.abs(found.peak_xy - radius_px).max():
        return not_matched(Reason.AT_WINDOW_EDGE, limit=radius_px)
    if sigma > settings.sigma_self_similar_px:
        similarity = correlation.self_similarity(template.normalised)
        if similarity > _SELF_SIMILAR:
            return not_matched(Reason.SELF_SIMILAR, sigma, settings.sigma_self_similar_px, (similarity,))
    if fit.correlation < settings.least_correlation:
        return not_matched(Reason.LOW_CORRELATION, fit.correlation, settings.least_correlation)
    return found


def _view(image: NDArray, name: str) -> View:
    """View of a caller's array; NaN is not valid."""
    if image.ndim != 2 or not image.size:
        raise ValueError(f"{name} must be a two-dimensional array, got shape {image.shape}")
    valid = np.isfinite(image)
    return view_of(in_counts(filled_with_mean(image, valid), valid), valid)
