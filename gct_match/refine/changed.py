"""Position of a template in a picture of another date, of which much has changed.

Season, water, crops, shadows and clouds are noise of the template: correlated, with a spectrum of its own,
and often more than what both have in common. Weights and filters that follow from the residuals would hold
the fit wherever it begins. All edges count alike, therefore, by their directions, strong ones no more than
others, and the scatter of the template's blocks, of which each sees changes of its own, is the covariance.
"""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.imaging.resample import composed, gradient, largest_px, warped
from boresight.gct_match.records import Image
from boresight.gct_match.refine.least_squares import PositionFit
from boresight.gct_match.refine.template_blocks import blocks_of
from boresight.records.record import Floats

__all__ = ["REACH_PX", "fit_changed"]

_STEPS = 16  # at most
_ALONG_SIDE = 6  # blocks: of 21 px, as wide as a change of season is correlated, on a chip of 128 px
_LONGEST_PX = 0.6  # a longer step is shortened: the picture is not linear beyond
_SETTLED_PX = 0.02  # a fifth of the standard error of such pairs, or less
_SETTLED_RIM_PX = 0.15  # the same at the template's rim, where an affine map is three times less accurate
_FARTHEST_PX = 2.5  # from the start
REACH_PX = 3  # from a whole pixel to where the fit may lie


def fit_changed(
    template: Image, picture: Image, usable: Image, grey: Image, start_px: Floats, reference_px: Floats, rigid: bool = False
) -> PositionFit:
    """Least-squares position in a picture of the point `reference_px` (x, y) of a template.

    `template` (2, h, w) and `picture` (2, H, W) are the planes of their edge fields, `usable` (h, w) is zero
    where these do not count, `grey` (H, W) are the picture's grey values. `start_px` (x, y) is the initial
    position of the template's first pixel in the picture, to 2 px.
    """
    shape, slopes = usable.shape, [gradient(plane) for plane in template]
    power = float(np.vdot(usable * template, template)) + 1e-30
    own = sum(float(np.vdot(usable * slope, slope)) for of_plane in slopes for slope in of_plane) + 1e-30
    # the transpose of a derivative is its negative: with this, a product of slopes is one with the picture
    bent = [
        -gradient(usable * gx)[0] - gradient(usable * gy)[1] for gx, gy in slopes
    ]
    first, step, last = start_px + reference_px, 1.0, np.zeros((2, 3))
    warp, from_corner, settled = np.eye(3), np.eye(3), False
    warp[:2, 2], from_corner[:2, 2] = first, -reference_px
    for _ in range(_STEPS):
        found = np.stack([_warped(plane, warp @ from_corner, shape) for plane in picture])
        gain = float(np.vdot(usable * template, found)) / power
        residual = found - np.float32(gain) * template
        response = max(sum(float(np.vdot(a, b)) for a, b in zip(bent, found)) / own, 1e-3)
        one, two = (
            blocks_of(gx, gy, left, usable, reference_px, 1.0, _ALONG_SIDE)
            for (gx, gy), left in zip(slopes, residual)
        )
        blocks = one.with_scores_of(two)
        P, cov = blocks.displacement_with_prior(warp[:2, :2] - np.eye(2), response, rigid)
        settled = bool(np.abs(P[:, 2]).max() < _SETTLED_PX and largest_px(P, shape) < _SETTLED_RIM_PX)
        if settled or np.abs(warp[:2, 2] - first).max() > _FARTHEST_PX:
            break
        same = P[:, 2] @ last[:, 2] + (min(shape) / 3.5) ** 2 * np.sum(P[:, :2] * last[:, :2])
        step = min(1.2 * step, 2.0) if same > 0.0 else 0.6 * step if same < 0.0 else step
        last = P
        warp = composed(warp, P * min(step, _LONGEST_PX / largest_px(P, shape)))
    return PositionFit(
        xy_px=warp[:2, 2].copy(),
        cov_px=cov,
        affine=warp[:2, :2] - np.eye(2),
        correlation=gain * float(np.sqrt(power / (float(np.vdot(usable * found, found)) + 1e-30))),
        converged=settled and gain > 0.0,
        found=warped(grey, warp @ from_corner, shape),
        residual=np.hypot(*residual),
    )


def _warped(plane, warp, shape):
    return cv2.warpAffine(plane, warp[:2], shape[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT)


def turned(field, xy_px, affine):
    A = np.eye(2) + affine
    warp = np.column_stack([A, xy_px - A @ xy_px])
    return np.stack([cv2.warpAffine(plane, warp, plane.shape[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP) for plane in field])
