"""Alignment from a correlation peak to a few hundredths of a pixel, with weights of the pixels.

Gauss-Newton steps on the normalised pictures, at every second pixel of every second row. The first weights
are the squared local correlation, later ones follow from the residuals. A small affine map is estimated as
soon as the template's blocks show one.
"""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.imaging.resample import change, composed, gradient, largest_px
from boresight.gct_match.records import Image
from boresight.gct_match.refine.template_blocks import blocks_of
from boresight.records.record import Floats

__all__ = ["approach", "robust_weights"]

_STEPS = 3  # of the first approach to a position, at most (set by hand)
_NEAR_PX = 0.15  # steps end below this displacement
_AFFINE_PX = 0.25  # translations below this allow the test for an affine map


def approach(
    template: Image, picture: Image, mask: Image, warp: Floats, reference_px: Floats
) -> tuple[Floats, Image]:
    """Improved warp (3, 3), and weights of every second pixel of `template` (h, w) in both directions.

    `warp` (3, 3) takes pixels of the template, relative to `reference_px`, to pixels of `picture`; its error
    may be 2 px. `mask` (h, w) is zero where template or picture must not be used.
    """
    t, mask = np.ascontiguousarray(template[::2, ::2]), mask[::2, ::2]
    slopes = [np.ascontiguousarray(slope[::2, ::2]) for slope in gradient(template)]
    from_every_second = np.array(
        [[2.0, 0.0, -reference_px[0]], [0.0, 2.0, -reference_px[1]], [0.0, 0.0, 1.0]]
    )
    affine, weight = False, mask
    for step in range(_STEPS):
        i = cv2.warpAffine(
            picture,
            (warp @ from_every_second)[:2],
            t.shape[::-1],
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        if step == 0:
            weight = mask * _similarity(t, i)
        weighted = weight * t
        power = float(np.vdot(weighted, t)) + 1e-30
        gain = max(float(np.vdot(weighted, i)) / power, 1e-3)
        residual = i - np.float32(gain) * t
        gx, gy = (slope - np.float32(float(np.vdot(weighted, slope)) / power) * t for slope in slopes)
        blocks = blocks_of(gx, gy, residual, weight, reference_px, 2.0)
        P = blocks.displacement(affine=affine)
        if not affine and np.abs(P).max() < _AFFINE_PX * gain and blocks.show_affine(gain):
            affine, P = True, blocks.displacement(affine=True)
        weight = robust_weights(residual - change((gx, gy), P, reference_px, 2.0), mask, 3, 1.5)
        P = P / gain
        warp = composed(warp, P)
        if largest_px(P, template.shape) < _NEAR_PX:
            break
    return warp, weight


def robust_weights(residual: Image, mask: Image, side: int, tolerance: float) -> Image:
    """`mask` (h, w), reduced where the variance over `side` x `side` px exceeds `tolerance` medians."""
    local = cv2.blur(residual * residual * mask, (side, side))
    some = local[::3, ::3]
    some = some[some > 0.0]
    median = float(np.partition(some, len(some) // 2)[len(some) // 2]) if some.size else 1.0
    ratio = local * np.float32(1.0 / (tolerance * median))
    return mask / (1.0 + ratio * ratio)


def _similarity(t: Image, i: Image) -> Image:
    """Squared positive local correlation (h, w) of two pictures, in neighbourhoods of 7 x 7 pixels."""
    tt, ii, ti = (cv2.blur(product, (7, 7)) for product in (t * t, i * i, t * i))
    floor = np.float32(1e-20 + 1e-4 * cv2.mean(tt)[0] * cv2.mean(ii)[0])
    return np.maximum(ti, 0.0) ** 2 / (tt * ii + floor)
