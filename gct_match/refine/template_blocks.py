"""Displacement of a template from its blocks: translation or affine map, with jackknife covariance.

A block b of pixels with gradients J, weights w and residuals r contributes a score g_b = Σ w J r and an
information N_b = Σ w J J^T. A displacement d(x) = P (x, y, 1) of the whole template follows by weighted least
squares. Leaving out block b changes P by (N - N_b)^-1 g_b; the scatter of these changes is the covariance
(jackknife), which accounts for residuals correlated within a block and for a few edges that carry most of
the weight. Gradients must be orthogonal to the radiometric terms.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from boresight.gct_match.records import Image
from boresight.records.record import Floats, record

__all__ = ["Blocks", "blocks_of"]

# Blocks along the shorter side of a template for the jackknife: 64 give its variance to 18 %, sqrt(2 / 64).
_ALONG_SIDE = 8
_AFFINE_CHI2 = 18.5  # chi² of the four affine parameters that chance exceeds in 0.1 %
_LARGEST_AFFINE = 0.05  # a larger map means that the template was predicted with a wrong model
# Prior standard errors of an affine map: of scale and rotation (rad), and of both shears.
_SIMILAR, _SHEARED = 0.02, 0.003
_SMALLEST = 8  # pixels along a block's side: more than the correlation length of the residual
# Scale, rotation and shears of an affine map, by its matrix, column after column; information on its six.
_KINDS = 0.5 * np.array([[1, 0, 0, 1], [0, 1, -1, 0], [1, 0, 0, -1], [0, 1, 1, 0]])
_KNOWN = np.pad((_KINDS.T / np.array([_SIMILAR, _SIMILAR, _SHEARED, _SHEARED]) ** 2) @ _KINDS, (0, 2))


@record  # built at every step: the shape check would cost
class Blocks:
    """Scores and information of the B blocks of a template on its displacement."""

    lever: Floats  # (B, 3) x, y of each block's middle, from the reference point, px, and one
    score: Floats  # (B, 2)
    information: Floats  # (B, 2, 2)
    prior: tuple[Floats, Floats] = np.zeros((6, 6)), np.zeros(6)  # information and pull on an affine map

    def displacement(self, *, affine: bool) -> Floats:
        """Correction (2, 3), px, of the map from template to picture by the residuals of the blocks: its last
        column displaces the reference point; the others are 0 unless `affine`.
        """
        n, g = self._sums(affine)
        P = np.zeros((2, 3))
        P[:, -g.size // 2 :] = np.linalg.solve(n, g).reshape(-1, 2).T
        return P

    def covariance(self, *, affine: bool) -> Floats:
        """Jackknife covariance (2, 2) of the reference point's displacement, px²; `affine` as above. Without
        more blocks than it takes from the count it is infinite.
        """
        count = len(self.lever)
        if count <= 4:
            return np.diag([np.inf, np.inf])
        n, g = self._sums(affine)
        n_b = self.information
        if affine:
            by_lever = self.lever[:, :, None] * self.lever[:, None, :]
            n_b = (by_lever[:, :, None, :, None] * n_b[:, None, :, None, :]).reshape(-1, 6, 6)
            n_b += self.prior[0] / count
        left = self._scores(affine) - n_b @ np.linalg.solve(n, g)
        moved = np.linalg.solve(n - n_b, left[:, :, None])[:, -2:, 0]
        moved -= moved.mean(axis=0)
        # 4 less than the count: keeps the mean of normalised squared errors, as the covariance is uncertain
        return (count - 1.0) / (count - 4.0) * moved.T @ moved

    def with_prior(self, affine: Floats, response: float) -> Blocks:
        """The blocks, each with its share of what is known of a chip's map: it is `affine` (2, 2) now, and
        near zero. `response` is the gain of the picture; the scatter of the scores tells their noise.
        """
        free = self.score - self.score.mean(axis=0)
        noise = float(np.vdot(free, free)) / (float(np.trace(self.information.sum(axis=0))) + 1e-30)
        known = noise / response**2 * _KNOWN
        return replace(self, prior=(known, response * known @ np.append(affine.T.ravel(), [0.0, 0.0])))

    def show_affine(self, response: float) -> bool:
        """Whether four affine parameters in addition to a translation are significant, and a small map.

        A score test of the residuals of the translation, with the scatter of the blocks as covariance (n - 4
        degrees of freedom of n, Hotelling's T²). `response` is the gain of the picture.
        """
        n, _ = self._sums(True)
        score = self._scores(True)
        free = score[:, :4] - score[:, 4:] @ np.linalg.solve(n[4:, 4:], n[4:, :4])
        total = free.sum(axis=0)
        free -= total / len(free)
        chi2 = total @ np.linalg.solve(_regularised(free.T @ free), total) * (len(free) - 4.0) / len(free)
        return bool(
            chi2 > _AFFINE_CHI2
            and np.abs(self.displacement(affine=True)[:, :2]).max() < _LARGEST_AFFINE * response
        )

    def _scores(self, affine: bool) -> Floats:
        """Right sides (B, P) of the parameters, column after column of P."""
        if not affine:
            return self.score
        return (self.lever[:, :, None] * self.score[:, None, :]).reshape(-1, 6) + self.prior[1] / len(
            self.lever
        )

    def _sums(self, affine: bool) -> tuple[Floats, Floats]:
        """Normal matrix (P, P), solvable, and right side (P,) of all blocks."""
        if not affine:
            return _regularised(self.information.sum(axis=0)), self.score.sum(axis=0)
        by_lever = (self.lever[:, :, None] * self.lever[:, None, :]).reshape(-1, 9)
        n = (by_lever.T @ self.information.reshape(-1, 4)).reshape(3, 3, 2, 2)
        firm = _regularised(n.transpose(0, 2, 1, 3).reshape(6, 6))
        return firm + self.prior[0], (self.lever.T @ self.score).ravel() + self.prior[1]


def blocks_of(
    gx: Image,
    gy: Image,
    residual: Image,
    weight: Image,
    reference_px: Floats,
    pitch_px: float,
    along_side: int = _ALONG_SIDE,
) -> Blocks:
    """Blocks of a template from gradients per px, residual and weight at every `pitch_px`-th pixel (h, w), or
    of all its planes (K, h, w).

    `reference_px` (x, y), in pixels of the template, is the point whose displacement is wanted. Along the
    shorter side lie `along_side` blocks, fewer where these would be too small.
    """
    h, w = residual.shape[-2:]
    side = max(_SMALLEST, min(h, w) // along_side)
    columns, rows = max(1, w // side), max(1, h // side)
    wx, wy = weight * gx, weight * gy
    products = np.stack([wx * residual, wy * residual, wx * gx, wx * gy, wy * gy])
    sums = _shares(h, rows) @ products @ _shares(w, columns).T
    by_block = sums.reshape(5, -1, rows * columns).sum(axis=1).T.astype(float)
    x, y = ((np.arange(n) + 0.5) * side / n - 0.5 for n, side in ((columns, w), (rows, h)))
    middles = np.stack([np.tile(x, rows), np.repeat(y, columns)], axis=1)
    lever = np.column_stack([middles * pitch_px - reference_px, np.ones(len(middles))])
    return Blocks(lever, by_block[:, :2], by_block[:, [2, 3, 3, 4]].reshape(-1, 2, 2))


@lru_cache(maxsize=32)
def _shares(n: int, parts: int) -> Image:
    """(parts, n) share of each of n pixels of a line in each of its equal parts."""
    reached = np.clip(np.linspace(0.0, n, parts + 1)[:, None] - np.arange(n), 0.0, 1.0)
    return np.diff(reached, axis=0).astype(np.float32)


def _regularised(normal: Floats) -> Floats:
    """A normal matrix regularised so that it can be solved without texture."""
    out = normal.copy()
    out.flat[:: len(out) + 1] += 1e-6 * np.diagonal(normal) + 1e-30
    return out
