"""Fractal relief: orthometric heights of an invented landscape on a grid of latitude and longitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boresight.simulator.lattice_noise import smooth_noise
from boresight.simulator.scenario import TerrainSettings

__all__ = ["relief_grid"]

Array = NDArray[np.float64]
Affine = tuple[float, float, float, float, float, float]

# Kilometres a degree on a sphere of 6371 km: scales the relief, whose size need not be exact.
_KM_PER_DEGREE = 111.2


def relief_grid(boxes_deg: Array, settings: TerrainSettings, key: int) -> tuple[NDArray[np.float32], Affine]:
    """Heights (rows, columns), m, north-up, and the affine of pixel corners in degrees, as rasterio has it.

    `boxes_deg` (B, 4) are the places of interest, south, west, north, east; the grid reaches around all of
    them, and is NaN outside every one.
    """
    step = settings.spacing_arcsec / 3600.0
    west, north = np.floor(boxes_deg[:, 1].min() / step), np.ceil(boxes_deg[:, 2].max() / step)
    columns = int(np.ceil(boxes_deg[:, 3].max() / step) - west) + 1
    rows = int(north - np.floor(boxes_deg[:, 0].min() / step)) + 1
    heights = np.full((rows, columns), np.nan, np.float32)
    for south_deg, west_deg, north_deg, east_deg in boxes_deg:
        top, bottom = int(north - np.ceil(north_deg / step)), int(north - np.floor(south_deg / step)) + 1
        left, right = int(np.floor(west_deg / step) - west), int(np.ceil(east_deg / step) - west) + 1
        lat = (north - np.arange(top, bottom) - 0.5) * step
        lon = (west + np.arange(left, right) + 0.5) * step
        x, y = np.meshgrid(lon, lat)
        heights[top:bottom, left:right] = _heights(x, y, settings, key)
    return heights, (step, 0.0, float(west * step), 0.0, -step, float(north * step))


def _heights(lon_deg: Array, lat_deg: Array, settings: TerrainSettings, key: int) -> Array:
    x, y = lon_deg * _KM_PER_DEGREE / settings.feature_km, lat_deg * _KM_PER_DEGREE / settings.feature_km
    finest = settings.spacing_arcsec / 3600.0 * _KM_PER_DEGREE * 2.0
    octaves = max(1, int(np.log2(settings.feature_km / finest)) + 1)
    strength = settings.roughness ** np.arange(octaves)
    total = np.zeros_like(x)
    for n in range(octaves):
        total += strength[n] * smooth_noise(x * 2.0**n, y * 2.0**n, key + n)
    rms_of_noise = 0.4  # of one octave of value noise
    return settings.mean_m + settings.relief_m * total / (rms_of_noise * np.sqrt((strength**2).sum()))
