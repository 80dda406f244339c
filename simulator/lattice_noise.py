"""Random numbers that belong to places: noise on an endless lattice, the same from whichever window it is
asked for.

A lattice point's number is a hash of its two indices and a key. Smooth and fractal noise are interpolated
from it, so that pieces of an endless ground can be made one by one, in any order, and fit together without
a seam.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["fractal", "smooth_noise", "white", "white_at"]

# Mask of 32 bits: the hash of a lattice point is computed modulo 2^32.
_WORD = 0xFFFFFFFF


def white(column: int, row: int, width: int, height: int, key: int) -> NDArray[np.float32]:
    """Uniform numbers in [-1, 1) of the lattice points of a window, (height, width)."""
    return _unit(_hashed_window(column, row, width, height, key))


def white_at(i: NDArray[np.int64], j: NDArray[np.int64], key: int) -> NDArray[np.float32]:
    """Numbers of `white` at lattice points i, j, elementwise."""
    return _unit(_hashed(i, j, key))


def smooth_noise(x: NDArray[np.float64], y: NDArray[np.float64], key: int) -> NDArray[np.float64]:
    """Value noise of unit wavelength at points x, y, elementwise: smooth fade between lattice numbers."""
    ix, iy = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = _fade(x - ix), _fade(y - iy)
    corners = [_unit(_hashed(ix + dx, iy + dy, key)).astype(float) for dy in (0, 1) for dx in (0, 1)]
    top = corners[0] + fx * (corners[1] - corners[0])
    bottom = corners[2] + fx * (corners[3] - corners[2])
    return np.asarray(top + fy * (bottom - top))


def fractal(
    column: int, row: int, width: int, height: int, key: int, octaves: int, persistence: float
) -> NDArray[np.float32]:
    """Sum of white noise on ever coarser lattices, linearly interpolated; (height, width), rms about 0.6.

    The finest lattice is that of the window; each further octave is twice as coarse and `1 / persistence`
    times as strong.
    """
    weights = persistence ** -np.arange(octaves, dtype=float)
    weights /= np.sqrt((weights**2).sum())
    windows = [(column, row, width, height)]
    for _ in range(octaves - 1):
        windows.append(_coarser(*windows[-1]))
    total = weights[-1].astype(np.float32) * white(*windows[-1], key + octaves - 1)
    for level in range(octaves - 2, -1, -1):
        c, r, w, h = windows[level]
        coarse_c, coarse_r, coarse_w, coarse_h = windows[level + 1]
        fine = cv2.resize(total, (2 * coarse_w, 2 * coarse_h), interpolation=cv2.INTER_LINEAR)
        left, top = c - 2 * coarse_c, r - 2 * coarse_r
        noise = white(c, r, w, h, key + level)
        noise *= np.float32(weights[level])
        noise += fine[top : top + h, left : left + w]
        total = noise
    return np.asarray(total, dtype=np.float32)


def _coarser(column: int, row: int, width: int, height: int) -> tuple[int, int, int, int]:
    """The window of the next coarser lattice that covers this one, with a point more on every side."""
    c, r = column // 2 - 1, row // 2 - 1
    return c, r, (column + width + 1) // 2 + 1 - c, (row + height + 1) // 2 + 1 - r


def _hashed(i: NDArray[np.int64], j: NDArray[np.int64], key: int) -> NDArray[np.uint32]:
    word = (i * 0x9E3779B1 + j * 0x85EBCA77 + ((key * 0xC2B2AE3D) & _WORD)) & _WORD
    return _mixed(word.astype(np.uint32))


def _hashed_window(column: int, row: int, width: int, height: int, key: int) -> NDArray[np.uint32]:
    i = ((np.arange(column, column + width) * 0x9E3779B1) & _WORD).astype(np.uint32)
    j = ((np.arange(row, row + height) * 0x85EBCA77 + ((key * 0xC2B2AE3D) & _WORD)) & _WORD).astype(np.uint32)
    return _mixed(i[None, :] + j[:, None])


def _mixed(word: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Avalanche of 32 bits by shifts and multiplications, in place."""
    shifted = np.empty_like(word)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        np.right_shift(word, np.uint32(shift), out=shifted)
        word ^= shifted
        word *= np.uint32(factor)
    np.right_shift(word, np.uint32(16), out=shifted)
    word ^= shifted
    return word


def _unit(word: NDArray[np.uint32]) -> NDArray[np.float32]:
    number = word.view(np.int32).astype(np.float32)
    number *= np.float32(2.0**-31)
    return number


def _fade(f: NDArray[np.float64]) -> NDArray[np.float64]:
    return f * f * f * (f * (6.0 * f - 15.0) + 10.0)
