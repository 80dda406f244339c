"""Georeferenced rasters: chips, terrain models and ground images, GeoTIFF files with a map."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent
from boresight.pipeline.files.images.image_file import open_image
from boresight.pipeline.files.images.tiff import open_tiff, tiff_window
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["GridPlace", "grid_place", "read_grid"]

PIXEL_SIDE_M = (0.01, 1e5)  # of a chip, terrain model or ground image; 1e-5 m would be a wrong unit
# Mean radius of the Earth, m: turns pixels in degrees into metres where only their size matters.
EARTH_RADIUS_M = 6.371e6
MAX_COORDINATE = 1e9  # of a map, in its unit

Affinity = tuple[float, float, float, float, float, float]


@record
class GridImage:
    """A georeferenced raster."""

    values: NDArray[np.float32] = array("H, W", "NaN where the file has no data")
    transform: Affinity = scalar("(a, b, c, d, e, f): x = a column + b row + c")
    crs: str = scalar("coordinate reference system as WKT")


def read_grid(path: Path, file: str, *, max_pixels: int, first_band: bool = False) -> GridImage:
    """A GeoTIFF with CRS and transform: a chip or a terrain model. `RawDataError` if it is none.

    It must have one band; with `first_band` the first of several is read.
    """
    with open_tiff(open_image(path, file, whole=False)) as image:
        check_extent(file, "image size", (image.width, image.height), max_pixels, "px")
        if image.count != 1 and not first_band:
            raise RawDataError(file, "bands", str(image.count), "1")
        if image.dtypes[0] not in ("uint8", "uint16", "int16", "float32", "float64"):
            raise RawDataError(file, "bit depth", str(image.dtypes[0]), "8 or 16 bits or floating point")
        if image.crs is None:
            raise RawDataError(file, "coordinate reference system", "none", "a GeoTIFF with a CRS")
        if (
            image.transform.is_identity
            or image.transform.determinant == 0
            or not np.isfinite(tuple(image.transform)).all()
        ):
            raise RawDataError(file, "transform", "none", "a GeoTIFF with an affine transform")
        raw = tiff_window(image, file, Window(0, 0, image.width, image.height))
        with np.errstate(over="ignore"):  # beyond 3e38 becomes infinite, which is no value
            values = raw.astype(np.float32, copy=False)
        if image.nodata is not None and np.isfinite(image.nodata):
            values[raw == image.nodata] = np.nan
        valid = np.isfinite(values)
        if not valid.any():
            raise RawDataError(file, "pixels", "none that is valid", "at least one valid pixel")
        if not valid.all():
            values[~valid] = np.nan
        wkt = _map_of(image, file)
        _check_transform(image.transform, CRS.from_user_input(wkt), file)
        a, b, c, d, e, f = (float(v) for v in tuple(image.transform)[:6])
        return GridImage(values, (a, b, c, d, e, f), wkt)


@record
class GridPlace:
    """Where a georeferenced raster lies, by its header."""

    shape: tuple[int, int] = scalar("rows, columns")
    transform: Affinity = scalar("as of `GridImage`")
    crs: str = scalar("coordinate reference system as WKT")

    @property
    def side_m(self) -> float:
        """Length of the image's shorter side on the ground, m."""
        return min(self.shape) * _pixel_side_m(Affine(*self.transform), CRS.from_user_input(self.crs))

    def contains(self, places_deg: Floats) -> Bools:
        """Which places (N, 2), latitude and longitude in °, lie in it."""
        lat, lon = np.vstack([places_deg, places_deg[-1:]]).T  # of one-element arrays pyproj warns
        to_map = Transformer.from_crs(CRS.from_epsg(4326), CRS.from_user_input(self.crs), always_xy=True)
        a, b, c, d, e, f = self.transform
        inverse = np.linalg.inv(np.array([[a, b], [d, e]]))
        with np.errstate(invalid="ignore"):  # infinite where the map does not reach
            xy = (np.column_stack(to_map.transform(lon, lat)) - [c, f]) @ inverse.T
        return np.asarray(((xy >= 0.0) & (xy <= self.shape[::-1])).all(axis=1))[:-1]

    @property
    def middle_deg(self) -> tuple[float, float]:
        """Latitude and longitude of its middle, °; not finite where the map has none."""
        rows, columns = self.shape
        to_degrees = Transformer.from_crs(CRS.from_user_input(self.crs), CRS.from_epsg(4326), always_xy=True)
        lon, lat = to_degrees.transform(*(Affine(*self.transform) @ (0.5 * columns, 0.5 * rows)))
        return float(lat), float(lon)


def grid_place(path: Path, file: str) -> GridPlace:
    """Where a georeferenced raster lies; only its header is read. `RawDataError` if it is none."""
    with open_tiff(open_image(path, file, whole=False)) as image:
        if image.crs is None:
            raise RawDataError(file, "coordinate reference system", "none", "a GeoTIFF with a CRS")
        a, b, c, d, e, f = (float(v) for v in tuple(image.transform)[:6])
        return GridPlace((image.height, image.width), (a, b, c, d, e, f), _map_of(image, file))


def _check_transform(transform: Any, crs: CRS, file: str) -> None:
    """`RawDataError` unless a pixel's side lies within `PIXEL_SIDE_M` and its coordinates on any map."""
    if not PIXEL_SIDE_M[0] <= (side := _pixel_side_m(transform, crs)) <= PIXEL_SIDE_M[1]:
        expected = f"{PIXEL_SIDE_M[0]:g} m to {PIXEL_SIDE_M[1]:g} m"
        raise RawDataError(file, "transform", f"pixels of {side:.3g} m", expected)
    if (largest := max(map(abs, transform))) > MAX_COORDINATE:
        raise RawDataError(file, "transform", f"{largest:g}", f"coordinates below {MAX_COORDINATE:g}")


def _pixel_side_m(transform: Any, crs: CRS) -> float:
    unit = crs.axis_info[0].unit_conversion_factor * (EARTH_RADIUS_M if crs.is_geographic else 1.0)
    return float(abs(transform.determinant) ** 0.5 * unit)


def _map_of(image: Any, file: str) -> str:
    """WKT of an image's CRS, which must convert from latitude and longitude."""
    expected = "one to which latitude and longitude can be converted"
    with refusing(file, "coordinate reference system", expected, (RasterioError, ProjError)):
        wkt = str(image.crs.to_wkt())
        _check_map(wkt)
    return wkt


@lru_cache(maxsize=64)
def _check_map(wkt: str) -> None:
    """`ProjError` for a CRS to which latitude and longitude cannot be converted."""
    Transformer.from_crs(CRS.from_epsg(4326), CRS.from_user_input(wkt), always_xy=True)
