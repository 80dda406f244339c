"""Gauss-Newton steps of the PSF parameters of many stars at once, each in its own window.

The state of a star is column and row from the middle of its window, flux and local background (px, px, DN,
DN); its logarithmic width may be a fifth parameter. The variance of a pixel is the background's plus the
photon noise of the star. Of a sky that is cut off, the model is the mean of what the cut leaves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Floats
from boresight.star_id.beyond_chance import NEVER_SIGMA
from boresight.star_id.finding.cut_sky import after_cut
from boresight.star_id.finding.psf import PsfImages
from boresight.star_id.finding.windows import StarWindows

__all__ = ["LARGEST_STEP_PX", "by_parameter", "newton_step", "noise_gain", "start_state"]

Pixels = NDArray[np.float32]
# Longest step along an axis, px: a longer one leaves the range in which the image is linear in it.
LARGEST_STEP_PX = 0.8
# Least variance of a pixel at the cut, as a share of an uncut one's: noise there is rare and large, but no
# outlier (1/2 - 1/(2 pi), that of a sky cut off at its level).
_LEAST_SHARE = float(after_cut(np.zeros(()))[1])


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
    scale[:, [0, 1, *range(4, parameters)]] = state[:, 2:3]
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
