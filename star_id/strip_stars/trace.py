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

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from boresight.geometry.record import Floats, array, record, scalar
from boresight.star_id.finding.psf import PsfImages

__all__ = ["Motion", "trace_images", "trace_radius"]

_NODES_IN_ROW = 5  # Gauss-Legendre: exact to 1e-4 of the peak for a pixel a row and optics of 0.4 px
_REACH_SIGMA = 3.0
_STEP_SIGMA = 0.5  # between the images of stages that are computed


@record
class Motion:
    """How image points of N stars move. Row n of every array is the same star."""

    rate: Floats = array("N", "pixels in a row period along the motion of the charge; negative: against it")
    drift: Floats = array("N", "samples in a row period")
    stages: int = scalar("TDI stages of the detector")

    def take(self, index: NDArray) -> Motion:
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
    stage, in_row, weight = _nodes(motion, sigma_px)
    pixel = np.arange(-radius, radius + 1.0)
    rate, drift = motion.rate[:, None, None], motion.drift[:, None, None]
    t = pixel[None, :, None] - offset[:, 1, None, None] + in_row  # (N, K, J)
    along = (rate * t + (rate - 1.0) * stage) / sigma_px
    beside = (offset[:, 0, None, None] + drift * (t + stage)) / sigma_px
    half = 0.5 / sigma_px
    share = ndtr(along + half) - ndtr(along - half)
    share_slope = (_density(along + half) - _density(along - half)) / sigma_px
    edges = np.arange(-radius - 0.5, radius + 1.0) / sigma_px
    z = edges - beside[..., None]  # (N, K, J, C + 1)
    column, density = np.diff(ndtr(z), axis=-1), _density(z)
    column_slope = (density[..., :-1] - density[..., 1:]) / sigma_px

    def summed(rows: Floats, columns: Floats) -> Floats:
        return np.matmul((rows * weight)[:, :, None, :], columns)[:, :, 0]  # (N, K, C)

    light = np.abs(rate)
    value, d_x = light * summed(share, column), light * summed(share, column_slope)
    by_rows = light * summed(share_slope, column)
    d_y = -rate * by_rows - drift * d_x
    images = np.stack([d_x, d_y, value, np.ones_like(value)], axis=1)
    return PsfImages(images.reshape(len(offset), 4, -1).astype(np.float32), None)


def _nodes(motion: Motion, sigma_px: float) -> tuple[Floats, Floats, Floats]:
    """Stages, instants within a row and weights (J,) whose sum stands for all of a row's exposure."""
    apart = float(np.hypot(1.0 - motion.rate, motion.drift).max(initial=0.0))
    wanted = 1 + int(np.ceil(motion.stages * apart / (_STEP_SIGMA * sigma_px)))
    count = min(motion.stages, wanted)
    stage = motion.stages * ((np.arange(count) + 0.5) / count - 0.5)
    node, weight = np.polynomial.legendre.leggauss(_NODES_IN_ROW)
    both = np.repeat(stage, len(node)), np.tile(0.5 * node, count), np.tile(0.5 * weight, count) / count
    return both


def _density(z: Floats) -> Floats:
    return np.asarray(np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi))
