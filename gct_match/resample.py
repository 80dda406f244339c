"""Pictures read between their pixels, exactly enough that the reading leaves no trace at a thousandth of a
pixel.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["gradient", "sample"]

Image = NDArray[Any]  # single precision

_GRID = 32.0  # OpenCV's remap rounds every point to this part of a pixel
_DIFFERENCE = np.array([1.0, -8.0, 0.0, 8.0, -1.0], dtype=np.float32) / 12.0


def sample(image: Image, x: Image, y: Image) -> Image:
    """The picture at points (x, y) (h, w), by Lanczos interpolation; mirrored beyond its edges.

    The points must form a smooth map of unit-like scale or finer. OpenCV reads at points rounded to 1/32
    px; the rest is brought in to first order, with the map's own derivatives of the picture that was read.
    """
    qx, qy = np.round(x * _GRID) / _GRID, np.round(y * _GRID) / _GRID
    out = cv2.remap(image, qx, qy, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    if min(x.shape) < 5:
        return out
    gu, gv = gradient(out)
    h, w = x.shape
    xu, yu = (x[h // 2, -1] - x[h // 2, 0]) / (w - 1), (y[h // 2, -1] - y[h // 2, 0]) / (w - 1)
    xv, yv = (x[-1, w // 2] - x[0, w // 2]) / (h - 1), (y[-1, w // 2] - y[0, w // 2]) / (h - 1)
    inverse = np.linalg.inv(np.array([[xu, xv], [yu, yv]], dtype=float)).astype(np.float32)
    dx, dy = x - qx, y - qy
    du = inverse[0, 0] * dx + inverse[0, 1] * dy
    dv = inverse[1, 0] * dx + inverse[1, 1] * dy
    return out + du * gu + dv * gv


def gradient(image: Image) -> tuple[Image, Image]:
    """Derivatives by column and row, from five points."""
    gx = cv2.filter2D(image, -1, _DIFFERENCE[None, :], borderType=cv2.BORDER_REFLECT)
    return gx, cv2.filter2D(image, -1, _DIFFERENCE[:, None], borderType=cv2.BORDER_REFLECT)
