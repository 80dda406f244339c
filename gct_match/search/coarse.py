"""A strip read once, in blocks of rows, and reduced to means of square blocks of pixels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.views import filled_with_mean
from boresight.gct_match.records import Image
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.line_camera import StripImage
from boresight.records.record import Bools, array, record, scalar

__all__ = ["CoarseStrip", "means_of_usable", "read_coarse", "read_window"]

_TILE_LINES = 512  # of a usual TIFF, or a divisor
_LEAST_VALID = 0.75  # share of a block's pixels that must be usable


@record
class CoarseStrip:
    """Part of a CCD's image, reduced to block means."""

    image: NDArray[Any] = array("H, W", "integers as in the strip, or float32 with NaN where invalid")
    origin_px: tuple[int, int] = scalar("(sample, line) of the strip's pixel at the corner of pixel (0, 0)")


def read_window(
    strip: StripImage, ccd: int, line0: int, line1: int, sample0: int, sample1: int, settings: MatchSettings
) -> tuple[Image, Bools]:
    """Grey values (lines, samples) of a strip's window (ends excluded), and which are valid: not NaN, not
    the no-data value, not saturated.
    """
    image = np.asarray(strip.read(ccd, line0, line1, sample0, sample1))
    valid = _usable(image, settings)
    return filled_with_mean(image, valid), valid


def read_coarse(
    strip: StripImage,
    ccd: int,
    lines: tuple[int, int],
    samples: tuple[int, int],
    factor: int,
    settings: MatchSettings,
) -> CoarseStrip:
    """Means over `factor`² px of a CCD's image between two lines and two samples (ends excluded).

    `factor` is a power of two; incomplete blocks at the ends are dropped.
    """
    h, w = (lines[1] - lines[0]) // factor, (samples[1] - samples[0]) // factor
    at_once = max(1, settings.read_block_px // (max(w, 1) * factor * factor))
    if (tiles := at_once * factor // _TILE_LINES) and lines[0] % _TILE_LINES == 0:
        at_once = tiles * _TILE_LINES // factor  # no row of tiles is decoded twice
    image: NDArray[Any] = np.empty((h, w), dtype=np.float32)
    for row in range(0, h, at_once):
        line0, line1 = lines[0] + row * factor, lines[0] + min(row + at_once, h) * factor
        block = np.asarray(strip.read(ccd, line0, line1, samples[0], samples[0] + w * factor))
        means = means_of_usable(block, factor, settings)
        image = image if row else np.empty((h, w), dtype=means.dtype)
        image[row : row + len(means)] = means
    return CoarseStrip(image, (samples[0], lines[0]))


def means_of_usable(block: NDArray, factor: int, settings: MatchSettings) -> NDArray:
    """Means (H / factor, W / factor) over `factor`² px of grey values (H, W), a power of two that divides H;
    NaN where few are valid. 8 and 16 bit integers keep their type if all are.
    """
    limits = np.isfinite([settings.saturation_dn, settings.no_data])
    if block.dtype.kind in "iu" and not limits.any():  # every value is valid
        return _block_means(block, factor)
    good = _usable(block, settings)
    means = _block_means(filled_with_mean(block, good), factor)
    if not good.all():
        means[_block_means(good.astype(np.float32), factor) <= _LEAST_VALID] = np.nan
    return means


def _usable(image: NDArray, settings: MatchSettings) -> Bools:
    usable = np.ones(image.shape, dtype=bool) if image.dtype.kind in "iu" else np.isfinite(image)
    if np.isfinite(settings.saturation_dn):
        usable &= image < settings.saturation_dn
    if np.isfinite(settings.no_data):
        usable &= image != settings.no_data
    return usable


def _block_means(image: NDArray, factor: int) -> NDArray:
    """Means of factor² pixels, by repeated halving; 8 and 16 bit integers keep their type."""
    if image.dtype not in (np.uint8, np.uint16):
        image = image.astype(np.float32, copy=False)
    while factor > 1:
        image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
        factor //= 2
    return image
