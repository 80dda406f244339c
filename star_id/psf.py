"""The image of a point: a Gaussian integrated over pixels, drawn out along a line when the camera turned
meanwhile.

The width may grow with the square of the distance from the middle of the image, as lenses do. A smear is the
mean of Gaussians along its line; its nodes and weights are Gauss-Legendre's, so a smear of a few sigmas costs
a few evaluations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

__all__ = ["Psf", "PsfImages", "psf_images"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Psf:
    """Width of a star's image in a given camera."""

    sigma_px: float  # in the middle of the image
    sigma_corner_px: float  # in its corners
    smear_px: tuple[float, float]  # (column, row) motion during the exposure
    width_px: int
    height_px: int

    def sigma_at(self, xy_px: Array) -> Array:
        """(N,) width at points (N, 2)."""
        size = np.array([self.width_px, self.height_px])
        radius2 = 2.0 * (((xy_px + 0.5) / size - 0.5) ** 2).sum(axis=1)
        return np.asarray(self.sigma_px + (self.sigma_corner_px - self.sigma_px) * radius2)


@dataclass(frozen=True, slots=True, eq=False)
class PsfImages:
    """Unit-flux images of N stars in square windows, and what moves them. All (N, side * side)."""

    value: NDArray[np.float32]
    d_x: NDArray[np.float32]
    d_y: NDArray[np.float32]
    d_log_sigma: NDArray[np.float32] | None
    d_stretch: (
        NDArray[np.float32] | None
    )  # (2, N, side * side): by (Cxx - Cyy) / 2 and by Cxy of the second moments


def psf_images(
    offset: Array, sigma: Array, smear_px: tuple[float, float], radius: int, *, widths: bool = False
) -> PsfImages:
    """Images of stars at `offset` (N, 2) from the central pixel of windows of side 2 radius + 1."""
    nodes, weights = _smear_nodes(smear_px, float(sigma.min()) if len(sigma) else 1.0)
    edges = np.arange(2 * radius + 2, dtype=np.float32) - np.float32(radius + 0.5)
    n, side = len(offset), 2 * radius + 1
    sigma = sigma.astype(np.float32)
    weights = weights.astype(np.float32)
    centre = offset[:, None, :] + nodes[None, :, None] * np.array(smear_px)  # (N, K, 2)
    z = (edges - centre[..., None].astype(np.float32)) / sigma[:, None, None, None]  # (N, K, 2, side + 1)
    density = np.exp(np.float32(-0.5) * z * z) * np.float32(1.0 / np.sqrt(2.0 * np.pi))
    cumulated = np.float32(0.5) * erf(z * np.float32(np.sqrt(0.5)))
    value = cumulated[..., 1:] - cumulated[..., :-1]  # (N, K, 2, side)
    slope = (density[..., :-1] - density[..., 1:]) / sigma[:, None, None, None]
    x, y = value[:, :, 0], value[:, :, 1] * weights[:, None]
    d_x, d_y = slope[:, :, 0], slope[:, :, 1] * weights[:, None]

    def product(rows: NDArray, columns: NDArray) -> NDArray[np.float32]:
        if rows.shape[1] == 1:
            image = rows[:, 0, :, None] * columns[:, 0, None, :]
        else:
            image = np.matmul(rows.transpose(0, 2, 1), columns)
        return np.asarray(image.reshape(n, side * side))

    d_log_sigma = d_stretch = None
    if widths:
        wide = z[..., :-1] * density[..., :-1] - z[..., 1:] * density[..., 1:]
        wide_y = wide[:, :, 1] * weights[:, None]
        # widening by heat: dE/dC = E''/2, and sigma^2 E'' is the derivative by log sigma
        by_x, by_y = product(y, wide[:, :, 0]), product(wide_y, x)
        d_log_sigma = by_x + by_y
        d_stretch = np.stack([0.5 * (by_x - by_y) / sigma[:, None] ** 2, product(d_y, d_x)])
    return PsfImages(product(y, x), product(y, d_x), product(d_y, x), d_log_sigma, d_stretch)


def _smear_nodes(smear_px: tuple[float, float], sigma: float) -> tuple[Array, Array]:
    """Places along the smear in [-1/2, 1/2] and their weights, summing to 1."""
    length = float(np.hypot(*smear_px)) / sigma
    if length < 1e-3:
        return np.zeros(1), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(int(np.ceil(3 + length)))
    return 0.5 * nodes, 0.5 * weights
