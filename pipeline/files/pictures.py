"""Pictures of the sky as PNG, JPEG, BMP, WebP, JPEG 2000, PGM or PPM: one plane, or colours, in memory.

PNG files of plain grey are read by `png_rows`, those with colours of 16 bits by the libpng of GDAL, as Pillow
would drop the lower 8; PGM and PPM by NumPy, as their values are counts, which Pillow would scale; all others
by Pillow. Each decoder either gives the file's pixels or raises; none ends the process (docs/design.md).
"""

from __future__ import annotations

import io
import re
import struct
import warnings
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from isal import isal_zlib
from isal.isal_zlib import IsalError
from numpy.typing import NDArray
from PIL import Image

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import open_regular, small_content
from boresight.pipeline.files.image_heads import check_length, check_size, encoded_content, kept_head
from boresight.pipeline.files.png_rows import png_rows

if TYPE_CHECKING:
    from PIL import Image

__all__ = ["PICTURE_MAGICS", "PNG_MAGIC", "read_picture", "read_png"]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"  # first bytes of every PNG (PNG 3rd ed., 5.2)
# Kinds of pictures by their first bytes.
PICTURE_MAGICS = {
    b"\xff\xd8\xff": "JPEG",
    b"BM": "BMP",
    b"RIFF": "WEBP",
    b"\x00\x00\x00\x0cjP  ": "JPEG2000",
    b"P2": "PGM",
    b"P3": "PPM",
    b"P5": "PGM",
    b"P6": "PPM",
}
_MODES = ("L", "LA", "I", "I;16", "I;16B", "RGB", "RGBA")  # of Pillow
_GREY_PNG, _PALETTE_PNG = 0, 3  # colour types
_PNG_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
# First column, first row, column and row step of each pass of an interlaced PNG (PNG 3rd ed., 8.1).
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_SPACE = rb"(?:\s|#[^\n]{0,4096}\n)+"  # between the numbers of a netpbm head: white space and comments
# Head of a netpbm file: kind, width, height, largest value.
_NETPBM = re.compile(
    rb"P([2356])" + _SPACE + rb"(\d{1,9})" + _SPACE + rb"(\d{1,9})" + _SPACE + rb"(\d{1,5})\s"
)
_HEAD_BYTES = 2**16  # of a netpbm file, comments included


def read_png(path: Path, file: str, size: tuple[int, int] | None, bits: int | None) -> NDArray[Any]:
    """Pixels (H, W) or planes (K, H, W) of a PNG file; grey, and of `size` and `bits`, where they are given.

    Raises `RawDataError` where chunks are incomplete or damaged, and for an animated PNG, of which readers
    show different frames.
    """
    head = kept_head(path, file, 33)
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise RawDataError(file, "byte 8", f"{len(head)} bytes without a header", "a PNG header (IHDR)")
    width, height, depth, colour = struct.unpack(">IIBB", head[16:26])
    if colour != _GREY_PNG and size is not None:
        raise RawDataError(file, "colour type", str(colour), "0 (grey)")
    check_size(file, (width, height), size, depth, bits)
    channels = 1 if colour in (_GREY_PNG, _PALETTE_PNG) else 4
    raw = encoded_content(path, file, width * height * channels * depth // 8)
    _check_png_chunks(raw, file)
    if (image := png_rows(raw)) is not None:
        return image
    _check_png_rows(raw, file)
    if depth == 16 and colour != _GREY_PNG:
        from boresight.pipeline.files.image_files import planes_of_png  # with GDAL 0.1 s to load

        return planes_of_png(raw, file)
    return _by_pillow(io.BytesIO(raw), path, file, "PNG")


def read_picture(path: Path, file: str) -> NDArray[Any]:
    """Pixels (H, W) or planes (K, H, W) of a file that begins with one of `PICTURE_MAGICS`."""
    head = kept_head(path, file, _HEAD_BYTES)
    kind = next(kind for magic, kind in PICTURE_MAGICS.items() if head.startswith(magic))
    if kind in ("PGM", "PPM"):
        return _read_netpbm(path, file, head)
    content = small_content(path)
    with open_regular(path) if content is None else io.BytesIO(content) as stream:
        return _by_pillow(stream, path, file, kind)


def _by_pillow(stream: IO[bytes], path: Path, file: str, kind: str) -> NDArray[Any]:
    """What Pillow decodes as a file of one kind, and as nothing else."""

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of metadata, and of sizes, which are limited here
            with Image.open(stream, formats=(kind,)) as image:
                check_size(file, image.size, None, 8, None)
                check_length(path, file, 4 * image.width * image.height)
                frames = getattr(image, "n_frames", 1)
                if frames > 1 and image.format != "MPO":  # MPO: previews follow
                    raise RawDataError(file, "frames", str(frames), "one image")
                if kind == "JPEG" and image.mode == "RGB":
                    image.draft("L", image.size)  # the luminance that the file holds
                return _planes(image.convert("RGB") if image.mode == "P" else image, file)
    except RawDataError:
        raise
    except Exception as error:  # Pillow raises many kinds for damaged files
        found = f"{type(error).__name__}: {error}"
        raise RawDataError(file, "pixels", found, "an image that decodes") from error


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


def _read_netpbm(path: Path, file: str, head: bytes) -> NDArray[Any]:
    """Counts of a PGM or PPM file; its largest value, of 12 bits for instance, scales nothing."""
    if (match := _NETPBM.match(head)) is None:
        raise RawDataError(
            file, "header", head[:20].hex(" "), "P2, P3, P5 or P6, width, height and largest value"
        )
    kind, width, height, largest = map(int, match.groups())
    if not (width and height and 0 < largest < 2**16):
        found = f"{width} x {height} px up to {largest}"
        raise RawDataError(file, "header", found, "a size, and a largest value from 1 to 65535")
    dtype = np.dtype(">u2" if largest > 255 else "u1")
    check_size(file, (width, height), None, 8 * dtype.itemsize, None)
    shape = (height, width) if kind in (2, 5) else (height, width, 3)
    if kind in (2, 3):
        values = _netpbm_text(encoded_content(path, file, 6 * int(np.prod(shape))), match.end(), shape, file)
        dtype = np.dtype("u2" if largest > 255 else "u1")
    else:
        raw = encoded_content(path, file, dtype.itemsize * int(np.prod(shape)))
        values = _netpbm_bytes(raw, match.end(), shape, dtype, file)
    values = values if len(shape) == 2 else np.moveaxis(values, 2, 0)
    if (most := int(values.max())) > largest:
        raise RawDataError(file, "pixels", f"a value of {most}", f"at most {largest}, as the header states")
    return values.astype(dtype.newbyteorder("="))


def _netpbm_bytes(raw: bytes, start: int, shape: tuple[int, ...], dtype: Any, file: str) -> NDArray[Any]:
    need = int(np.prod(shape))
    if len(raw) - start < need * dtype.itemsize:
        raise RawDataError(file, "pixels", f"{len(raw) - start} bytes", f"{need * dtype.itemsize} bytes")
    return np.frombuffer(raw, dtype, need, start).reshape(shape)


def _netpbm_text(raw: bytes, start: int, shape: tuple[int, ...], file: str) -> NDArray[Any]:
    """Values written as decimal digits, with comments."""
    text, need = raw[start:], int(np.prod(shape))
    if text.translate(None, b"0123456789 \t\r\n\v\f"):
        text = re.sub(rb"#[^\n]*", b"", text)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of text that is no number
            values = np.fromstring(text, dtype=np.int64, sep=" ")[:need]
    except (ValueError, DeprecationWarning) as error:
        raise RawDataError(file, "pixels", str(error), f"{need} numbers") from error
    if len(values) < need or values.min(initial=0) < 0:
        found = f"{len(values)} numbers" if len(values) < need else f"a value of {values.min()}"
        raise RawDataError(file, "pixels", found, f"{need} numbers from 0 on")
    return values.reshape(shape)


def _check_png_rows(raw: bytes, file: str) -> None:
    """`RawDataError` where the stream of a PNG file ends before its last row: Pillow fills the rest with
    black, so a small file may state a large image. What is damaged otherwise its reader reports.
    """
    width, height, depth, colour, *_, interlaced = struct.unpack(">IIBBBBB", raw[16:29])
    bits = depth * _PNG_SAMPLES.get(colour, 1)
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = [((width - x + dx - 1) // dx, (height - y + dy - 1) // dy) for x, y, dx, dy in passes]
    need = sum(h * (1 + (w * bits + 7) // 8) for w, h in sizes if w > 0 and h > 0)
    at, done, inflate = len(PNG_MAGIC), 0, isal_zlib.decompressobj()
    while at + 12 <= len(raw) and done < need:
        (length,) = struct.unpack_from(">I", raw, at)
        piece = raw[at + 8 : at + 8 + length] if raw[at + 4 : at + 8] == b"IDAT" else b""
        while piece and done < need:
            try:
                done += len(inflate.decompress(piece, 2**20))
            except IsalError:  # type: ignore[misc]  # its stub makes it a variable
                return
            piece = inflate.unconsumed_tail
        at += 12 + length
    if done < need:
        raise RawDataError(file, "pixels", f"{done} bytes", f"{need} bytes of rows")


def _check_png_chunks(raw: bytes, file: str) -> None:
    """`RawDataError` unless every chunk is complete, its name of letters and its checksum right.

    Decoders fill gaps with black.
    """
    at = len(PNG_MAGIC)
    content = memoryview(raw)
    while at + 12 <= len(raw):
        (length,) = struct.unpack_from(">I", raw, at)
        kind = raw[at + 4 : at + 8]
        if not (kind.isascii() and kind.isalpha()):
            raise RawDataError(file, f"byte {at + 4}", kind.hex(" "), "the name of a chunk: four letters")
        if kind == b"acTL":
            raise RawDataError(file, f"byte {at + 4}", "an animated PNG (acTL)", "a PNG of one image")
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
