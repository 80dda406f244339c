"""Tables and images that a caller gives for a dump: rows as mappings, raw counts, TIFF files of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.accepted import count_of, label_of, shown, wrong
from boresight.pipeline.files.images.tiff import TILES, write_tiff

__all__ = [
    "READERS",
    "bits_of",
    "image_of",
    "pixels_of",
    "stored",
    "write_image",
]

# How columns of targets and measured points are read; all others are numbers.
READERS = dict.fromkeys(("id", "strip", "height_kind"), label_of) | {"ccd": count_of}


def image_of(value: Any, name: str) -> NDArray[Any]:
    """An image (H, W) of integers, computed now where it is a function."""
    expected = "raw counts (rows, columns) of type uint8 or uint16"
    pixels = pixels_of(value, name, expected)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise wrong(name, pixels, expected)
    return pixels


def pixels_of(value: Any, name: str, expected: str) -> NDArray[Any]:
    """Grey values (H, W), computed now where they are a function; masked pixels of floating ones are NaN."""
    try:
        given = value() if isinstance(value, Callable) else value  # type: ignore[arg-type]
        hidden = np.ma.getmaskarray(given) if np.ma.is_masked(given) else None
        pixels = np.asarray(given)
    except Exception as error:  # of a function, or of a foreign class that pretends to be an array
        raise wrong(name, value, f"{expected} ({shown(error)})") from error
    if pixels.ndim != 2 or pixels.dtype.kind not in "uif" or not pixels.size:
        raise wrong(name, pixels, expected)
    if hidden is None:
        return pixels
    if pixels.dtype.kind != "f":
        raise wrong(name, f"an array with {hidden.sum()} masked pixels", f"{expected}, none of them masked")
    return np.where(hidden, pixels.dtype.type(np.nan), pixels)


def bits_of(stated: int | None, types: set[Any], name: str) -> int:
    if stated is not None:
        return stated
    if types - {np.dtype(np.uint8)}:
        raise wrong(name, "None", "the bits in use, 9 to 16, of images of uint16")
    return 8 if types else 0


def write_image(path: Path, pixels: NDArray[Any], **options: Any) -> None:
    write_tiff(path, pixels, **(TILES if min(pixels.shape) > 256 else {}), **options)


def stored(pixels: NDArray[Any], bits: int) -> NDArray[Any]:
    """Counts in the type that the format has for their bits."""
    return pixels.astype(np.uint16) if bits > 8 else pixels
