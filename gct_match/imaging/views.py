"""A picture with its valid pixels, and its band-passed copy that depends little on illumination.

Light, season and haze change a scene's grey values but leave most of its edges: a picture is compared after
subtraction of its local mean and division by its local contrast.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.records import Image
from boresight.records.record import Bools, array, record

__all__ = ["View", "filled_with_mean", "in_counts", "normalised", "view_of", "wide_mean", "window"]

_FINE_PX, _LOCAL_PX, _CONTRAST_PX = 0.8, 4.0, 6.0  # pass band and the neighbourhood of the contrast
_COUNTS = 50.0  # standard deviation of a usual picture of 8 bits
_MOST_COUNTS = 1e6  # beyond, single precision makes whole numbers of others
_FLOOR = 0.15  # of the median contrast: noise on flat ground is not amplified to texture


@record
class View:
    """A picture and what search and fit need of it."""

    grey: Image = array("H, W", "grey values, single precision")
    valid: Bools = array("H, W", "pixels that may be used")
    normalised: Image = array("H, W", "what is compared: output of `normalised`")


def view_of(grey: Image, valid: Bools) -> View:
    """View of the picture `grey` (H, W), float32, of which only the pixels in `valid` (H, W) are used."""
    return View(grey, valid, normalised(grey, valid))


def in_counts(image: NDArray, valid: Bools) -> Image:
    """The picture (H, W) as float32: as it is where its grey values are whole numbers below 1e6; reflectances
    and other units about zero, with the standard deviation of usual counts.
    """
    values = image[valid]
    mean, deviation = (float(values.mean()), float(values.std())) if values.size else (0.0, 0.0)
    if not values.size or (np.abs(values).max() < _MOST_COUNTS and (values == np.rint(values)).all()):
        return image.astype(np.float32)
    return ((image - mean) * (_COUNTS / (deviation or np.inf))).astype(np.float32)


def filled_with_mean(image: NDArray, valid: Bools) -> Image:
    """The picture (H, W) as float32, with the mean of its valid pixels where it is not valid."""
    if valid.all():
        return image.astype(np.float32)
    return np.where(valid, image, image[valid].mean() if valid.any() else 0.0).astype(np.float32)


def normalised(image: Image, valid: Bools) -> Image:
    """Band-passed picture (H, W), divided by its local contrast and limited to ±3; zero where not valid."""
    if valid.all():
        fine = _fine(image)
        fine -= wide_mean(fine, _LOCAL_PX)
        power = wide_mean(fine * fine, _CONTRAST_PX)
    elif not valid.any():
        return np.zeros_like(image)
    else:
        weight = valid.astype(np.float32)
        image = np.where(valid, image, image[valid].mean()).astype(np.float32)
        fine = _fine(image)
        fine -= wide_mean(image * weight, _LOCAL_PX) / (wide_mean(weight, _LOCAL_PX) + np.float32(1e-6))
        fine *= weight
        part = wide_mean(weight, _CONTRAST_PX) + np.float32(1e-6)
        power = wide_mean(fine * fine, _CONTRAST_PX) / part
    some = power[tuple(slice(None, None, max(1, n // 64)) for n in power.shape)]
    median = np.partition(some.ravel(), some.size // 2)[some.size // 2]
    floor = np.float32(_FLOOR**2 * float(median) + 1e-12)
    fine /= cv2.sqrt(np.maximum(power, 0.0) + floor)
    return np.clip(fine, -3.0, 3.0, out=fine)


def window(image: NDArray, x: int, y: int, w: int, h: int) -> NDArray:
    """Columns x..x + w, rows y..y + h of the last two axes of `image` (..., H, W); zero beyond its edges."""
    rows, columns = image.shape[-2:]
    a, b, c, d = max(0, y), min(rows, y + h), max(0, x), min(columns, x + w)
    if (a, b, c, d) == (y, y + h, x, x + w):
        return image[..., a:b, c:d]
    out = np.zeros((*image.shape[:-2], h, w), dtype=image.dtype)
    if a < b and c < d:
        out[..., a - y : b - y, c - x : d - x] = image[..., a:b, c:d]
    return out


def _fine(image: Image) -> Image:
    return cv2.GaussianBlur(image, (0, 0), _FINE_PX)


def wide_mean(image: Image, sigma_px: float) -> Image:
    """Mean over a wide Gaussian, computed from means of 2 x 2 pixels."""
    h, w = image.shape
    small = cv2.resize(image, (max(1, w // 2), max(1, h // 2)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), sigma_px / 2.0), (w, h), interpolation=cv2.INTER_LINEAR)
