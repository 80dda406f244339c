"""Star images: exposures of a dump, and single pictures of the sky in many formats, read whole.

An exposure is a PNG, TIFF or FITS of 8 or 16 bits. A single picture may have colours, floating-point values,
further HDUs, or be of any other format listed in `PICTURE_MAGICS`, or .npy.

Size and bit depth are checked in the header before a pixel is decoded. An image that cannot be used raises
`RawDataError`; the caller decides whether that stops the run.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import content_of
from boresight.pipeline.files.image_heads import MAX_STAR_PIXELS, TIFF_MAGICS, check_size, kept_head
from boresight.pipeline.files.pictures import PICTURE_MAGICS, PNG_MAGIC, read_picture, read_png

__all__ = ["grey_image", "opened_fits", "read_exposure", "read_star_image"]

# First bytes of a FITS file.
FITS_MAGIC = b"SIMPLE  ="
# First bytes of a file of numpy.save.
NPY_MAGIC = b"\x93NUMPY"
_GREY = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # of red, green, blue (ITU-R BT.601)
_LARGEST = 1e15  # of a floating-point value: squares and sums of it stay within single precision
_PACKINGS = ("RICE_1", "PLIO_1", "HCOMPRESS_1")  # of FITS tiles, whose size the header bounds
# Longest header of a FITS image, in blocks of 2880 bytes: 3600 keywords.
MAX_FITS_HEADER_BYTES = 100 * 2880


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
    magic = kept_head(path, file, 16)
    if magic.startswith(PNG_MAGIC):
        return grey_image(read_png(path, file, size, bits), file)
    if magic.startswith(TIFF_MAGICS):
        from boresight.pipeline.files.image_files import read_planes, read_tiff  # with GDAL 0.1 s to load

        return (
            grey_image(read_planes(path, file), file) if size is None else read_tiff(path, file, size, bits)
        )
    if magic.startswith(FITS_MAGIC):
        return _read_fits(path, file, size, bits) if size is not None else _read_any_fits(path, file)
    if size is None and magic.startswith(NPY_MAGIC):
        return _read_npy(path, file)
    if size is None and magic.startswith(tuple(PICTURE_MAGICS)):
        return grey_image(read_picture(path, file), file)
    if not magic:
        raise RawDataError(file, "byte 0", "an empty file", "a PNG, TIFF or FITS image")
    expected = "a PNG, TIFF or FITS image" + (", JPEG, BMP or .npy" if size is None else "")
    raise RawDataError(file, "byte 0", magic[:8].hex(" "), expected)


@contextmanager
def opened_fits(path: Path, file: str, **options: bool) -> Iterator[Any]:
    """The HDUs of a file; what astropy raises at damaged headers becomes a `RawDataError`."""
    from astropy.io import fits

    if b"END" + b" " * 77 not in kept_head(path, file, MAX_FITS_HEADER_BYTES):
        raise RawDataError(file, "FITS header", "no END", f"END within {MAX_FITS_HEADER_BYTES} bytes")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged headers, which are refused where they matter
            with fits.open(
                io.BytesIO(content_of(path)), memmap=False, lazy_load_hdus=True, **options
            ) as hdus:
                yield hdus
    except RawDataError:
        raise
    except Exception as error:  # astropy raises many kinds for damaged headers
        raise RawDataError(file, "FITS header", f"{type(error).__name__}: {error}", "a FITS image") from error


def _read_fits(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    with opened_fits(path, file, do_not_scale_image_data=True) as hdus:
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


def grey_image(planes: NDArray[Any], file: str) -> NDArray[Any]:
    """One plane (H, W) of an image of one (H, W), or of one, three or four planes (K, H, W) or (H, W, K).

    `RawDataError`, which names `file`, for other shapes and types, and where no pixel is a number.
    """
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
    with np.errstate(over="ignore"):  # what becomes infinite is no number
        values = planes.astype(np.float32)
    grey = values if values.ndim == 2 else np.tensordot(_GREY, values[:3], axes=1)
    if planes.dtype in (np.uint8, np.uint16):
        return np.rint(grey).astype(planes.dtype)
    if not (number := np.isfinite(grey)).any():
        raise RawDataError(file, "pixels", "none that is a number", "at least one")
    if (largest := float(np.abs(grey[number]).max())) > _LARGEST:
        raise RawDataError(file, "pixels", f"a value of {largest:g}", f"at most {_LARGEST:g}")
    return np.where(number, grey, np.median(grey[number]))


def _read_npy(path: Path, file: str) -> NDArray[Any]:
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        if values.size > 4 * MAX_STAR_PIXELS:
            raise RawDataError(file, "image size", f"{values.size} values", f"at most {MAX_STAR_PIXELS} px")
        return grey_image(np.array(values), file)
    except RawDataError:
        raise
    except Exception as error:  # of a damaged header NumPy raises also what its tokenizer does
        found = f"{type(error).__name__}: {error}"
        raise RawDataError(file, "npy", found, "an array without objects") from error


def _read_any_fits(path: Path, file: str) -> NDArray[Any]:
    """The first HDU with an image: integer or floating, scaled or not, one plane or three."""
    with opened_fits(path, file, disable_image_compression=True) as hdus:
        for hdu in hdus:
            _check_packing(hdu.header, file)
    with opened_fits(path, file) as hdus:
        for hdu in hdus:
            if not hdu.is_image or not 2 <= hdu.header.get("NAXIS", 0) <= 4:
                continue
            _check_fits_size(hdu, path, file)
            planes = np.squeeze(np.asarray(hdu.data))
            return grey_image(planes.astype(planes.dtype.newbyteorder("=")), file)
    raise RawDataError(file, "HDU", "none with an image", "an image of one plane or three")


def _check_packing(header: Any, file: str) -> None:
    """`RawDataError` for an HDU with tiles that are packed by gzip: astropy unpacks them to any size."""
    if not header.get("ZIMAGE"):
        return
    expected = f"one of {', '.join(_PACKINGS)}, without a column of gzip; `funpack` unpacks such a file"
    if (kind := header.get("ZCMPTYPE")) not in _PACKINGS:
        raise RawDataError(file, "ZCMPTYPE", kind, expected)
    if "GZIP_COMPRESSED_DATA" in header["TTYPE*"].values():
        raise RawDataError(file, "TTYPE", "GZIP_COMPRESSED_DATA", expected)


def _check_fits_size(hdu: Any, path: Path, file: str) -> None:
    """`RawDataError` if an HDU states more values than are read, or than the file holds."""
    values = math.prod(int(hdu.header[f"NAXIS{k + 1}"]) for k in range(hdu.header["NAXIS"]))
    if values > MAX_STAR_PIXELS:
        raise RawDataError(file, "image size", f"{values} values", f"at most {MAX_STAR_PIXELS}")
    need = values * abs(int(hdu.header["BITPIX"])) // 8
    have = path.stat().st_size - hdu.fileinfo()["datLoc"]
    if have < need and not hasattr(hdu, "compression_type"):
        raise RawDataError(file, "pixels", f"{have} bytes", f"{need} bytes")
