"""A strip's images reduced to a few hundred pixels, for the report's map."""

from __future__ import annotations

import cv2
import numpy as np

from boresight.gct_match.search.coarse import means_of_usable, read_coarse
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.record import array, record, scalar
from boresight.pipeline.files.images.tiff import StripFiles

__all__ = ["Overview", "overview"]

SIDE_PX = 420  # least length of the longer side, if the image has as many pixels
LEAST_ROWS = 100  # of the overview of a strip that is read in bands
BAND_LINES = 4  # image lines that are read, and averaged, for a row of such an overview


@record(kw_only=True)
class Overview:
    """Means over blocks of a CCD's image."""

    means: np.ndarray = array("H, W", "counts, single precision; NaN where none is usable")
    first_px: tuple[float, float] = scalar("middle (sample, line) of the first block")
    pitch_px: tuple[int, int] = scalar("samples and lines from one block to the next")


def overview(images: StripFiles, ccd: int, settings: MatchSettings) -> Overview:
    """Means over blocks of a CCD's image, without counts that `settings` exclude. `RawDataError` if it is
    damaged.

    Of a long strip the first lines of each row of its file's tiles are enough: decoding all takes longer
    than matching it.
    """
    lines, samples = images.shape(ccd)
    factor = 1
    while 2 * factor * SIDE_PX < lines and 2 * factor <= min(lines, samples):
        factor *= 2
    height = min(factor, BAND_LINES)
    found = images.read_bands(ccd, height, lines // LEAST_ROWS)
    if found is None:
        coarse = read_coarse(images, ccd, (0, lines), (0, samples), factor, settings).image
        middle = 0.5 * (factor - 1)
        return Overview(means=coarse.astype(np.float32), first_px=(middle, middle), pitch_px=(factor, factor))
    bands, pitch = found
    means = means_of_usable(bands[:, : samples // factor * factor], height, settings).astype(np.float32)
    wide = cv2.resize(means, (samples // factor, len(means)), interpolation=cv2.INTER_AREA)
    return Overview(
        means=np.asarray(wide), first_px=(0.5 * (factor - 1), 0.5 * (height - 1)), pitch_px=(factor, pitch)
    )
