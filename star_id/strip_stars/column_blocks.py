"""Candidates in one block of a strip: what exceeds its columns' level like a star's trace does.

Every pixel of a line detector has an offset and a noise of its own, the same in all rows: level and noise are
taken column by column, so that a hot column is not a star.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from boresight.records.record import Floats, Ints, array, record
from boresight.star_id.beyond_chance import NOISIER, SELDOM_SIGMA
from boresight.star_id.finding.windows import NINE

__all__ = ["Columns", "candidates", "column_levels"]

# Least noise of a column, DN: that of rounding to whole counts, 1 / sqrt(12).
_LEAST_NOISE_DN = 0.3


@record
class Columns:
    """Level and noise of W columns of a block."""

    level_dn: Floats = array("W", "mean without stars, DN")
    noise_dn: Floats = array("W", "standard deviation of a pixel, DN")
    good: NDArray[np.bool_] = array("W", "not much noisier than the others")


def column_levels(block: NDArray[Any]) -> Columns:
    """Level and noise of the columns of a block (H, W): mean and deviation without what deviates by 4 sigma,
    and without the pixels around it, whose light would displace a star towards the middle of its pixel."""
    few = np.sort(block[:: max(1, len(block) // 128)].astype(np.float32), axis=0)
    middle, low = few[len(few) // 2], few[int(0.1587 * len(few))]
    spread = np.maximum(middle - low, 1.0)
    away = block.astype(np.float32) - middle
    high = (np.abs(away) > SELDOM_SIGMA * spread).astype(np.uint8)
    inside = cv2.dilate(high, NINE, iterations=2) == 0  # a star extends to 2 px around
    count = np.maximum(inside.sum(axis=0), 1)
    away *= inside
    mean = away.sum(axis=0, dtype=float) / count
    variance = np.einsum("ij,ij->j", away, away) / count - mean**2
    noise = _unclipped(np.sqrt(np.maximum(variance, 0.0)), SELDOM_SIGMA * spread + 0.5)  # whole counts
    usual = float(np.median(noise[noise > 0.0])) if noise.any() else 0.0  # some columns may hold nothing
    return Columns(middle + mean, np.maximum(noise, _LEAST_NOISE_DN), noise <= NOISIER * usual)


def _unclipped(deviation: Floats, limit: Floats) -> Floats:
    """Standard deviations (W,) of normals that deviate by `deviation` within `limit` of their means."""
    noise = deviation
    for _ in range(3):  # each step leaves a fifth of the error, or less
        c = limit / np.maximum(noise, 1e-9)
        lost = c * np.exp(-0.5 * c * c) * np.sqrt(2.0 / np.pi) / erf(c / np.sqrt(2.0))
        noise = deviation / np.sqrt(1.0 - lost)
    return np.asarray(noise)


def candidates(block: NDArray[Any], columns: Columns, image: NDArray[Any], threshold: float) -> Ints:
    """Pixels (N, 2), (column, row), where the filter matched to `image` (S, S) has a peak above `threshold`
    of its noise.
    """
    z = (block.astype(np.float32) - columns.level_dn.astype(np.float32)) / columns.noise_dn.astype(np.float32)
    z[:, ~columns.good] = 0.0
    np.minimum(z, np.float32(1e4), out=z)
    kernel = (image / np.sqrt((image**2).sum())).astype(np.float32)
    snr = cv2.filter2D(z, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    high = snr > threshold
    if not high.any():
        return np.empty((0, 2), dtype=np.int64)
    peak = high & (snr >= cv2.dilate(snr, NINE, iterations=2))
    row, column = np.nonzero(peak)
    return np.column_stack([column, row]).astype(np.int64)
