"""Star images: exposures of a dump, and single pictures of the sky in many formats, read whole.

An exposure is a PNG, TIFF or FITS of 8 or 16 bits. A single picture may have colours, floating-point values,
further HDUs, or be of any other of `FORMATS`. FITS is read by astropy; PGM and PPM by NumPy, as their values
are counts, which Pillow would scale; all others by Pillow. Each decoder either gives the file's pixels or
raises; none ends the process (docs/design.md).

Size and bit depth are checked in the header before a pixel is decoded. An image that cannot be used raises
`RawDataError`; the caller decides whether that stops the run.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_bytes
from boresight.pipeline.files.images import image_file
from boresight.pipeline.files.images.png import read_png

__all__ = ["grey_image", "opened_fits", "read_exposure", "read_star_image"]

_GREY = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # of red, green, blue (ITU-R BT.601)
_LARGEST = 1e20  # of a floating-point value: after a change of unit it stays within single precision
_PACKINGS = ("RICE_1", "PLIO_1", "HCOMPRESS_1")  # of FITS tiles, whose size the header bounds
# Longest header of a FITS image, in blocks of 2880 bytes: 3600 keywords.
MAX_FITS_HEADER_BYTES = 100 * 2880
_MODES = ("L", "LA", "I", "I;16", "I;16B", "RGB", "RGBA")  # of Pillow
_SPACE = rb"(?:\s|#[^\n]{0,4096}\n)+"  # between the numbers of a netpbm head: white space and comments
# Head of a netpbm file: kind, width, height, largest value.
_NETPBM = re.compile(
    rb"P([2356])" + _SPACE + rb"(\d{1,9})" + _SPACE + rb"(\d{1,9})" + _SPACE + rb"(\d{1,5})\s"
)
_NETPBM_HEAD_BYTES = 2**16  # comments included


def read_exposure(path: Path, file: str, *, width: int, height: int, bit_depth: int) -> NDArray[np.uint16]:
    """Raw counts (height, width) of an exposure: PNG, TIFF or FITS, 8 or 16 bits, else `RawDataError`."""
    opened = image_file.open_image(path, file, size=(width, height), bits=8 if bit_depth <= 8 else 16)
    image = _decoded(opened)
    if bit_depth not in (8, 16) and int(image.max()) >> bit_depth:
        raise RawDataError(file, "pixels", f"a value of {image.max()}", f"values of {bit_depth} bits")
    return image


def read_star_image(path: Path, file: str) -> NDArray[Any]:
    """Values (height, width) of any star image up to 2^28 px, colours grey; no number: the median."""
    return grey_image(_decoded(image_file.open_image(path, file)), file)


def _decoded(image: image_file.ImageFile) -> NDArray[Any]:
    """Counts (H, W) of an exposure; of any other picture also planes (K, H, W) or (H, W, K)."""
    is_exposure = image.size is not None
    match image.format:
        case "PNG":
            pixels = read_png(image)
            return _by_pillow(image, "PNG") if pixels is None else pixels
        case "TIFF":
            from boresight.pipeline.files.images.tiff import read_tiff  # with GDAL 0.1 s to load

            return read_tiff(image)
        case "FITS":
            return _read_raw_fits(image) if is_exposure else _read_fits(image)
        case "NPY" if not is_exposure:
            return _read_npy(image)
        case "PGM" | "PPM" if not is_exposure:
            return _read_netpbm(image)
        case "JPEG" | "BMP" | "WEBP" | "JPEG2000" as kind if not is_exposure:
            return _by_pillow(image, kind)
    if not image.head:
        raise RawDataError(image.name, "byte 0", "an empty file", "a PNG, TIFF or FITS image")
    expected = "a PNG, TIFF or FITS image" + ("" if is_exposure else ", JPEG, BMP or .npy")
    raise RawDataError(image.name, "byte 0", image.head[:8].hex(" "), expected)


def grey_image(planes: NDArray[Any], file: str) -> NDArray[Any]:
    """One plane (H, W) of an image of one (H, W), or of one, three or four planes (K, H, W) or (H, W, K).

    Integers are counts, whatever type holds them: of 8 or 16 bits where these do. `RawDataError`, which names
    `file`, for other shapes and types, and where no pixel is a number.
    """
    if planes.ndim == 3 and planes.shape[0] not in (1, 3, 4):
        planes = np.moveaxis(planes, 2, 0)
    if planes.ndim not in (2, 3) or (planes.ndim == 3 and planes.shape[0] not in (1, 3, 4)):
        raise RawDataError(file, "planes", f"shape {planes.shape}", "one plane, or red, green and blue")
    if planes.dtype.kind not in "uif":
        raise RawDataError(file, "values", str(planes.dtype), "integers or floating point")
    image_file.check_star_pixels(file, planes.shape[-1], planes.shape[-2])
    if planes.ndim == 3 and planes.shape[0] == 1:
        planes = planes[0]
    whole = planes.dtype.kind in "ui" and planes.dtype != np.uint8
    least = planes.min(initial=0) if planes.dtype.kind == "i" else 0
    if whole and least >= 0 and (most := planes.max(initial=0)) < 2**16:
        planes = planes.astype(np.uint8 if most < 2**8 else np.uint16, copy=False)
    if planes.ndim == 2 and planes.dtype in (np.uint8, np.uint16):
        return planes
    with np.errstate(over="ignore"):  # what becomes infinite is no number
        values: NDArray[Any] = planes.astype(np.float64 if planes.dtype == np.float64 else np.float32)
    grey = values if values.ndim == 2 else np.tensordot(_GREY, values[:3], axes=1)
    if planes.dtype in (np.uint8, np.uint16):
        return np.rint(grey).astype(planes.dtype)
    if not (number := np.isfinite(grey)).any():
        raise RawDataError(file, "pixels", "none that is a number", "at least one")
    if (largest := float(np.abs(grey[number]).max())) > _LARGEST:
        raise RawDataError(file, "pixels", f"a value of {largest:g}", f"at most {_LARGEST:g}")
    return np.where(number, grey, np.median(grey[number]))


@contextmanager
def opened_fits(image: image_file.ImageFile, **options: bool) -> Iterator[Any]:
    """The HDUs of a file; what astropy raises at damaged headers becomes a `RawDataError`."""
    from astropy.io import fits

    if b"END" + b" " * 77 not in image.first(MAX_FITS_HEADER_BYTES):
        raise RawDataError(image.name, "FITS header", "no END", f"END within {MAX_FITS_HEADER_BYTES} bytes")
    with _decoding(image.name, "FITS header", "a FITS image"):
        content = io.BytesIO(image.whole())
        with fits.open(content, memmap=False, lazy_load_hdus=True, **options) as hdus:
            yield hdus


@contextmanager
def _decoding(file: str, field: str, expected: str) -> Iterator[None]:
    """What a library raises at a damaged file, of whatever kind, as a `RawDataError`; warnings, of what is
    refused where it matters, are not shown.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except RawDataError:
        raise
    except Exception as error:
        raise RawDataError(file, field, f"{type(error).__name__}: {error}", expected) from error


def _read_raw_fits(image: image_file.ImageFile) -> NDArray[Any]:
    """Counts of an exposure: the primary HDU, of 8 or 16 bits."""
    file = image.name
    with opened_fits(image, do_not_scale_image_data=True) as hdus:
        header = hdus[0].header
        naxis, bitpix = header.get("NAXIS"), header.get("BITPIX")
        if naxis != 2:
            raise RawDataError(file, "NAXIS", str(naxis), "2, one grey image in the primary HDU")
        if bitpix not in (8, 16):
            raise RawDataError(file, "BITPIX", str(bitpix), "8 or 16")
        width, height = int(header["NAXIS1"]), int(header["NAXIS2"])
        image.check_size(width, height, bitpix)
        start, need = hdus[0].fileinfo()["datLoc"], width * height * bitpix // 8
        if (have := image.length - start) < need:
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


def _read_fits(image: image_file.ImageFile) -> NDArray[Any]:
    """The first HDU with an image: integer or floating, scaled or not, one plane or three."""
    with opened_fits(image, disable_image_compression=True) as hdus:
        for hdu in hdus:
            _check_packing(hdu.header, image.name)
    with opened_fits(image) as hdus:
        for hdu in hdus:
            if not hdu.is_image or not 2 <= hdu.header.get("NAXIS", 0) <= 4:
                continue
            _check_fits_size(hdu, image)
            planes = np.squeeze(np.asarray(hdu.data))
            return planes.astype(planes.dtype.newbyteorder("="))
    raise RawDataError(image.name, "HDU", "none with an image", "an image of one plane or three")


def _check_packing(header: Any, file: str) -> None:
    """`RawDataError` for an HDU with tiles that are packed by gzip: astropy unpacks them to any size."""
    if not header.get("ZIMAGE"):
        return
    expected = f"one of {', '.join(_PACKINGS)}, without a column of gzip; `funpack` unpacks such a file"
    if (kind := header.get("ZCMPTYPE")) not in _PACKINGS:
        raise RawDataError(file, "ZCMPTYPE", kind, expected)
    if "GZIP_COMPRESSED_DATA" in header["TTYPE*"].values():
        raise RawDataError(file, "TTYPE", "GZIP_COMPRESSED_DATA", expected)


def _check_fits_size(hdu: Any, image: image_file.ImageFile) -> None:
    """`RawDataError` if an HDU states more values than are read, or than the file holds."""
    width, *more = (int(hdu.header[f"NAXIS{k + 1}"]) for k in range(hdu.header["NAXIS"]))
    size = abs(int(hdu.header["BITPIX"])) // 8
    image_file.check_star_pixels(image.name, width, math.prod(more), size)
    need = width * math.prod(more) * size
    have = image.length - hdu.fileinfo()["datLoc"]
    if have < need and not hasattr(hdu, "compression_type"):
        raise RawDataError(image.name, "pixels", f"{have} bytes", f"{need} bytes")


def _read_npy(image: image_file.ImageFile) -> NDArray[Any]:
    check_bytes(image.path, image.name, image_file.MAX_STAR_BYTES)
    with _decoding(image.name, "npy", "an array without objects"):
        values = np.load(image.path, mmap_mode="r", allow_pickle=False)
        image_file.check_star_pixels(image.name, values.size // 4, 1, 4 * values.itemsize)
        return np.array(values)


def _read_netpbm(image: image_file.ImageFile) -> NDArray[Any]:
    """Counts of a PGM or PPM file; its largest value, of 12 bits for instance, scales nothing."""
    file = image.name
    if (match := _NETPBM.match(image.first(_NETPBM_HEAD_BYTES))) is None:
        expected = "P2, P3, P5 or P6, width, height and largest value"
        raise RawDataError(file, "header", image.head[:20].hex(" "), expected)
    kind, width, height, largest = map(int, match.groups())
    if not (width and height and 0 < largest < 2**16):
        found = f"{width} x {height} px up to {largest}"
        raise RawDataError(file, "header", found, "a size, and a largest value from 1 to 65535")
    image_file.check_star_pixels(file, width, height)
    shape = (height, width) if kind in (2, 5) else (height, width, 3)
    dtype = np.dtype(np.uint16 if largest > 255 else np.uint8)
    if kind in (2, 3):
        values = _netpbm_text(image.whole(6 * math.prod(shape)), match.end(), shape, file)
    else:
        need = dtype.itemsize * math.prod(shape)
        content = image.whole(need)
        if (have := len(content) - match.end()) < need:
            raise RawDataError(file, "pixels", f"{have} bytes", f"{need} bytes")
        values = np.frombuffer(content, dtype.newbyteorder(">"), math.prod(shape), match.end()).reshape(shape)
    values = values if len(shape) == 2 else np.moveaxis(values, 2, 0)
    if (most := int(values.max())) > largest:
        raise RawDataError(file, "pixels", f"a value of {most}", f"at most {largest}, as the header states")
    return values.astype(dtype)


def _netpbm_text(content: bytes, start: int, shape: tuple[int, ...], file: str) -> NDArray[Any]:
    """Values written as decimal digits, with comments."""
    text, need = content[start:], math.prod(shape)
    if text.translate(None, b"0123456789 \t\r\n\v\f"):
        text = re.sub(rb"#[^\n]*", b"", text)
    with refusing(file, "pixels", f"{need} numbers", (ValueError, DeprecationWarning)):
        with warnings.catch_warnings(action="error"):  # of text that is no number
            values = np.fromstring(text, dtype=np.int64, sep=" ")[:need]
    if len(values) < need or values.min(initial=0) < 0:
        found = f"{len(values)} numbers" if len(values) < need else f"a value of {values.min()}"
        raise RawDataError(file, "pixels", found, f"{need} numbers from 0 on")
    return values.reshape(shape)


def _by_pillow(image: image_file.ImageFile, kind: str) -> NDArray[Any]:
    """What Pillow decodes as a file of one kind, and as nothing else."""
    with _decoding(image.name, "pixels", "an image that decodes"):
        with image.stream() as stream, Image.open(stream, formats=(kind,)) as picture:
            image_file.check_star_pixels(image.name, *picture.size)
            image_file.check_length(image.path, image.name, 4 * picture.width * picture.height)
            frames = getattr(picture, "n_frames", 1)
            if frames > 1 and picture.format != "MPO":  # MPO: previews follow
                raise RawDataError(image.name, "frames", str(frames), "one image")
            if kind == "JPEG" and picture.mode == "RGB":
                picture.draft("L", picture.size)  # the luminance that the file holds
            return _planes(picture.convert("RGB") if picture.mode == "P" else picture, image.name)


def _planes(image: Image.Image, file: str) -> NDArray[Any]:
    """One plane (H, W) of 8 or 16 bits, or three or four (K, H, W)."""
    if image.mode not in _MODES:
        expected = "grey of 8 or 16 bits, or red, green and blue"
        raise RawDataError(file, "pixels", f"values of kind {image.mode}", expected)
    values = np.asarray(image.getchannel(0) if image.mode == "LA" else image)
    if values.ndim == 3:
        return np.moveaxis(values, 2, 0)
    if values.dtype == np.uint8:
        return values
    if values.min() < 0 or values.max() > np.iinfo(np.uint16).max:
        raise RawDataError(file, "pixels", f"values from {values.min()} to {values.max()}", "0 to 65535")
    return values.astype(np.uint16)
