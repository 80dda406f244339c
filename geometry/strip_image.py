"""What rooms that look at a strip's pixels need to know of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from numpy.typing import NDArray

__all__ = ["StripImage"]


class StripImage(Protocol):
    """A strip's raw pixels, read by window: the CCDs of a camera, or the single image of the virtual CCD."""

    @property
    def ccds(self) -> Sequence[int]:
        """The CCDs that were recorded, numbered as in the camera model."""

    def shape(self, ccd: int) -> tuple[int, int]:
        """(lines, samples) of one CCD's image."""

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray[Any]:
        """Pixels (rows, columns) line0..line1, sample0..sample1 (ends excluded, inside the image), any real
        type; NaN marks what must not be used: no data, cloud, saturation.
        """
