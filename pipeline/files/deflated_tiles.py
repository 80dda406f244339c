"""Tiles of a deflated TIFF decoded with ISA-L, twice to three times as fast as by GDAL.

GDAL opens the file, checks its header and tells where the tiles lie. Tiles of another form than stated here,
and damaged ones, are left to GDAL, whose errors name what is wrong.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from isal import isal_zlib
from isal.igzip_lib import IsalError
from numpy.typing import NDArray
from rasterio.windows import Window

from boresight.pipeline.files.content import open_regular

__all__ = ["read_deflated"]

SPARE_BYTES = 1024  # of a tile that does not compress, beyond its pixels: headers of zlib's blocks
FEW_LINES = 600  # of a row of tiles: to add along each takes less than the columns of all, one by one


def read_deflated(path: Path, image: Any, window: Window) -> NDArray[Any] | None:
    """Pixels (rows, columns) of a window of an open TIFF; None where GDAL has to read them.

    One band of 8 or 16 bits in whole little-endian tiles, zlib-compressed, with or without differences
    between neighbouring columns (predictor 2).
    """
    structure = image.tags(ns="IMAGE_STRUCTURE") | image.tags(1, ns="IMAGE_STRUCTURE")
    kind, predictor = np.dtype(image.dtypes[0]), structure.get("PREDICTOR", "1")
    deflated = structure.get("COMPRESSION") == "DEFLATE" and predictor in ("1", "2")
    whole = (
        image.count == 1
        and image.block_shapes[0][1] < image.width
        and "NBITS" not in structure
        and image.nodata is None
    )
    if not (deflated and whole and kind in (np.uint8, np.uint16)):
        return None
    height, width = image.block_shapes[0]
    first, last = window.col_off // width, (window.col_off + window.width - 1) // width
    pixels = np.empty((window.height, (last - first + 1) * width), kind)
    with open_regular(path) as stream:
        if stream.read(2) != b"II":
            return None
        end = window.row_off + window.height
        for row in range(window.row_off // height, (end - 1) // height + 1):
            top, below = max(row * height, window.row_off), min((row + 1) * height, end)
            of_tile = slice(top - row * height, below - row * height)
            columns = range(first, last + 1)
            tiles = [_inflated(stream, image, row, column, kind, of_tile.stop) for column in columns]
            if any(tile is None for tile in tiles):
                return None
            pixels[top - window.row_off : below - window.row_off] = _side_by_side(tiles, predictor)[of_tile]
    left = window.col_off - first * width
    return pixels[:, left : left + window.width]


def _inflated(
    stream: BinaryIO, image: Any, row: int, column: int, kind: np.dtype[Any], rows: int
) -> NDArray | None:
    """The first `rows` of a tile as they were compressed; None if it is missing or damaged there."""
    height, width = image.block_shapes[0]
    place = [image.get_tag_item(f"BLOCK_{what}_{column}_{row}", "TIFF", 1) for what in ("OFFSET", "SIZE")]
    n_bytes = height * width * kind.itemsize
    if None in place or not 0 < (size := int(place[1])) <= n_bytes + n_bytes // 8 + SPARE_BYTES:
        return None
    stream.seek(int(place[0]))
    needed = rows * width * kind.itemsize
    likely = min(
        size, SPARE_BYTES + size * needed * 5 // (n_bytes * 4)
    )  # ISA-L inflates all that it is given
    inflate = isal_zlib.decompressobj()
    try:
        content = inflate.decompress(stream.read(likely), needed)
        if len(content) < needed:
            content += inflate.decompress(stream.read(size - likely), needed - len(content))
    except IsalError:  # type: ignore[misc]  # its stub makes it a variable
        return None
    return np.frombuffer(content, kind).reshape(rows, width) if len(content) == needed else None


def _side_by_side(tiles: list[Any], predictor: str) -> NDArray[Any]:
    """Tiles (rows, width) in a row, their columns summed up where the file holds differences."""
    if predictor == "1":
        return np.concatenate(tiles, axis=1)
    height, width = tiles[0].shape
    if len(tiles) * height < FEW_LINES:
        sums = np.add.accumulate(np.stack(tiles), axis=2, dtype=tiles[0].dtype)
        return np.ascontiguousarray(sums.transpose(1, 0, 2)).reshape(height, -1)
    columns = np.empty(
        (width, len(tiles), height), tiles[0].dtype
    )  # a column of all tiles is one run of memory
    for n, tile in enumerate(tiles):
        columns[:, n] = cv2.transpose(tile)
    for before, here in pairwise(columns):
        np.add(here, before, out=here)
    return np.concatenate([cv2.transpose(columns[:, n]) for n in range(len(tiles))], axis=1)
