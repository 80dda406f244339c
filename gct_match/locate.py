"""One template in one window: found by correlation, placed by least squares, judged.

Several peaks of the correlation are tried where they are of like height; the least-squares fit with the
highest robust correlation wins. What cannot be believed comes back as the reason why not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.refine.least_squares import Placement, place
from boresight.gct_match.search.correlation import (
    correlation_surface,
    independent_values,
    likeness_to_itself,
    peaks_of,
    probability_wrong,
    view_of,
)
from boresight.gct_match.settings import MatchSettings

__all__ = ["Located", "NotLocated", "locate"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision
Mask = NDArray[np.bool_]

_ABSENT = 0.05  # prior probability that a target cannot be seen where it should be
_SECOND_PEAK = 0.7  # peaks this high, against the best, are tried too
_ALIKE = 0.4  # of 441 look-alikes that passed every other test, one came from a template less like itself
_LEAST_USABLE = 0.4  # share of the template that clouds and the strip's edges must leave


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A place that can be believed."""

    placement: Placement
    probability_wrong: float
    surface: Image  # (2 r + 1, 2 r + 1) correlation at whole pixels around the start


@dataclass(frozen=True, slots=True)
class NotLocated:
    """Why no place can be believed."""

    reason: str


def locate(
    template: Image,
    template_valid: Mask,
    picture: Image,
    picture_valid: Mask,
    start_px: tuple[int, int],
    radius: int,
    reference_px: Array,
    settings: MatchSettings,
) -> Located | NotLocated:
    """Look for `template` (h, w) in `picture` (H, W) within `radius` px of `start_px`.

    `start_px` (x, y) is the expected place of the template's first pixel in the picture, which should show
    `radius` and 8 px more on every side; what is missing counts as not valid. `reference_px` (x, y) is the
    point of the template whose place is wanted.
    """
    h, w = template.shape
    x, y = start_px
    here = _cut(picture_valid, x, y, w, h) & template_valid
    if here.mean() < _LEAST_USABLE:
        return NotLocated(
            f"{100.0 * here.mean():.0f} % of the template can be used (cloud, no data, saturation, edge), "
            f"{100.0 * _LEAST_USABLE:.0f} % are needed"
        )
    one, two = view_of(template, template_valid), view_of(picture, picture_valid)
    a = one.normalised
    b = _cut(two.normalised, x - radius, y - radius, w + 2 * radius, h + 2 * radius)
    surface = correlation_surface(a, b)
    peaks = peaks_of(surface, 3, 3)
    if len(peaks.value) == 0:
        return NotLocated("correlates nowhere in its window")
    best, best_peak = None, peaks.xy[0]
    for peak, value in zip(peaks.xy, peaks.value, strict=True):
        if value < _SECOND_PEAK * peaks.value[0]:
            break
        trial = place(one, two, peak + start_px - radius, reference_px)
        if trial.converged and (best is None or trial.correlation > best.correlation):
            best, best_peak = trial, np.round(peak)
    if best is None:
        return NotLocated(f"least squares did not converge from its {len(peaks.value)} best peak(s)")
    wrong = probability_wrong(surface, best_peak, independent_values(a), _ABSENT)
    reason = _why_not(best, best_peak, wrong, float(peaks.value[0]), radius, a, settings)
    return NotLocated(reason) if reason else Located(best, wrong, surface)


def _why_not(
    best: Placement,
    peak: Array,
    wrong: float,
    highest: float,
    radius: int,
    normalised: Image,
    settings: MatchSettings,
) -> str:
    """Why a place is not to be believed; empty if it is."""
    sigma = float(np.sqrt(max(best.cov_px[0, 0], best.cov_px[1, 1])))
    if not sigma <= settings.sigma_px:
        return f"its texture places it to {sigma:.2g} px only, {settings.sigma_px} px are needed"
    if wrong > settings.probability_wrong:
        return (
            f"is another place with probability {wrong:.1g} (highest correlation {highest:.2f}), "
            f"{settings.probability_wrong:.1g} is allowed"
        )
    if np.abs(peak - radius).max() >= radius:
        return f"lies at the edge of its search window of {radius} px"
    if sigma > settings.sigma_alike_px and (likeness := likeness_to_itself(normalised)) > _ALIKE:
        return (
            f"holds things alike (it correlates to {likeness:.2f} with itself elsewhere) and is placed to "
            f"{sigma:.2g} px only, {settings.sigma_alike_px} px are needed to tell them apart"
        )
    if best.correlation < settings.least_correlation:
        return f"correlates to {best.correlation:.2f} only, {settings.least_correlation} is needed"
    return ""


def _cut(image: NDArray, x: int, y: int, w: int, h: int) -> NDArray:
    """A window of a picture; zero beyond its edges."""
    rows, columns = image.shape
    a, b, c, d = max(0, y), min(rows, y + h), max(0, x), min(columns, x + w)
    if (a, b, c, d) == (y, y + h, x, x + w):
        return image[a:b, c:d]
    out = np.zeros((h, w), dtype=image.dtype)
    if a < b and c < d:
        out[a - y : b - y, c - x : d - x] = image[a:b, c:d]
    return out
