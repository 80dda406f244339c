"""Square cut-outs of an image around stars, with the sky's level taken away and full pixels marked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.finding.background import Background

__all__ = ["StarWindows", "star_windows", "windows_at"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StarWindows:
    """Windows of side 2 radius + 1, their pixels in one row of M."""

    corner: NDArray[np.int64]  # (N, 2) first pixel, column and row
    radius: int
    data: NDArray[np.float32]  # (N, M) DN above the sky's level
    good: NDArray[np.float32]  # (N, M) 1, or 0 for pixels that must not count
    noise2: Array  # (N,) variance of a pixel of sky
    saturated: NDArray[np.bool_]  # (N,) some pixel is at the top of the range

    def take(self, index: NDArray) -> StarWindows:
        names = ("corner", "data", "good", "noise2", "saturated")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def offsets(self, xy_px: Array) -> Array:
        """(N, 2) places in the image as seen from the windows' middles."""
        return np.asarray(xy_px - self.corner - self.radius, dtype=np.float64)


def windows_at(image: NDArray, corners: NDArray[np.int64], side: int) -> NDArray:
    """Square cut-outs (N, side, side) whose first pixels (column, row) are `corners`, which must lie
    inside."""
    height, width = image.shape
    image = np.ascontiguousarray(image)
    row, pixel = image.strides
    shape = ((height - side) * width + width - side + 1, side, side)
    every = np.lib.stride_tricks.as_strided(image, shape, (pixel, row, pixel), writeable=False)
    return np.asarray(every[corners[:, 1] * width + corners[:, 0]])


def star_windows(
    image: NDArray, places: NDArray[np.int64], background: Background, radius: int, saturation_dn: float
) -> StarWindows:
    """Windows with `places` (N, 2) in their middles, or beside them at the image's edge."""
    height, width = image.shape
    side = 2 * radius + 1
    corner = np.clip(places - radius, 0, [width - side, height - side])
    raw = windows_at(image, corner, side)
    level, noise = background.at(places.astype(float))
    full = raw >= saturation_dn
    saturated = np.asarray(full.any(axis=(1, 2)))
    good = np.ones(raw.shape, dtype=np.float32)
    if saturated.any():
        good[full] = 0.0
        arms = full & _bloomed(full)[:, None, None]
        good[:, 1:][arms[:, :-1]] = 0.0  # a bloom ends in a pixel that is not full, and not the star's alone
        good[:, :-1][arms[:, 1:]] = 0.0
    n = len(raw)
    data = raw.reshape(n, side * side) - level[:, None].astype(np.float32)
    return StarWindows(corner, radius, data, good.reshape(n, side * side), noise**2, saturated)


def _bloomed(full: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) whether the full pixels (N, side, side) stand more than one row higher than they are wide: charge
    ran over."""
    return np.asarray(full.any(axis=2).sum(axis=1) > full.any(axis=1).sum(axis=1) + 1)
