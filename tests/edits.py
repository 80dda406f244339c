"""Files of a dump changed by tests: texts, rasters, and tables of CSV as lists of rows, each a dictionary of
its cells.
"""

import csv
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import rasterio

Row = dict[str, str]


def rows_of(path: Path) -> list[Row]:
    """All rows below the header."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write rows, at least one, under a header of the first one's columns: as a new file, as the old one may
    be a link."""
    first, *others = rows
    path.unlink(missing_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, first, lineterminator="\n")
        writer.writeheader()
        writer.writerows([first, *others])


def replaced(path: Path, old: str, new: str, count: int = -1) -> None:
    """Put a text in the place of another one that a file must have: everywhere, or at the first places."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count), newline="")


def repaint(path: Path, paint: Callable[[np.ndarray], np.ndarray], shift_m: float = 0.0) -> None:
    """The raster with other pixels, its geo-reference moved to the east: as a new file, as above."""
    with rasterio.open(path) as file:
        image, profile = file.read(1), dict(file.profile)
    if shift_m:
        profile["transform"] = rasterio.Affine.translation(shift_m, 0.0) @ profile["transform"]
    path.unlink()
    with rasterio.open(path, "w", **profile) as file:
        file.write(paint(image), 1)
