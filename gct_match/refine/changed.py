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

__all__ = ["REACH_PX", "fit_changed", "turned"]

_STEPS = 16  # at most
_ALONG_SIDE = 6  # blocks: of 21 px, as wide as a change of season is correlated, on a chip of 128 px
_LONGEST_PX = 0.6  # a longer step is shortened: the picture is not linear beyond
_LONGER, _SHORTER = 1.0, 0.6
_SETTLED_PX = 0.02  # a fifth of the standard error of such pairs, or less
_SETTLED_RIM_PX = 0.15  # the same at the template's rim, where an affine map is less accurate
_FARTHEST_PX = 2.5  # from the start
REACH_PX = 3  # from a whole pixel to where the fit may lie


def fit_changed(
    template: Image,
    picture: Image,
    usable: Image,
    grey: Image,
    start_px: Floats,
    reference_px: Floats,
    *,
    affine: bool,
) -> PositionFit:
    """Least-squares position in a picture of the point `reference_px` (x, y) of a template.

    `template` (2, h, w) and `picture` (2, H, W) are the planes of their edge fields, `usable` (h, w) is zero
    where these do not count, `grey` (H, W) are the picture's grey values. `start_px` (x, y) is the initial
    position of the template's first pixel in the picture, to 2 px. An `affine` map is estimated with the
    prior that a chip is turned and scaled by some hundredths: a translation alone trades with a turn where
    edges lie on one side.
    """
    shape: tuple[int, ...] = usable.shape
    weighted = usable * template
    power = float(np.vdot(weighted, template)) + 1e-30
    slopes = [gradient(plane) for plane in template]
    # a derivative's transpose is its negative: common slopes are the picture's product with this
    bent = np.stack([-gradient(usable * gx)[0] - gradient(usable * gy)[1] for gx, gy in slopes])
    own = float(np.vdot(bent, template)) + 1e-30
    first, length = start_px + reference_px, 1.0
    warp, from_corner, settled = np.eye(3), np.eye(3), False
    last: Floats = np.zeros((2, 3))
    warp[:2, 2], from_corner[:2, 2] = first, -reference_px
    for _ in range(_STEPS):
        found = np.stack([_resampled(plane, warp @ from_corner, shape) for plane in picture])
        gain = float(np.vdot(weighted, found)) / power
        residual = found - np.float32(gain) * template
        response = max(float(np.vdot(bent, found)) / own, 1e-3)
        one, two = (
            blocks_of(gx, gy, left, usable, reference_px, 1.0, _ALONG_SIDE)
            for (gx, gy), left in zip(slopes, residual)
        )
        blocks = one.with_scores_of(two).with_prior(warp[:2, :2] - np.eye(2), response)
        P = blocks.displacement(affine=affine) / response
        settled = bool(np.abs(P[:, 2]).max() < _SETTLED_PX and largest_px(P, shape) < _SETTLED_RIM_PX)
        if settled or np.abs(warp[:2, 2] - first).max() > _FARTHEST_PX:
            break
        agrees = P[:, 2] @ last[:, 2] + np.vdot(P[:, :2], last[:, :2]) * np.mean(blocks.lever[:, :2] ** 2)
        length *= _LONGER if agrees > 0.0 else _SHORTER if agrees < 0.0 else 1.0
        warp, last = composed(warp, P * min(length, _LONGEST_PX / largest_px(P, shape))), P
    return PositionFit(
        xy_px=warp[:2, 2].copy(),
        cov_px=blocks.covariance(affine=affine) / response**2,
        affine=warp[:2, :2] - np.eye(2),
        correlation=gain * float(np.sqrt(power / (float(np.vdot(usable * found, found)) + 1e-30))),
        converged=settled and gain > 0.0,
        found=_resampled(grey, warp @ from_corner, shape),
        residual=np.hypot(*residual),
    )


def turned(field: Image, xy_px: Floats, affine: Floats) -> Image:
    """An edge field (2, H, W) as a template sees it that is mapped by 1 + `affine` about `xy_px` (x, y)."""
    A = np.eye(2) + affine
    warp = np.column_stack([A, xy_px - A @ xy_px])
    return np.stack([_resampled(plane, warp, plane.shape) for plane in field])


def _resampled(plane: Image, warp: Floats, shape: tuple[int, ...]) -> Image:
    """A plane at the warped pixels of a picture of `shape` (h, w), to a thirtieth of a pixel."""
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(plane, warp[:2], shape[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT)
