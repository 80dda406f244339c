"""Write TIFF files of one band, georeferenced or not: strips, chips, terrain."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

__all__ = ["TILES", "tiff_opened", "write_tiff"]

TILES = {"tiled": True, "blockxsize": 256, "blockysize": 256}  # options of images that are read by window


@contextmanager
def tiff_opened(path: Path, shape: tuple[int, int], kind: str, **options: Any) -> Iterator[Any]:
    """A new file of (lines, samples) of a NumPy type, to be written by windows; `options` are GDAL's."""
    profile = {"driver": "GTiff", "height": shape[0], "width": shape[1], "count": 1, "dtype": kind}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile, **options) as image:
            yield image


def write_tiff(path: Path, pixels: NDArray[Any], **options: Any) -> None:
    """Write an image (lines, samples), deflated unless `options` say otherwise."""
    lines, samples = pixels.shape
    how = {"compress": "deflate"} | options
    with tiff_opened(path, (lines, samples), pixels.dtype.name, **how) as image:
        image.write(pixels, 1)
