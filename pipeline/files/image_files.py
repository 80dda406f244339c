"""Read TIFF files: chips and star images whole, strips and terrain by window.

Size and bit depth are checked in the header before a pixel is decoded. An image that cannot be used raises
`RawDataError`; the caller decides whether that stops the run. TIFF files are opened by GDAL's GeoTIFF driver
only, without sidecar files and without network.
"""

from __future__ import annotations

import io
import warnings
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import Compression, Interleaving
from rasterio.errors import RasterioError, RasterioIOError
from rasterio.io import MemoryFile
from rasterio.transform import Affine
from rasterio.windows import Window

from boresight.geometry.record import Bools, Floats, array, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import open_regular, small_content
from boresight.pipeline.files.image_heads import TIFF_MAGICS, check_photometric, check_size, first_bytes
from boresight.pipeline.files.object_store import StoredPath

__all__ = [
    "GridImage",
    "GridPlace",
    "StripFiles",
    "grid_place",
    "open_geotiff",
    "read_grid",
    "read_planes",
    "read_tiff",
]

MAX_BLOCK_BYTES = 2**29  # a row of tiles or a strip of a TIFF is decoded as a whole
PIXEL_SIDE_M = (0.01, 1e5)  # of a chip, terrain model or ground image; 1e-5 m would be a wrong unit
# Mean radius of the Earth, m: turns pixels in degrees into metres where only their size matters.
EARTH_RADIUS_M = 6.371e6
# A star image of more than 64 million pixels whose file has less than a byte for 10,000 of them shows no sky,
# whose noise packs to some tenths of a byte a pixel; unpacked it may take a GB. Set by hand.
LARGE_PIXELS, MOST_PIXELS_A_BYTE = 2**26, 10_000
_INFLATED_BYTES = 2**20  # of a block that is inflated to see its checksum, at once
_BANDS = (1, 2, 3, 4)  # grey, colours, either with opacity
_ALONE = {  # GDAL reads that file and no other: no sidecar, no network
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_TIFF_INTERNAL_MASK": "YES",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
}
MAX_COORDINATE = 1e9  # of a map, in its unit


def read_tiff(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    """Counts (height, width) of a TIFF with one band of 8 or 16 bits, read whole.

    Raises `RawDataError` if it is none, or not of `size` and `bits`.
    """
    _check_black(path, file)
    content = small_content(path)
    with open_geotiff(path, file, content) as image:
        depth = _bits(image, file)
        check_size(file, (image.width, image.height), size, depth, bits)
        if image.count != 1:
            raise RawDataError(file, "bands", str(image.count), "1")
        _check_deflated(image, content, file)
        return _read_window(image, file, Window(0, 0, image.width, image.height))


def read_planes(path: Path, file: str) -> NDArray[Any]:
    """All bands (K, height, width) of a TIFF of any depth, at most 4; `RawDataError` if it is none."""
    _check_black(path, file)
    content = small_content(path)
    with open_geotiff(path, file, content) as image:
        if image.count not in _BANDS:  # a header of some kB may state 65535 of them, which take minutes
            raise RawDataError(file, "SamplesPerPixel", str(image.count), "1 to 4: grey or colours")
        check_size(file, (image.width * image.count, image.height), None, 16, None)
        values = image.width * image.height * image.count
        least = values // MOST_PIXELS_A_BYTE if values > LARGE_PIXELS else 0
        if content is not None and len(content) < least:
            raise RawDataError(file, "file", f"{len(content)} bytes", f"{least} or more for so many pixels")
        _check_deflated(image, content, file)
        try:
            return np.asarray(image.read())
        except (RasterioError, RasterioIOError, ValueError, MemoryError) as error:
            raise RawDataError(file, "pixels", str(error), "pixels that decode") from error


def _check_deflated(image: Any, content: bytes | None, file: str) -> None:
    """`RawDataError` unless every deflated block of an open TIFF, whose bytes are `content`, ends and has its
    checksum: GDAL and others do not look at it, and fill a damaged end with different values. A file that is
    too large for `small_content` is not looked through.
    """
    if content is None or image.compression is not Compression.deflate:
        return
    bands = range(1, image.count + 1) if image.interleaving is Interleaving.band else (1,)
    for band in bands:
        for (row, column), _ in image.block_windows(band):
            place = f"{column}_{row}"
            start, size = (
                image.get_tag_item(f"BLOCK_{key}_{place}", "TIFF", band) for key in ("OFFSET", "SIZE")
            )
            if start is None or size is None:
                continue  # a block that is not there is zero
            stream = zlib.decompressobj()
            try:
                rest = content[int(start) : int(start) + int(size)]
                while rest and not stream.eof:
                    stream.decompress(rest, _INFLATED_BYTES)
                    rest = stream.unconsumed_tail
            except zlib.error as error:
                raise RawDataError(file, f"block {place}", str(error), "a sound stream") from error
            if not stream.eof:
                raise RawDataError(file, f"block {place}", "a stream without end", "a sound stream")


def _check_black(path: Path, file: str) -> None:
    content = small_content(path)
    with open_regular(path) if content is None else io.BytesIO(content) as stream:
        check_photometric(stream, file)


def planes_of_png(content: bytes, file: str) -> NDArray[Any]:
    """All planes (K, height, width) of a PNG file in memory, by libpng; `RawDataError` if it is none."""
    try:
        with rasterio.Env(**_ALONE), warnings.catch_warnings(), MemoryFile(content) as memory:
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with memory.open(driver="PNG") as image:
                return np.asarray(image.read())
    except (RasterioError, ValueError, OSError, MemoryError) as error:
        raise RawDataError(file, "pixels", str(error), "pixels that decode") from error


@contextmanager
def open_geotiff(path: Path, file: str, content: bytes | None = None) -> Iterator[Any]:
    """A TIFF opened for reading by window; only its header is parsed. `RawDataError` if it is none.

    With `content`, all bytes of the file, these are read instead of the file. `WorkerError` if the store of
    the file does not answer.
    """
    magic = content[:4] if content is not None else first_bytes(path, file, 4)
    if magic not in TIFF_MAGICS:
        raise RawDataError(file, "byte 0", magic.hex(" ") or "an empty file", "a TIFF (II or MM, 42 or 43)")
    streams: list[Any] = []

    def opener(name: str, mode: str = "rb") -> Any:
        streams.append(path.open(mode, buffering=0))
        return streams[-1]

    with rasterio.Env(**_ALONE), warnings.catch_warnings(), ExitStack() as memory, _answered(streams):
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        try:
            source: Any = path.resolve()
            if content is not None:
                source = memory.enter_context(MemoryFile(content))
            ranges = isinstance(path, StoredPath) and content is None
            image = rasterio.open(
                path.name if ranges else source,  # for the name of a bucket rasterio asks for credentials
                driver="GTiff",
                sharing=False,
                opener=opener if ranges else None,
            )
        except (RasterioError, ValueError, OSError) as error:
            raise RawDataError(file, "TIFF header", str(error), "a TIFF image") from error
        with image:
            for (rows, columns), kind in zip(image.block_shapes, image.dtypes):
                if (row := rows * max(columns, image.width) * np.dtype(kind).itemsize) > MAX_BLOCK_BYTES:
                    found = f"{columns} x {rows} px, {row} bytes in a row"
                    raise RawDataError(file, "tiles or strips", found, f"at most {MAX_BLOCK_BYTES} bytes")
            if image.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES":
                expected = "1, black is zero: programs disagree whether to reverse the values of 0"
                raise RawDataError(file, "PhotometricInterpretation", "0, white is zero", expected)
            yield image


@contextmanager
def _answered(streams: Sequence[Any]) -> Iterator[None]:
    """What went wrong in a stream in place of what GDAL says of it."""
    try:
        yield
    except RawDataError as error:
        for stream in streams:
            if stream.failure is not None:
                raise stream.failure from error
        raise


def _bits(image: Any, file: str) -> int:
    depth = {"uint8": 8, "uint16": 16}.get(image.dtypes[0])
    if depth is None:
        raise RawDataError(file, "bit depth", str(image.dtypes[0]), "uint8 or uint16")
    return depth


def _read_window(image: Any, file: str, window: Window) -> NDArray[Any]:
    try:
        return image.read(1, window=window)
    except (RasterioError, RasterioIOError, ValueError, MemoryError) as error:
        where = f"rows {window.row_off}..{window.row_off + window.height - 1}"
        raise RawDataError(file, where, str(error), "pixels that decode") from error


@record
class StripFiles:
    """The raw images of one strip, one file for each CCD, read by window (`geometry.strip_image`)."""

    paths: dict[int, Path] = scalar("image files by CCD")
    names: dict[int, str] = scalar("paths as the user knows them, by CCD")
    shapes: dict[int, tuple[int, int]] = scalar("(lines, samples) by CCD")

    @property
    def ccds(self) -> tuple[int, ...]:
        """Numbers of the CCDs in increasing order."""
        return tuple(sorted(self.paths))

    def of(self, ccds: Iterable[int]) -> StripFiles:
        """The images of some of the CCDs."""
        chosen = [ccd for ccd in ccds if ccd in self.paths]
        return StripFiles(
            {ccd: self.paths[ccd] for ccd in chosen},
            {ccd: self.names[ccd] for ccd in chosen},
            {ccd: self.shapes[ccd] for ccd in chosen},
        )

    def shape(self, ccd: int) -> tuple[int, int]:
        """(lines, samples) of a CCD's image."""
        return self.shapes[ccd]

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray[Any]:
        """Raw counts (rows, columns) line0..line1-1, sample0..sample1-1; `ValueError` outside the image."""
        lines, samples = self.shapes[ccd]
        if not (0 <= line0 < line1 <= lines and 0 <= sample0 < sample1 <= samples):
            raise ValueError(f"window {line0}:{line1}, {sample0}:{sample1} is not inside {lines} x {samples}")
        with open_geotiff(self.paths[ccd], self.names[ccd]) as image:
            window = Window(sample0, line0, sample1 - sample0, line1 - line0)
            return _read_window(image, self.names[ccd], window)

    def read_bands(self, ccd: int, height: int, most_pitch: int) -> tuple[NDArray[Any], int] | None:
        """Bands of `height` lines, one below the other (rows, samples), and the lines from band to band.

        Each begins with a row of the file's tiles, so little of it is decoded; they are at most `most_pitch`
        lines apart. None where tiles are too high for that.
        """
        lines, samples = self.shapes[ccd]
        with open_geotiff(self.paths[ccd], self.names[ccd]) as image:
            block = image.block_shapes[0][0]
            if (pitch := most_pitch // block * block) <= height:
                return None
            tops = range(0, lines - height + 1, pitch)
            windows = [Window(0, top, samples, height) for top in tops]
            bands = [_read_window(image, self.names[ccd], window) for window in windows]
        return np.concatenate(bands), pitch


def check_strip_file(path: Path, file: str, *, lines: int, samples: int, bit_depth: int) -> None:
    """`RawDataError` if a strip's image has not the stated size and depth, or its last row is missing."""
    with open_geotiff(path, file) as image:
        depth = _bits(image, file)
        check_size(file, (image.width, image.height), (samples, lines), depth, 8 if bit_depth <= 8 else 16)
        if image.count != 1:
            raise RawDataError(file, "bands", str(image.count), "1")
        _read_window(image, file, Window(0, lines - 1, samples, 1))


@record
class GridImage:
    """A georeferenced raster."""

    values: NDArray[np.float32] = array("H, W", "NaN where the file has no data")
    transform: tuple[float, float, float, float, float, float] = scalar(
        "(a, b, c, d, e, f): x = a column + b row + c"
    )
    crs: str = scalar("coordinate reference system as WKT")


def read_grid(path: Path, file: str, *, max_pixels: int, first_band: bool = False) -> GridImage:
    """A GeoTIFF with CRS and transform: a chip or a terrain model. `RawDataError` if it is none.

    It must have one band; with `first_band` the first of several is read.
    """
    with open_geotiff(path, file) as image:
        if image.width * image.height > max_pixels:
            raise RawDataError(
                file, "image size", f"{image.width} x {image.height} px", f"<= {max_pixels} px"
            )
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
        raw = _read_window(image, file, Window(0, 0, image.width, image.height))
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
    transform: tuple[float, float, float, float, float, float] = scalar("as of `GridImage`")
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
    with open_geotiff(path, file) as image:
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
    try:
        wkt = str(image.crs.to_wkt())
        _check_map(wkt)
    except (RasterioError, ProjError) as error:
        expected = "one to which latitude and longitude can be converted"
        raise RawDataError(file, "coordinate reference system", str(error), expected) from error
    return wkt


@lru_cache(maxsize=64)
def _check_map(wkt: str) -> None:
    """`ProjError` for a CRS to which latitude and longitude cannot be converted."""
    Transformer.from_crs(CRS.from_epsg(4326), CRS.from_user_input(wkt), always_xy=True)
