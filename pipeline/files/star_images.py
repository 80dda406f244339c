"""Star images: exposures of a dump, and single pictures of the sky in many formats, read whole.

An exposure is a PNG, TIFF or FITS of 8 or 16 bits. A single picture may have colours, floating-point values,
further HDUs, or be of any other format listed in `_OTHER_MAGICS`, or .npy.

Size and bit depth are checked in the header before a pixel is decoded. An image that cannot be used raises
`RawDataError`; the caller decides whether that stops the run.
"""

from __future__ import annotations

import io
import math
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import check_regular, content_of, small_content
from boresight.pipeline.files.png_rows import png_rows

__all__ = ["TIFF_MAGICS", "check_size", "first_bytes", "read_exposure", "read_star_image"]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
TIFF_MAGICS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
FITS_MAGIC = b"SIMPLE  ="
JPEG_MAGIC = b"\xff\xd8\xff"
BMP_MAGIC = b"BM"
NPY_MAGIC = b"\x93NUMPY"
_OTHER_MAGICS = (b"P2", b"P3", b"P5", b"P6", b"RIFF", b"\x00\x00\x00\x0cjP  ")  # PGM, PPM, WebP, JPEG 2000
_GREY = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # of red, green, blue, as OpenCV's
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
    """Values (height, width) of any star image of up to 2^28 px; colours become grey. Floating-point values
    that are no number become the image's median."""
    return _read_star_image(path, file, None, None)


def _read_star_image(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    magic = _head(path, file, 16)
    if magic.startswith(PNG_MAGIC):
        return _read_png(path, file, size, bits)
    if magic.startswith(TIFF_MAGICS):
        from boresight.pipeline.files.image_files import read_planes, read_tiff  # with GDAL 0.1 s to load

        return _grey(read_planes(path, file), file) if size is None else read_tiff(path, file, size, bits)
    if magic.startswith(FITS_MAGIC):
        return _read_fits(path, file, size, bits) if size is not None else _read_any_fits(path, file)
    if size is None and magic.startswith(NPY_MAGIC):
        return _read_npy(path, file)
    if size is None and magic.startswith(_OTHER_MAGICS):
        return _read_other(path, file)
    if size is None and (magic.startswith(JPEG_MAGIC) or magic.startswith(BMP_MAGIC)):
        return _read_jpeg_or_bmp(path, file)
    if not magic:
        raise RawDataError(file, "byte 0", "an empty file", "a PNG, TIFF or FITS image")
    expected = "a PNG, TIFF or FITS image" + (", JPEG, BMP or .npy" if size is None else "")
    raise RawDataError(file, "byte 0", magic[:8].hex(" "), expected)


def _head(path: Path, file: str, n: int) -> bytes:
    """The first bytes of a file that is going to be read as a whole."""
    check_regular(path, file, "an image")
    try:
        content = small_content(path)
        return first_bytes(path, file, n) if content is None else content[:n]
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable image") from error


def first_bytes(path: Path, file: str, n: int) -> bytes:
    """The first `n` bytes of an image file; `RawDataError` if it cannot be read."""
    check_regular(path, file, "an image")
    try:
        with path.open("rb") as stream:
            return stream.read(n)
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable image") from error


def check_size(
    file: str, got: tuple[int, int], expected: tuple[int, int] | None, got_bits: int, bits: int | None
) -> None:
    """`RawDataError` unless width and height are as expected, or few enough, and the depth 8 or 16 bits."""
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
    check_size(file, (width, height), size, depth, bits)
    channels = 1 if colour in (0, 3) else 4
    raw = _encoded(path, file, width * height * channels * depth // 8)
    _check_png_chunks(raw, file)
    if (image := png_rows(raw)) is not None:
        return image
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
    content = memoryview(raw)
    while at + 12 <= len(raw):
        (length,) = struct.unpack_from(">I", raw, at)
        kind = raw[at + 4 : at + 8]
        if at + 12 + length > len(raw):
            break
        (stated,) = struct.unpack_from(">I", raw, at + 8 + length)
        computed = isal_zlib.crc32(content[at + 4 : at + 8 + length])
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
    check_size(file, (width, height), None, 8, 8)
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


@contextmanager
def _opened_fits(path: Path, file: str, **options: bool) -> Iterator[Any]:
    """The HDUs of a file; what astropy raises at damaged headers becomes a `RawDataError`."""
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    if b"END" + b" " * 77 not in _head(path, file, MAX_FITS_HEADER_BYTES):
        raise RawDataError(file, "FITS header", "no END", f"END within {MAX_FITS_HEADER_BYTES} bytes")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)
            with fits.open(
                io.BytesIO(content_of(path)), memmap=False, lazy_load_hdus=True, **options
            ) as hdus:
                yield hdus
    except RawDataError:
        raise
    except Exception as error:  # astropy raises many kinds for damaged headers
        raise RawDataError(file, "FITS header", f"{type(error).__name__}: {error}", "a FITS image") from error


def _read_fits(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    with _opened_fits(path, file, do_not_scale_image_data=True) as hdus:
        header = hdus[0].header
        naxis, bitpix = header.get("NAXIS"), header.get("BITPIX")
        if naxis != 2:
            raise RawDataError(file, "NAXIS", str(naxis), "2, one grey image in the primary HDU")
        if bitpix not in (8, 16):
            raise RawDataError(file, "BITPIX", str(bitpix), "8 or 16")
        width, height = int(header["NAXIS1"]), int(header["NAXIS2"])
        check_size(file, (width, height), size, bitpix, bits)
        start, need = hdus[0].fileinfo()["datLoc"], width * height * bitpix // 8
        if (have := path.stat().st_size - start) < need:
            raise RawDataError(file, "pixels", f"{have} bytes", f"{need} bytes")
        zero, scale = float(header.get("BZERO", 0)), float(header.get("BSCALE", 1))
        if scale != 1.0 or zero not in (0.0, 32768.0):
            raise RawDataError(file, "BZERO, BSCALE", f"{zero:g}, {scale:g}", "0 or 32768, 1")
        pixels = np.asarray(hdus[0].data)
    if bitpix == 8:
        return pixels
    values = pixels.astype(np.int32) + int(zero)
    if values.min() < 0:
        raise RawDataError(file, "pixels", f"a value of {values.min()}", "counts from 0 to 65535")
    return values.astype(np.uint16)


def _grey(planes: NDArray[Any], file: str) -> NDArray[Any]:
    """One plane (H, W) of an image of one (H, W), or of one, three or four planes (K, H, W) or (H, W, K)."""
    if planes.ndim == 3 and planes.shape[0] not in (1, 3, 4):
        planes = np.moveaxis(planes, 2, 0)
    if planes.ndim not in (2, 3) or (planes.ndim == 3 and planes.shape[0] not in (1, 3, 4)):
        raise RawDataError(file, "planes", f"shape {planes.shape}", "one plane, or red, green and blue")
    if planes.dtype.kind not in "uif":
        raise RawDataError(file, "values", str(planes.dtype), "integers or floating point")
    check_size(file, (planes.shape[-1], planes.shape[-2]), None, 16, None)
    if planes.ndim == 3 and planes.shape[0] == 1:
        planes = planes[0]
    if planes.ndim == 2 and planes.dtype in (np.uint8, np.uint16):
        return planes
    values = planes.astype(np.float32)
    grey = values if values.ndim == 2 else np.tensordot(_GREY, values[:3], axes=1)
    if planes.dtype in (np.uint8, np.uint16):
        return np.rint(grey).astype(planes.dtype)
    if not (number := np.isfinite(grey)).any():
        raise RawDataError(file, "pixels", "none that is a number", "at least one")
    return np.where(number, grey, np.median(grey[number]))


def _read_npy(path: Path, file: str) -> NDArray[Any]:
    try:
        return _grey(np.array(np.load(path, mmap_mode="r", allow_pickle=False)), file)
    except (ValueError, OSError, EOFError) as error:
        raise RawDataError(file, "npy", str(error), "an array without objects") from error


def _read_other(path: Path, file: str) -> NDArray[Any]:
    from PIL import Image

    raw = content_of(path)
    try:
        with Image.open(io.BytesIO(raw)) as header:
            width, height = header.size
    except Exception as error:  # Pillow raises many kinds for damaged headers
        raise RawDataError(file, "header", f"{type(error).__name__}: {error}", "an image") from error
    check_size(file, (width, height), None, 8, None)
    return _decoded(raw, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH, file, width, height)


def _read_any_fits(path: Path, file: str) -> NDArray[Any]:
    """The first HDU with an image: integer or floating, scaled or not, one plane or three."""
    with _opened_fits(path, file) as hdus:
        for hdu in hdus:
            if not hdu.is_image or not 2 <= hdu.header.get("NAXIS", 0) <= 4:
                continue
            _check_fits_size(hdu, path, file)
            planes = np.squeeze(np.asarray(hdu.data))
            return _grey(planes.astype(planes.dtype.newbyteorder("=")), file)
    raise RawDataError(file, "HDU", "none with an image", "an image of one plane or three")


def _check_fits_size(hdu: Any, path: Path, file: str) -> None:
    """`RawDataError` if an HDU states more values than are read, or than the file holds."""
    from astropy.io import fits

    values = math.prod(int(hdu.header[f"NAXIS{k + 1}"]) for k in range(hdu.header["NAXIS"]))
    if values > MAX_STAR_PIXELS:
        raise RawDataError(file, "image size", f"{values} values", f"at most {MAX_STAR_PIXELS}")
    need = values * abs(int(hdu.header["BITPIX"])) // 8
    have = path.stat().st_size - hdu.fileinfo()["datLoc"]
    if have < need and not isinstance(hdu, fits.CompImageHDU):
        raise RawDataError(file, "pixels", f"{have} bytes", f"{need} bytes")
