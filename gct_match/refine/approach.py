"""From a peak of the correlation to a few hundredths of a pixel, and to the pixels that can be trusted.

Template and picture are looked at normalised (`correlation`), in every second pixel of every second row.
At first a pixel counts by how alike the two are around it, then by how well its neighbourhood fits. A small
affine map is taken up as soon as the blocks of the template ask for it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.resample import change, composed, gradient, largest_px
from boresight.gct_match.refine.blocks import blocks_of

__all__ = ["approach", "robust_weights"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision

_STEPS = 3
_NEAR_PX = 0.15
_SURE_PX = 0.25


def approach(
    template: Image, picture: Image, mask: Image, warp: Array, reference_px: Array
) -> tuple[Array, Image]:
    """The warp, bettered, and the weight of every second pixel of `template` (h, w) in both directions.

    `warp` (3, 3) takes pixels of the template, counted from `reference_px`, to pixels of `picture`; it may
    be 2 px off. `mask` (h, w) is zero where template or picture must not be used.
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
            weight = mask * _likeness(t, i)
        weighted = weight * t
        power = float(np.vdot(weighted, t)) + 1e-30
        gain = max(float(np.vdot(weighted, i)) / power, 1e-3)
        residual = i - np.float32(gain) * t
        gx, gy = (slope - np.float32(float(np.vdot(weighted, slope)) / power) * t for slope in slopes)
        blocks = blocks_of(gx, gy, residual, weight, reference_px, 2.0)
        P = blocks.displacement(affine=affine)
        if not affine and np.abs(P).max() < _SURE_PX * gain and blocks.ask_for_affine(gain):
            affine, P = True, blocks.displacement(affine=True)
        weight = robust_weights(residual - change((gx, gy), P, reference_px, 2.0), mask, 3, 1.5)
        P = P / gain
        warp = composed(warp, P)
        if largest_px(P, template.shape) < _NEAR_PX:
            break
    return warp, weight


def robust_weights(residual: Image, mask: Image, side: int, tolerance: float) -> Image:
    """`mask`, less where a neighbourhood of `side` x `side` pixels has over `tolerance` times the usual
    variance.
    """
    local = cv2.blur(residual * residual * mask, (side, side))
    some = local[::3, ::3]
    some = some[some > 0.0]
    usual = float(np.partition(some, len(some) // 2)[len(some) // 2]) if some.size else 1.0
    ratio = local * np.float32(1.0 / (tolerance * usual))
    return mask / (1.0 + ratio * ratio)


def _likeness(t: Image, i: Image) -> Image:
    """Square of the positive local correlation of two pictures, in neighbourhoods of 7 x 7 pixels."""
    tt, ii, ti = (cv2.blur(product, (7, 7)) for product in (t * t, i * i, t * i))
    floor = np.float32(1e-20 + 1e-4 * cv2.mean(tt)[0] * cv2.mean(ii)[0])
    return np.maximum(ti, 0.0) ** 2 / (tt * ii + floor)
