"""Pixels of grey PNG files whose rows are filtered by nothing, by the pixel before or by the row above.

That is how OpenCV, Pillow and the simulator write images of noise. ISA-L inflates them in a third of the time
of libpng, and these filters are sums of whole rows and columns. Files with the other two filters, whose sums
are rounded pixel by pixel, are left to Pillow. PNG: ISO/IEC 15948:2004.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from isal import isal_zlib
from isal.isal_zlib import IsalError
from numpy.typing import NDArray

__all__ = ["png_rows"]

NONE, SUB, UP = range(3)  # filters of a row
FIRST_CHUNK = 33  # after signature and header
ANCILLARY = 0x20  # bit of a chunk's first letter: readers may pass over it
# Inflated bytes of a PNG of which the filters of the rows are looked at first: they tell those of most
# files (set by hand).
_FIRST_BYTES = 2**12
_WINDOW = 2**15  # the largest that a stream may state
_FEED_BYTES = 2**18  # compressed bytes that are inflated at once: their rows stay in the cache
_SLAB_ROWS = 1024  # whose columns are summed at once


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


def _image_data(content: bytes) -> list[bytes] | None:
    """Compressed bytes of the image, of each chunk IDAT; None if they are not in one run, or beside a chunk
    that would change the pixels or that no reader may pass over (ISO/IEC 15948, 5.4)."""
    data: list[bytes] = []
    at, before = FIRST_CHUNK, b""
    while at + 12 <= len(content):
        (size,) = struct.unpack_from(">I", content, at)
        kind = content[at + 4 : at + 8]
        if kind == b"IEND":
            return data
        if kind == b"tRNS" or not (kind == b"IDAT" or kind[0] & ANCILLARY):
            return None
        if kind == b"IDAT":
            if data and before != kind:
                return None
            data.append(content[at + 8 : at + 8 + size])
        at, before = at + 12 + size, kind
    return None


def _inflated(
    data: list[bytes], height: int, length: int
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


def _pieces(data: list[bytes]) -> Iterator[bytes]:
    """The compressed bytes, a few first, then more at a time."""
    pieces: list[bytes] = []
    length, enough = 0, _FIRST_BYTES
    for one in data:
        pieces.append(one)
        length += len(one)
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
