"""Similarity of two pictures by the directions of their edges, insensitive to changed grey values.

A field that was darker than the track beside it may be brighter in another year; the boundary stays. The
square of the complex gradient g = g_x + i g_y has twice its angle and does not depend on which side is the
brighter (Kass & Witkin 1987); divided by its length it weights all edges equally (orientation correlation,
Fitch et al. 2002):

    z = g² / (|g|² + median of |g|²)

The median suppresses noise on flat ground. A picture holds integers, or single precision with NaN where it
is not valid: there z is zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from boresight.gct_match.imaging.views import View, wide_mean
from boresight.gct_match.records import Image
from boresight.records.record import Bools

__all__ = [
    "FULL",
    "agreeing_parts",
    "centred",
    "coarse_edge_fields",
    "distinct_edges",
    "edge_field",
    "edge_similarity",
    "halved",
    "normalised_correlation",
]

FULL = np.float32(127.0)  # 8 bit value of |z| = 1

_FLOOR = np.float32(0.1)  # of the template's power: least power of the edges under it
_AROUND_PX = 6.0  # sigma of a Gaussian: neighbourhood whose mean direction tells nothing about the place
# Pairs of one resolution differ in `_fineness` by 1.0 (0.5 to 1.6), references of 4 x coarser pixels by 2.5.
_SHARPER, _COARSER_PX = 2.0, 1.0
_PARTS = 6  # along a template's longer side, for `agreeing_parts`: of 21 px on a chip of 128 px
_BAND = 64  # rows of the field at a time: they stay in the cache
_STRIPS, _ROWS = 24, 16  # strips of so many rows from which a large picture's median is estimated


def edge_field(image: Image) -> Image:
    """(2, H, W) real and imaginary part of z at each pixel of a picture (H, W), single precision."""
    return _field(image, _median_power(_strips(image)))


def distinct_edges(grey: Image, valid: Bools, coarser: View | None = None) -> Image:
    """(2, H, W) edge field z of a picture (H, W) less its mean around each pixel; zero where not `valid`.

    Furrows, dunes and lines of trees have one direction over a large area: z alone correlates with itself
    along all of it. A picture with more fine detail than a `coarser` reference is smoothed first: its finest
    edges would not agree.
    """
    image = np.where(valid, grey, np.float32(np.nan))
    if coarser and _fineness(grey, valid) > _SHARPER * _fineness(coarser.grey, coarser.valid):
        image = cv2.GaussianBlur(image, (0, 0), _COARSER_PX)
    inner = cv2.erode(valid.astype(np.float32), np.ones((3, 3), np.uint8))
    return np.stack([(plane - wide_mean(plane, _AROUND_PX)) * inner for plane in edge_field(image)])


def _fineness(grey: Image, valid: Bools) -> float:
    """Power of a picture's slopes over that after a Gaussian of 2 px."""
    image = np.where(valid, grey, np.float32(np.nan))
    some = range(0, len(image), 16)  # of the rows, for speed
    smooth = cv2.GaussianBlur(image, (0, 0), 2.0)
    fine, coarse = (_median_power([one[k : k + 6] for k in some]) for one in (image, smooth))
    return float(fine / coarse)


def coarse_edge_fields(image: Image) -> tuple[Image, Image]:
    """Edge fields z of a picture (H, W) at half and a quarter of its resolution, real and imaginary part.

    First z of means over 2 x 2 px, (2, H // 4 * 2, W // 4 * 2), 8 bit in parts of `FULL`; then means over
    2 x 2 of this z, (2, H // 4, W // 4), single precision, which keep edges that means of grey values lose.
    """
    h, w = (n // 4 for n in image.shape)
    image = image[: 4 * h, : 4 * w]
    median = _median_power([halved(strip) for strip in _strips(image)])
    fine, pooled = np.empty((2, 2 * h, 2 * w), dtype=np.int8), np.empty((2, h, w), dtype=np.float32)
    for top in range(0, h, _BAND // 2):
        stop = min(top + _BAND // 2, h)
        first, last = max(0, 4 * top - 2), min(4 * stop + 2, 4 * h)
        field = _field(halved(image[first:last]), median)[:, (4 * top - first) // 2 :][:, : 2 * (stop - top)]
        for k in (0, 1):
            pooled[k, top:stop] = halved(field[k])
        np.multiply(field, FULL, out=fine[:, 2 * top : 2 * stop], casting="unsafe")
    return fine, pooled


def halved(image: Image) -> Image:
    """Means of 2 x 2 px, single precision."""
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return cv2.resize(image.astype(np.float32, copy=False), size, interpolation=cv2.INTER_AREA)


def edge_similarity(template: Image, field: Image) -> Image:
    """(H - h + 1, W - w + 1) normalised correlation of a template's edges (2, h, w) with a picture's
    (2, H, W); normalisation removes the preference for ground full of edges.
    """
    h, w = template.shape[1:]
    planes = zip(field, centred(template), strict=True)
    product = sum(cv2.matchTemplate(plane, kernel, cv2.TM_CCORR) for plane, kernel in planes)
    power = field[0] * field[0]
    power += field[1] * field[1]
    under = cv2.boxFilter(power, -1, (w, h), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    return normalised_correlation(product, template, under[: len(product), : product.shape[1]])


def agreeing_parts(template: Image, field: Image) -> float:
    """Number of parts of a template's edges (2, h, w) whose agreement with a field (2, h, w) is the agreement
    of the whole: (Σ c)² / Σ c² of the products c of parts. Signs of c are random where the two have nothing
    in common: so many or more agree with a probability of exp(-N / 2) at most (Hoeffding's inequality).
    """
    h, w = template.shape[1:]
    size = max(1, w * _PARTS // max(h, w)), max(1, h * _PARTS // max(h, w))
    c = cv2.resize((centred(template) * field).sum(axis=0), size, interpolation=cv2.INTER_AREA).astype(float)
    return float(max(c.sum(), 0.0) ** 2 / (np.sum(c * c) + 1e-30))


def normalised_correlation(product: Image, template: Image, power: Image) -> Image:
    """Correlations (h, w) from a template's products with fields of mean `power`; small for empty fields."""
    own = np.float32(2.0 * np.mean(np.square(template)))
    if own == 0.0:  # a template without edges is like nothing
        return np.zeros_like(product)
    scale = np.maximum(power, _FLOOR * own)
    np.sqrt(scale, out=scale)
    scale *= np.float32(0.5 * template.size) * np.sqrt(own)
    return product / scale


def centred(template: Image) -> Image:
    """A template's edges (2, h, w) without their mean."""
    return template - template.mean(axis=(1, 2), keepdims=True)


def _field(image: Image, median_power: np.float32) -> Image:
    gx: Image = cv2.Sobel(image, cv2.CV_32F, 1, 0)
    gy: Image = cv2.Sobel(image, cv2.CV_32F, 0, 1)
    field: Image = np.empty((2, *image.shape), dtype=np.float32)
    np.multiply(gx, gy, out=field[1])
    field[1] *= 2.0
    gx *= gx
    gy *= gy
    np.subtract(gx, gy, out=field[0])
    gx += gy
    gx += median_power
    field /= gx
    if image.dtype.kind == "f":
        cv2.patchNaNs(field.reshape(-1, image.shape[1]), 0.0)
    return field


def _strips(image: Image) -> list[Image]:
    """Rows of a picture, evenly spread over it; all of a small one."""
    rows = len(image)
    if rows <= _STRIPS * _ROWS:
        return [image]
    return [image[first : first + _ROWS] for first in np.linspace(0, rows - _ROWS, _STRIPS).astype(int)]


def _median_power(strips: Sequence[Image]) -> np.float32:
    """Median of |g|² over strips of a picture."""
    power = []
    for strip in strips:
        gx, gy = (cv2.Sobel(strip, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
        power.append((gx * gx + gy * gy)[1:-1].ravel())
    every = np.concatenate(power)
    every = every[np.isfinite(every)]
    return np.float32(np.median(every) + 1e-6 if every.size else 1.0)
