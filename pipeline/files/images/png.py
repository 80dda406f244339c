"""PNG files: decoded where they are plain grey, checked always; grey images of noise written.

Pixels are decoded here where the rows are filtered by nothing, by the pixel before or by the row above. That
is how OpenCV, Pillow and the simulator write images of noise. ISA-L inflates them in a third of the time of
libpng, and these filters are sums of whole rows and columns. Files with the other two filters, whose sums are
rounded pixel by pixel, and colours are left to Pillow, colours of 16 bits to the libpng of GDAL, as Pillow
would drop the lower 8. PNG: ISO/IEC 15948:2004.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import islice, pairwise
from typing import Any

import cv2
import numpy as np
from isal import isal_zlib
from isal.isal_zlib import IsalError
from numpy.typing import NDArray

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.images.image_file import PNG_MAGIC, ImageFile

__all__ = ["png_of_noise", "png_rows", "read_png"]

NONE, SUB, UP = range(3)  # filters of a row
FIRST_CHUNK = 33  # after signature and header
ANCILLARY = 0x20  # bit of a chunk's first letter: readers may pass over it
# Inflated bytes of a PNG of which the filters of the rows are looked at first: they tell those of most
# files (set by hand).
_FIRST_BYTES = 2**12
_WINDOW = 2**15  # the largest that a stream may state
_FEED_BYTES = 2**18  # compressed bytes that are inflated at once: their rows stay in the cache
_SLAB_ROWS = 1024  # whose columns are summed at once
_GREY, _PALETTE = 0, 3  # colour types
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # of a pixel, by colour type
# First column, first row, column and row step of each pass of an interlaced PNG (PNG 3rd ed., 8.1).
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
# Level of ISA-L's compression, of 0 to 3 (set by hand, for speed).
_LEVEL = 1
_CHUNK_BYTES = 2**20  # OpenCV reads no chunk of more than 8 MB


def read_png(image: ImageFile) -> NDArray[Any] | None:
    """Pixels (height, width) or planes (K, height, width) of a PNG file; None where Pillow has to read them.

    A file of which a size is expected must be grey. Raises `RawDataError` where chunks are incomplete or
    damaged, and for an animated PNG, of which readers show different frames.
    """
    if len(image.head) < FIRST_CHUNK or image.head[12:16] != b"IHDR":
        found = f"{len(image.head[:FIRST_CHUNK])} bytes without a header"
        raise RawDataError(image.name, "byte 8", found, "a PNG header (IHDR)")
    width, height, depth, colour = struct.unpack(">IIBB", image.head[16:26])
    if colour != _GREY and image.size is not None:
        raise RawDataError(image.name, "colour type", str(colour), "0 (grey)")
    image.check_size(width, height, depth)
    channels = 1 if colour in (_GREY, _PALETTE) else 4
    content = image.whole(width * height * channels * depth // 8)
    _check_chunks(content, image.name)
    if (pixels := png_rows(content)) is not None:
        return pixels
    _check_rows(content, image.name)
    if depth == 16 and colour != _GREY:
        from boresight.pipeline.files.images.tiff import planes_of_png  # with GDAL 0.1 s to load

        return planes_of_png(content, image.name)
    return None


def png_rows(content: bytes) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
    """Pixels (height, width) of a PNG file of 8 or 16 bits of grey; None where Pillow has to read them.

    The file's chunks are complete, the first one is IHDR. Pillow reads what is interlaced, coloured, has a
    transparent grey value or other filters, and what the standard forbids, of which it tells the reason.
    """
    length, width, height, depth, *kinds = struct.unpack_from(">I4xIIBBBBB", content, 8)
    plain = length == 13 and width and height and depth in (8, 16)
    if not plain or any(kinds):  # colour, compression, filter method, interlace
        return None
    size = depth // 8
    if (data := _image_data(content)) is None:
        return None
    filtered = _inflated(data, height, width * size)
    if filtered is None:
        return None
    filters, rows = filtered
    _sum_along_rows(rows, np.flatnonzero(filters == SUB), size)
    for row in np.flatnonzero(filters[1:] == UP) + 1:  # above the first row all is zero
        np.add(rows[row], rows[row - 1], out=rows[row])
    return rows if size == 1 else rows.view(">u2").astype(np.uint16)


def _chunks(content: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Begin, end and name of each chunk; the last one may end beyond the file."""
    begin = len(PNG_MAGIC)
    while begin + 12 <= len(content):
        end = begin + 12 + struct.unpack_from(">I", content, begin)[0]
        yield begin, end, content[begin + 4 : begin + 8]
        begin = end


def _image_data(content: bytes) -> list[memoryview] | None:
    """Compressed bytes of the image, of each chunk IDAT; None if they are not in one run, or beside a chunk
    that would change the pixels or that no reader may pass over (ISO/IEC 15948, 5.4)."""
    data: list[memoryview] = []
    before = b""
    for begin, end, kind in islice(_chunks(content), 1, None):  # after IHDR
        if kind == b"IEND":
            return data
        if kind == b"tRNS" or not (kind == b"IDAT" or kind[0] & ANCILLARY):
            return None
        if kind == b"IDAT":
            if data and before != kind:
                return None
            data.append(memoryview(content)[begin + 8 : end - 4])
        before = kind
    return None


def _inflated(
    data: list[memoryview], height: int, length: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
    """Filters (height,) and filtered rows (height, length)."""
    filters, rows = np.empty(height, np.uint8), np.empty((height, length), np.uint8)
    inflate, rest, done = isal_zlib.decompressobj(), b"", 0
    for n, piece in enumerate(_pieces(data)):
        if n == 0 and not _is_plain_stream(piece, height * (1 + length)):
            return None
        try:
            rest += inflate.decompress(piece, (height - done) * (1 + length) - len(rest) + 1)
        except IsalError:  # type: ignore[misc]  # its stub makes it a variable
            return None
        more = len(rest) // (1 + length)
        if done + more == height and len(rest) > more * (1 + length):
            return None  # more than the image
        block = np.frombuffer(rest, np.uint8, more * (1 + length)).reshape(more, 1 + length)
        if more and block[:, 0].max() > UP:
            return None
        filters[done : done + more], rows[done : done + more] = block[:, 0], block[:, 1:]
        done, rest = done + more, rest[more * (1 + length) :]
    return (filters, rows) if done == height and not rest and inflate.eof else None


def _is_plain_stream(head: bytes, length: int) -> bool:
    """Whether a stream of `length` bytes, inflated, may refer back as far as ISA-L allows (RFC 1950, 2.2).

    ISA-L takes the window for one of 32 kB whatever the stream states; zlib refuses what reaches beyond it.
    """
    window = 2 ** ((head[0] >> 4) + 8) if len(head) >= 2 else 0
    return 0 < window <= _WINDOW and (window == _WINDOW or length <= window)


def _pieces(data: list[memoryview]) -> Iterator[bytes]:
    """The compressed bytes, a few first, then more at a time."""
    pieces: list[memoryview] = []
    length, enough = 0, _FIRST_BYTES
    for part in data:
        pieces.append(part)
        length += len(part)
        if length >= enough:
            yield b"".join(pieces)
            pieces, length, enough = [], 0, _FEED_BYTES
    yield b"".join(pieces)


def _sum_along_rows(rows: NDArray[np.uint8], which: NDArray[np.intp], size: int) -> None:
    """Add to each pixel of some rows all before it, byte by byte, in place."""
    of_pixels: NDArray[Any] = rows.view(np.uint8 if size == 1 else np.uint16)
    for first in range(0, len(which), _SLAB_ROWS):
        slab = which[first : first + _SLAB_ROWS]
        columns: NDArray[Any] = cv2.transpose(of_pixels[slab]).view(np.uint8)
        for before, here in pairwise(columns):
            np.add(here, before, out=here)
        of_pixels[slab] = cv2.transpose(columns.view(of_pixels.dtype))


def _check_chunks(content: bytes, file: str) -> None:
    """`RawDataError` unless every chunk is complete, its name of letters and its checksum right.

    Decoders fill gaps with black.
    """
    at, view = len(PNG_MAGIC), memoryview(content)
    for begin, end, kind in _chunks(content):
        if not (kind.isascii() and kind.isalpha()):
            raise RawDataError(file, f"byte {begin + 4}", kind.hex(" "), "the name of a chunk: four letters")
        if kind == b"acTL":
            raise RawDataError(file, f"byte {begin + 4}", "an animated PNG (acTL)", "a PNG of one image")
        if end > len(content):
            break
        (stated,) = struct.unpack_from(">I", content, end - 4)
        if (computed := isal_zlib.crc32(view[begin + 4 : end - 4])) != stated:
            raise RawDataError(file, f"byte {begin}", f"checksum {computed:08x}", f"{stated:08x}")
        if kind == b"IEND":
            return
        at = end
    raise RawDataError(
        file, f"byte {len(content)}", "end of file", f"the rest of the PNG chunk that starts at {at}"
    )


def _check_rows(content: bytes, file: str) -> None:
    """`RawDataError` where the stream of a PNG file ends before its last row: Pillow fills the rest with
    black, so a small file may state a large image. What is damaged otherwise its reader reports.
    """
    width, height, depth, colour, *_, interlaced = struct.unpack(">IIBBBBB", content[16:29])
    bits = depth * _SAMPLES.get(colour, 1)
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = [((width - x + dx - 1) // dx, (height - y + dy - 1) // dy) for x, y, dx, dy in passes]
    need = sum(h * (1 + (w * bits + 7) // 8) for w, h in sizes if w > 0 and h > 0)
    done, inflate = 0, isal_zlib.decompressobj()
    for begin, end, kind in _chunks(content):
        piece = content[begin + 8 : end - 4] if kind == b"IDAT" else b""
        while piece and done < need:
            try:
                done += len(inflate.decompress(piece, 2**20))
            except IsalError:  # type: ignore[misc]  # its stub makes it a variable
                return
            piece = inflate.unconsumed_tail
    if done < need:
        raise RawDataError(file, "pixels", f"{done} bytes", f"{need} bytes of rows")


def png_of_noise(image: NDArray[Any]) -> bytes:
    """The file of an image (height, width), uint8 or uint16."""
    height, width = image.shape
    size = image.dtype.itemsize
    rows = np.zeros((height, 1 + width * size), np.uint8)  # the first byte of a row: no filter
    rows[:, 1:] = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder(">")).view(np.uint8)
    header = struct.pack(">IIBBBBB", width, height, 8 * size, 0, 0, 0, 0)
    packed = isal_zlib.compress(rows, _LEVEL)
    parts = [packed[at : at + _CHUNK_BYTES] for at in range(0, len(packed), _CHUNK_BYTES)]
    chunks = [(b"IHDR", header), *((b"IDAT", part) for part in parts), (b"IEND", b"")]
    return PNG_MAGIC + b"".join(_chunk(kind, content) for kind, content in chunks)


def _chunk(kind: bytes, content: bytes) -> bytes:
    body = kind + content
    return struct.pack(">I", len(content)) + body + struct.pack(">I", isal_zlib.crc32(body))
