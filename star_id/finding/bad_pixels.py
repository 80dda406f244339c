"""Hot and dead pixels of a sensor that has many: found before stars are, replaced, and without weight in the
fits.

The median of a pixel's four neighbours is not far below it wherever a star lies, since the optics spread its
light. A pixel that is higher than any star makes it beside such neighbours is hot; one far below the sky is
dead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.beyond_chance import CLIP_SIGMA, NEVER_SIGMA
from boresight.star_id.finding.background import Background, background_image
from boresight.star_id.finding.lines import SPARSE

__all__ = ["has_many_dead_pixels", "without_bad_pixels"]

# Factor on the height that a star in the middle of a pixel has beside its neighbours: pixels differ in
# response (set by hand).
_UNEVEN = 1.4


def has_many_dead_pixels(image: NDArray[Any], background: Background, share: float) -> bool:
    """Whether more than a `share` of the pixels of an image (H, W) are far below the darkest sky."""
    darkest = background.level_dn.min() - NEVER_SIGMA * background.noise_dn.max()
    sample = image[::SPARSE, ::SPARSE] if image.dtype.kind != "u" or darkest > 0.0 else image[:0]
    return bool(np.count_nonzero(sample < darkest) > share * sample.size)


def without_bad_pixels(
    image: NDArray[Any], background: Background, sigma_px: float
) -> tuple[NDArray[Any], Background, int]:
    """The image (H, W) with hot and dead pixels replaced by the median of their neighbours, its background,
    which holds where they are, and the number of hot ones. Stars have the width `sigma_px`."""
    level = background_image(background.level_dn, image.shape)
    noise = background_image(background.noise_dn, image.shape)
    height = image.astype(np.float32) - level
    rows, columns = (height[:-2, 1:-1], height[2:, 1:-1]), (height[1:-1, :-2], height[1:-1, 2:])
    lower = np.maximum(np.minimum(*rows), np.minimum(*columns))  # the second and third of four
    middle = 0.5 * (lower + np.minimum(np.maximum(*rows), np.maximum(*columns)))
    steepest = _UNEVEN * float(np.exp(0.5 / (sigma_px**2 + 1.0 / 12.0)))  # with the pixel's own width
    above = np.zeros(image.shape, dtype=np.float32)  # what a star beside such neighbours leaves
    above[1:-1, 1:-1] = height[1:-1, 1:-1] - steepest * np.maximum(middle, 0.0)
    hot = above > CLIP_SIGMA * noise  # as are by chance one good pixel in 700
    bad = hot | (height < -NEVER_SIGMA * noise)
    clean = image.copy()
    clean[1:-1, 1:-1][bad[1:-1, 1:-1]] = (middle + level[1:-1, 1:-1])[bad[1:-1, 1:-1]]
    return clean, background.without(bad), int(np.count_nonzero(above > NEVER_SIGMA * noise))
