"""Ortho-images and height models as users have them: any raster with a map that rasterio reads (GeoTIFF, COG,
VRT), of one or several bands, read by window. In a store (`https://`, `s3://`) it is a GeoTIFF.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.warp import reproject
from rasterio.windows import Window

from boresight.geometry.geoid import egm96
from boresight.geometry.terrain import Surface, TerrainGrid
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent
from boresight.pipeline.files.images.image_file import open_image
from boresight.pipeline.files.images.tiff import open_tiff
from boresight.pipeline.files.object_store import StoredPath
from boresight.pipeline.files.xml_files import read_xml
from boresight.records.record import Floats, array, record, scalar

__all__ = [
    "HeightModel",
    "RasterFile",
    "RasterWindow",
    "band_count",
    "map_to_map",
    "mapped",
    "open_raster",
    "read_heights",
]

# Most pixels of a height model that is read at once; larger ones are to be cut.
MAX_PIXELS = 20_000 * 20_000
GREY_BANDS = 3  # of a colour image: their mean; a fourth band is infrared or transparency
OUTLINE = 9  # points of each side of a window that are taken to another map
SPARE_PX = 4  # read around a window that is resampled
# Option of GDAL: no name is fetched from the network.
_OFFLINE = {"CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none"}
_LISTS = (b"<", b"{")  # first bytes of files that name others: XML, JSON
_SOURCES = ("SourceFilename", "SourceDataset", "SourceRaster")  # of a VRT
VERTICAL = {"egm2008": "EPSG:9518"}  # WGS84 with heights above the geoid

Transform = tuple[float, float, float, float, float, float]


@record
class RasterWindow:
    """A part of a raster: grey values of an image, or heights."""

    values: NDArray[np.float32] = array("H, W", "NaN without data, or in a cloud of its mask")
    transform: Transform = array("6", "of pixel corners")
    crs: str = scalar("WKT of its map")


@record(kw_only=True)
class RasterFile:
    """A raster with a map, of which windows are read."""

    path: Path = scalar("of the file; a `StoredPath` in a store")
    shape: tuple[int, int] = scalar("rows, columns")
    transform: Transform = array("6", "of pixel corners")
    crs: str = scalar("WKT of its map")
    bands: tuple[int, ...] = scalar("whose mean is taken, from 1")
    day: str = scalar("of the image, ISO 8601; empty: not known, and another than of all others", default="")
    clouds: RasterFile | None = scalar("its mask of clouds", default=None)
    cloudy: tuple[int, ...] = scalar("values of that mask in clouds", default=())
    cloudy_bits: int = scalar("bits of that mask of which any is set in clouds", default=0)

    @property
    def label(self) -> str:
        """The day; where it is not known, the file's name without its ending."""
        return self.day or self.path.stem

    def window(self, left: int, top: int, width: int, height: int, step: int = 1) -> RasterWindow:
        """Pixels of a window, or means over `step`² of them; `RawDataError` where they cannot be read."""
        inside, shape = Window(left, top, width, height), (-(-height // step), -(-width // step))
        how = Resampling.average if step > 1 else Resampling.nearest
        with _opened(self.path) as image, _read_errors(self.path):
            asked = {"window": inside, "resampling": how, "out_dtype": "float32"}
            planes = image.read(list(self.bands), out_shape=(len(self.bands), *shape), **asked)
            mask = image.dataset_mask(window=inside, out_shape=shape)
        values = planes.mean(axis=0)
        values[(mask == 0) | ~np.isfinite(values)] = np.nan
        a, b, _, d, e, _ = self.transform
        c, f = mapped(self.transform, left, top)
        u, v = width / shape[1], height / shape[0]
        part = RasterWindow(values, (a * u, b * v, float(c), d * u, e * v, float(f)), self.crs)
        if self.clouds is not None:
            state = self.clouds.resampled(part, Resampling.nearest).values
            known = np.nan_to_num(state).astype(np.int64)
            values[np.isnan(state) | np.isin(known, self.cloudy) | (known & self.cloudy_bits != 0)] = np.nan
        return part

    def resampled(self, like: RasterWindow, how: Resampling = Resampling.cubic) -> RasterWindow:
        """The raster on the pixels of another; NaN where it does not show that ground."""
        there = RasterWindow(np.full_like(like.values, np.nan), like.transform, like.crs)
        rows, columns = like.values.shape
        u, v = np.meshgrid(np.linspace(0, columns, OUTLINE), np.linspace(0, rows, OUTLINE))
        x, y = map_to_map(like.crs, self.crs).transform(*mapped(like.transform, u, v))
        own = np.array(mapped(tuple(~Affine(*self.transform))[:6], x, y))
        if not np.isfinite(own).all():
            return there
        low = np.maximum(own.min(axis=(1, 2)).astype(int) - SPARE_PX, 0)
        high = np.minimum(own.max(axis=(1, 2)).astype(int) + SPARE_PX, self.shape[::-1])
        if (high <= low).any():
            return there
        finer = float(np.prod(np.ptp(own, axis=(1, 2)) / (columns, rows)))  # own pixels in one of the other
        step = max(1, int(finer**0.5)) if how is Resampling.cubic else 1
        (left, top), (width, height) = low.tolist(), (high - low).tolist()
        part = self.window(left, top, width, height, step)
        reproject(
            part.values,
            there.values,
            src_transform=Affine(*part.transform),
            src_crs=part.crs,
            src_nodata=np.nan,
            dst_transform=Affine(*there.transform),
            dst_crs=there.crs,
            dst_nodata=np.nan,
            resampling=how,
        )
        return there


def mapped(transform: Transform, column: Any, row: Any) -> tuple[Any, Any]:
    """Coordinates of points by a transform of pixel corners."""
    a, b, c, d, e, f = transform
    return a * column + b * row + c, d * column + e * row + f


@lru_cache(maxsize=64)
def map_to_map(one: str, other: str) -> Transformer:
    """From the coordinates of a map to those of another."""
    return Transformer.from_crs(CRS.from_user_input(one), CRS.from_user_input(other), always_xy=True)


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


def open_raster(path: Path, band: int | None = None, day: str = "") -> RasterFile:
    """A raster: its `band` (from 1), or the mean of its first three; `RawDataError` if it has no map."""
    with _opened(path) as image:
        if band is not None and not 1 <= band <= image.count:
            raise RawDataError(str(path), "--band", str(band), f"1 to {image.count}")
        bands = (band,) if band is not None else tuple(range(1, min(image.count, GREY_BANDS) + 1))
        transform, crs = _map_of(image, str(path))
        return RasterFile(path=path, shape=image.shape, transform=transform, crs=crs, bands=bands, day=day)


def band_count(path: Path) -> int:
    """Number of bands of a raster; `RawDataError` if it cannot be read."""
    with _opened(path) as image:
        return int(image.count)


def read_heights(paths: list[Path], kind: str) -> HeightModel:
    """The height model of DEMs. `RawDataError` if a file is unusable or the geoid's grid is not there."""
    if kind in VERTICAL and not TransformerGroup(VERTICAL[kind], "EPSG:4979").best_available:
        expected = "a PROJ grid of that geoid (`pyproj sync --file us_nga_egm08`), or other heights"
        raise RawDataError("--heights", kind, "no grid of it is installed", expected)
    grids = []
    for path in paths:
        file = open_raster(path, 1)
        rows, columns = file.shape
        size = columns, rows, 1
        check_extent(str(path), "image size", size, MAX_PIXELS, "px (cut larger images into parts)")
        whole = file.window(0, 0, columns, rows)
        if np.isnan(whole.values).all():
            raise RawDataError(str(path), "pixels", "none that is valid", "at least one valid pixel")
        with refusing(str(path), "heights", "a grid of heights"):
            grids.append(TerrainGrid.from_raster(whole.values, file.transform, file.crs, None))
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


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A raster opened by rasterio; `RawDataError` if it cannot be."""
    if isinstance(path, StoredPath):
        with open_tiff(open_image(path, str(path), whole=False)) as image:
            yield image
        return
    driver = _driver_of(path, str(path))
    with rasterio.Env(**_OFFLINE):
        with _read_errors(path):
            image = rasterio.open(path.resolve(), driver=driver)
        with image:
            yield image


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """`RawDataError` in place of what rasterio raises."""
    try:
        yield
    except (RasterioError, OSError) as error:
        reason = str(error).split("\n")[0]
        raise RawDataError(str(path), "file", reason, "a GeoTIFF, COG or VRT that can be read") from error


def _map_of(image: Any, file: str) -> tuple[Transform, str]:
    """Transform and WKT of a raster with a map; `RawDataError` if it has none."""
    if image.crs is None or image.transform.is_identity or image.transform.determinant == 0:
        expected = "a raster with coordinate reference system and affine transform"
        raise RawDataError(file, "map", "none", expected)
    with refusing(file, "coordinate reference system", "a known one", ProjError, found="unknown to PROJ"):
        CRS.from_wkt(crs := image.crs.to_wkt())
    a, b, c, d, e, f = (float(v) for v in tuple(image.transform)[:6])
    return (a, b, c, d, e, f), crs
