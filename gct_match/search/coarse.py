"""A strip read once, in blocks of rows, and kept as the means of square blocks of pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.views import filled
from boresight.gct_match.records import StripImage
from boresight.gct_match.settings import MatchSettings

__all__ = ["CoarseStrip", "read_coarse", "read_window"]

Image = NDArray[Any]  # single precision

_LEAST_VALID = 0.75  # share of a block's pixels that must be usable


@dataclass(frozen=True, slots=True, eq=False)
class CoarseStrip:
    """Part of a CCD's image: pixel (0, 0) is the mean of factor² pixels from `origin_px` (sample, line)
    on.
    """

    image: NDArray[
        Any
    ]  # (h, w) whole numbers as in the strip, or single precision with NaN where it shows nothing
    origin_px: tuple[int, int]
    factor: int


def read_window(
    strip: StripImage, ccd: int, line0: int, line1: int, sample0: int, sample1: int, settings: MatchSettings
) -> tuple[Image, NDArray[np.bool_]]:
    """Grey values, and where they can be used: not NaN, not the no-data value, not saturated."""
    image = np.asarray(strip.read(ccd, line0, line1, sample0, sample1))
    valid = _usable(image, settings)
    return filled(image, valid), valid


def read_coarse(
    strip: StripImage,
    ccd: int,
    lines: tuple[int, int],
    samples: tuple[int, int],
    factor: int,
    settings: MatchSettings,
) -> CoarseStrip:
    """The part of a CCD between two lines and two samples; `factor` is a power of two, what does not fill a
    block at the ends is left off.
    """
    h, w = (lines[1] - lines[0]) // factor, (samples[1] - samples[0]) // factor
    image = np.empty((h, w), dtype=np.float32)
    at_once = max(1, settings.read_block_px // (max(w, 1) * factor * factor))
    for row in range(0, h, at_once):
        stop = min(row + at_once, h)
        line0, line1 = lines[0] + row * factor, lines[0] + stop * factor
        block = np.asarray(strip.read(ccd, line0, line1, samples[0], samples[0] + w * factor))
        means = _means_of_usable(block, factor, settings)
        if row == 0:
            image = np.empty((h, w), dtype=means.dtype)
        image[row:stop] = means
    return CoarseStrip(image, (samples[0], lines[0]), factor)


def _means_of_usable(block: NDArray, factor: int, settings: MatchSettings) -> NDArray:
    if _sets_nothing_aside(block, settings):
        return _block_means(block, factor)
    good = _usable(block, settings)
    means = _block_means(filled(block, good), factor)
    if not good.all():
        means[_block_means(good.astype(np.float32), factor) <= _LEAST_VALID] = np.nan
    return means


def _sets_nothing_aside(image: NDArray, settings: MatchSettings) -> bool:
    """Whole numbers, each of which is a grey value: there is nothing to look for."""
    limits = np.isfinite([settings.saturation, settings.no_data])
    return image.dtype.kind in "iu" and not limits.any()


def _usable(image: NDArray, settings: MatchSettings) -> NDArray[np.bool_]:
    usable = np.ones(image.shape, dtype=bool) if image.dtype.kind in "iu" else np.isfinite(image)
    if np.isfinite(settings.saturation):
        usable &= image < settings.saturation
    if np.isfinite(settings.no_data):
        usable &= image != settings.no_data
    return usable


def _block_means(image: NDArray, factor: int) -> NDArray:
    """Means of factor² pixels, by halving; whole numbers of 8 or 16 bit stay whole."""
    if image.dtype not in (np.uint8, np.uint16):
        image = image.astype(np.float32, copy=False)
    while factor > 1:
        image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
        factor //= 2
    return image
