"""How alike two pictures of one ground are by the directions of their edges, whatever has changed between
them.

A field that was darker than the track beside it is brighter in another year: grey values and the signs of
their differences come and go, the line between two parcels stays. The square of the complex gradient
g = g_x + i g_y has twice its angle and forgets which side is the brighter (Kass & Witkin 1987); divided by
its length it counts every edge alike (orientation correlation, Fitch et al. 2002):

    z = g² / (|g|² + median of |g|²)

The median keeps noise on flat ground from counting as edges.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["edge_field", "edge_similarity"]

Image = NDArray[Any]  # single precision


def edge_field(image: Image, valid: NDArray[np.bool_]) -> Image:
    """(2, H, W) real and imaginary part of z at each pixel of a picture (H, W), float32; zero where the
    picture is not valid.
    """
    gx: Image = cv2.Sobel(image, cv2.CV_32F, 1, 0)
    gy: Image = cv2.Sobel(image, cv2.CV_32F, 0, 1)
    xx, yy = gx * gx, gy * gy
    field: Image = np.empty((2, *image.shape), dtype=np.float32)
    np.subtract(xx, yy, out=field[0])
    np.multiply(gx, gy, out=field[1])
    field[1] *= 2.0
    power: Image = np.add(xx, yy, out=xx)
    step = max(1, min(image.shape) // 256)
    field /= power + np.float32(np.median(power[::step, ::step]) + 1e-6)
    if not valid.all():
        field[:, cv2.dilate((~valid).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = 0.0
    return field


def edge_similarity(template: Image, field: Image) -> Image:
    """Correlation of a template's edges (2, h, w) with a picture's (2, H, W) wherever the template lies
    within it, (H - h + 1, W - w + 1).
    """
    real, imaginary = (
        cv2.matchTemplate(plane, kernel - kernel.mean(), cv2.TM_CCORR)
        for kernel, plane in zip(template, field, strict=True)
    )
    return real + imaginary
