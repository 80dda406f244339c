"""Input and output records of target matching: chips, targets, strips, matches and refusals.

Image points are (x, y) = (sample, line); (0, 0) is the centre of the first pixel of a CCD's raw image.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.record import Bools, Floats, array, record, scalar

__all__ = [
    "Chip",
    "Image",
    "Reason",
    "Refusal",
    "StripMatches",
    "Target",
    "TargetMatch",
    "TemplateMatch",
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
class Target:
    """A ground calibration target: a surveyed point, best near the middle of its chip."""

    target_id: str = scalar("identifier")
    p_e: Floats = array("3", "position, ITRS, m")
    sigma_m: Floats = array("3", "standard error east, north, up, m")


class Reason(StrEnum):
    """Why a target or a template was not matched."""

    OUTSIDE_REACH = "outside_reach"
    OUTSIDE_CCDS = "outside_ccds"
    OUTSIDE_CHIP = "outside_chip"
    CHIP_TOO_SMALL = "chip_too_small"
    TOO_LITTLE_TEXTURE = "too_little_texture"
    NO_COMMON_ROTATION = "no_common_rotation"
    TEMPLATE_CUT = "template_cut"
    FEW_VALID_PIXELS = "few_valid_pixels"
    ONE_GREY_VALUE = "one_grey_value"
    NO_CORRELATION = "no_correlation"
    NOT_CONVERGED = "not_converged"
    UNCERTAIN_POSITION = "uncertain_position"
    PROBABLY_WRONG = "probably_wrong"
    AT_WINDOW_EDGE = "at_window_edge"
    SELF_SIMILAR = "self_similar"
    LOW_CORRELATION = "low_correlation"
    INCONSISTENT = "inconsistent"


# Sentence of each reason why a target is not matched; filled with its value, the limit and further numbers.
_SENTENCES = {
    Reason.OUTSIDE_REACH: "outside the strip for every installation matrix within the stated uncertainty",
    Reason.OUTSIDE_CCDS: "outside every CCD's image at the common rotation",
    Reason.OUTSIDE_CHIP: "coordinates lie {value:.0f} px outside its chip of {more[0]:.0f} x "
    "{more[1]:.0f} px",
    Reason.CHIP_TOO_SMALL: "its chip is {value:.3g} px wide in the strip, at least {limit:.0f} px are "
    "needed; check the pixel size in its geo-reference",
    Reason.TOO_LITTLE_TEXTURE: "its chip has too little texture: expected standard error {value:.2g} px, "
    "at most {limit} px is allowed",
    Reason.NO_COMMON_ROTATION: "no common rotation: of {more[0]:.0f} targets {more[1]:.0f} agree and "
    "{more[2]:.0f} of these were matched, which happens by chance with probability {value:.1g}, "
    "{limit:.1g} is allowed",
    Reason.TEMPLATE_CUT: "{more[0]:.0f} x {more[1]:.0f} px of its chip lie within the strip's image, "
    "{limit:.0f} are needed",
    Reason.FEW_VALID_PIXELS: "{value:.0%} of the template's pixels are valid (cloud, no data, saturation, "
    "image edge), {limit:.0%} are needed",
    Reason.ONE_GREY_VALUE: "the strip has the grey value {value:g} throughout its search window: the "
    "detector is dead or saturated there, or its file is empty",
    Reason.NO_CORRELATION: "no positive correlation in the search window",
    Reason.NOT_CONVERGED: "least squares did not converge from the {more[0]:.0f} highest correlation peak(s)",
    Reason.UNCERTAIN_POSITION: "standard error {value:.2g} px, at most {limit} px is allowed",
    Reason.PROBABLY_WRONG: "wrong with probability {value:.1g} (highest correlation {more[0]:.2f}), at most "
    "{limit:.1g} is allowed",
    Reason.AT_WINDOW_EDGE: "at the edge of its search window of ±{limit:.0f} px",
    Reason.SELF_SIMILAR: "self-similar template (correlation {more[0]:.2f} with a displaced copy of itself) "
    "with standard error {value:.2g} px, at most {limit} px is allowed to exclude a false match",
    Reason.LOW_CORRELATION: "correlation {value:.2f}, at least {limit} is needed",
    Reason.INCONSISTENT: "{value:.1f} standard errors ({more[0]:+.2f}, {more[1]:+.2f} px) from the position "
    "that the strip's other targets predict, at most {limit:.0f} are allowed",
}
# Stands for a value or limit that a test does not have.
_NONE = float("nan")


@record
class Refusal:
    """A target that was not matched in a CCD, or a template that was not found; false in a condition."""

    reason: Reason = scalar("which test failed")
    value: float = scalar("value that failed the test, NaN if the test has none", default=_NONE)
    limit: float = scalar("limit of the test in the unit of `value`, NaN if none", default=_NONE)
    more: tuple[float, ...] = scalar("further numbers of the sentence", default=())
    target_id: str = scalar("refused target; empty for a template without a target", default="")
    ccd: int = scalar("CCD; -1 if the refusal concerns the whole strip", default=-1)
    match: TargetMatch | None = scalar("the match that contradicts the others", default=None)

    @property
    def sentence(self) -> str:
        """What was measured and what is needed, in plain English."""
        return _SENTENCES[self.reason].format(value=self.value, limit=self.limit, more=self.more)

    @property
    def is_out_of_view(self) -> bool:
        """Whether the target lies outside the strip's footprint."""
        return self.reason in (Reason.OUTSIDE_REACH, Reason.OUTSIDE_CCDS)

    def __bool__(self) -> Literal[False]:
        return False

    def __str__(self) -> str:
        return self.sentence

    def __repr__(self) -> str:
        return f"not matched: {self.sentence}"


@record(kw_only=True)
class TemplateMatch:
    """Position of a template in a picture, accepted by all tests."""

    xy_px: Floats = array("2", "(x, y) of the template's reference point in the picture, px")
    cov_px: Floats = array("2, 2", "its covariance, px²")
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
    refused: tuple[Refusal, ...] = scalar("refused targets")
    theta_vote: Floats = array("3", "common rotation, rad, axes of frame c; NaN if the targets agree on none")
    probability_chance: float = scalar("probability that as many targets agree by chance")
