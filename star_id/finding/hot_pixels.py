"""Hot pixels of a sensor that has many: found before stars are, replaced, and without weight in their fits.

The median of a pixel's four neighbours is not far below it wherever a star lies, since the optics spread its
light. A pixel that is higher than any star makes it beside such neighbours is hot.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.finding.background import Background, background_image

__all__ = ["without_hot_pixels"]

# Height over that of a star with the same neighbours, sigmas of a pixel: one good pixel in 4000 is higher
# by chance, and lower hot ones are no detections.
_HEIGHT_SIGMA = 3.5
# Factor on the height that a star in the middle of a pixel has beside its neighbours: pixels differ in
# response (set by hand).
_UNEVEN = 1.4
# Variance of a pixel's own width, px^2, that adds to a star's.
_PIXEL_VARIANCE = 1.0 / 12.0


def without_hot_pixels(
    image: NDArray[Any], background: Background, sigma_px: float
) -> tuple[NDArray[Any], Background, int]:
    """The image (H, W) with its hot pixels replaced by the median of their neighbours, its background, which
    holds where they are, and their number. Stars have the width `sigma_px`."""
    level = background_image(background.level_dn, image.shape)
    noise = background_image(background.noise_dn, image.shape)
    height = image.astype(np.float32) - level
    beside = np.stack([height[:-2, 1:-1], height[2:, 1:-1], height[1:-1, :-2], height[1:-1, 2:]])
    middle = 0.5 * (beside.sum(axis=0) - beside.max(axis=0) - beside.min(axis=0))
    steepest = _UNEVEN * float(np.exp(0.5 / (sigma_px**2 + _PIXEL_VARIANCE)))
    limit = steepest * np.maximum(middle, 0.0) + _HEIGHT_SIGMA * noise[1:-1, 1:-1]
    hot = np.zeros(image.shape, dtype=bool)
    hot[1:-1, 1:-1] = height[1:-1, 1:-1] > limit
    clean = image.copy()
    clean[hot] = (middle + level[1:-1, 1:-1])[hot[1:-1, 1:-1]]
    return clean, background.without(hot), int(np.count_nonzero(hot))
