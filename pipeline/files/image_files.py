"""Read image files: exposures and chips whole, strips and terrain by window.

Size and bit depth are checked in the header before a pixel is decoded. An image that cannot be used raises
`RawDataError`; the caller decides whether that stops the run. TIFF files are opened by GDAL's GeoTIFF driver
only, without sidecar files and without network.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.errors import RasterioError, RasterioIOError
from rasterio.io import MemoryFile
from rasterio.windows import Window

from boresight.geometry.record import array, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import content_of, small_content
from boresight.pipeline.files.deflated_tiles import read_deflated
from boresight.pipeline.files.text_files import check_regular

__all__ = ["GridImage", "StripFiles", "open_geotiff", "read_exposure", "read_grid", "read_star_image"]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
TIFF_MAGICS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
FITS_MAGIC = b"SIMPLE  ="
JPEG_MAGIC = b"\xff\xd8\xff"
BMP_MAGIC = b"BM"
MAX_BLOCK_BYTES = 2**29  # a row of tiles or a strip of a TIFF is decoded as a whole
PIXEL_SIDE_M = (0.01, 1e5)  # of a chip, terrain model or ground image; 1e-5 m would be a wrong unit
EARTH_RADIUS_M = 6.371e6
MAX_COORDINATE = 1e9  # of a map, in its unit
MAX_FITS_HEADER_BYTES = 100 * 2880
ENCODED_SPARE_BYTES = 2**20  # for tables and comments of a file, beyond twice its pixels
MAX_STAR_PIXELS = 2**28  # an image of `identify`; those of a dump must have the camera's size


def read_exposure(path: Path, file: str, *, width: int, height: int, bit_depth: int) -> NDArray[np.uint16]:
    """Raw counts (height, width) of an exposure: PNG, TIFF or FITS, 8 or 16 bits, else `RawDataError`."""
    image = _read_star_image(path, file, (width, height), 8 if bit_depth <= 8 else 16)
    if bit_depth not in (8, 16) and int(image.max()) >> bit_depth:
        raise RawDataError(file, "pixels", f"a value of {image.max()}", f"values of {bit_depth} bits")
    return image


def read_star_image(path: Path, file: str) -> NDArray[Any]:
    """Counts (height, width) of any star image of up to 2^28 px, also JPEG and BMP; colours become grey."""
    return _read_star_image(path, file, None, None)


def _read_star_image(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    magic = _head(path, file, 16)
    if magic.startswith(PNG_MAGIC):
        return _read_png(path, file, size, bits)
    if magic.startswith(TIFF_MAGICS):
        return _read_tiff_whole(path, file, size, bits)
    if magic.startswith(FITS_MAGIC):
        return _read_fits(path, file, size, bits)
    if size is None and (magic.startswith(JPEG_MAGIC) or magic.startswith(BMP_MAGIC)):
        return _read_jpeg_or_bmp(path, file)
    if not magic:
        raise RawDataError(file, "byte 0", "an empty file", "a PNG, TIFF or FITS image")
    raise RawDataError(file, "byte 0", magic[:8].hex(" "), "a PNG, TIFF or FITS image")


def _head(path: Path, file: str, n: int) -> bytes:
    """The first bytes of a file that is going to be read as a whole."""
    check_regular(path, file, "an image")
    try:
        content = small_content(path)
        return _first_bytes(path, file, n) if content is None else content[:n]
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable image") from error


def _first_bytes(path: Path, file: str, n: int) -> bytes:
    check_regular(path, file, "an image")
    try:
        with path.open("rb") as stream:
            return stream.read(n)
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable image") from error


def _check_size(
    file: str, got: tuple[int, int], expected: tuple[int, int] | None, got_bits: int, bits: int | None
) -> None:
    if expected is None and got[0] * got[1] > MAX_STAR_PIXELS:
        raise RawDataError(file, "image size", f"{got[0]} x {got[1]} px", f"at most {MAX_STAR_PIXELS} px")
    if expected is not None and got != expected:
        raise RawDataError(file, "image size", f"{got[0]} x {got[1]} px", f"{expected[0]} x {expected[1]} px")
    if (bits is not None and got_bits != bits) or got_bits not in (8, 16):
        expected_bits = f"{bits}" if bits is not None else "8 or 16"
        raise RawDataError(file, "bit depth", f"{got_bits} bits", f"{expected_bits} bits a pixel")


def _read_png(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    head = _head(path, file, 33)
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise RawDataError(file, "byte 8", f"{len(head)} bytes without a header", "a PNG header (IHDR)")
    width, height, depth, colour = struct.unpack(">IIBB", head[16:26])
    if colour != 0 and size is not None:
        raise RawDataError(file, "colour type", str(colour), "0 (grey)")
    _check_size(file, (width, height), size, depth, bits)
    channels = 1 if colour in (0, 3) else 4
    raw = _encoded(path, file, width * height * channels * depth // 8)
    _check_png_chunks(raw, file)
    flag = cv2.IMREAD_UNCHANGED if colour == 0 else cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    return _decoded(raw, flag, file, width, height)


def _encoded(path: Path, file: str, pixel_bytes: int) -> bytes:
    """The bytes of a compressed file, whose size must agree with its number of pixels."""
    limit = 2 * pixel_bytes + ENCODED_SPARE_BYTES
    if (length := path.stat().st_size) > limit:
        raise RawDataError(file, "file", f"{length} bytes", f"at most {limit} bytes for so many pixels")
    return content_of(path)


def _decoded(raw: bytes, flag: int, file: str, width: int, height: int) -> NDArray[Any]:
    expected = f"{width} x {height} px"
    try:
        image = cv2.imdecode(np.frombuffer(raw, np.uint8), flag)
    except cv2.error as error:
        raise RawDataError(file, "pixels", str(error), expected) from error
    if image is None or image.shape != (height, width):
        raise RawDataError(file, "pixels", "data that do not decode", expected)
    return image


def _check_png_chunks(raw: bytes, file: str) -> None:
    """`RawDataError` unless every chunk is complete and its checksum right; decoders fill gaps with black."""
    at = 8
    while at + 12 <= len(raw):
        (length,) = struct.unpack_from(">I", raw, at)
        kind = raw[at + 4 : at + 8]
        if at + 12 + length > len(raw):
            break
        (stated,) = struct.unpack_from(">I", raw, at + 8 + length)
        computed = zlib.crc32(raw[at + 4 : at + 8 + length])
        if computed != stated:
            raise RawDataError(file, f"byte {at}", f"checksum {computed:08x}", f"{stated:08x}")
        if kind == b"IEND":
            return
        at += 12 + length
    raise RawDataError(
        file, f"byte {len(raw)}", "end of file", f"the rest of the PNG chunk that starts at {at}"
    )


def _read_jpeg_or_bmp(path: Path, file: str) -> NDArray[Any]:
    head = _head(path, file, ENCODED_SPARE_BYTES)
    width, height = _jpeg_size(head, file) if head.startswith(JPEG_MAGIC) else _bmp_size(head, file)
    _check_size(file, (width, height), None, 8, 8)
    raw = _encoded(path, file, 4 * width * height)
    return _decoded(raw, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION, file, width, height)


def _jpeg_size(raw: bytes, file: str) -> tuple[int, int]:
    """Width and height from the frame header (ITU-T T.81, B.2.2)."""
    at = 2
    while at + 9 < len(raw) and raw[at] == 0xFF:
        marker = raw[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", raw, at + 5)
            return width, height
        at += 1 if marker == 0xFF else 2 + struct.unpack_from(">H", raw, at + 2)[0]
    raise RawDataError(file, f"byte {at}", "no frame header", "a JPEG image")


def _bmp_size(raw: bytes, file: str) -> tuple[int, int]:
    if len(raw) < 26 or struct.unpack_from("<I", raw, 14)[0] < 40:
        raise RawDataError(file, "byte 14", f"{len(raw)} bytes", "a Windows bitmap header")
    width, height = struct.unpack_from("<ii", raw, 18)
    if width <= 0 or height == 0:
        raise RawDataError(file, "byte 18", f"{width} x {height} px", "a size")
    return width, abs(height)


def _read_fits(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    if b"END" + b" " * 77 not in _head(path, file, MAX_FITS_HEADER_BYTES):
        raise RawDataError(file, "FITS header", "no END", f"END within {MAX_FITS_HEADER_BYTES} bytes")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)
            with fits.open(path, memmap=False, lazy_load_hdus=True, do_not_scale_image_data=True) as hdus:
                header = hdus[0].header
                naxis, bitpix = header.get("NAXIS"), header.get("BITPIX")
                if naxis != 2:
                    raise RawDataError(file, "NAXIS", str(naxis), "2, one grey image in the primary HDU")
                if bitpix not in (8, 16):
                    raise RawDataError(file, "BITPIX", str(bitpix), "8 or 16")
                width, height = int(header["NAXIS1"]), int(header["NAXIS2"])
                _check_size(file, (width, height), size, bitpix, bits)
                start, need = hdus[0].fileinfo()["datLoc"], width * height * bitpix // 8
                if (have := path.stat().st_size - start) < need:
                    raise RawDataError(file, "pixels", f"{have} bytes", f"{need} bytes")
                zero, scale = float(header.get("BZERO", 0)), float(header.get("BSCALE", 1))
                if scale != 1.0 or zero not in (0.0, 32768.0):
                    raise RawDataError(file, "BZERO, BSCALE", f"{zero:g}, {scale:g}", "0 or 32768, 1")
                pixels = np.asarray(hdus[0].data)
    except RawDataError:
        raise
    except Exception as error:  # astropy raises many kinds for damaged headers
        raise RawDataError(file, "FITS header", f"{type(error).__name__}: {error}", "a FITS image") from error
    if bitpix == 8:
        return pixels
    values = pixels.astype(np.int32) + int(zero)
    if values.min() < 0:
        raise RawDataError(file, "pixels", f"a value of {values.min()}", "counts from 0 to 65535")
    return values.astype(np.uint16)


def _read_tiff_whole(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    with open_geotiff(path, file, small_content(path)) as image:
        depth = _bits(image, file)
        _check_size(file, (image.width, image.height), size, depth, bits)
        if image.count != 1:
            raise RawDataError(file, "bands", str(image.count), "1")
        return _read_window(image, file, Window(0, 0, image.width, image.height))


@contextmanager
def open_geotiff(path: Path, file: str, content: bytes | None = None) -> Iterator[Any]:
    """A TIFF opened for reading by window; only its header is parsed. `RawDataError` if it is none.

    With `content`, all bytes of the file, these are read instead of the file.
    """
    magic = content[:4] if content is not None else _first_bytes(path, file, 4)
    if magic not in TIFF_MAGICS:
        raise RawDataError(file, "byte 0", magic.hex(" ") or "an empty file", "a TIFF (II or MM, 42 or 43)")
    options = {
        "GDAL_PAM_ENABLED": "NO",
        "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
        "GDAL_TIFF_INTERNAL_MASK": "YES",
        "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
    }
    with rasterio.Env(**options), warnings.catch_warnings(), ExitStack() as memory:
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        try:
            if content is None:
                image = rasterio.open(path.resolve(), driver="GTiff", sharing=False)
            else:
                image = memory.enter_context(MemoryFile(content)).open(driver="GTiff", sharing=False)
        except (RasterioError, ValueError, OSError) as error:
            raise RawDataError(file, "TIFF header", str(error), "a TIFF image") from error
        with image:
            for (rows, columns), kind in zip(image.block_shapes, image.dtypes):
                if (row := rows * max(columns, image.width) * np.dtype(kind).itemsize) > MAX_BLOCK_BYTES:
                    found = f"{columns} x {rows} px, {row} bytes in a row"
                    raise RawDataError(file, "tiles or strips", found, f"at most {MAX_BLOCK_BYTES} bytes")
            yield image


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
    """The raw images of one strip, one file for each CCD, read by window (`gct_match`'s StripImage)."""

    paths: dict[int, Path] = scalar("image files by CCD")
    names: dict[int, str] = scalar("paths as the user knows them, by CCD")
    shapes: dict[int, tuple[int, int]] = scalar("(lines, samples) by CCD")

    @property
    def ccds(self) -> tuple[int, ...]:
        """Numbers of the CCDs in increasing order."""
        return tuple(sorted(self.paths))

    def shape(self, ccd: int) -> tuple[int, int]:
        """(lines, samples) of a CCD's image."""
        return self.shapes[ccd]

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray[Any]:
        """Raw counts (rows, columns) line0..line1-1, sample0..sample1-1; `ValueError` outside the image."""
        lines, samples = self.shapes[ccd]
        if not (0 <= line0 < line1 <= lines and 0 <= sample0 < sample1 <= samples):
            raise ValueError(f"window {line0}:{line1}, {sample0}:{sample1} is not inside {lines} x {samples}")
        window = Window(sample0, line0, sample1 - sample0, line1 - line0)
        with open_geotiff(self.paths[ccd], self.names[ccd]) as image:
            pixels = read_deflated(self.paths[ccd], image, window)
            return _read_window(image, self.names[ccd], window) if pixels is None else pixels


def check_strip_file(path: Path, file: str, *, lines: int, samples: int, bit_depth: int) -> None:
    """`RawDataError` if a strip's image has not the stated size and depth, or its last row is missing."""
    with open_geotiff(path, file) as image:
        depth = _bits(image, file)
        _check_size(file, (image.width, image.height), (samples, lines), depth, 8 if bit_depth <= 8 else 16)
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
            values = raw.astype(np.float32)
        if image.nodata is not None and np.isfinite(image.nodata):
            values[raw == image.nodata] = np.nan
        values[~np.isfinite(values)] = np.nan
        if not np.isfinite(values).any():
            raise RawDataError(file, "pixels", "none that is valid", "at least one valid pixel")
        wkt = _map_of(image, file)
        _check_transform(image.transform, CRS.from_user_input(wkt), file)
        a, b, c, d, e, f = (float(v) for v in tuple(image.transform)[:6])
        return GridImage(values, (a, b, c, d, e, f), wkt)


def _check_transform(transform: Any, crs: CRS, file: str) -> None:
    """`RawDataError` unless a pixel's side lies within `PIXEL_SIDE_M` and its coordinates on any map."""
    unit = crs.axis_info[0].unit_conversion_factor * (EARTH_RADIUS_M if crs.is_geographic else 1.0)
    if not PIXEL_SIDE_M[0] <= (side := abs(transform.determinant) ** 0.5 * unit) <= PIXEL_SIDE_M[1]:
        expected = f"{PIXEL_SIDE_M[0]:g} m to {PIXEL_SIDE_M[1]:g} m"
        raise RawDataError(file, "transform", f"pixels of {side:.3g} m", expected)
    if (largest := max(map(abs, transform))) > MAX_COORDINATE:
        raise RawDataError(file, "transform", f"{largest:g}", f"coordinates below {MAX_COORDINATE:g}")


def _map_of(image: Any, file: str) -> str:
    """WKT of an image's CRS, which must convert from latitude and longitude."""
    try:
        wkt = str(image.crs.to_wkt())
        Transformer.from_crs(CRS.from_epsg(4326), CRS.from_user_input(wkt), always_xy=True)
    except (RasterioError, ProjError) as error:
        expected = "one to which latitude and longitude can be converted"
        raise RawDataError(file, "coordinate reference system", str(error), expected) from error
    return wkt
