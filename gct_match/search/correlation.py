"""Correlation of normalised pictures, its peaks, and the probability that a peak is a false match.

That probability follows from the correlation away from the peak. Pictures are normalised with
`imaging.views`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.views import window
from boresight.gct_match.records import Image
from boresight.records.record import Bools, Floats, array, record

__all__ = [
    "Peaks",
    "correlation_surface",
    "mean_and_spread",
    "peaks_of",
    "positions_under",
    "probability_wrong",
    "self_similarity",
]

# Of a chip held against its own displaced copy: least displacement, of its side; least overlap, of its area.
_FAR, _SHARED = 0.25, 0.25
_PRIOR_ABSENT = 0.05  # prior probability that the target is not visible where it should be
# Share of the independent values that changes of season leave to decide between places; and between positions
# under one peak, also of a picture that was turned to agree (NAIP: errors are then as stated).
_CHANGED, _MOVED, _TURNED = 0.5, 0.6, 0.5
_PARTS = 4  # of a pixel, between which likelihoods of positions are nearly linear


@record
class Peaks:
    """The highest maxima of a correlation surface, best first."""

    xy: Floats = array("K, 2", "column, row of the surface, to a fraction of a pixel")
    value: Floats = array("K", "correlation")


def correlation_surface(template: Image, picture: Image) -> Image:
    """(H - h + 1, W - w + 1) correlation of a normalised template (h, w) at all positions in a normalised
    picture (H, W).
    """
    template = template - np.float32(cv2.mean(template)[0])
    out = cv2.matchTemplate(picture, template, cv2.TM_CCORR)
    h, w = template.shape
    below = cv2.integral(picture * picture)
    energy = below[h:, w:] - below[:-h, w:] - below[h:, :-w] + below[:-h, :-w]
    total = float(np.vdot(template, template))
    floor = 0.05 * total  # lowers the correlation of windows with few valid pixels
    return out / np.sqrt(total * np.maximum(energy, floor) + 1e-12).astype(np.float32)


def peaks_of(surface: Image, most: int, apart: int) -> Peaks:
    """The `most` highest positive maxima of a surface (h, w), more than `apart` px from one another."""
    size = 2 * apart + 1
    highest = cv2.dilate(surface, np.ones((size, size), np.uint8))
    row, column = np.nonzero((surface == highest) & (surface > 0.0))
    value = surface[row, column]
    order = np.argsort(-value, kind="stable")[:most]
    row, column, value = row[order], column[order], value[order]
    xy = np.column_stack([column + _vertex(surface, row, column, 1), row + _vertex(surface, row, column, 0)])
    return Peaks(xy.astype(float), value.astype(float))


def probability_wrong(
    surface: Image, peak_xy: Floats, reach_px: int | None = None, own: Image | None = None
) -> float:
    """Probability that the true position is not under a peak (x, y) of a whole correlation surface (R, C).

    Each position has the likelihood (1 - r²)^(-n/2) of being the true one, against 1 for chance. One over the
    variance of r away from the peak is the number of independent values; what has changed takes as many of
    them: n is half of it. Side lobes are not chance: those of `own`, the template's correlation with itself,
    highest in the middle (R, C), are taken off. Under the peak are positions joined to it at more than half
    its height, from which least squares converges to it: all of a ridge along a road, or what lies within
    `reach_px` of the peak.
    """
    under = _under(surface, peak_xy, reach_px)
    if np.count_nonzero(~under) < 30:
        return 1.0
    (column, row), (h, w), away = np.round(peak_xy).astype(int), under.shape, surface
    if own is not None:
        away = surface - surface[row, column] * window(own, w // 2 - column, h // 2 - row, w, h)
    log_likelihood = _log_likelihood(surface, away[~under])
    here, elsewhere = (float(np.logaddexp.reduce(log_likelihood[part])) for part in (under, ~under))
    wrong = float(np.logaddexp(elsewhere, np.log(_PRIOR_ABSENT / (1.0 - _PRIOR_ABSENT) * under.size)))
    return float(np.exp(wrong - np.logaddexp(wrong, here)))


def positions_under(surface: Image, peak: Floats, reach_px: int, *, turned: bool) -> tuple[Floats, Floats]:
    """Positions (2, N) within `reach_px` of a peak (x, y) of a correlation surface (R, C), at fractions of a
    pixel, and the log-likelihood (N,) of each; lower for a picture that was `turned` to agree.
    """
    under = _under(surface, peak, reach_px)
    offset = np.linspace(-reach_px, reach_px, 2 * reach_px * _PARTS + 1)
    x, y = np.meshgrid(*(np.round(peak)[:, None] + offset).astype(np.float32))
    inside = cv2.remap(under.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
    fine = cv2.remap(surface, x, y, cv2.INTER_CUBIC)[inside]
    return np.stack([x[inside], y[inside]]).astype(float), _log_likelihood(
        fine, surface[~under], _TURNED if turned else _MOVED
    )


def mean_and_spread(xy: Floats, log_likelihood: Floats) -> tuple[Floats, Floats]:
    """Mean (2,) of positions (2, N), px, and their covariance (2, 2), px², by the likelihood of each."""
    weight = np.exp(log_likelihood - np.logaddexp.reduce(log_likelihood))
    mean = xy @ weight
    off = xy - mean[:, None]
    return mean, (weight * off) @ off.T


def self_similarity(template: Image) -> float:
    """Highest correlation of a normalised template (h, w) with a copy displaced by at least a quarter of its
    side and overlapping by at least a quarter of its area: high if it shows similar objects.
    """
    h, w = (n // 2 for n in template.shape)
    small: Image = cv2.resize(template, (w, h), interpolation=cv2.INTER_AREA)
    small = small - np.float32(cv2.mean(small)[0])
    up, left = 3 * h // 4, 3 * w // 4  # the farthest with such an overlap
    common, energy = (
        cv2.matchTemplate(
            cv2.copyMakeBorder(part, up, up, left, left, cv2.BORDER_CONSTANT), other, cv2.TM_CCORR
        )
        for part, other in ((small, small), (small * small, np.ones_like(small)))
    )
    down, along = (np.abs(np.arange(-n, n + 1)) / side for n, side in ((up, h), (left, w)))
    far = (np.maximum(down[:, None], along) >= _FAR) & (np.outer(1.0 - down, 1.0 - along) >= _SHARED)
    back = energy[::-1, ::-1]  # of the other copy's shared part
    floor = 1e-6 * float(np.vdot(small, small)) ** 2 + 1e-12
    return float(np.max(common[far] / np.sqrt(np.maximum(energy[far] * back[far], floor))))


def _under(surface: Image, peak_xy: Floats, reach_px: int | None) -> Bools:
    """The positions (R, C) of a surface that are under its peak (x, y), as in `probability_wrong`."""
    column, row = np.clip(np.round(peak_xy).astype(int), 0, np.array(surface.shape[::-1]) - 1)
    _, labels = cv2.connectedComponents((surface > 0.5 * surface[row, column]).astype(np.uint8))
    near = (labels == labels[row, column]).astype(np.uint8)
    near[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = 1
    under = cv2.dilate(near, np.ones((5, 5), np.uint8)).astype(bool)
    if reach_px is not None:
        y, x = np.ogrid[: surface.shape[0], : surface.shape[1]]
        under &= np.maximum(np.abs(x - column), np.abs(y - row)) <= reach_px
    return under


def _log_likelihood(correlation: NDArray, away: NDArray, share: float = _CHANGED) -> Floats:
    """That of positions by their correlation; those `away` from the peak tell the number of independent
    values, of which a `share` counts.
    """
    n = share / max(float(np.mean(away.astype(float) ** 2)), 1e-6)
    return -0.5 * n * np.log1p(-(np.clip(correlation.astype(float), 0.0, 0.99999) ** 2))


def _vertex(surface: Image, row: NDArray, column: NDArray, axis: int) -> Floats:
    """Offset of the parabola through three values from the middle one; zero at the surface's edge."""
    n = surface.shape[axis]
    at = row if axis == 0 else column
    inner = (at > 0) & (at < n - 1)
    step = np.where(inner, 1, 0)
    before = surface[row - step, column] if axis == 0 else surface[row, column - step]
    after = surface[row + step, column] if axis == 0 else surface[row, column + step]
    curvature = 2.0 * surface[row, column] - before - after
    offset = np.where(curvature > 1e-9, 0.5 * (after - before) / np.maximum(curvature, 1e-9), 0.0)
    return np.clip(np.where(inner, offset, 0.0), -0.5, 0.5)
