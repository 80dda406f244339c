"""Pictures read between their pixels, exactly enough that the reading leaves no trace at a thousandth of a
pixel.

A warp (3, 3) takes (x, y, 1) of one picture to those of another.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["change", "composed", "gradient", "largest_px", "sample", "shifted", "warped"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_GRID = 32.0  # OpenCV's remap rounds every point to this part of a pixel
_REACH = 5  # half length of the interpolating kernel
_TAP = np.arange(-_REACH, _REACH + 1)


def composed(warp: Array, P: Array) -> Array:
    """warp o (identity + P)^-1, with P (2, 3) the displacement P (x, y, 1) of the points it starts from."""
    (a, b, x), (c, d, y) = P
    return warp @ np.linalg.inv(np.array([[1.0 + a, b, x], [c, 1.0 + d, y], [0.0, 0.0, 1.0]]))


def largest_px(P: Array, shape: tuple[int, ...]) -> float:
    """How far P (2, 3) displaces the points of a picture (h, w), about its middle, at most."""
    return float(np.abs(P[:, 2]).max() + 0.5 * max(shape) * np.abs(P[:, :2]).max())


def change(slopes: tuple[Image, Image], P: Array, reference_px: Array, pitch_px: float) -> Image:
    """What P (2, 3), a displacement of a picture's points by far less than a pixel, changes in the picture.

    `slopes` (h, w) each are its derivatives per px at every `pitch_px`-th pixel, `reference_px` (x, y) is
    the pixel from which P counts.
    """
    y, x = (pitch_px * np.arange(n) - at for n, at in zip(slopes[0].shape, reference_px[::-1], strict=True))
    (along, across), (down, below) = (
        ((a * x + c).astype(np.float32), (b * y).astype(np.float32)[:, None]) for a, b, c in P
    )
    return slopes[0] * (along + across) + slopes[1] * (down + below)


def warped(picture: Image, warp: Array, shape: tuple[int, ...]) -> Image:
    """The picture as seen from the pixels of another one of `shape`; mirrored beyond its edges."""
    h, w = shape
    if (warp[:2, :2] == np.eye(2)).all():
        whole = np.round(warp[:2, 2]).astype(int)
        x0, y0 = whole - _REACH
        inner = _cut(picture, x0, y0, w + 2 * _REACH, h + 2 * _REACH)
        return shifted(inner, *(warp[:2, 2] - whole))[_REACH:-_REACH, _REACH:-_REACH]
    m = warp.astype(np.float32)
    x, y = np.arange(w, dtype=np.float32)[None, :], np.arange(h, dtype=np.float32)[:, None]
    return sample(picture, m[0, 0] * x + (m[0, 1] * y + m[0, 2]), m[1, 0] * x + (m[1, 1] * y + m[1, 2]))


def shifted(image: Image, dx: float, dy: float) -> Image:
    """The picture read at (x + dx, y + dy), each within half a pixel; mirrored beyond its edges."""
    return cv2.sepFilter2D(image, -1, _kernel(dx), _kernel(dy), borderType=cv2.BORDER_REFLECT)


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
    """Derivatives by column and row, of the windowed sinc that `shifted` reads with."""
    gx = cv2.filter2D(image, -1, _SLOPE[None, :], borderType=cv2.BORDER_REFLECT)
    return gx, cv2.filter2D(image, -1, _SLOPE[:, None], borderType=cv2.BORDER_REFLECT)


def _kernel(fraction: float) -> NDArray[np.float32]:
    """Windowed sinc that reads a picture at `fraction` (-0.5..0.5) of a pixel from its grid."""
    t = np.pi * (_TAP - fraction)
    t[_REACH] = t[_REACH] or 1e-9
    taps = np.sin(t) * np.sin(t / (_REACH + 0.5)) / (t * t)
    return (taps / taps.sum()).astype(np.float32)


def _slope() -> NDArray[np.float32]:
    """Derivative of the windowed sinc at the taps, scaled so that a ramp comes out exactly."""
    taps = -np.where(_TAP % 2, -1.0, 1.0) * np.sinc(_TAP / (_REACH + 0.5)) / np.where(_TAP, _TAP, np.inf)
    return (taps / np.sum(taps * _TAP)).astype(np.float32)


_SLOPE = _slope()


def _cut(picture: Image, x: int, y: int, w: int, h: int) -> Image:
    """A window of a picture, mirrored beyond its edges."""
    rows, columns = picture.shape
    inner = picture[max(0, y) : y + h, max(0, x) : x + w]
    if inner.shape == (h, w):
        return inner
    top, left, bottom, right = max(0, -y), max(0, -x), max(0, y + h - rows), max(0, x + w - columns)
    return cv2.copyMakeBorder(inner, top, bottom, left, right, borderType=cv2.BORDER_REFLECT)
