"""A strip's images reduced to a few hundred pixels, for the report's map.

They depend on the strip alone: they can be made before, or while, the matrix is estimated.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from boresight.gct_match.search.coarse import means_of_usable, read_coarse
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.record import array, record, scalar
from boresight.pipeline.files.dump import Strip
from boresight.pipeline.files.image_files import StripFiles

__all__ = ["Overview", "OverviewTask", "overview", "overview_tasks"]

SIDE_PX = 420  # least length of the longer side, if the image has as many pixels
LEAST_ROWS = 100  # of a strip that is read in bands
BAND_LINES = 4  # of a long strip that are read for a row


@record(kw_only=True)
class OverviewTask:
    """One CCD's image of a strip."""

    strip_id: str = scalar("id of the strip")
    images: StripFiles = scalar("its image files")
    ccd: int = scalar("number of the CCD")
    settings: MatchSettings = scalar("counts that are no measurement")


@record(kw_only=True)
class Overview:
    """Means over blocks of a CCD's image."""

    means: np.ndarray = array("H, W", "counts, single precision; NaN where none is usable")
    first_px: tuple[float, float] = scalar("middle (sample, line) of the first block")
    pitch_px: tuple[int, int] = scalar("samples and lines from one block to the next")


def overview_tasks(strips: Sequence[Strip], settings: MatchSettings) -> list[OverviewTask]:
    """The images of strips, strip by strip in the order of their CCDs."""
    return [
        OverviewTask(strip_id=strip.strip_id, images=strip.images, ccd=ccd, settings=settings)
        for strip in strips
        for ccd in strip.images.ccds
    ]


def overview(task: OverviewTask) -> Overview:
    """Means over blocks of a CCD's image; `RawDataError` if it cannot be read.

    Of a long strip the first lines of each row of its file's tiles are enough: decoding all takes longer
    than matching it.
    """
    lines, samples = task.images.shape(task.ccd)
    factor = 1
    while 2 * factor * SIDE_PX < lines and 2 * factor <= min(lines, samples):
        factor *= 2
    height = min(factor, BAND_LINES)
    found = task.images.read_bands(task.ccd, height, lines // LEAST_ROWS)
    if found is None:
        coarse = read_coarse(task.images, task.ccd, (0, lines), (0, samples), factor, task.settings).image
        middle = 0.5 * (factor - 1)
        return Overview(means=coarse.astype(np.float32), first_px=(middle, middle), pitch_px=(factor, factor))
    bands, pitch = found
    means = means_of_usable(bands[:, : samples // factor * factor], height, task.settings).astype(np.float32)
    wide = cv2.resize(means, (samples // factor, len(means)), interpolation=cv2.INTER_AREA)
    return Overview(
        means=np.asarray(wide), first_px=(0.5 * (factor - 1), 0.5 * (height - 1)), pitch_px=(factor, pitch)
    )
