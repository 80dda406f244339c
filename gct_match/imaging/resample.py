"""Resampling of pictures, with errors far below a thousandth of a pixel.

A warp (3, 3) takes (x, y, 1) of one picture to those of another; P (2, 3) is the displacement P (x, y, 1).
"""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.records import Image
from boresight.records.record import Floats

__all__ = ["change", "composed", "gradient", "largest_px", "sample", "shifted", "warped"]

_GRID = 32.0  # OpenCV's remap rounds every point to this part of a pixel
_REACH = 5  # pixels on either side that the interpolating kernel takes (set by hand)
_TAP = np.arange(-_REACH, _REACH + 1)  # distances of the kernel's taps, px


def composed(warp: Floats, P: Floats) -> Floats:
    """warp o (identity + P)^-1, a warp (3, 3): P (2, 3) displaces the points from which the warp starts."""
    (a, b, x), (c, d, y) = P
    return warp @ np.linalg.inv(np.array([[1.0 + a, b, x], [c, 1.0 + d, y], [0.0, 0.0, 1.0]]))


def largest_px(P: Floats, shape: tuple[int, ...]) -> float:
    """Largest displacement, px, of the points of a picture (h, w) by P (2, 3) about its middle."""
    return float(np.abs(P[:, 2]).max() + 0.5 * max(shape) * np.abs(P[:, :2]).max())


def change(slopes: tuple[Image, Image], P: Floats, reference_px: Floats, pitch_px: float) -> Image:
    """First-order change (h, w) of a picture whose points are displaced by P (2, 3), far less than a pixel.

    `slopes` (h, w) are its derivatives by x and y at every `pitch_px`-th pixel; P is relative to the pixel
    `reference_px` (x, y).
    """
    y, x = (pitch_px * np.arange(n) - at for n, at in zip(slopes[0].shape, reference_px[::-1], strict=True))
    (along, across), (down, below) = (
        ((a * x + c).astype(np.float32), (b * y).astype(np.float32)[:, None]) for a, b, c in P
    )
    return slopes[0] * (along + across) + slopes[1] * (down + below)


def warped(picture: Image, warp: Floats, shape: tuple[int, ...]) -> Image:
    """The picture at the warped pixels of another one of `shape` (h, w); mirrored beyond its edges."""
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
    """The picture (h, w) at (x + dx, y + dy), |dx| and |dy| up to half a pixel; mirrored beyond its edges."""
    return cv2.sepFilter2D(image, -1, _kernel(dx), _kernel(dy), borderType=cv2.BORDER_REFLECT)


def sample(image: Image, x: Image, y: Image) -> Image:
    """The picture at points x, y (h, w each), by Lanczos interpolation; mirrored beyond its edges.

    The points must form a smooth map with steps of about a pixel or less. OpenCV rounds points to 1/32 px;
    the remainder is added to first order, with derivatives of the resampled picture, unless all points lie on
    one line.
    """
    qx, qy = np.round(x * _GRID) / _GRID, np.round(y * _GRID) / _GRID
    out = cv2.remap(image, qx, qy, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    if min(x.shape) < 5:
        return out
    gu, gv = gradient(out)
    h, w = x.shape
    xu, yu = (x[h // 2, -1] - x[h // 2, 0]) / (w - 1), (y[h // 2, -1] - y[h // 2, 0]) / (w - 1)
    xv, yv = (x[-1, w // 2] - x[0, w // 2]) / (h - 1), (y[-1, w // 2] - y[0, w // 2]) / (h - 1)
    jacobian = np.array([[xu, xv], [yu, yv]], dtype=float)
    if np.linalg.det(jacobian) == 0.0:
        return out
    inverse = np.linalg.inv(jacobian).astype(np.float32)
    dx, dy = x - qx, y - qy
    du = inverse[0, 0] * dx + inverse[0, 1] * dy
    dv = inverse[1, 0] * dx + inverse[1, 1] * dy
    return out + du * gu + dv * gv


def gradient(image: Image) -> tuple[Image, Image]:
    """Derivatives by column and row, (h, w) each, of the windowed sinc that `shifted` uses."""
    gx = cv2.filter2D(image, -1, _SLOPE[None, :], borderType=cv2.BORDER_REFLECT)
    return gx, cv2.filter2D(image, -1, _SLOPE[:, None], borderType=cv2.BORDER_REFLECT)


def _kernel(fraction: float) -> Image:
    """Taps of the windowed sinc for a shift by `fraction` (-0.5..0.5) of a pixel."""
    t = np.pi * (_TAP - fraction)
    t[_REACH] = t[_REACH] or 1e-9
    taps = np.sin(t) * np.sin(t / (_REACH + 0.5)) / (t * t)
    return (taps / taps.sum()).astype(np.float32)


# Weights of the taps that give the slope of a picture: derivative of the windowed sinc, exact for a ramp.
_SLOPE = -np.where(_TAP % 2, -1.0, 1.0) * np.sinc(_TAP / (_REACH + 0.5)) / np.where(_TAP, _TAP, np.inf)
_SLOPE = (_SLOPE / np.sum(_SLOPE * _TAP)).astype(np.float32)


def _cut(picture: Image, x: int, y: int, w: int, h: int) -> Image:
    """A window of a picture, mirrored beyond its edges."""
    rows, columns = picture.shape
    inner = picture[max(0, y) : y + h, max(0, x) : x + w]
    if inner.shape == (h, w):
        return inner
    top, left, bottom, right = max(0, -y), max(0, -x), max(0, y + h - rows), max(0, x + w - columns)
    return cv2.copyMakeBorder(inner, top, bottom, left, right, borderType=cv2.BORDER_REFLECT)
