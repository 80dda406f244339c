"""Ortho-images and height models as users have them: any raster with a map that rasterio reads (GeoTIFF, COG,
VRT), of one or several bands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup
from rasterio.errors import RasterioError

from boresight.geometry.geoid import egm96
from boresight.geometry.record import Bools, Floats, array, record, scalar
from boresight.geometry.terrain import Surface, TerrainGrid
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import check_extent
from boresight.pipeline.files.images.image_file import open_image
from boresight.pipeline.files.xml_files import read_xml

__all__ = ["HeightModel", "Ortho", "band_count", "read_heights", "read_ortho"]

# Most pixels of an ortho-image that is read at once; larger ones are to be cut.
MAX_PIXELS = 20_000 * 20_000
GREY_BANDS = 3  # of a colour image: their mean; a fourth band is infrared or transparency
# Option of GDAL: no name is fetched from the network.
_OFFLINE = {"CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none"}
_LISTS = (b"<", b"{")  # first bytes of files that name others: XML, JSON
_SOURCES = ("SourceFilename", "SourceDataset", "SourceRaster")  # of a VRT
VERTICAL = {"egm2008": "EPSG:9518"}  # WGS84 with heights above the geoid


@record
class Ortho:
    """An ortho-image in grey values."""

    file: str = scalar("its path")
    values: NDArray[np.float32] = array("H, W", "grey values, 0 where not valid")
    valid: Bools = array("H, W", "False without data")
    transform: tuple[float, float, float, float, float, float] = array("6", "of pixel corners")
    crs: str = scalar("WKT of its map")


@record
class HeightModel:
    """Heights of one or several rasters; the first that covers a point gives its height."""

    grids: tuple[Surface, ...] = scalar("heights as the files have them, one grid a file")
    kind: str = scalar("ellipsoidal, egm96 or egm2008")
    files: tuple[str, ...] = scalar("paths of the rasters", default=())

    def stated(self, lat_deg: Floats, lon_deg: Floats) -> tuple[Floats, str]:
        """Heights (N,) of points (N,) and their kind as targets.csv has it; NaN where no raster covers."""
        lat, lon = np.radians(lat_deg), np.radians(lon_deg)
        height: Floats = np.full(len(lat), np.nan)
        for grid in self.grids:
            height = np.where(np.isnan(height), grid.height_m(lat, lon), height)
        if self.kind not in VERTICAL:
            return height, self.kind
        to_ellipsoid = Transformer.from_crs(VERTICAL[self.kind], "EPSG:4979", always_xy=True)
        return np.asarray(to_ellipsoid.transform(lon_deg, lat_deg, height)[2]), "ellipsoidal"

    def ellipsoidal(self, lat_deg: Floats, lon_deg: Floats) -> Floats:
        """Heights (N,) above the ellipsoid."""
        height, kind = self.stated(lat_deg, lon_deg)
        lat, lon = np.radians(lat_deg), np.radians(lon_deg)
        return height + egm96().undulation_m(lat, lon) if kind == "egm96" else height


def read_ortho(path: Path, band: int | None = None) -> Ortho:
    """An ortho-image: its `band` (from 1), or the mean of its first three bands; `RawDataError` if none."""
    values, valid, transform, crs = _read(path, band, GREY_BANDS)
    return Ortho(str(path), np.where(valid, values, 0.0).astype(np.float32), valid, transform, crs)


def band_count(path: Path) -> int:
    """Number of bands of a raster; `RawDataError` or `RasterioError` if it cannot be read."""
    driver = _driver_of(path, str(path))
    with rasterio.Env(**_OFFLINE), rasterio.open(path.resolve(), driver=driver) as image:
        return int(image.count)


def read_heights(paths: list[Path], kind: str) -> HeightModel:
    """The height model of DEMs. `RawDataError` if a file is unusable or the geoid's grid is not there."""
    if kind in VERTICAL and not TransformerGroup(VERTICAL[kind], "EPSG:4979").best_available:
        expected = "a PROJ grid of that geoid (`pyproj sync --file us_nga_egm08`), or other heights"
        raise RawDataError("--heights", kind, "no grid of it is installed", expected)
    grids = []
    for path in paths:
        values, valid, transform, crs = _read(path, 1, 1)
        heights = np.where(valid, values, np.nan)
        try:
            grids.append(TerrainGrid.from_raster(heights, transform, crs, None))
        except ValueError as error:
            raise RawDataError(str(path), "heights", str(error), "a grid of heights") from error
    return HeightModel(tuple(grids), kind, tuple(map(str, paths)))


def _driver_of(path: Path, file: str) -> str | None:
    """GDAL's driver of a raster, None for any that reads pixels. `RawDataError` for a list of addresses, and
    for a VRT with code or of anything but files of pixels of this machine.
    """
    if not (head := open_image(path, file, whole=False).head.lstrip()).startswith(_LISTS):
        return None
    root = read_xml(path, file) if head.startswith(b"<") else None
    if root is None or root.tag != "VRTDataset":
        raise RawDataError(file, "byte 0", head[:16].decode("ascii", "replace"), "a GeoTIFF, COG or VRT")
    for element in root.iter():
        if element.tag.startswith("PixelFunction"):
            raise RawDataError(file, element.tag, "code", "a VRT without functions of its own")
        if element.tag in _SOURCES:
            name = (element.text or "").strip()
            folder = path.resolve().parent if element.get("relativeToVRT") == "1" else Path()
            source = open_image(folder / name, f"{file}: {name}", whole=False)
            if source.head.startswith(_LISTS):
                raise RawDataError(file, element.tag, f"{name}, a list of others", "a file of pixels")
    return "VRT"


def _read(
    path: Path, band: int | None, most: int
) -> tuple[NDArray[np.float32], Bools, tuple[float, float, float, float, float, float], str]:
    """Mean of bands, validity, transform and CRS of a raster with a map."""
    file = str(path)
    driver = _driver_of(path, file)
    try:
        with rasterio.Env(**_OFFLINE), rasterio.open(path.resolve(), driver=driver) as image:
            bands = [band] if band is not None else list(range(1, min(image.count, most) + 1))
            size = image.width, image.height, len(bands)
            check_extent(file, "image size", size, MAX_PIXELS, "px (cut larger images into parts)")
            if band is not None and not 1 <= band <= image.count:
                raise RawDataError(file, "--band", str(band), f"1 to {image.count}")
            if image.crs is None or image.transform.is_identity:
                expected = "a raster with coordinate reference system and affine transform"
                raise RawDataError(file, "map", "none", expected)
            values = image.read(bands, out_dtype="float32").mean(axis=0)
            valid = (image.dataset_mask() > 0) & np.isfinite(values)
            crs, t = image.crs.to_wkt(), tuple(float(v) for v in image.transform)[:6]
    except (RasterioError, OSError) as error:
        reason = str(error).split("\n")[0]
        raise RawDataError(file, "file", reason, "a GeoTIFF, COG or VRT that can be read") from error
    try:
        CRS.from_wkt(crs)
    except ProjError as error:
        raise RawDataError(file, "coordinate reference system", "unknown to PROJ", "a known one") from error
    if not valid.any():
        raise RawDataError(file, "pixels", "none that is valid", "at least one valid pixel")
    return values, valid, (t[0], t[1], t[2], t[3], t[4], t[5]), crs
