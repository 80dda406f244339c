"""The table of image points that commands read: ccd, sample, line."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["PixelRow"]


class PixelRow(BaseModel):
    """One line of the file of pixels. (0, 0) is the centre of the first pixel."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)
    ccd: Annotated[int, Field(ge=0)]
    sample: float
    line: float
