"""How far a template is displaced, as its blocks see it: translation or affine map, and how well it is known.

A block b of pixels with gradients J, weights w and residuals r says of its own displacement a score
g_b = Σ w J r and an information N_b = Σ w J J^T, no more. A displacement d(x) = P (x, y, 1) of the whole
follows from them by weighted least squares. Leaving out one block moves P by (N - N_b)^-1 g_b. The scatter
of these moves is the covariance (jackknife): it honours a residual that is correlated within a block, and
a few edges that carry most of the weight. Gradients must be free of all that the radiometry could explain.
"""

from __future__ import annotations

from dataclasses import dataclass
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

    centre_px: Array  # (B, 2) from the reference point
    score: Array  # (B, 2)
    information: Array  # (B, 2, 2)

    def displacement(self, *, affine: bool) -> Array:
        """P (2, 3), px: the displacement of the reference point is its last column; the others are zero
        unless `affine`.
        """
        n_b, g_b = self._equations(affine)
        n = n_b.sum(axis=0)
        P = np.zeros((2, 3))
        solution = np.linalg.solve(_firm(n), g_b.sum(axis=0))
        P[:, -solution.size // 2 :] = solution.reshape(-1, 2).T
        return P

    def covariance(self, *, affine: bool) -> Array:
        """Covariance (2, 2) of the reference point's displacement, px², from the residuals that it leaves."""
        n_b, g_b = self._equations(affine)
        whole = _firm(n_b.sum(axis=0))
        left = g_b - n_b @ np.linalg.solve(whole, g_b.sum(axis=0))
        moved = np.linalg.solve(whole - n_b, left[:, :, None])[:, -2:, 0]
        moved -= moved.mean(axis=0)
        n = len(moved)
        # a covariance from n blocks is itself uncertain: n - 4 keeps the mean of the normalised error squared
        return (n - 1.0) / (n - 4.0) * moved.T @ moved

    def ask_for_affine(self, response: float) -> bool:
        """Whether four affine parameters beside a translation are more than noise, and still a small map.

        A score test of the residuals that the translation left. Its covariance is the blocks' own scatter,
        with n - 4 degrees of freedom of n (Hotelling's T²). `response` is the picture's gain.
        """
        n_b, g_b = self._equations(True)
        n = _firm(n_b.sum(axis=0))
        free = g_b[:, :4] - g_b[:, 4:] @ np.linalg.solve(n[4:, 4:], n[4:, :4])
        total = free.sum(axis=0)
        free -= total / len(free)
        chi2 = total @ np.linalg.solve(_firm(free.T @ free), total) * (len(free) - 4.0) / len(free)
        return bool(
            chi2 > _AFFINE_CHI2
            and np.abs(self.displacement(affine=True)[:, :2]).max() < _LARGEST_AFFINE * response
        )

    def _equations(self, affine: bool) -> tuple[Array, Array]:
        """Normal matrices (B, P, P) and right sides (B, P) of the parameters, column after column of P."""
        if not affine:
            return self.information, self.score
        lever = np.concatenate([self.centre_px, np.ones((len(self.centre_px), 1))], axis=1)
        by_lever = (lever[:, :, None] * lever[:, None, :])[:, :, None, :, None]
        n_b = by_lever * self.information[:, None, :, None, :]
        return n_b.reshape(-1, 6, 6), (lever[:, :, None] * self.score[:, None, :]).reshape(-1, 6)


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
    gx_r, gy_r, xx, xy, yy = area * np.array(sums, dtype=float)
    x = ((np.arange(columns) + 0.5) * w / columns - 0.5) * pitch_px - reference_px[0]
    y = ((np.arange(rows) + 0.5) * h / rows - 0.5) * pitch_px - reference_px[1]
    centre = np.stack([np.tile(x, rows), np.repeat(y, columns)], axis=1)
    return Blocks(
        centre, np.stack([gx_r, gy_r], axis=1), np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    )


def _firm(normal: Array) -> Array:
    """A normal matrix that can be solved even where there is no texture."""
    out = normal.copy()
    out.flat[:: len(out) + 1] += 1e-6 * np.diagonal(normal) + 1e-30
    return out
