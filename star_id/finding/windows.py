"""Square windows of an image around stars, background subtracted and saturated pixels masked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.finding.background import Background

__all__ = ["AT_ONCE", "NINE", "StarWindows", "star_windows", "windows_at"]

# Windows worked on at a time, so that they stay in the processor's cache.
AT_ONCE = 128
# A pixel and the eight around it: twice, those up to 2 px away.
NINE = np.ones((3, 3), np.uint8)


@record(kw_only=True)
class StarWindows:
    """Windows of side 2 radius + 1 around N stars, each as one row of M pixels."""

    corner: Ints = array("N, 2", "first pixel as (column, row)")
    radius: int = scalar("pixels from the middle to the edge")
    data: NDArray[np.float32] = array("N, M", "above the background, DN")
    good: NDArray[np.float32] = array("N, M", "weight, 1 where all pixels are alike; 0 for masked pixels")
    noise2: Floats = array("N", "variance of a pixel without the star's photons, DN^2")
    rounding2: float = scalar("part of it that pixels of the sky do not have, DN^2", default=0.0)
    saturated: Bools = array("N", "whether some pixel is saturated")
    above_cut: Floats | None = array(
        "N", "sigmas from the least value up to the sky; None: nothing of it is cut off", default=None
    )

    def take(self, index: NDArray[Any]) -> StarWindows:
        """The windows at indices (M,) or of a mask (N,)."""
        names = ("corner", "data", "good", "noise2", "saturated")
        above = None if self.above_cut is None else self.above_cut[index]
        return replace(self, above_cut=above, **{name: getattr(self, name)[index] for name in names})

    @property
    def sky2(self) -> Floats:
        """(N,) variances of a pixel of the sky, DN^2."""
        return self.noise2 - self.rounding2

    @property
    def middles(self) -> Ints:
        """(N, 2) pixels of the image in the middles of the windows."""
        return self.corner + self.radius

    def offsets(self, xy_px: Floats) -> Floats:
        """Pixels (N, 2) of the image relative to the middles of the windows."""
        return np.asarray(xy_px - self.middles, dtype=np.float64)


def windows_at(image: NDArray[Any], corners: Ints, side: int) -> NDArray[Any]:
    """Cut-outs (N, side, side) whose first pixels (column, row) are `corners` (N, 2), all inside the
    image."""
    height, width = image.shape
    image = np.ascontiguousarray(image)
    row, pixel = image.strides
    shape = ((height - side) * width + width - side + 1, side, side)
    every = np.lib.stride_tricks.as_strided(image, shape, (pixel, row, pixel), writeable=False)
    return np.asarray(every[corners[:, 1] * width + corners[:, 0]])


def star_windows(
    image: NDArray[Any], pixels: Ints, background: Background, radius: int, saturation_dn: float
) -> StarWindows:
    """Windows centred on `pixels` (N, 2), shifted inwards at the image's edges, no larger than the image."""
    height, width = image.shape
    radius = min(radius, (min(image.shape) - 1) // 2)
    side = 2 * radius + 1
    corner = np.clip(pixels - radius, 0, [width - side, height - side])
    raw = windows_at(image, corner, side)
    level, noise = background.at(pixels.astype(float))
    full = raw >= saturation_dn
    saturated = np.asarray(full.any(axis=(1, 2)))
    good = np.ones(raw.shape, dtype=np.float32)
    if background.weights is not None:
        row, column = np.indices((side, side)) % 2
        x, y = (corner % 2).T[:, :, None, None]
        good *= background.weights.astype(np.float32)[(row + y) % 2, (column + x) % 2]
    if background.unusable is not None:
        good *= ~windows_at(background.unusable, corner, side)
    rows = saturated.nonzero()[0]
    if len(rows):
        good[rows] *= _unsaturated(full[rows])
    n = len(raw)
    along_x, along_y = background.slope_dn
    away = np.arange(-radius, radius + 1.0)
    plane = (along_x * away + along_y * away[:, None]).ravel()
    data = raw.reshape(n, side * side) - (level[:, None] + plane).astype(np.float32)
    return StarWindows(
        corner=corner,
        radius=radius,
        data=data,
        good=good.reshape(n, side * side),
        noise2=noise**2 + background.rounding_dn**2,
        rounding2=background.rounding_dn**2,
        saturated=saturated,
        above_cut=background.above_cut_at(pixels.astype(float)),
    )


def _unsaturated(full: Bools) -> NDArray[np.float32]:
    """(N, side, side) 0 in saturated pixels and beside the ends of blooms, where the charge is not the star's
    alone; else 1. A star blooms whose saturated pixels are at least two pixels higher than wide."""
    bloomed = full.any(axis=2).sum(axis=1) > full.any(axis=1).sum(axis=1) + 1
    arms, lost = full & bloomed[:, None, None], full.copy()
    lost[:, 1:] |= arms[:, :-1]
    lost[:, :-1] |= arms[:, 1:]
    return np.asarray(~lost, dtype=np.float32)
