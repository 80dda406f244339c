"""What is asked of an image file before a pixel of it is decoded: first bytes, size, depth, length."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import check_regular, content_of, open_regular, small_content

__all__ = ["MAX_STAR_PIXELS", "TIFF_MAGICS"]
__all__ += ["check_length", "check_photometric", "check_size", "encoded_content", "first_bytes", "kept_head"]

# First four bytes of a TIFF: little-endian or big-endian, classic (42) or BigTIFF (43).
TIFF_MAGICS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
MAX_STAR_PIXELS = 2**28  # an image of `identify`; those of a dump must have the camera's size
# Number of the TIFF tag PhotometricInterpretation; most tags of a directory that are read.
_PHOTOMETRIC, _MOST_TAGS = 262, 4096
_SPARE_BYTES = 2**20  # for tables and comments of a file, beyond twice its pixels


def first_bytes(path: Path, file: str, n: int) -> bytes:
    """The first `n` bytes of an image file; `RawDataError` if it cannot be read."""
    check_regular(path, file, "an image")
    try:
        with open_regular(path) as stream:
            return stream.read(n)
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable image") from error


def kept_head(path: Path, file: str, n: int) -> bytes:
    """The first `n` bytes of a file that is then read whole, a small one being kept; `RawDataError` if it
    cannot be read."""
    check_regular(path, file, "an image")
    try:
        content = small_content(path)
        return first_bytes(path, file, n) if content is None else content[:n]
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable image") from error


def check_length(path: Path, file: str, pixel_bytes: int) -> None:
    """`RawDataError` for a file that is longer than its pixels can account for."""
    limit = 2 * pixel_bytes + _SPARE_BYTES
    if (length := path.stat().st_size) > limit:
        raise RawDataError(file, "file", f"{length} bytes", f"at most {limit} bytes for so many pixels")


def encoded_content(path: Path, file: str, pixel_bytes: int) -> bytes:
    """The bytes of a file whose length agrees with its number of pixels."""
    check_length(path, file, pixel_bytes)
    return content_of(path)


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


def check_photometric(stream: BinaryIO, file: str) -> None:
    """`RawDataError` unless a TIFF states once whether black is zero: of another number of values programs
    take none, or the first.
    """
    head = stream.read(16)
    order, is_big = ("<" if head[:2] == b"II" else ">"), head[2:4] in (b"+\0", b"\0+")
    counts, entry = (order + "Q", order + "HHQ8x") if is_big else (order + "H", order + "HHI4x")
    try:
        stream.seek(struct.unpack_from(order + ("Q" if is_big else "I"), head, 8 if is_big else 4)[0])
        (tags,) = struct.unpack(counts, stream.read(struct.calcsize(counts)))
        content = stream.read(min(tags, _MOST_TAGS) * struct.calcsize(entry))
        stated = [n for tag, _, n in struct.iter_unpack(entry, content) if tag == _PHOTOMETRIC]
    except (struct.error, OverflowError, OSError, ValueError):
        return  # the reader tells what is wrong
    if len(stated) > 1 or any(n != 1 for n in stated):
        found = f"{sum(stated)} values"
        raise RawDataError(file, "PhotometricInterpretation", found, "one value, or none")
