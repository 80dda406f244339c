"""Random numbers that belong to places: noise on an endless lattice, the same from whichever window it is
asked for.

A lattice point's number follows from its two indices and a key. Smooth and fractal noise are interpolated
from such numbers, so that pieces of an endless ground can be made one by one, in any order, and fit together
without a seam.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

__all__ = ["BAND", "fractal", "smooth_noise", "white", "white_at"]

# Mask of 32 bits: the hash of a lattice point is computed modulo 2^32.
_WORD = 0xFFFFFFFF
BAND = 128  # rows of noise that are made at once: they stay in the processor's cache
_PERIOD = 2**20  # numbers of the table, 4 MB
_RUN = 4096  # of its numbers that a row takes in one piece


def white(column: int, row: int, width: int, height: int, key: int) -> NDArray[np.float32]:
    """Uniform numbers in [-1, 1) of the lattice points of a window, (height, width).

    Each row is a long piece of one table of random numbers, which begins at a place given by the hash of the
    row: two rows may be alike, shifted against each other, but no area is found again elsewhere.
    """
    j = np.arange(row, row + height)
    first = (_hashed(np.zeros_like(j), j, key).astype(np.int64) + column) % _PERIOD
    pieces = [
        sliding_window_view(_table(), min(width - left, _RUN))[(first + left) % _PERIOD]
        for left in range(0, width, _RUN)
    ]
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=1)


@cache
def _table() -> NDArray[np.float32]:
    """(_PERIOD + _RUN,) numbers; the last ones are the first ones again."""
    numbers = 2.0 * np.random.default_rng(0).random(_PERIOD, dtype=np.float32) - 1.0
    return np.append(numbers, numbers[:_RUN])


def white_at(i: NDArray[np.int64], j: NDArray[np.int64], key: int) -> NDArray[np.float32]:
    """Uniform numbers in [-1, 1) at lattice points i, j, elementwise: each the hash of its two indices."""
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
) -> Iterator[NDArray[np.float32]]:
    """Sum of white noise on ever coarser lattices, linearly interpolated, rms about 0.5; in bands (R, width),
    which stay in the processor's cache while they are worked on.

    The finest lattice has every second point of the window's along either axis: what is finer is lost in the
    blur of optics. Each further octave is twice as coarse and `1 / persistence` times as strong.
    """
    weights = persistence ** -np.arange(octaves, dtype=float)
    weights /= np.sqrt((weights**2).sum())
    windows = [(column, row, width, height)]
    for _ in range(octaves):
        x, y, w, h = windows[-1]  # the window of the next coarser lattice covers it, with a point more around
        c, r = x // 2 - 1, y // 2 - 1
        windows.append((c, r, (x + w + 1) // 2 + 1 - c, (y + h + 1) // 2 + 1 - r))
    total = weights[-1].astype(np.float32) * white(*windows[-1], key + octaves)
    for level in range(octaves - 1, 0, -1):
        (total,) = _finer(total, (windows[level], windows[level + 1]), windows[level][3])
        noise = white(*windows[level], key + level)
        total = cv2.scaleAdd(noise, float(weights[level - 1]), total, noise)
    yield from _finer(total, (windows[0], windows[1]), BAND)


def _finer(
    coarse: NDArray[np.float32],
    windows: tuple[tuple[int, int, int, int], tuple[int, int, int, int]],
    band: int,
) -> Iterator[NDArray[np.float32]]:
    """Noise interpolated on a lattice of half the distance, in bands.

    `windows` are those of the finer and of the coarse lattice.
    """
    (column, row, width, height), (coarse_column, coarse_row, coarse_width, coarse_height) = windows
    left = column - 2 * coarse_column
    for top in range(row, row + height, band):
        rows = min(band, row + height - top)
        first = max(top // 2 - coarse_row - 1, 0)
        near = coarse[first : min((top + rows + 1) // 2 - coarse_row + 1, coarse_height)]
        fine = cv2.resize(near, (2 * coarse_width, 2 * len(near)), interpolation=cv2.INTER_LINEAR)
        skipped = top - 2 * (coarse_row + first)
        yield np.asarray(fine[skipped : skipped + rows, left : left + width])


def _hashed(i: NDArray[np.int64], j: NDArray[np.int64], key: int) -> NDArray[np.uint32]:
    word = (i * 0x9E3779B1 + j * 0x85EBCA77 + ((key * 0xC2B2AE3D) & _WORD)) & _WORD
    return _mixed(word.astype(np.uint32))


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
