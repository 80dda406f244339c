"""TIFF files: star images and strips, read whole or by window, and written; by GDAL.

They are opened by its GeoTIFF driver only, without sidecar files and without network. Size and bit depth are
checked in the header before a pixel is decoded. An image that cannot be used raises `RawDataError`; the
caller decides whether that stops the run.
"""

from __future__ import annotations

import logging
import struct
import warnings
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Compression, Interleaving
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile
from rasterio.windows import Window

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent
from boresight.pipeline.files.images.image_file import ImageFile, check_length, check_star_pixels, open_image
from boresight.pipeline.files.object_store import StoredPath
from boresight.records.record import record, scalar

__all__ = [
    "TILES",
    "StripFiles",
    "check_strip_file",
    "open_tiff",
    "planes_of_png",
    "read_tiff",
    "tiff_opened",
    "tiff_window",
    "write_tiff",
]

logging.getLogger("rasterio").setLevel(logging.INFO)  # else a hundred lines for each image at DEBUG
MAX_BLOCK_BYTES = 2**29  # a row of tiles or a strip of a TIFF is decoded as a whole
# A star image of more than 64 million pixels whose file has less than a byte for 10,000 of them shows no sky,
# whose noise packs to some tenths of a byte a pixel; unpacked it may take a GB. Set by hand.
LARGE_PIXELS, MOST_PIXELS_A_BYTE = 2**26, 10_000
TILES = {"tiled": True, "blockxsize": 256, "blockysize": 256}  # options of images that are read by window
_INFLATED_BYTES = 2**20  # of a block that is inflated to see its checksum, at once
UNDECODED = (RasterioError, ValueError, MemoryError)  # of pixels that do not decode
_BANDS = (1, 2, 3, 4)  # grey, colours, either with opacity
# Number of the TIFF tag PhotometricInterpretation; most tags of a directory that are read.
_PHOTOMETRIC, _MOST_TAGS = 262, 4096
_ALONE = {  # GDAL reads that file and no other: no sidecar, no network
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_TIFF_INTERNAL_MASK": "YES",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
}
# Images of cameras have no map.
_unplaced = partial(warnings.catch_warnings, action="ignore", category=NotGeoreferencedWarning)


def read_tiff(image: ImageFile) -> NDArray[Any]:
    """Counts (height, width) of an exposure, a TIFF with one band of 8 or 16 bits; of any other picture all
    bands (K, height, width), at most 4, of any depth. `RawDataError` if it is none.
    """
    _check_photometric(image)
    with open_tiff(image) as tiff:
        if image.size is not None:
            _check_counts(image, tiff)
            _check_deflated(tiff, image)
            return tiff_window(tiff, image.name, Window(0, 0, *image.size))
        _check_planes(image, tiff)
        _check_deflated(tiff, image)
        with refusing(image.name, "pixels", "pixels that decode", UNDECODED):
            return np.asarray(tiff.read())


@contextmanager
def open_tiff(image: ImageFile) -> Iterator[Any]:
    """A TIFF opened by GDAL; only its header is parsed. `RawDataError` if it is none.

    The content of an image that is read whole and small is not read again. `WorkerError` if the store of the
    file does not answer.
    """
    if image.format != "TIFF":
        found = image.head[:4].hex(" ") or "an empty file"
        raise RawDataError(image.name, "byte 0", found, "a TIFF (II or MM, 42 or 43)")
    streams: list[Any] = []

    def opener(name: str, mode: str = "rb") -> Any:
        streams.append(image.path.open(mode, buffering=0))
        return streams[-1]

    with rasterio.Env(**_ALONE), _unplaced(), ExitStack() as memory, _answered(streams):
        with refusing(image.name, "TIFF header", "a TIFF image", (RasterioError, ValueError, OSError)):
            source: Any = image.path.resolve()
            if image.content is not None:
                source = memory.enter_context(MemoryFile(image.content))
            ranges = isinstance(image.path, StoredPath) and image.content is None
            tiff = rasterio.open(
                image.path.name if ranges else source,  # for a bucket's name rasterio asks for credentials
                driver="GTiff",
                sharing=False,
                opener=opener if ranges else None,
            )
        with tiff:
            for (rows, columns), kind in zip(tiff.block_shapes, tiff.dtypes):
                row = rows, max(columns, tiff.width), np.dtype(kind).itemsize
                check_extent(image.name, "tiles or strips", row, MAX_BLOCK_BYTES, "bytes in a row")
            if tiff.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES":
                expected = "1, black is zero: programs disagree whether to reverse the values of 0"
                raise RawDataError(image.name, "PhotometricInterpretation", "0, white is zero", expected)
            yield tiff


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


def tiff_window(tiff: Any, file: str, window: Window) -> NDArray[Any]:
    """Pixels (rows, columns) of the first band of an open TIFF; `RawDataError` where they do not decode."""
    where = f"rows {window.row_off}..{window.row_off + window.height - 1}"
    with refusing(file, where, "pixels that decode", UNDECODED):
        return np.asarray(tiff.read(1, window=window))


def _check_counts(image: ImageFile, tiff: Any) -> None:
    """`RawDataError` unless an open TIFF has one band of the expected size and depth."""
    depth = {"uint8": 8, "uint16": 16}.get(tiff.dtypes[0])
    if depth is None:
        raise RawDataError(image.name, "bit depth", str(tiff.dtypes[0]), "uint8 or uint16")
    image.check_size(tiff.width, tiff.height, depth)
    if tiff.count != 1:
        raise RawDataError(image.name, "bands", str(tiff.count), "1")


def _check_planes(image: ImageFile, tiff: Any) -> None:
    """`RawDataError` for an open TIFF of too many bands or pixels, or of more than its file can hold."""
    if tiff.count not in _BANDS:  # a header of some kB may state 65535 of them, which take minutes
        raise RawDataError(image.name, "SamplesPerPixel", str(tiff.count), "1 to 4: grey or colours")
    check_star_pixels(image.name, tiff.width * tiff.count, tiff.height, np.dtype(tiff.dtypes[0]).itemsize)
    values = tiff.width * tiff.height * tiff.count
    least = values // MOST_PIXELS_A_BYTE if values > LARGE_PIXELS else 0
    if image.content is not None and image.length < least:
        expected = f"{least} or more for so many pixels"
        raise RawDataError(image.name, "file", f"{image.length} bytes", expected)


def _check_deflated(tiff: Any, image: ImageFile) -> None:
    """`RawDataError` unless every deflated block of an open TIFF ends and has its checksum: GDAL and others
    do not look at it, and fill a damaged end with different values. A file that is not kept in memory is
    not looked through.
    """
    if image.content is None or tiff.compression is not Compression.deflate:
        return
    bands = range(1, tiff.count + 1) if tiff.interleaving is Interleaving.band else (1,)
    for band in bands:
        for (row, column), _ in tiff.block_windows(band):
            place = f"{column}_{row}"
            start = tiff.get_tag_item(f"BLOCK_OFFSET_{place}", "TIFF", band)
            size = tiff.get_tag_item(f"BLOCK_SIZE_{place}", "TIFF", band)
            if start is None or size is None:
                continue  # a block that is not there is zero
            stream = zlib.decompressobj()
            with refusing(image.name, f"block {place}", "a sound stream", zlib.error):
                rest = image.content[int(start) : int(start) + int(size)]
                while rest and not stream.eof:
                    stream.decompress(rest, _INFLATED_BYTES)
                    rest = stream.unconsumed_tail
            if not stream.eof:
                raise RawDataError(image.name, f"block {place}", "a stream without end", "a sound stream")


def _check_photometric(image: ImageFile) -> None:
    """`RawDataError` unless a TIFF states once whether black is zero: programs differ on other numbers."""
    head = image.head
    order, is_big = ("<" if head[:2] == b"II" else ">"), head[2:4] in (b"+\0", b"\0+")
    counts, entry = (order + "Q", order + "HHQ8x") if is_big else (order + "H", order + "HHI4x")
    try:
        with image.stream() as stream:
            stream.seek(struct.unpack_from(order + ("Q" if is_big else "I"), head, 8 if is_big else 4)[0])
            (tags,) = struct.unpack(counts, stream.read(struct.calcsize(counts)))
            content = stream.read(min(tags, _MOST_TAGS) * struct.calcsize(entry))
        stated = [n for tag, _, n in struct.iter_unpack(entry, content) if tag == _PHOTOMETRIC]
    except (struct.error, OverflowError, OSError, ValueError):
        return  # the reader tells what is wrong
    if len(stated) > 1 or any(n != 1 for n in stated):
        found = f"{sum(stated)} values"
        raise RawDataError(image.name, "PhotometricInterpretation", found, "one value, or none")


def planes_of_png(content: bytes, file: str) -> NDArray[Any]:
    """All planes (K, height, width) of a PNG file in memory, by libpng; `RawDataError` if it is none."""
    with refusing(file, "pixels", "pixels that decode", (RasterioError, ValueError, OSError, MemoryError)):
        with rasterio.Env(**_ALONE), _unplaced(), MemoryFile(content) as memory:
            with memory.open(driver="PNG") as image:
                return np.asarray(image.read())


@record
class StripFiles:
    """The raw images of one strip, one file for each CCD, read by window (`geometry.line_camera`)."""

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
        every: Any = self.paths, self.names, self.shapes
        return StripFiles(*({ccd: one[ccd] for ccd in chosen} for one in every))

    def shape(self, ccd: int) -> tuple[int, int]:
        """(lines, samples) of a CCD's image."""
        return self.shapes[ccd]

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray[Any]:
        """Raw counts (rows, columns) line0..line1-1, sample0..sample1-1; `ValueError` outside the image."""
        lines, samples = self.shapes[ccd]
        if not (0 <= line0 < line1 <= lines and 0 <= sample0 < sample1 <= samples):
            raise ValueError(f"window {line0}:{line1}, {sample0}:{sample1} is not inside {lines} x {samples}")
        with self._opened(ccd) as tiff:
            window = Window(sample0, line0, sample1 - sample0, line1 - line0)
            return tiff_window(tiff, self.names[ccd], window)

    def read_bands(self, ccd: int, height: int, most_pitch: int) -> tuple[NDArray[Any], int] | None:
        """Bands of `height` lines, one below the other (rows, samples), and the lines from band to band.

        Each begins with a row of the file's tiles, so little of it is decoded; they are at most `most_pitch`
        lines apart. None where tiles are too high for that.
        """
        lines, samples = self.shapes[ccd]
        with self._opened(ccd) as tiff:
            block = tiff.block_shapes[0][0]
            if (pitch := most_pitch // block * block) <= height:
                return None
            tops = range(0, lines - height + 1, pitch)
            windows = [Window(0, top, samples, height) for top in tops]
            bands = [tiff_window(tiff, self.names[ccd], window) for window in windows]
        return np.concatenate(bands), pitch

    def _opened(self, ccd: int) -> AbstractContextManager[Any]:
        return open_tiff(open_image(self.paths[ccd], self.names[ccd], whole=False))


def check_strip_file(path: Path, file: str, *, lines: int, samples: int, bit_depth: int) -> None:
    """`RawDataError` if a strip's image has not the stated size and depth, or its last row is missing."""
    bits = 8 if bit_depth <= 8 else 16
    image = open_image(path, file, whole=False, size=(samples, lines), bits=bits)
    check_length(path, file, lines * samples * bits // 8)
    with open_tiff(image) as tiff:
        _check_counts(image, tiff)
        tiff_window(tiff, file, Window(0, lines - 1, samples, 1))


@contextmanager
def tiff_opened(path: Path, shape: tuple[int, int], kind: str, **options: Any) -> Iterator[Any]:
    """A new file of (lines, samples) of a NumPy type, to be written by windows; `options` are GDAL's."""
    profile = {"driver": "GTiff", "height": shape[0], "width": shape[1], "count": 1, "dtype": kind}
    with _unplaced(), rasterio.open(path, "w", **profile, **options) as image:
        yield image


def write_tiff(path: Path, pixels: NDArray[Any], **options: Any) -> None:
    """Write an image (lines, samples), deflated unless `options` say otherwise."""
    lines, samples = pixels.shape
    how = {"compress": "deflate"} | options
    with tiff_opened(path, (lines, samples), pixels.dtype.name, **how) as image:
        image.write(pixels, 1)
