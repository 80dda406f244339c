"""A star image as a page shows it: its picture, and a mark for each detection (star_image.html.j2)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from boresight.pipeline.report.observations import data_uri
from boresight.records.record import record, scalar

__all__ = ["Detection", "star_detection", "star_picture"]


@record(kw_only=True)
class Detection:
    """One mark on the star image."""

    x: float = scalar("column, px of the image")
    y: float = scalar("row, px of the image")
    r: float = scalar("size of the mark, about 1")
    state: str = scalar("key of the page's states")
    words: str = scalar("hover text")
    name: str = scalar("HIP number or planet; empty where not identified")


def star_detection(
    x: float, y: float, snr: float, state: str, states: Mapping[str, str], name: str
) -> Detection:
    """The mark of a star, larger for one with a higher signal-to-noise ratio; `states` has their meanings."""
    r = round(0.6 + min(0.3 * float(np.log10(max(snr, 1.0))), 0.9), 2)
    words = (f"{name}, " if name else "") + f"signal to noise {snr:.1f}: {states[state]}"
    return Detection(x=x, y=y, r=r, state=state, words=words, name=name)


def star_picture(
    jpeg: bytes, shrunk: int, size_px: tuple[int, int], marks: Sequence[Detection], states: Mapping[str, str]
) -> dict[str, Any]:
    """What the template's macro `picture` draws of an image of `size_px` (width, height) that is reduced by
    `shrunk`, without its words.
    """
    counts = Counter(mark.state for mark in marks)
    width, height = (side // shrunk * shrunk for side in size_px)
    return {
        "uri": data_uri("image/jpeg", jpeg),
        "shrunk": shrunk,
        "width": width,
        "height": height,
        "marks": marks,
        "counts": {name: counts[name] for name in states},
    }
