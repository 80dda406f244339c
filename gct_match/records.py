"""What goes into the ground half and what comes out: chips, targets, strips, places and refusals.

Image points are (x, y) = (sample, line); (0, 0) is the centre of the first pixel of a CCD's raw image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Chip", "Evidence", "Refusal", "StripImage", "StripMatches", "Target", "TargetMatch"]

Array = NDArray[np.float64]
Image = NDArray[Any]  # single precision


@dataclass(frozen=True, slots=True, eq=False)
class Chip:
    """A geo-referenced picture of the ground around a target.

    `transform` (a, b, c, d, e, f) takes a point (column, row) of the chip to map coordinates of `crs`,
    X = a col + b row + c, Y = d col + e row + f, where (0, 0) is the **outer corner** of the first pixel,
    as in a GeoTIFF; the centre of the first pixel is (0.5, 0.5).
    """

    target_id: str
    image: Image  # (H, W) grey values of any radiometric scale
    transform: tuple[float, float, float, float, float, float]
    crs: str  # anything PROJ understands: "EPSG:32633", WKT
    valid: NDArray[np.bool_]  # (H, W) false where the chip holds no data or a cloud

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or self.valid.shape != self.image.shape:
            raise ValueError(
                f"chip {self.target_id}: image and valid must be one (H, W), "
                f"got {self.image.shape} and {self.valid.shape}"
            )
        a, b, _, d, e, _ = self.transform
        if a * e - b * d == 0.0:
            raise ValueError(f"chip {self.target_id}: its transform {self.transform} has no inverse")


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A ground calibration target: a surveyed point, best near the middle of its chip."""

    target_id: str
    p_e: Array  # (3,) ITRS, m
    sigma_m: Array  # (3,) standard error east, north, up, m

    def __post_init__(self) -> None:
        if np.shape(self.p_e) != (3,) or np.shape(self.sigma_m) != (3,):
            raise ValueError(f"target {self.target_id}: p_e and sigma_m must have shape (3,)")


class StripImage(Protocol):
    """A strip's raw pixels, read by window; the four CCDs, or the one image of the virtual CCD."""

    @property
    def ccds(self) -> Sequence[int]:
        """The CCDs that were recorded, numbered as in the camera model."""

    def shape(self, ccd: int) -> tuple[int, int]:
        """(lines, samples) of one CCD's image."""

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray:
        """Rows line0..line1 and columns sample0..sample1 (ends excluded, all inside the image), any real
        type.

        NaN marks what must not be used: no data, cloud, saturation.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a person needs to see to believe a match; all pictures are on the strip's own pixel grid."""

    template: Image  # (h, w) the chip as the strip should show it
    found: Image  # (h, w) the strip, resampled to where the template was found
    residual: Image  # (h, w) found minus template after gain and offset, in grey values of the strip
    correlation: Image  # correlation surface of the search around the place
    origin_px: Array  # (2,) (sample, line) of the template's first pixel as predicted


@dataclass(frozen=True, slots=True, eq=False)
class TargetMatch:
    """A target placed in one CCD of a strip."""

    target_id: str
    ccd: int
    xy_px: Array  # (2,) (sample, line) of the target's own point
    cov_px: Array  # (2, 2) its covariance, px²
    correlation: float  # of template and strip, both filtered, at the place found
    probability_wrong: float  # that this is another place than the target's
    model: str  # "translation" or "affine"
    predicted_px: Array  # (2,) where the model at the present installation matrix put it
    residual_px: Array  # (2,) place found minus place after the common rotation
    evidence: Evidence


@dataclass(frozen=True, slots=True)
class Refusal:
    """A target that was not placed in a CCD, and why. `ccd` is -1 when it concerns the whole strip."""

    target_id: str
    ccd: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class StripMatches:
    """All targets of a strip: placed, or refused with the reason.

    `theta_vote` is the one small rotation on which the targets agree, against the installation matrix that
    the search started from: R_cs = exp[[theta]] R_cs0 (geometry/installation.py), rad, axes of frame c. It
    is a by-product for the search; the calibration estimates its own. NaN when the targets agreed on nothing.
    """

    matches: tuple[TargetMatch, ...]
    refused: tuple[Refusal, ...]
    theta_vote: Array  # (3,) rad
    cov_theta_vote: Array  # (3, 3) rad²
    probability_chance: float  # that so many targets agree by chance
    pixels_read: int
