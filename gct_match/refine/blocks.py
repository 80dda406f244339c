"""How far a template is displaced, as its blocks see it: translation or affine map, and how well it is known.

A block b of pixels with gradients J, weights w and residuals r says of its own displacement a score
g_b = Σ w J r and an information N_b = Σ w J J^T, no more. A displacement d(x) = P (x, y, 1) of the whole
follows from them by weighted least squares. Leaving out one block moves P by (N - N_b)^-1 g_b. The scatter
of these moves is the covariance (jackknife): it honours a residual that is correlated within a block, and
a few edges that carry most of the weight. Gradients must be free of all that the radiometry could explain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Blocks", "blocks_of"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_ALONG_SIDE = 8
_AFFINE_CHI2 = 18.5  # four parameters more have to earn this: chi² of 4 at 0.1 %
_LARGEST_AFFINE = 0.05  # beyond, the template was predicted with another model than the strip's
_SMALLEST = 8  # pixels along a block's side: more than the residual is correlated over


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """What the B blocks of a template say of its displacement."""

    lever: Array  # (B, 3) x, y of each block's middle, from the reference point, px, and one
    score: Array  # (B, 2)
    information: Array  # (B, 2, 2)

    def displacement(self, *, affine: bool) -> Array:
        """P (2, 3), px: the displacement of the reference point is its last column; the others are zero
        unless `affine`.
        """
        n, g = self._sums(affine)
        P = np.zeros((2, 3))
        P[:, -g.size // 2 :] = np.linalg.solve(n, g).reshape(-1, 2).T
        return P

    def covariance(self, *, affine: bool) -> Array:
        """Covariance (2, 2) of the reference point's displacement, px², from the residuals that it leaves."""
        n, g = self._sums(affine)
        n_b = self.information
        if affine:
            by_lever = self.lever[:, :, None] * self.lever[:, None, :]
            n_b = (by_lever[:, :, None, :, None] * n_b[:, None, :, None, :]).reshape(-1, 6, 6)
        left = self._scores(affine) - n_b @ np.linalg.solve(n, g)
        moved = np.linalg.solve(n - n_b, left[:, :, None])[:, -2:, 0]
        moved -= moved.mean(axis=0)
        count = len(moved)
        # a covariance from so many blocks is itself uncertain: 4 less keeps the mean of the normalised error
        # squared
        return (count - 1.0) / (count - 4.0) * moved.T @ moved

    def ask_for_affine(self, response: float) -> bool:
        """Whether four affine parameters beside a translation are more than noise, and still a small map.

        A score test of the residuals that the translation left. Its covariance is the blocks' own scatter,
        with n - 4 degrees of freedom of n (Hotelling's T²). `response` is the picture's gain.
        """
        n, _ = self._sums(True)
        score = self._scores(True)
        free = score[:, :4] - score[:, 4:] @ np.linalg.solve(n[4:, 4:], n[4:, :4])
        total = free.sum(axis=0)
        free -= total / len(free)
        chi2 = total @ np.linalg.solve(_firm(free.T @ free), total) * (len(free) - 4.0) / len(free)
        return bool(
            chi2 > _AFFINE_CHI2
            and np.abs(self.displacement(affine=True)[:, :2]).max() < _LARGEST_AFFINE * response
        )

    def _scores(self, affine: bool) -> Array:
        """Right sides (B, P) of the parameters, column after column of P."""
        return (self.lever[:, :, None] * self.score[:, None, :]).reshape(-1, 6) if affine else self.score

    def _sums(self, affine: bool) -> tuple[Array, Array]:
        """Normal matrix (P, P), solvable, and right side (P,) of all blocks."""
        if not affine:
            return _firm(self.information.sum(axis=0)), self.score.sum(axis=0)
        by_lever = (self.lever[:, :, None] * self.lever[:, None, :]).reshape(-1, 9)
        n = (by_lever.T @ self.information.reshape(-1, 4)).reshape(3, 3, 2, 2)
        return _firm(n.transpose(0, 2, 1, 3).reshape(6, 6)), (self.lever.T @ self.score).ravel()


def blocks_of(
    gx: Image, gy: Image, residual: Image, weight: Image, reference_px: Array, pitch_px: float
) -> Blocks:
    """Blocks of a template (h, w): its gradients per px, residual and weight at every `pitch_px`-th pixel.

    `reference_px` (x, y) is the point, in pixels of the template, whose displacement is wanted.
    """
    h, w = residual.shape
    side = max(_SMALLEST, min(h, w) // _ALONG_SIDE)
    columns, rows = w // side, h // side
    wx, wy, area = weight * gx, weight * gy, h * w / (rows * columns)
    sums = [
        cv2.resize(product, (columns, rows), interpolation=cv2.INTER_AREA).ravel()
        for product in (wx * residual, wy * residual, wx * gx, wx * gy, wy * gy)
    ]
    by_block = (area * np.array(sums, dtype=float)).T
    middles = _middles(h, w, columns, rows)
    lever = np.ones((len(middles), 3))
    lever[:, :2] = middles * pitch_px - reference_px
    return Blocks(lever, by_block[:, :2], by_block[:, [2, 3, 3, 4]].reshape(-1, 2, 2))


@lru_cache(maxsize=32)
def _middles(h: int, w: int, columns: int, rows: int) -> Array:
    """Middle (x, y) of each block of a template (h, w), its pixels."""
    x = (np.arange(columns) + 0.5) * w / columns - 0.5
    y = (np.arange(rows) + 0.5) * h / rows - 0.5
    return np.stack([np.tile(x, rows), np.repeat(y, columns)], axis=1)


def _firm(normal: Array) -> Array:
    """A normal matrix that can be solved even where there is no texture."""
    out = normal.copy()
    out.flat[:: len(out) + 1] += 1e-6 * np.diagonal(normal) + 1e-30
    return out
