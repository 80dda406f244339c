"""An image file: its format, and what is checked before a pixel is decoded: size, depth, length."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import (
    check_bytes,
    check_extent,
    check_regular,
    content_of,
    open_regular,
    small_content,
)
from boresight.records.record import record, scalar

__all__ = ["PNG_MAGIC", "ImageFile", "check_length", "check_star_pixels", "open_image"]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"  # PNG 3rd ed., 5.2
# Formats by the first bytes of their files; of a TIFF little-endian or big-endian, classic (42) or Big (43).
FORMATS = {
    PNG_MAGIC: "PNG",
    b"II*\x00": "TIFF",
    b"MM\x00*": "TIFF",
    b"II+\x00": "TIFF",
    b"MM\x00+": "TIFF",
    b"SIMPLE  =": "FITS",
    b"\x93NUMPY": "NPY",
    b"\xff\xd8\xff": "JPEG",
    b"BM": "BMP",
    b"RIFF": "WEBP",
    b"\x00\x00\x00\x0cjP  ": "JPEG2000",
    b"P2": "PGM",
    b"P3": "PPM",
    b"P5": "PGM",
    b"P6": "PPM",
}
MAX_STAR_PIXELS = 2**28  # an image of `identify`; those of a dump must have the camera's size
MAX_STAR_BYTES = 2**29  # of its values, colours among them: 16 bits of so many pixels
_HEAD_BYTES = 64  # read when a file is opened
_SPARE_BYTES = 2**20  # for tables and comments of a file, beyond twice its pixels


@record
class ImageFile:
    """A regular file that was opened as an image; no pixel of it is decoded."""

    path: Path = scalar("path of the file")
    name: str = scalar("path as the user knows it, for errors")
    head: bytes = scalar("its first bytes, at most 64")
    content: bytes | None = scalar("all its bytes; None: it is large, or read by window", repr=False)
    size: tuple[int, int] | None = scalar("width and height that it must have; None: any", default=None)
    bits: int | None = scalar("bits a pixel that it must have, 8 or 16; None: any", default=None)

    @property
    def format(self) -> str:
        """Format by the first bytes, a value of `FORMATS`; empty for any other."""
        return next((name for magic, name in FORMATS.items() if self.head.startswith(magic)), "")

    @property
    def length(self) -> int:
        """Number of bytes."""
        return self.path.stat().st_size if self.content is None else len(self.content)

    def first(self, n: int) -> bytes:
        """The first `n` bytes."""
        with self.stream() as stream:
            return stream.read(n)

    def stream(self) -> BinaryIO:
        """All bytes, to be read from the first on."""
        return open_regular(self.path) if self.content is None else io.BytesIO(self.content)

    def whole(self, pixel_bytes: int | None = None) -> bytes:
        """All bytes; `RawDataError` if they are more than pixels of so many bytes can account for."""
        if pixel_bytes is not None:
            check_length(self.path, self.name, pixel_bytes)
        return content_of(self.path) if self.content is None else self.content

    def check_size(self, width: int, height: int, bits: int) -> None:
        """`RawDataError` unless width and height are as expected, or few enough, and so is the depth."""
        if self.size is None:
            check_star_pixels(self.name, width, height)
        elif (width, height) != self.size:
            expected = f"{self.size[0]} x {self.size[1]} px"
            raise RawDataError(self.name, "image size", f"{width} x {height} px", expected)
        if bits not in ((8, 16) if self.bits is None else (self.bits,)):
            expected = f"{self.bits or '8 or 16'} bits a pixel"
            raise RawDataError(self.name, "bit depth", f"{bits} bits", expected)


def open_image(
    path: Path, name: str, *, whole: bool = True, size: tuple[int, int] | None = None, bits: int | None = None
) -> ImageFile:
    """An image file that is read `whole`, or by window; `RawDataError` if it cannot be read."""
    check_regular(path, name, "an image")
    try:
        content = small_content(path) if whole else None
        if content is not None:
            return ImageFile(path, name, content[:_HEAD_BYTES], content, size, bits)
        with open_regular(path) as stream:
            return ImageFile(path, name, stream.read(_HEAD_BYTES), None, size, bits)
    except OSError as error:
        raise RawDataError(name, "file", error.strerror or str(error), "a readable image") from error


def check_length(path: Path, name: str, pixel_bytes: int) -> None:
    """`RawDataError` for a file that is longer than its pixels can account for."""
    check_bytes(path, name, 2 * pixel_bytes + _SPARE_BYTES)


def check_star_pixels(name: str, width: int, height: int, pixel_bytes: int = 1) -> None:
    """`RawDataError` for more pixels than `MAX_STAR_PIXELS`, or for more bytes than `MAX_STAR_BYTES`."""
    check_extent(name, "image size", (width, height), MAX_STAR_PIXELS, "px")
    check_extent(name, "image size", (width, height, pixel_bytes), MAX_STAR_BYTES, "bytes")
