"""Point spread function: a Gaussian integrated over pixels, smeared along a line if the camera rotates.

The width may grow with the square of the distance from the image's centre. A smear is the mean of Gaussians
along its line, by Gauss-Legendre quadrature, so that a smear of a few sigmas costs a few evaluations; coma
that of Gaussians over the fan of third-order coma (Born & Wolf, Principles of Optics, 5.3), whose length
grows with the distance from the image's centre. Stars of any other form have an empirical image instead
(`finding.shape`), interpolated by cubic splines.

It is fitted to many stars at once, each in its own window, by Gauss-Newton steps. The state of a star is
column and row from the middle of its window, flux and local background (px, px, DN, DN); its logarithmic
width may be a fifth parameter. The variance of a pixel is the background's plus the photon noise of the star.
Of a sky that is cut off, the model is the mean of what the cut leaves.
"""

from __future__ import annotations

from functools import lru_cache
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from boresight.records.record import Floats, Ints, inner, record, scalar
from boresight.star_id.beyond_chance import NEVER_SIGMA
from boresight.star_id.finding.cut_sky import after_cut
from boresight.star_id.finding.windows import AT_ONCE, StarWindows

__all__ = [
    "FINE",
    "LARGEST_STEP_PX",
    "USUAL_SIGMA_PX",
    "Psf",
    "PsfImages",
    "by_parameter",
    "images_at",
    "newton_step",
    "noise_gain",
    "psf_images",
    "shape_images",
    "start_state",
]

# Width of the stars of a usual image, px, that detection starts with (set by hand).
USUAL_SIGMA_PX = 1.2
# Points along a pixel of the grid of an empirical PSF (set by hand).
FINE = 2
Pixels = NDArray[np.float32]
# Longest step along an axis, px: a longer one leaves the range in which the image is linear in it.
LARGEST_STEP_PX = 0.8
# Least variance of a pixel at the cut, as a share of an uncut one's: noise there is rare and large, but no
# outlier (1/2 - 1/(2 pi), that of a sky cut off at its level).
_LEAST_SHARE = float(after_cut(np.zeros(()))[1])


@record
class Psf:
    """Point spread function over the images of a camera."""

    sigma_px: float = scalar("standard deviation in the centre of the image, px")
    sigma_corner_px: float = scalar("standard deviation in its corners, px")
    smear_px: tuple[float, float] = scalar("motion (column, row) during the exposure, px")
    width_px: int = scalar("columns of the image")
    height_px: int = scalar("rows of the image")
    coma_px: float = scalar(
        "length of the comatic fan in the corners, outwards; negative: inwards", default=0.0
    )
    wings: float = scalar(
        "of a fan's Gaussians: half of the light has a variance that is this share larger, half smaller",
        default=0.0,
    )
    scale_sigma: float = scalar(
        "1-sigma error of all distances from the image's middle, relative, by that of the fan", default=0.0
    )
    shape: NDArray[Any] | None = scalar(
        "(T, T) spline coefficients of a star's image, FINE points a pixel; None: a smeared Gaussian",
        default=None,
    )
    error_factor: NDArray[Any] | None = scalar(
        "(2, 2) errors of centroids over those of stars that look like `shape`", default=None
    )

    @property
    def shape_radius_px(self) -> int:
        """Pixels from the middle of the empirical image to its edge; 0 without one."""
        return 0 if self.shape is None else (self.shape.shape[0] // FINE - 1) // 2

    def sigma_at(self, xy_px: Floats) -> Floats:
        """Standard deviation (N,) of the Gaussian, px, at pixels (N, 2)."""
        size = np.array([self.width_px, self.height_px])
        radius2 = 2.0 * (((xy_px + 0.5) / size - 0.5) ** 2).sum(axis=1)
        return np.asarray(self.sigma_px + (self.sigma_corner_px - self.sigma_px) * radius2)

    def coma_at(self, xy_px: Floats) -> Floats | None:
        """Fans (N, 2) as (column, row) from tip to end, px, at pixels (N, 2); None without coma."""
        if self.coma_px == 0.0:
            return None
        return np.asarray(
            (xy_px - self.middle_px) * (self.coma_px / float(np.hypot(*(self.middle_px + 0.5))))
        )

    @property
    def middle_px(self) -> Floats:
        """(2,) the middle of the image."""
        return 0.5 * np.array([self.width_px - 1.0, self.height_px - 1.0])

    @property
    def smear_sigma_px(self) -> float:
        """Standard deviation along one axis, px, of the smear: its length over the root of 24."""
        return float(np.hypot(*self.smear_px) / np.sqrt(24.0))

    @property
    def is_flat(self) -> bool:
        """Whether stars have flat tops with edges, so that full steps of a fit overshoot."""
        return self.shape is not None or float(np.hypot(*self.smear_px)) > 4.0 * self.sigma_px

    @property
    def reach_px(self) -> float:
        """Distance, px, beyond that of the Gaussian, to which stars extend by smear and coma."""
        return 0.5 * float(np.hypot(*self.smear_px) + abs(self.coma_px))


@record
class PsfImages:
    """Unit-flux images of N stars in square windows of M pixels, with derivatives."""

    # (N, P, M): derivatives by column and row, the image, ones and, if P is 5, the derivative by log width
    columns: NDArray[np.float32]
    # (2, N, M) derivatives by (Cxx - Cyy) / 2 and by Cxy of the second moments; None if P is 4
    d_stretch: NDArray[np.float32] | None
    d_x = inner[NDArray[np.float32]]("columns", "(N, M) derivative by column", of=itemgetter(np.s_[:, 0]))
    d_y = inner[NDArray[np.float32]]("columns", "(N, M) derivative by row", of=itemgetter(np.s_[:, 1]))
    value = inner[NDArray[np.float32]]("columns", "(N, M) unit-flux image", of=itemgetter(np.s_[:, 2]))


def images_at(psf: Psf, middles: Ints, offset: Floats, sigma: Floats, radius: int) -> PsfImages:
    """Images of stars at `offset` (N, 2) from the pixels `middles` (N, 2) of the image, px, in windows of
    side 2 radius + 1 about these: empirical, or smeared Gaussians of width `sigma` (N,)."""
    if psf.shape is not None:
        return shape_images(psf.shape, offset, radius)
    coma = psf.coma_at(middles.astype(float))
    return psf_images(offset, sigma, psf.smear_px, radius, coma=coma, wings=psf.wings)


def shape_images(shape: NDArray[Any], offset: Floats, radius: int) -> PsfImages:
    """Images as in `images_at` from the spline coefficients (T, T) of an empirical image."""
    rows, columns = (_spline_weights(offset[:, axis], radius, len(shape)) for axis in (1, 0))
    coefficients = shape.astype(np.float32)
    images = np.ones((len(offset), 4, 2 * radius + 1, 2 * radius + 1), dtype=np.float32)
    for first in range(0, len(offset), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        across = columns[some].transpose(0, 1, 3, 2)
        half = rows[some] @ coefficients
        np.matmul(half[:, 0], across[:, 1], out=images[some, 0])
        np.matmul(half[:, 1], across[:, 0], out=images[some, 1])
        np.matmul(half[:, 0], across[:, 0], out=images[some, 2])
    return PsfImages(images.reshape(len(offset), 4, (2 * radius + 1) ** 2), None)


def _spline_weights(offset: Floats, radius: int, size: int) -> NDArray[np.float32]:
    """(N, 2, side, size) weights of spline coefficients along one axis in the pixels of windows, at `offset`
    (N,) from their middles, and their derivatives by it. Coefficients beyond the edge are zero.

    All pixels of a star lie at the same fraction of a cell, so it has four weights: a cubic B-spline's.
    """
    at = size // 2 - FINE * offset
    cell = np.floor(at)
    t = at - cell
    weights = np.array([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 3 * (t + t**2 - t**3) + 1, t**3]) / 6.0
    slopes = np.array([-((1 - t) ** 2), 3 * t**2 - 4 * t, 1 + 2 * t - 3 * t**2, t**2]) / 2.0
    side = 2 * radius + 1
    pixels = FINE * np.arange(-radius, radius + 1)
    index = cell.astype(np.int64)[:, None, None] + pixels[:, None] + np.arange(4)  # beyond an edge: 0 or last
    index = np.clip(index, 0, size + 1)[:, None]
    both = np.stack([weights, -FINE * slopes]).transpose(2, 0, 1)[:, :, None]
    answer = np.zeros((len(offset), 2, side, size + 2), dtype=np.float32)
    star, kind = np.ogrid[: len(offset), :2]
    answer[star[..., None, None], kind[..., None, None], np.arange(side)[:, None], index] = both
    return answer[..., 1:-1]


def psf_images(
    offset: Floats,
    sigma: Floats,
    smear_px: tuple[float, float],
    radius: int,
    *,
    widths: bool = False,
    coma: Floats | None = None,
    wings: float = 0.0,
) -> PsfImages:
    """Images of stars of width `sigma` (N,) at `offset` (N, 2) from the middle of windows of side 2 radius +
    1, px.

    `widths` adds the derivatives by width and by second moments, of Gaussians without `wings` (as in `Psf`);
    `coma` (N, 2) are the fans of `Psf.coma_at`.
    """
    nodes, weights = _nodes(smear_px, coma, float(sigma.min()) if len(sigma) else 1.0)
    edges = np.arange(2 * radius + 2, dtype=np.float32) - np.float32(radius + 0.5)
    n, side = len(offset), 2 * radius + 1
    sigma = sigma.astype(np.float32)
    width = sigma[:, None, None, None]
    if wings:
        halves = np.sqrt([1.0 - wings, 1.0 + wings]).astype(np.float32)
        width = width * np.repeat(halves, len(weights))[:, None, None]
        nodes, weights = np.tile(nodes, (1, 2, 1)), 0.5 * np.tile(weights, 2)
    weights = weights.astype(np.float32)
    centre = offset[:, None, :] + nodes  # (N, K, 2)
    z = (edges - centre[..., None].astype(np.float32)) / width  # (N, K, 2, side + 1)
    density = np.exp(np.float32(-0.5) * z * z) * np.float32(1.0 / np.sqrt(2.0 * np.pi))
    cumulated = np.float32(0.5) * erf(z * np.float32(np.sqrt(0.5)))
    value = cumulated[..., 1:] - cumulated[..., :-1]  # (N, K, 2, side)
    slope = (density[..., :-1] - density[..., 1:]) / width
    x, y = value[:, :, 0], value[:, :, 1] * weights[:, None]
    d_x, d_y = slope[:, :, 0], slope[:, :, 1] * weights[:, None]
    columns = np.empty((n, 5 if widths else 4, side, side), dtype=np.float32)

    def product(rows: NDArray[Any], columns: NDArray[Any], out: Pixels | None = None) -> Pixels:
        if rows.shape[1] == 1:  # einsum's loop takes half as long as that of a product by broadcasting
            return np.asarray(np.einsum("ni,nj->nij", rows[:, 0], columns[:, 0], out=out))
        return np.matmul(rows.transpose(0, 2, 1), columns, out=out)

    product(y, d_x, columns[:, 0])
    product(d_y, x, columns[:, 1])
    product(y, x, columns[:, 2])
    columns[:, 3] = 1.0
    d_stretch = None
    if widths:
        wide = z[..., :-1] * density[..., :-1] - z[..., 1:] * density[..., 1:]
        wide_y = wide[:, :, 1] * weights[:, None]
        # heat equation: dE/dC = E''/2, and sigma^2 E'' is the derivative by log sigma
        by_x, by_y = product(y, wide[:, :, 0]), product(wide_y, x)
        np.add(by_x, by_y, out=columns[:, 4])
        half = np.float32(0.5) * (by_x - by_y) / sigma[:, None, None] ** 2
        d_stretch = np.stack([half, product(d_y, d_x)]).reshape(2, n, side * side)
    return PsfImages(columns.reshape(n, columns.shape[1], side * side), d_stretch)


def _nodes(smear_px: tuple[float, float], coma: Floats | None, sigma: float) -> tuple[Floats, Floats]:
    """Displacements (1 or N, K, 2), px, of the Gaussians that make a star's image, and their weights (K,),
    which sum to 1."""
    along, weights = _smear_nodes(float(np.hypot(*smear_px)) / sigma)
    nodes = along[None, :, None] * np.array(smear_px)
    if coma is None:
        return nodes, weights
    fan, of_fan = _fan_nodes(float(np.hypot(*coma.T).max(initial=0.0)) / sigma)
    across = coma[:, ::-1] * [-1.0, 1.0]
    fans = fan[:, :1] * coma[:, None] + fan[:, 1:] * across[:, None]
    both = np.asarray((nodes[:, :, None] + fans[:, None]).reshape(len(coma), -1, 2))
    return both, np.asarray(np.outer(weights, of_fan).ravel())


def _smear_nodes(length: float) -> tuple[Floats, Floats]:
    """Nodes along a smear of `length` sigmas in [-1/2, 1/2] and their weights, which sum to 1."""
    if length < 1e-3:
        return np.zeros(1), np.ones(1)
    nodes, weights = _gauss_legendre(int(np.ceil(3 + length)))
    return 0.5 * nodes, 0.5 * weights


@lru_cache(maxsize=64)  # each group of stars of a frame asks for the same few; trails have at most some 60
def _gauss_legendre(count: int) -> tuple[Floats, Floats]:
    """Nodes (N,) in [-1, 1] and weights (N,) of Gauss and Legendre's quadrature, read only."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    nodes.setflags(write=False)
    weights.setflags(write=False)
    return nodes, weights


def _fan_nodes(length: float) -> tuple[Floats, Floats]:
    """Nodes (K, 2), along and across, and weights (K,) of a comatic fan of unit length about its mean.

    They are circles from zones of the pupil, of radius u / 3 for the share u of the pupil's area, displaced
    by twice that; enough of them for a fan of `length` sigmas.
    """
    zone, of_zone = _gauss_legendre(int(np.ceil(2 + 0.3 * length)))
    angle = 2.0 * np.pi * (np.arange(n := int(np.ceil(5 + 0.5 * length))) + 0.5) / n
    radius = (1.0 + zone[:, None]) / 6.0
    nodes = np.stack([radius * (2.0 + np.cos(angle)) - 1.0 / 3.0, radius * np.sin(angle)], axis=2)
    return nodes.reshape(-1, 2), np.asarray(np.repeat(0.5 * of_zone / n, n))


def start_state(windows: StarWindows, offset: Floats, images: PsfImages) -> Floats:
    """State (N, 4) at `offset` (N, 2), flux and background by unweighted least squares."""
    p, g, d = images.value, windows.good, windows.data
    gp, gd = g * p, g * d
    n, sp, spp = (np.asarray(v, dtype=float) for v in (g.sum(1), gp.sum(1), np.einsum("nm,nm->n", gp, p)))
    sd, spd = np.asarray(gd.sum(1), dtype=float), np.asarray(np.einsum("nm,nm->n", gd, p), dtype=float)
    determinant = np.maximum(n * spp - sp**2, 1e-12)
    flux, sky = (n * spd - sp * sd) / determinant, (spp * sd - sp * spd) / determinant
    return np.column_stack([offset, flux, sky])


def newton_step(
    windows: StarWindows, images: PsfImages, state: Floats, gain_e_per_dn: float
) -> tuple[Floats, Floats, Pixels, Pixels]:
    """One Gauss-Newton step: (N, P) step, (N, P, P) normal matrix, (N, M) residuals, (N, M) weights.

    P is 4, or 5 if the images include the derivative by width.
    """
    signal = images.value * state[:, 2:3].astype(np.float32)
    variance: NDArray[Any] = windows.noise2[:, None].astype(np.float32)
    if np.isfinite(gain_e_per_dn):
        variance = variance + np.maximum(signal, np.float32(0.0)) * np.float32(1.0 / gain_e_per_dn)
    residual = windows.data - signal
    residual -= state[:, 3:4].astype(np.float32)
    unit = images.columns
    if windows.above_cut is not None:
        noise = np.sqrt(windows.sky2)[:, None]
        above = windows.above_cut[:, None]
        mean, share, slope = after_cut(above + (signal + state[:, 3:4]) / noise)
        residual = (windows.data - noise * (mean - after_cut(above)[0])).astype(np.float32)
        less = 1.0 - np.maximum(share, _LEAST_SHARE)
        variance = (variance - less * windows.sky2[:, None]).astype(np.float32)
        unit = unit * slope[:, None].astype(np.float32)
    weight = windows.good / variance
    weighted = unit * weight[:, None, :]
    scale = by_parameter(state, unit.shape[1])
    normal = np.matmul(weighted, unit.transpose(0, 2, 1)) * (scale[:, :, None] * scale[:, None, :])
    gradient = np.matmul(weighted, residual[:, :, None])[:, :, 0] * scale
    diagonal = normal.reshape(len(normal), unit.shape[1] ** 2)[:, :: unit.shape[1] + 1]
    diagonal *= 1.0 + 1e-9
    diagonal += 1e-30
    return np.linalg.solve(normal, gradient[:, :, None])[:, :, 0], normal, residual, weight


def by_parameter(state: Floats, parameters: int) -> Floats:
    """Factors (N, P) that turn the derivatives of unit-flux images into those of the model with `state`
    (N, 4): the flux for place and width (columns 0, 1 and from 4 on), 1 for flux and sky.
    """
    scale = np.ones((len(state), parameters))
    scale[:, :2] = scale[:, 4:] = state[:, 2:3]
    return scale


def noise_gain(windows: StarWindows, value: Pixels, flux: Floats, sky: Floats) -> float:
    """Electrons per DN of the photon noise that the residuals about unit images (N, M) show; infinite if they
    do not grow with the signal."""
    signal = flux[:, None] * value
    square = (windows.data - sky[:, None] - signal) ** 2
    noise2, per_dn = windows.noise2[:, None], 0.0
    for _ in range(4):
        variance = noise2 + per_dn * np.maximum(signal, 0.0)
        weight = (square < NEVER_SIGMA**2 * variance) * (signal > 0.0) * windows.good / variance**2
        per_dn = max(float((weight * signal * (square - noise2)).sum() / (weight * signal**2).sum()), 0.0)
    return 1.0 / per_dn if per_dn > 0.0 else np.inf
