"""GeoTIFF files of given pixels."""

from pathlib import Path

import numpy as np
import rasterio


def write_raster(path: Path, pixels: np.ndarray, **profile: object) -> Path:
    """Write pixels (rows, columns) or (bands, rows, columns) as a TIFF; `profile` as rasterio takes it."""
    bands = pixels[None] if pixels.ndim == 2 else pixels
    count, height, width = bands.shape
    form = {"driver": "GTiff", "count": count, "height": height, "width": width, "dtype": bands.dtype.name}
    with rasterio.open(path, "w", **form | profile) as file:
        file.write(bands)
    return path
