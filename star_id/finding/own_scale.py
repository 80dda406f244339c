"""Images in counts of their own: the same stars in whatever unit and above whatever offset.

Whole steps between all values (counts of 12 bits shifted to 16, divided, or averaged) become whole numbers.
Other floating values are divided by their noise, as neighbouring pixels show it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.record import array, record, scalar
from boresight.star_id.finding.background import NEAR_PX

__all__ = ["OwnScale", "in_own_counts"]

# Pixels by which steps between values, and the noise, are judged (set by hand).
_SAMPLE = 16384
# Departure from whole steps, as a share of one, that rounding to single precision makes at most.
_ROUNDED = 0.02
# Noise of other images after the division: steps of whole numbers are then fine enough.
_NOISE = 16.0


@record
class OwnScale:
    """An image in counts, and what these are: value = zero + unit * counts."""

    counts: NDArray[Any] = array("H, W", "8 or 16 bits, or single precision")
    unit: float = scalar("value of a count", default=1.0)
    zero: float = scalar("value of no counts", default=0.0)


def in_own_counts(image: NDArray[Any]) -> OwnScale:
    """An image (H, W) in counts; itself if its steps are one."""
    few, floating = image.ravel()[:: max(1, image.size // _SAMPLE)], np.issubdtype(image.dtype, np.floating)
    for some in () if floating else (few[::16], few):  # of most images a sixteenth shows a step of one
        if np.diff(np.unique(some)[:-1]).min(initial=2) == 1:  # without the largest, see below
            return OwnScale(image)
    least, largest, few = image.min(), image.max(), few.astype(np.float64)
    if not 0.0 < float(largest) - float(least) < np.inf:
        return (
            OwnScale(np.zeros(image.shape, dtype=np.uint8), zero=float(least))
            if floating
            else OwnScale(image)
        )
    values = np.unique(np.append(few[few < largest], least))  # the largest may be a limit between two steps
    step = float(np.diff(values).min(initial=float(largest) - float(least)))
    if not floating and step <= 1.0:
        return OwnScale(image)
    if float(largest) - float(least) <= np.iinfo(np.uint16).max * step:
        reach = values[-1] - values[0]
        step = float(reach / np.rint(reach / step)) if reach > 0.0 else step  # to the last digits
        steps = (image - np.float64(least)) / step
        whole = np.rint(steps)
        if np.abs(steps - whole).max(where=image < largest, initial=0.0) < _ROUNDED:
            bits = np.uint8 if whole.max() <= np.iinfo(np.uint8).max else np.uint16
            return OwnScale(whole.astype(bits), step, float(least))
    if not floating:
        return OwnScale(image)
    middle = float(np.median(few))
    far = image[:, NEAR_PX:].astype(np.float64) - image[:, :-NEAR_PX]
    off = np.abs(far.ravel()[:: max(1, far.size // _SAMPLE)])
    off = off[off > 0.0]  # of a sky that is cut off most are zero
    unit = float(np.median(off) if len(off) else float(largest) - float(least)) / _NOISE
    return OwnScale(((image - np.float64(middle)) / unit).astype(np.float32), unit, middle)
