"""Position of a template in a picture of another date, of which much has changed.

Season, water, crops and shadows are noise of the template with a spectrum of its own and more of it than of
what is common. Weights that follow from the residuals would then hold the fit wherever it begins: pixels count
alike, in the band of frequencies that survives a change of season, and grey values count as they are, so that
strong edges, which do survive, have the largest part. The covariance is that of the template's blocks.
"""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.imaging.resample import composed, gradient, largest_px, warped
from boresight.gct_match.imaging.views import View, window
from boresight.gct_match.records import Image
from boresight.gct_match.refine.least_squares import PositionFit, usable_pixels
from boresight.gct_match.refine.template_blocks import blocks_of
from boresight.geometry.record import Bools, Floats

__all__ = ["band_passed", "fit_changed"]

_FINE_PX, _WIDE_PX = 1.0, 4.0  # Gaussians whose difference is the band
_STEPS = 12  # at most
_LONGEST_PX = 0.6  # a longer step is shortened: the picture is not linear beyond
_AFFINE_PX = 0.25  # translations below this allow the test for an affine map
_SETTLED_PX = 0.02  # a tenth of the smallest standard error of such a pair
_FARTHEST_PX = 2.5  # from the start
_REACH_PX = 16  # of the picture around the template: farthest displacement, filter, interpolation


def band_passed(image: Image, valid: Bools) -> Image:
    """The picture (H, W) less what is finer and coarser than the band; only `valid` (H, W) pixels count."""
    if valid.all():
        return cv2.GaussianBlur(image, (0, 0), _FINE_PX) - cv2.GaussianBlur(image, (0, 0), _WIDE_PX)
    weight = valid.astype(np.float32)
    level = np.float32(image[valid].mean()) if valid.any() else np.float32(0.0)
    fine, wide = (
        cv2.GaussianBlur((image - level) * weight, (0, 0), sigma)
        / (cv2.GaussianBlur(weight, (0, 0), sigma) + np.float32(1e-3))
        for sigma in (_FINE_PX, _WIDE_PX)
    )
    return (fine - wide) * weight


def fit_changed(template: View, picture: View, start_px: Floats, reference_px: Floats) -> PositionFit:
    """Least-squares position in `picture` (H, W) of the point `reference_px` (x, y) of `template` (h, w).

    `start_px` (x, y) is the initial position of the template's first pixel in the picture, to 2 px.
    """
    h, w = template.grey.shape
    usable = usable_pixels(template.valid, picture.valid, start_px + reference_px)
    corner = np.round(start_px).astype(int) - _REACH_PX
    around = *corner.tolist(), w + 2 * _REACH_PX, h + 2 * _REACH_PX
    t = band_passed(template.grey, template.valid)
    i = band_passed(window(picture.grey, *around), window(picture.valid, *around))
    first = start_px - corner + reference_px
    warp, from_corner, affine, settled = np.eye(3), np.eye(3), False, False
    warp[:2, 2], from_corner[:2, 2] = first, -reference_px
    power = float(np.vdot(usable * t, t)) + 1e-30
    slopes = gradient(t)
    gx, gy = (slope - np.float32(float(np.vdot(usable * t, slope)) / power) * t for slope in slopes)
    own = sum(float(np.vdot(usable * slope, slope)) for slope in slopes) + 1e-30
    for _ in range(_STEPS):
        found = warped(i, warp @ from_corner, (h, w))
        gain = float(np.vdot(usable * t, found)) / power
        residual = found - np.float32(gain) * t
        cross = sum(float(np.vdot(usable * a, b)) for a, b in zip(slopes, gradient(found), strict=True))
        response = max(cross / own, 1e-3)
        blocks = blocks_of(gx, gy, residual, usable, reference_px, 1.0)
        P = blocks.displacement(affine=affine) / response
        if not affine and np.abs(P).max() < _AFFINE_PX and blocks.show_affine(response):
            affine, P = True, blocks.displacement(affine=True) / response
        length = largest_px(P, t.shape)
        settled = length < _SETTLED_PX * (3.0 if affine else 1.0)
        if settled:
            break
        warp = composed(warp, P * min(1.0, _LONGEST_PX / length))
        if np.abs(warp[:2, 2] - first).max() > _FARTHEST_PX:
            break
    left = float(np.vdot(usable * found, found)) + 1e-30
    return PositionFit(
        xy_px=warp[:2, 2] + corner,
        cov_px=blocks.covariance(affine=affine) / response**2,
        affine=warp[:2, :2] - np.eye(2),
        correlation=gain * np.sqrt(power / left),
        converged=settled and gain > 0.0,
        found=warped(picture.grey, _moved(warp, corner) @ from_corner, (h, w)),
        residual=residual,
    )


def _moved(warp: Floats, by_px: Floats) -> Floats:
    out = warp.copy()
    out[:2, 2] += by_px
    return out
