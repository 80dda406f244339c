"""Two fields of rows: the stars of even and odd rows apart, as interlaced sensors leave them in motion.

A star's image is then a comb. Fitted with one place it leaves residuals that are taken for photon noise. What
even and odd rows of the bright stars leave shows how far they are apart. Where that is significant, motion
between the fields, the share of it during which a field is exposed, and the width are fitted together. The
place of a star is that of the instant between both fields.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from boresight.geometry.record import Floats
from boresight.star_id.finding.blur import (
    chi2_of_stars,
    do_not_stand_out,
    gain_about,
    is_better,
    refined,
)
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_shape import WidthFits

__all__ = ["find_fields"]

# Distance of the fields, in standard errors of what single stars say, from which it is looked for (set by
# hand); and in px: a smaller one widens a star by less than a hundredth, and coarse pixels show as much.
_SIGNIFICANT, _LEAST_PX = 6.0, 0.1
# Brightest stars whose even and odd rows are compared (set by hand).
_BRIGHTEST = 20
# Fewest stars that it is fitted to (as for coma).
_FEWEST = 12
# Changes by which the fit is scaled: of log width, motion (px), and the squared share of the exposure (set by
# hand).
_UNSURE = (0.1, 0.1, 0.1, 0.3)
# Squared share of the time between fields during which one is exposed: 1 at most.
_BOUNDS = ([-np.inf, -np.inf, -np.inf, 0.0], [np.inf, np.inf, np.inf, 1.0])
# Share of a pixel's light by which real stars differ from a Gaussian (as for coma).
_UNLIKE = 0.1


def find_fields(fits: WidthFits, psf: Psf) -> tuple[Psf, float] | None:
    """PSF with two fields of rows, and the gain, e-/DN, that the residuals about it show; None where the
    stars of even and odd rows are at one place."""
    if np.count_nonzero(fits.settled) < _FEWEST:
        return None
    apart, error = _apart(fits)
    if math.hypot(*apart) < max(_SIGNIFICANT * error, _LEAST_PX):
        return None
    windows, start = fits.windows.take(fits.settled), fits.state[fits.settled, :2]

    def of_fields(theta: Floats) -> Psf:
        width, x, y, exposed = (float(value) for value in theta)
        sigma, smear = math.exp(width), (math.sqrt(exposed) * x, math.sqrt(exposed) * y)
        return replace(psf, sigma_px=sigma, sigma_corner_px=sigma, smear_px=smear, fields_px=(x, y))

    narrow = max(psf.sigma_px**2 - float(apart @ apart) / 8.0, 0.25 * psf.sigma_px**2)
    theta = np.array([0.5 * np.log(narrow), *apart, 0.1])
    theta, _ = refined(windows, start, of_fields, theta, np.array(_UNSURE), _UNLIKE, _BOUNDS)
    if not is_better(windows, start, of_fields(theta), psf, _UNLIKE):
        return None
    alone = do_not_stand_out(chi2_of_stars(windows, start, of_fields(theta), _UNLIKE))
    windows, start = windows.take(alone), start[alone]
    # with the weights that widths of other images have: wings are seen less
    found = of_fields(refined(windows, start, of_fields, theta, np.array(_UNSURE), 0.0, _BOUNDS)[0])
    return found, gain_about(windows, start, found)


def _apart(fits: WidthFits) -> tuple[Floats, float]:
    """Places of odd rows less those of even ones (2,), px, to first order, and their standard error along
    either axis by the scatter of stars."""
    use, windows = fits.settled.nonzero()[0][:_BRIGHTEST], fits.windows
    side = 2 * windows.radius + 1
    odd = (windows.corner[use, 1, None] + np.arange(side)).repeat(side, axis=1) % 2
    slopes, residual = fits.images.columns[use, :2], fits.residual[use] * (odd - np.float32(0.5))
    seen = np.matmul(slopes, residual[:, :, None])[:, :, 0]
    each = seen / (0.25 * fits.state[use, 2:3] * (slopes * slopes).sum(axis=2))
    middle = len(use) // 2
    apart = np.sort(each, axis=0)[middle]
    error = 1.4826 * np.sort(np.abs(each - apart), axis=0)[middle].max() / math.sqrt(len(use))
    return apart, float(error)
