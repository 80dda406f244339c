"""Position of a template in a picture of another date, of which much has changed.

Season, water, crops, shadows and clouds are noise of the template: correlated, with a spectrum of its own,
and often more than what both have in common. Weights and filters that follow from the residuals would hold
the fit wherever it begins. All edges count alike, therefore, by their directions, strong ones no more than
others, and the scatter of the template's blocks, of which each sees changes of its own, is the covariance.
"""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.imaging.resample import composed, gradient, largest_px
from boresight.gct_match.records import Image
from boresight.gct_match.refine.least_squares import PositionFit
from boresight.gct_match.refine.template_blocks import blocks_of
from boresight.records.record import Floats

__all__ = ["REACH_PX", "fit_changed", "resampled"]

_STEPS = 16  # at most
_ALONG_SIDE = 6  # blocks: of 21 px, as wide as a change of season is correlated, on a chip of 128 px
_LONGEST_PX = 0.6  # a longer step is shortened: the picture is not linear beyond
_DAMPED = 0.7  # part of a step that is taken: noise of the found edges makes whole ones alternate
_SETTLED_PX, _SETTLED_RIM_PX = 0.02, 0.15  # a fifth of the standard error or less, also at the rim
_FARTHEST_PX = 2.5  # from the start
REACH_PX = 3  # from a whole pixel to where the fit may lie


def fit_changed(
    template: Image, picture: Image, usable: Image, start_px: Floats, reference_px: Floats, affine: bool
) -> PositionFit:
    """Least-squares position in a picture of the point `reference_px` (x, y) of a template.

    `template` (2, h, w) and `picture` (2, H, W) are the planes of their edge fields, `usable` (h, w) is zero
    where these do not count. `start_px` (x, y) is the initial position of the template's first pixel in the
    picture, to 2 px. Where edges lie on one side, a turned chip is displaced unless `affine` is estimated.
    """
    shape: tuple[int, ...] = usable.shape
    weighted = usable * template
    power = float(np.vdot(weighted, template)) + 1e-30
    gx, gy = map(np.stack, zip(*map(gradient, template)))
    # a derivative's transpose is its negative: common slopes are the picture's product with this
    slopes = np.stack([-gradient(usable * x)[0] - gradient(usable * y)[1] for x, y in zip(gx, gy)])
    own = float(np.vdot(slopes, template)) + 1e-30
    first = start_px + reference_px
    warp, from_corner, settled = np.eye(3), np.eye(3), False
    warp[:2, 2], from_corner[:2, 2] = first, -reference_px
    for _ in range(_STEPS):
        found = resampled(picture, warp @ from_corner, shape)
        gain = float(np.vdot(weighted, found)) / power
        residual = found - np.float32(gain) * template
        response = max(float(np.vdot(slopes, found)) / own, 1e-3)
        blocks = blocks_of(gx, gy, residual, usable, reference_px, 1.0, _ALONG_SIDE)
        blocks = blocks.with_prior(warp[:2, :2] - np.eye(2), response)
        P = blocks.displacement(affine=affine) / response
        settled = bool(np.abs(P[:, 2]).max() < _SETTLED_PX and largest_px(P, shape) < _SETTLED_RIM_PX)
        if settled or np.abs(warp[:2, 2] - first).max() > _FARTHEST_PX:
            break
        warp = composed(warp, P * min(_DAMPED, _LONGEST_PX / largest_px(P, shape)))
    return PositionFit(
        xy_px=warp[:2, 2].copy(),
        cov_px=blocks.covariance(affine=affine) / response**2,
        affine=warp[:2, :2] - np.eye(2),
        correlation=gain * float(np.sqrt(power / (float(np.vdot(usable * found, found)) + 1e-30))),
        converged=settled and gain > 0.0,
        found=np.hypot(*found),
        residual=np.hypot(*residual),
    )


def resampled(planes: Image, warp: Floats, shape: tuple[int, ...]) -> Image:
    """Planes (K, H, W) at the warped pixels of a picture of `shape` (h, w), to a thirtieth of a pixel."""
    mode, beyond = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, cv2.BORDER_REFLECT
    size = shape[1], shape[0]
    return np.stack([cv2.warpAffine(p, warp[:2], size, flags=mode, borderMode=beyond) for p in planes])
