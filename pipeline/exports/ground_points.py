"""Targets as they were found in a strip: the record that the three formats of ground control points share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["GroundPoints"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GroundPoints:
    """Targets in the raw image of one CCD of one strip. Row n of every array speaks of the same sighting."""

    strip_id: str
    ccd: int
    image: str  # file name of the raw image
    target_id: tuple[str, ...]
    lat_deg: Array  # (N,) WGS84
    lon_deg: Array  # (N,)
    height_m: Array  # (N,) above the WGS84 ellipsoid
    xy_px: Array  # (N, 2) (sample, line), (0, 0) is the centre of the first pixel
    sigma_px: Array  # (N, 2) 1-sigma of xy_px
    used: NDArray[np.bool_]  # (N,) False: rejected by the calibration

    def __post_init__(self) -> None:
        n = len(self.target_id)
        shapes = {
            "lat_deg": (n,),
            "lon_deg": (n,),
            "height_m": (n,),
            "xy_px": (n, 2),
            "sigma_px": (n, 2),
            "used": (n,),
        }
        for name, shape in shapes.items():
            if (got := np.shape(getattr(self, name))) != shape:
                raise ValueError(f"GroundPoints.{name} must have shape {shape}, got {got}")
