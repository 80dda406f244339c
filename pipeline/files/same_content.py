"""Whether files and images of a dump have the same content. Only files of equal size are read, first in part;
strips are compared by windows.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from boresight.geometry.record import Floats
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import content_digest
from boresight.pipeline.files.images.star_images import read_exposure

if TYPE_CHECKING:
    from boresight.pipeline.files.star_side import Exposure, StarImages
    from boresight.pipeline.files.strip_table import Strip

__all__ = ["equal_files", "grouped", "has_one_grey_value", "same_exposure", "same_ground"]

SAMPLE_BYTES = 4096  # at the beginning, in the middle and at the end of a file, compared before all bytes are
WINDOW_PX, WINDOWS = 64, 5  # of two strips that are compared
SAME_GROUND = 0.5  # least correlation of windows of the same ground; of independent ground it stays below

Key = TypeVar("Key")


def equal_files(paths: Mapping[Key, Path]) -> list[list[Key]]:
    """Groups of two and more files with the same bytes, by their keys; what cannot be read is in none."""
    of_size = grouped(paths, lambda key: paths[key].stat().st_size)
    alike = [part for group in of_size for part in grouped(group, lambda key: _sample(paths[key]))]
    return [part for group in alike for part in grouped(group, lambda key: content_digest(paths[key]))]


def grouped(keys: Iterable[Key], what: Callable[[Key], object]) -> list[list[Key]]:
    """Groups of two and more keys with the same `what`; those for which it raises `OSError` are in none."""
    groups = defaultdict(list)
    for key in keys:
        with suppress(OSError):
            groups[what(key)].append(key)
    return [group for group in groups.values() if len(group) > 1]


def _sample(path: Path) -> bytes:
    size = path.stat().st_size
    with path.open("rb") as stream:
        parts = []
        for share in (0.0, 0.5, 1.0):
            stream.seek(int(share * max(size - SAMPLE_BYTES, 0)))
            parts.append(stream.read(SAMPLE_BYTES))
    return b"".join(parts)


def same_exposure(images: StarImages, a: Exposure, b: Exposure) -> bool:
    """Whether two exposures have the same pixels; true where one cannot be read, which its reader reports."""
    form = {"width": images.camera.width_px, "height": images.camera.height_px, "bit_depth": images.bit_depth}
    if a.path == b.path or equal_files({"a": a.path, "b": b.path}):
        return True
    with suppress(RawDataError, OSError):
        return np.array_equal(read_exposure(a.path, a.file, **form), read_exposure(b.path, b.file, **form))
    return True


def same_ground(a: Strip, b: Strip, ccd: int, span_s: tuple[float, float]) -> bool:
    """Whether two images of a CCD show the same ground at the same times; true where that is not seen."""
    if a.images.paths.get(ccd) == b.images.paths.get(ccd):
        return True
    correlations = list(_correlations(a, b, ccd, span_s))
    return not correlations or float(np.median(correlations)) >= SAME_GROUND


def has_one_grey_value(strip: Strip, ccd: int, t_s: float) -> bool:
    """Whether the middle of an image, at an instant, has one grey value."""
    try:
        return bool(np.ptp(_window(strip, ccd, t_s, 0.5)) == 0.0)
    except RawDataError:
        return False


def _correlations(a: Strip, b: Strip, ccd: int, span_s: tuple[float, float]) -> Iterator[float]:
    """Correlations of windows of two images of a CCD at the same times."""
    begin, end = span_s
    for share in np.linspace(0.1, 0.9, WINDOWS).tolist():
        with suppress(RawDataError, ValueError, KeyError):
            of_a, of_b = (_window(strip, ccd, begin + share * (end - begin), share) for strip in (a, b))
            if of_a.std() > 0.0 and of_b.std() > 0.0:
                yield float(np.corrcoef(of_a.ravel(), of_b.ravel())[0, 1])


def _window(strip: Strip, ccd: int, t_s: float, share: float) -> Floats:
    """Counts around an instant, at a share of the CCD's samples."""
    lines, samples = strip.images.shape(ccd)
    middle = float(strip.clock.lines_of_rows(ccd, strip.clock.row(t_s)))
    top = round(middle) - WINDOW_PX // 2
    top, left = min(max(top, 0), max(lines - WINDOW_PX, 0)), int(share * max(samples - WINDOW_PX, 0))
    below, right = min(top + WINDOW_PX, lines), min(left + WINDOW_PX, samples)
    return strip.images.read(ccd, top, below, left, right).astype(float)
