"""Spectra of pictures, and filters without phase.

Spectra are packed as by OpenCV: as many real numbers as pixels, real and imaginary parts separate, so that
powers and filters without phase are element-wise products. Frequencies are in cycles per pixel.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.records import Image
from boresight.records.record import Floats

__all__ = [
    "filtered",
    "frequency",
    "padded_picture",
    "padded_shape",
    "padded_spectrum",
    "picture_of",
    "ring_means",
    "rings",
]

Shape = tuple[int, int]

_PAD = 8  # mirrored pixels around a picture that is filtered
_RING = 1.0 / 32.0  # width of a ring, cycles per pixel: hundreds of coefficients each on a 64 px chip; of
# smaller ones that of a coefficient, so that no ring is empty


def filtered(image: Image, amplitude: Image) -> Image:
    """A picture (h, w) after the filter `amplitude`, packed for its `padded_shape`."""
    return picture_of(padded_spectrum(image) * amplitude, image.shape)


def padded_spectrum(image: Image) -> Image:
    """Packed spectrum, of `padded_shape`, of a picture (h, w) with mirrored edges."""
    (h, w), (rows, columns) = image.shape, padded_shape(image.shape)
    bottom, right = rows - h - _PAD, columns - w - _PAD
    return cv2.dft(cv2.copyMakeBorder(image, _PAD, bottom, _PAD, right, borderType=cv2.BORDER_REFLECT))


def picture_of(packed: Image, shape: tuple[int, ...]) -> Image:
    """The picture of `shape` (h, w) within the padded one of a packed spectrum."""
    return padded_picture(packed)[_PAD : _PAD + shape[0], _PAD : _PAD + shape[1]]


def padded_picture(packed: Image) -> Image:
    """The padded picture (h, w) of a packed spectrum (h, w)."""
    return cv2.idft(packed, flags=cv2.DFT_SCALE)


@lru_cache(maxsize=32)
def padded_shape(shape: tuple[int, ...]) -> Shape:
    """A shape of fast transforms with at least _PAD pixels around `shape` (h, w)."""
    return cv2.getOptimalDFTSize(shape[0] + 2 * _PAD), cv2.getOptimalDFTSize(shape[1] + 2 * _PAD)


@lru_cache(maxsize=32)
def frequency(shape: Shape) -> Image:
    """Absolute frequency, cycles per px, of each number of a packed spectrum of `shape` (h, w)."""
    rows, columns = shape
    fx = (np.arange(columns) + 1) // 2 / columns
    fy = np.repeat(np.abs(np.fft.fftfreq(rows))[:, None], columns, axis=1)
    alone = [0] if columns % 2 else [0, -1]  # columns whose coefficients are conjugate to each other
    fy[:, alone] = ((np.arange(rows) + 1) // 2 / rows)[:, None]
    return np.hypot(fx[None, :], fy).astype(np.float32)


def rings(shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Mid frequencies (R,) of the rings of a spectrum for pictures of `shape`, and their sizes (R,)."""
    return _sorted(_quick(shape))[2:]


def ring_means(a: Image, b: Image) -> tuple[Floats, ...]:
    """Means (R,) over rings: powers of two tapered pictures a, b (h, w), and their real cross power."""
    (h, w), (rows, columns) = a.shape, _quick(a.shape)
    if (rows, columns) != (h, w):
        a, b = (
            cv2.copyMakeBorder(x, 0, rows - h, 0, columns - w, borderType=cv2.BORDER_CONSTANT) for x in (a, b)
        )
    order, starts, _, count = _sorted((rows, columns))
    a, b = (cv2.dft(image).ravel().take(order) for image in (a, b))
    return tuple(np.add.reduceat(product, starts).astype(float) / count for product in (a * a, b * b, a * b))


def _quick(shape: tuple[int, ...]) -> Shape:
    return cv2.getOptimalDFTSize(shape[0]), cv2.getOptimalDFTSize(shape[1])


@lru_cache(maxsize=32)
def _sorted(shape: Shape) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Order that sorts a packed spectrum by ring; start, mid frequency and size of each ring."""
    width = max(_RING, 1.0 / max(shape))
    ring = (frequency(shape) / width).astype(np.int64).ravel()
    count = np.bincount(ring)
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    return np.argsort(ring, kind="stable"), starts, (np.arange(len(count)) + 0.5) * width, count.astype(float)
