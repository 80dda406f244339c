"""The image of a star that crosses a line detector, with its derivatives.

A star whose image point moves `r` pixels a row along the stages and `d` samples a row along the detector
crosses the middle of the detector at line y and sample x. In the time of row k, shifted by the stage j (from
the middle) as its charge is, the image point lies at

    a = r (k - y + q) + (r - 1) j   pixels along the motion of the charge,     q in [-1/2, 1/2] within the row
    b = x + d (k - y + q + j)       samples

and a pixel collects the light of the optics' Gaussian between a - 1/2 and a + 1/2, and about b. With matched
rate (r = 1, d = 0) all stages see the same; else their images lie side by side: the smear.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from scipy.linalg import eigh_tridiagonal
from scipy.special import ndtr

from boresight.records.record import Floats, array, record, scalar
from boresight.star_id.beyond_chance import CLIP_SIGMA, NEVER_SIGMA
from boresight.star_id.finding.psf import PsfImages

__all__ = ["Motion", "trace_curvatures", "trace_images", "trace_radius"]

# Gauss-Legendre nodes within a row's exposure: exact to 1e-4 of the peak for a pixel a row and optics of
# 0.4 px.
_NODES_IN_ROW = 5
# Nodes that stand for the stages where their images lie at one place, and with one more for each width of the
# optics between those images: exact to 1e-4 of the peak.
_STAGE_NODES = 3
# Terms of the series of columns for each width of the optics that the drift moves the light to either side:
# to 5e-5 of the peak.
_TERMS_A_SIGMA = 4.0


@record
class Motion:
    """How image points of N stars move. Row n of every array is the same star."""

    rate: Floats = array("N", "pixels in a row period along the motion of the charge; negative: against it")
    drift: Floats = array("N", "samples in a row period")
    stages: int = scalar("TDI stages of the detector")

    def take(self, index: NDArray[Any]) -> Motion:
        """The motions at indices (M,) or of a mask (N,)."""
        return Motion(self.rate[index], self.drift[index], self.stages)

    @property
    def smear_rows(self) -> Floats:
        """(N,) distance of the images of the first and the last stage, in rows."""
        return (self.stages - 1.0) * np.abs(1.0 - self.rate) / np.abs(self.rate)


def trace_radius(motion: Motion, sigma_px: float) -> int:
    """Pixels from the middle of a window to its edge that hold 99 % of the information of every star."""
    rows = (CLIP_SIGMA * sigma_px + 0.5) / np.abs(motion.rate) + 0.5 + 0.5 * motion.smear_rows
    side = 0.5 * (motion.stages + np.abs(1.0 / motion.rate)) * np.abs(motion.drift)
    return int(np.ceil(max(float(rows.max()), CLIP_SIGMA * sigma_px + 0.5 + float(side.max()))))


def trace_images(offset: Floats, motion: Motion, sigma_px: float, radius: int) -> PsfImages:
    """Images of unit charge of stars at `offset` (N, 2), (sample, line) from the middle of windows of side
    2 radius + 1, and the derivatives by both.
    """
    rows, columns = _profiles(offset, motion, sigma_px, radius, order=1)
    rate, drift = motion.rate[:, None, None], motion.drift[:, None, None]
    value, d_x = (rows[0] @ column for column in columns)
    d_y = -rate * (rows[1] @ columns[0]) - drift * d_x
    images = np.stack([d_x, d_y, value, np.ones_like(value)], axis=1)
    return PsfImages(images.reshape(len(offset), 4, -1).astype(np.float32), None)


def trace_curvatures(offset: Floats, motion: Motion, sigma_px: float, radius: int) -> Floats:
    """Second derivatives (N, 3, M) of the images of `trace_images`, by sample twice, by sample and line, by
    line twice."""
    rows, columns = _profiles(offset, motion, sigma_px, radius, order=2)
    rate, drift = motion.rate[:, None, None], motion.drift[:, None, None]
    d_xx = rows[0] @ columns[2]
    across = rows[1] @ columns[1]
    along = rows[2] @ columns[0]
    d_xy = -rate * across - drift * d_xx
    d_yy = rate**2 * along + 2.0 * rate * drift * across + drift**2 * d_xx
    return np.stack([d_xx, d_xy, d_yy], axis=1).reshape(len(offset), 3, -1)


def _profiles(
    offset: Floats, motion: Motion, sigma_px: float, radius: int, *, order: int
) -> tuple[list[Floats], list[Floats]]:
    """Factors of the images: rows (N, K, T) and columns (N, T, C), whose products are the images (N, K, C),
    with their derivatives by the place along the motion of the charge and by sample up to `order`.

    The light at the stage j and the instant t of a row lies in the row's share at a, and spreads over the
    columns about b, which depends on u = t + j alone: as a series in Chebyshev's polynomials of u, of as many
    terms T as the drift over the trace asks.
    """
    stage, in_row, weight = _nodes(motion, sigma_px)
    pixel = np.arange(-radius, radius + 1.0)
    rate, drift = motion.rate[:, None, None], motion.drift[:, None, None]
    t = pixel[None, :, None] - offset[:, 1, None, None] + in_row  # (N, K, J)
    along = rate * t + (rate - 1.0) * stage
    half = 0.5 / sigma_px
    shares = [
        high - low
        for low, high in zip(*(_integrals(along / sigma_px + side, order) for side in (-half, half)))
    ]
    lit = (0.5 * motion.stages + NEVER_SIGMA * sigma_px + 0.5) / float(np.abs(motion.rate).min(initial=1.0))
    terms = _terms(lit * float(np.abs(motion.drift).max(initial=0.0)) / sigma_px)
    series = chebvander(np.clip((t + stage) / lit, -1.0, 1.0), terms - 1)  # (N, K, J, T)
    series *= (np.abs(rate) * weight)[..., None]
    node = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    edges = np.arange(-radius - 0.5, radius + 1.0)
    beside = offset[:, 0, None, None] + drift * lit * node[:, None]  # (N, T, 1)
    columns = [np.diff(integral, axis=-1) for integral in _integrals((edges - beside) / sigma_px, order)]
    at_nodes = np.linalg.inv(chebvander(node, terms - 1))
    of_rows = [np.einsum("nkj,nkjt->nkt", share, series) / sigma_px**n for n, share in enumerate(shares)]
    of_columns = [at_nodes @ column / (-sigma_px) ** n for n, column in enumerate(columns)]
    return of_rows, of_columns


def _terms(half_range: float) -> int:
    """Terms of a series for an optics' image that moves by `half_range` of its widths to either side."""
    return 1 if half_range == 0.0 else 4 + int(np.ceil(_TERMS_A_SIGMA * half_range))


def _integrals(z: Floats, order: int) -> list[Floats]:
    """The normal distribution's cumulated density at z, and its derivatives up to `order` (1 or 2)."""
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return [ndtr(z), density, -z * density][: order + 1]


def _nodes(motion: Motion, sigma_px: float) -> tuple[Floats, Floats, Floats]:
    """Stages, instants within a row and weights (J,) whose sum stands for all of a row's exposure."""
    apart = float(np.hypot(1.0 - motion.rate, motion.drift).max(initial=0.0))
    wanted = _STAGE_NODES + int(np.ceil(motion.stages * apart / sigma_px))
    stage, share = _gauss_sum(motion.stages, min(motion.stages, wanted))
    node, weight = np.polynomial.legendre.leggauss(_NODES_IN_ROW)
    weights = np.asarray(np.outer(share, 0.5 * weight), dtype=float)
    return np.repeat(stage, len(node)), np.tile(0.5 * node, len(stage)), weights.ravel()


def _gauss_sum(points: int, count: int) -> tuple[Floats, Floats]:
    """Nodes and weights (count,) of the mean over `points` integers about 0, exact for polynomials of degree
    2 count - 1: Gauss's rule of Chebyshev's discrete polynomials (Golub and Welsch 1969, Math. Comp. 23,
    221)."""
    k2 = np.arange(1.0, count) ** 2
    beside = np.sqrt(k2 * (points**2 - k2) / (4.0 * (4.0 * k2 - 1.0)))
    node, vector = eigh_tridiagonal(np.zeros(count), beside)
    return np.asarray(node), np.asarray(vector[0] ** 2)
