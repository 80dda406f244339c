"""Correlation of normalised pictures, its peaks, and the probability that a peak is a false match.

That probability follows from the correlation away from the peak. Pictures are normalised with
`imaging.views`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.records import Image
from boresight.geometry.record import Bools, Floats, array, record, scalar

__all__ = [
    "Peaks",
    "Posterior",
    "correlation_surface",
    "peaks_of",
    "posterior",
    "self_similarity",
]

# Of a chip held against its own displaced copy: least displacement, of its side; least overlap, of its area.
_FAR, _SHARED = 0.25, 0.25


@record
class Peaks:
    """The highest maxima of a correlation surface, best first."""

    xy: Floats = array("K, 2", "column, row of the surface, to a fraction of a pixel")
    value: Floats = array("K", "correlation")


@record
class Posterior:
    """Where the true position may be, by correlation surfaces."""

    wrong: float = scalar("probability that it is not under the peak")
    cov_px: Floats = array("2, 2", "covariance of the positions under the peak, px²")


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


def posterior(
    surfaces: Sequence[Image], peak_xy: Floats, absent: float, reach_px: int | None = None
) -> Posterior:
    """Where the true position may be, given the whole correlation surfaces (R, C) of a pair.

    Each position has the likelihood (1 - r²)^(-n/2) of being the true one in each surface, against 1 for
    chance. One over the variance of r away from the peak is the number of independent values; what has
    changed lies along the same edges and takes as many of them as one surface has: n is the number over one
    more than the surfaces. Under the peak of the first are positions joined to it at more than half its
    height, from which least squares converges to it: all of a ridge along a road, or what lies within
    `reach_px` of the peak. `absent` is the prior probability that the surfaces do not contain the target.
    """
    first = surfaces[0]
    column, row = np.clip(np.round(peak_xy).astype(int), 0, np.array(first.shape[::-1]) - 1)
    _, labels = cv2.connectedComponents((first > 0.5 * first[row, column]).astype(np.uint8))
    near = (labels == labels[row, column]).astype(np.uint8)
    near[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = 1
    under = cv2.dilate(near, np.ones((5, 5), np.uint8)).astype(bool)
    y, x = np.mgrid[: first.shape[0], : first.shape[1]]
    if reach_px is not None:
        under &= np.maximum(np.abs(x - column), np.abs(y - row)) <= reach_px
    if np.count_nonzero(~under) < 30:
        return Posterior(1.0, np.diag([np.inf, np.inf]))
    log_likelihood = np.zeros(first.shape)
    for surface in surfaces:
        r = surface.astype(float)
        n = 1.0 / max(float(np.mean(r[~under] ** 2)), 1e-6) / (1.0 + len(surfaces))
        log_likelihood -= 0.5 * n * np.log1p(-(np.clip(r, 0.0, 0.99999) ** 2))
    here, elsewhere = (float(np.logaddexp.reduce(log_likelihood[part])) for part in (under, ~under))
    chance = float(np.log(absent / (1.0 - absent) * first.size))
    wrong = float(np.logaddexp(elsewhere, chance))
    weight = np.exp(log_likelihood[under] - here)
    return Posterior(
        float(np.exp(wrong - np.logaddexp(wrong, here))), np.cov(x[under], y[under], ddof=0, aweights=weight)
    )


def self_similarity(template: Image) -> float:
    """Highest correlation of a normalised template (h, w) with a copy displaced by at least a quarter of its
    side and overlapping by at least a quarter of its area: high if it shows similar objects.
    """
    h, w = (n // 2 for n in template.shape)
    small: Image = cv2.resize(template, (w, h), interpolation=cv2.INTER_AREA)
    small = small - np.float32(cv2.mean(small)[0])
    every, far = _displaced(h, w)
    spectrum, power = (cv2.dft(_twice(part)) for part in (small, small * small))
    common, energy = (
        cv2.idft(cv2.mulSpectrums(one, other, 0, conjB=True), flags=cv2.DFT_SCALE)
        for one, other in ((spectrum, spectrum), (power, every))
    )
    back = np.roll(energy[::-1, ::-1], 1, axis=(0, 1))  # of the other copy's shared part
    floor = 1e-6 * float(np.vdot(small, small)) ** 2 + 1e-12
    return float(np.max(common[far] / np.sqrt(np.maximum(energy[far] * back[far], floor))))


@lru_cache(maxsize=16)
def _displaced(h: int, w: int) -> tuple[Image, Bools]:
    """Packed spectrum of ones (h, w) padded with zeros, and the mask of displacements of at least a quarter
    of the side that leave an overlap of at least a quarter of the area.
    """
    down, along = (np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) / n for n in (h, w))
    shared = np.outer(1.0 - down, 1.0 - along)
    far = np.maximum(down[:, None], along) >= _FAR
    return cv2.dft(_twice(np.ones((h, w), dtype=np.float32))), far & (shared >= _SHARED)


def _twice(image: Image) -> Image:
    """A picture padded with zeros to twice its size."""
    h, w = image.shape
    return cv2.copyMakeBorder(image, 0, h, 0, w, borderType=cv2.BORDER_CONSTANT)


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
