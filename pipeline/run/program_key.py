"""The program that makes a result: its sources, and the versions of the libraries whose numbers enter."""

from __future__ import annotations

from functools import cache
from importlib import metadata

import cv2
import pyproj
import rasterio

from boresight.pipeline import __version__
from boresight.pipeline.run.digests import digest, numerical_versions, sources_of

__all__ = ["library_versions", "program_digest"]


@cache
def program_digest(*modules: str) -> str:
    """Version of the program, and a digest of everything installed that results of `modules` depend on.

    These are the sources of the modules and of all that they import from the same package, the data files
    beside these, and the versions of the libraries. A package's name stands for all modules in it.
    """
    return f"{__version__} {digest(sources_of(*modules), library_versions())}"


@cache
def library_versions() -> dict[str, str]:
    """Versions of Python and of the libraries whose numbers enter the results."""
    linked = {"opencv": cv2.__version__, "rasterio": rasterio.__version__, "gdal": rasterio.__gdal_version__}
    linked |= {"pyproj": pyproj.__version__, "proj": pyproj.proj_version_str}
    others = {name: metadata.version(name) for name in ("astropy", "astropy-iers-data", "scikit-image")}
    return numerical_versions() | linked | others
