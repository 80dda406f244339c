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
from numpy.typing import NDArray
from scipy.special import ndtr

from boresight.geometry.record import Floats, array, record, scalar
from boresight.star_id.finding.psf import PsfImages

__all__ = ["Motion", "trace_curvatures", "trace_images", "trace_radius"]

# Gauss-Legendre nodes within a row's exposure: exact to 1e-4 of the peak for a pixel a row and optics of
# 0.4 px.
_NODES_IN_ROW = 5
# Radius of a star's image, widths of the optics, that is computed: 99 % of its light.
_REACH_SIGMA = 3.0
# Distance, widths of the optics, between the images of stages that are computed; others are interpolated
# (set by hand).
_STEP_SIGMA = 0.5


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
    rows = (_REACH_SIGMA * sigma_px + 0.5) / np.abs(motion.rate) + 0.5 + 0.5 * motion.smear_rows
    side = 0.5 * (motion.stages + np.abs(1.0 / motion.rate)) * np.abs(motion.drift)
    return int(np.ceil(max(float(rows.max()), _REACH_SIGMA * sigma_px + 0.5 + float(side.max()))))


def trace_images(offset: Floats, motion: Motion, sigma_px: float, radius: int) -> PsfImages:
    """Images of unit charge of stars at `offset` (N, 2), (sample, line) from the middle of windows of side
    2 radius + 1, and the derivatives by both.
    """
    rows, columns, weight = _profiles(offset, motion, sigma_px, radius, order=1)
    rate, drift = motion.rate[:, None, None], motion.drift[:, None, None]
    value, d_x = (_summed(rows[0], column, weight) for column in columns)
    d_y = -rate * _summed(rows[1], columns[0], weight) - drift * d_x
    images = np.stack([d_x, d_y, value, np.ones_like(value)], axis=1)
    return PsfImages(images.reshape(len(offset), 4, -1).astype(np.float32), None)


def trace_curvatures(offset: Floats, motion: Motion, sigma_px: float, radius: int) -> Floats:
    """Second derivatives (N, 3, M) of the images of `trace_images`, by sample twice, by sample and line, by
    line twice."""
    rows, columns, weight = _profiles(offset, motion, sigma_px, radius, order=2)
    rate, drift = motion.rate[:, None, None], motion.drift[:, None, None]
    d_xx = _summed(rows[0], columns[2], weight)
    across = _summed(rows[1], columns[1], weight)
    along = _summed(rows[2], columns[0], weight)
    d_xy = -rate * across - drift * d_xx
    d_yy = rate**2 * along + 2.0 * rate * drift * across + drift**2 * d_xx
    return np.stack([d_xx, d_xy, d_yy], axis=1).reshape(len(offset), 3, -1)


def _profiles(
    offset: Floats, motion: Motion, sigma_px: float, radius: int, *, order: int
) -> tuple[list[Floats], list[Floats], Floats]:
    """Shares of the light of an image point at each node that rows (N, K, J) and columns (N, K, J, C) of a
    window take, their derivatives by its place along the motion of the charge and by sample up to `order`,
    and the weights (N, J) of the nodes."""
    stage, in_row, weight = _nodes(motion, sigma_px)
    pixel = np.arange(-radius, radius + 1.0)
    rate, drift = motion.rate[:, None, None], motion.drift[:, None, None]
    t = pixel[None, :, None] - offset[:, 1, None, None] + in_row  # (N, K, J)
    along = (rate * t + (rate - 1.0) * stage) / sigma_px
    beside = (offset[:, 0, None, None] + drift * (t + stage)) / sigma_px
    half = 0.5 / sigma_px
    rows = [high - low for low, high in zip(*(_integrals(along + side, order) for side in (-half, half)))]
    edges = np.arange(-radius - 0.5, radius + 1.0) / sigma_px
    columns = [np.diff(integral, axis=-1) for integral in _integrals(edges - beside[..., None], order)]
    of_rows = [row / sigma_px**n for n, row in enumerate(rows)]
    of_columns = [column / (-sigma_px) ** n for n, column in enumerate(columns)]
    return of_rows, of_columns, np.abs(motion.rate)[:, None] * weight


def _integrals(z: Floats, order: int) -> list[Floats]:
    """The normal distribution's cumulated density at z, and its derivatives up to `order` (1 or 2)."""
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return [ndtr(z), density, -z * density][: order + 1]


def _summed(rows: Floats, columns: Floats, weight: Floats) -> Floats:
    """(N, K, C) images of all nodes, added with their weights (N, J)."""
    return np.asarray(np.matmul((rows * weight[:, None])[:, :, None, :], columns)[:, :, 0])


def _nodes(motion: Motion, sigma_px: float) -> tuple[Floats, Floats, Floats]:
    """Stages, instants within a row and weights (J,) whose sum stands for all of a row's exposure."""
    apart = float(np.hypot(1.0 - motion.rate, motion.drift).max(initial=0.0))
    wanted = 1 + int(np.ceil(motion.stages * apart / (_STEP_SIGMA * sigma_px)))
    count = min(motion.stages, wanted)
    stage = motion.stages * ((np.arange(count) + 0.5) / count - 0.5)
    node, weight = np.polynomial.legendre.leggauss(_NODES_IN_ROW)
    both = np.repeat(stage, len(node)), np.tile(0.5 * node, count), np.tile(0.5 * weight, count) / count
    return both
