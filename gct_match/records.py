"""Input and output records of target matching: chips, targets, strips and matches.

Image points are (x, y) = (sample, line); (0, 0) is the centre of the first pixel of a CCD's raw image.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = [
    "Chip",
    "GroundReference",
    "Image",
    "StripMatches",
    "Target",
    "TargetMatch",
    "TemplateMatch",
    "not_matched",
]

Image = NDArray[Any]  # single precision


@record
class Chip:
    """A geo-referenced picture of the ground around a target.

    `transform` (a, b, c, d, e, f) takes a point (column, row) of the chip to map coordinates of `crs`,
    X = a col + b row + c, Y = d col + e row + f, where (0, 0) is the **outer corner** of the first pixel,
    as in a GeoTIFF; the centre of the first pixel is (0.5, 0.5). Construction raises `ValueError` where the
    transform has no inverse.
    """

    target_id: str = scalar("identifier of the target that the chip shows")
    image: Image = array("H, W", "grey values, any radiometric scale")
    transform: tuple[float, float, float, float, float, float] = scalar("pixel corners to map coordinates")
    crs: str = scalar('coordinate reference system as PROJ understands it: "EPSG:32633", WKT')
    valid: Bools = array("H, W", "false where the chip holds no data or a cloud")

    def __post_init__(self) -> None:
        a, b, _, d, e, _ = self.transform
        if a * e - b * d == 0.0:
            raise ValueError(f"chip {self.target_id}: its transform {self.transform} has no inverse")


@record
class GroundReference:
    """A mosaic, or a survey, whose points have an offset in common."""

    name: str = scalar("identifier")
    sigma_m: Floats = array("3", "1-sigma of the offset east, north, up, m")
    length_m: float = scalar("correlation length of the offset; 0: one offset everywhere")


@record
class Target:
    """A ground calibration target: a surveyed point, best near the middle of its chip."""

    target_id: str = scalar("identifier")
    p_e: Floats = array("3", "position, ITRS, m")
    sigma_m: Floats = array("3", "standard error east, north, up, m, beside that of its reference")
    reference: GroundReference | None = scalar(
        "what its place is taken from, if that is stated", default=None
    )


def not_matched(
    reason: Reason, value: float = math.nan, limit: float = math.nan, more: tuple[float, ...] = ()
) -> Entry:
    """Entry of a target, or of a template alone, that was not found; who knows its subject names it."""
    return Entry(Subject(Kind.TARGET), reason, value=value, limit=limit, more=more)


@record(kw_only=True)
class TemplateMatch:
    """Position of a template in a picture, accepted by all tests."""

    xy_px: Floats = array("2", "(x, y) of the template's reference point in the picture, px")
    cov_px: Floats = array("2, 2", "its covariance, px²")
    cov_moved_px: Floats = array("2, 2", "part of it by ground that has moved between the dates, px²")
    correlation: float = scalar("of template and picture at that position, both filtered")
    probability_wrong: float = scalar("probability that the true position is another one")
    affine: Floats = array("2, 2", "A - I of the affine map template to picture; zero for a translation")
    found: Image = array("H, W", "picture resampled to the template's pixels")
    residual: Image = array("H, W", "found minus template after gain and offset, filtered, grey values")
    surface: Image = array("R, C", "correlation at whole pixels of the search window")

    @property
    def model(self) -> str:
        """The map from template to picture: "translation" or "affine"."""
        return "affine" if self.affine.any() else "translation"

    def __repr__(self) -> str:
        x, y, sigma = *self.xy_px, np.sqrt(np.diag(self.cov_px))
        return (
            f"{type(self).__name__}: x {x:.4f} ± {sigma[0]:.4f} px, y {y:.4f} ± {sigma[1]:.4f} px\n"
            f"  correlation {self.correlation:.3f}, wrong with probability {self.probability_wrong:.1g}\n"
            f"  {'affine map' if self.affine.any() else 'translation'} of {self.found.shape[1]} x "
            f"{self.found.shape[0]} px"
        )


@record(kw_only=True)
class TargetMatch(TemplateMatch):
    """A target matched in one CCD of a strip: the template is its chip, and the picture the strip.

    `xy_px` is the (sample, line) of the target's surveyed point.
    """

    target_id: str = scalar("identifier of the target")
    ccd: int = scalar("CCD as numbered in the camera model")
    predicted_px: Floats = array("2", "(sample, line) predicted with the initial installation matrix")
    expected_px: Floats = array("2", "(sample, line) predicted with the rotation that was searched for")
    residual_px: Floats = array("2", "xy_px minus the position predicted with the common rotation")
    template: Image = array("H, W", "chip as the strip should show it, on the strip's pixel grid")
    place_px: Floats = array("2", "(column, row) of the surveyed point in `template` and `found`")


@record(kw_only=True)
class StripMatches:
    """All targets of a strip: matched, or refused with the reason.

    `theta_vote` is the small rotation on which the targets agree, relative to the installation matrix that
    the search started from: R_cs = exp[[theta]] R_cs0 (geometry/installation.py). It serves the search only;
    the calibration estimates its own.
    """

    matches: tuple[TargetMatch, ...] = scalar("accepted matches, one for each target and CCD")
    refused: tuple[Entry, ...] = scalar("targets that were not matched, with reasons")
    theta_vote: Floats = array("3", "common rotation, rad, axes of frame c; NaN if the targets agree on none")
    probability_chance: float = scalar("probability that as many targets agree by chance")
