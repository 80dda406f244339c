"""Position of a template in a picture of another date, of which much has changed.

Season, water, crops, shadows and clouds are noise of the template: correlated, with a spectrum of its own,
and often more than what both have in common. Weights and filters that follow from the residuals would hold
the fit wherever it begins. All edges count alike, therefore, by their directions, strong ones no more than
others, and the scatter of the template's blocks, of which each sees changes of its own, is the covariance.
"""

from __future__ import annotations

import numpy as np

from boresight.gct_match.imaging.resample import composed, gradient, largest_px, warped
from boresight.gct_match.records import Image
from boresight.gct_match.refine.least_squares import PositionFit
from boresight.gct_match.refine.template_blocks import blocks_of
from boresight.records.record import Floats

__all__ = ["REACH_PX", "fit_changed"]

_STEPS = 12  # at most
_ALONG_SIDE = 6  # blocks: of 21 px, as wide as a change of season is correlated, on a chip of 128 px
_LONGEST_PX = 0.6  # a longer step is shortened: the picture is not linear beyond
_AFFINE_PX = 0.25  # translations below this allow the test for an affine map
_SETTLED_PX = 0.02  # a fifth of the standard error of such pairs, or less
_SETTLED_RIM_PX = 0.06  # the same at the template's rim, where an affine map is three times less accurate
_FARTHEST_PX = 2.5  # from the start
REACH_PX = 3  # from a whole pixel to where the fit may lie


def fit_changed(
    template: Image, picture: Image, usable: Image, grey: Image, start_px: Floats, reference_px: Floats
) -> PositionFit:
    """Least-squares position in a picture of the point `reference_px` (x, y) of a template.

    `template` (2, h, w) and `picture` (2, H, W) are the planes of their edge fields, `usable` (h, w) is zero
    where these do not count, `grey` (H, W) are the picture's grey values. `start_px` (x, y) is the initial
    position of the template's first pixel in the picture, to 2 px.
    """
    shape, slopes = usable.shape, [gradient(plane) for plane in template]
    power = float(np.vdot(usable * template, template)) + 1e-30
    own = sum(float(np.vdot(usable * slope, slope)) for of_plane in slopes for slope in of_plane) + 1e-30
    first = start_px + reference_px
    warp, from_corner, affine, settled = np.eye(3), np.eye(3), False, False
    warp[:2, 2], from_corner[:2, 2] = first, -reference_px
    for _ in range(_STEPS):
        found = np.stack([warped(plane, warp @ from_corner, shape) for plane in picture])
        gain = float(np.vdot(usable * template, found)) / power
        residual = found - np.float32(gain) * template
        of_found = [gradient(plane) for plane in found]
        cross = sum(
            float(np.vdot(usable * a, b)) for one, two in zip(slopes, of_found) for a, b in zip(one, two)
        )
        response = max(cross / own, 1e-3)
        one, two = (
            blocks_of(gx, gy, left, usable, reference_px, 1.0, _ALONG_SIDE)
            for (gx, gy), left in zip(slopes, residual)
        )
        blocks = one.with_scores_of(two)
        P = blocks.displacement(affine=affine) / response
        if not affine and np.abs(P).max() < _AFFINE_PX and blocks.show_affine(response):
            affine, P = True, blocks.displacement(affine=True) / response
        settled = bool(np.abs(P[:, 2]).max() < _SETTLED_PX and largest_px(P, shape) < _SETTLED_RIM_PX)
        if settled or np.abs(warp[:2, 2] - first).max() > _FARTHEST_PX:
            break
        warp = composed(warp, P * min(1.0, _LONGEST_PX / largest_px(P, shape)))
    return PositionFit(
        xy_px=warp[:2, 2].copy(),
        cov_px=blocks.covariance(affine=affine) / response**2,
        affine=warp[:2, :2] - np.eye(2),
        correlation=gain * float(np.sqrt(power / (float(np.vdot(usable * found, found)) + 1e-30))),
        converged=settled and gain > 0.0,
        found=warped(grey, warp @ from_corner, shape),
        residual=np.hypot(*residual),
    )
