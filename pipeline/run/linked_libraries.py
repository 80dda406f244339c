"""Versions of the libraries in C that read and resample images, as they state them themselves."""

from __future__ import annotations

import cv2
import pyproj
import rasterio

__all__ = ["linked_versions"]


def linked_versions() -> dict[str, str]:
    """Versions of OpenCV, GDAL and PROJ, and of the packages that bring the last two."""
    named = {"opencv": cv2.__version__, "rasterio": rasterio.__version__, "gdal": rasterio.__gdal_version__}
    return named | {"pyproj": pyproj.__version__, "proj": pyproj.proj_version_str}
