"""Unit vectors of angles on the sphere: right ascension and declination, or longitude and latitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["unit_vectors"]


def unit_vectors(longitude_rad: ArrayLike, latitude_rad: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors (..., 3) at longitude and latitude (...), or at right ascension and declination."""
    lon, lat = np.asarray(longitude_rad, float), np.asarray(latitude_rad, float)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
