"""A strip read once, in blocks of rows, and kept as the means of square blocks of pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gct_match.records import StripImage
from gct_match.settings import MatchSettings

__all__ = ["CoarseStrip", "read_coarse", "read_window"]

Image = NDArray[Any]  # single precision


@dataclass(frozen=True, slots=True, eq=False)
class CoarseStrip:
    """Part of a CCD's image: pixel (0, 0) is the mean of factor² pixels from `origin_px` (sample, line)
    on.
    """

    image: Image  # (h, w)
    valid: NDArray[np.bool_]  # (h, w)
    origin_px: tuple[int, int]
    factor: int


def read_window(
    strip: StripImage, ccd: int, line0: int, line1: int, sample0: int, sample1: int, settings: MatchSettings
) -> tuple[Image, NDArray[np.bool_]]:
    """Grey values, and where they can be used: not NaN, not the no-data value, not saturated."""
    image = np.asarray(strip.read(ccd, line0, line1, sample0, sample1)).astype(np.float32)
    valid = np.isfinite(image) & (image < settings.saturation) & (image != settings.no_data)
    if not valid.all():
        image = np.where(valid, image, image[valid].mean() if valid.any() else 0.0).astype(np.float32)
    return image, valid


def read_coarse(
    strip: StripImage,
    ccd: int,
    lines: tuple[int, int],
    samples: tuple[int, int],
    factor: int,
    settings: MatchSettings,
) -> CoarseStrip:
    """The part of a CCD between two lines and two samples; what does not fill a block at its ends is left
    off.
    """
    h, w = (lines[1] - lines[0]) // factor, (samples[1] - samples[0]) // factor
    image = np.empty((h, w), dtype=np.float32)
    valid = np.ones((h, w), dtype=bool)
    at_once = max(1, settings.read_block_px // (max(w, 1) * factor * factor))
    for row in range(0, h, at_once):
        stop = min(row + at_once, h)
        line0, line1 = lines[0] + row * factor, lines[0] + stop * factor
        block, good = read_window(strip, ccd, line0, line1, samples[0], samples[0] + w * factor, settings)
        image[row:stop] = cv2.resize(block, (w, stop - row), interpolation=cv2.INTER_AREA)
        if not good.all():
            share = cv2.resize(good.astype(np.float32), (w, stop - row), interpolation=cv2.INTER_AREA)
            valid[row:stop] = share > 0.75
    return CoarseStrip(image, valid, (samples[0], lines[0]), factor)
