"""Pictures that let a person judge a match, small enough to be kept: 8 bits, PNG."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.records.record import Floats, record, scalar

__all__ = ["NO_PICTURES", "MatchPictures", "match_pictures", "trace_pictures"]

MOST_PX = 160  # a side longer than this is cut about its middle
# Side of the part of a correlation surface that is kept for the report, px.
SURFACE_PX = 96


@record
class MatchPictures:
    """Pictures of one match on the strip's own pixel grid."""

    template_png: bytes = scalar("chip as the strip should show it")
    found_png: bytes = scalar("strip at the matched position")
    difference_png: bytes = scalar("strip minus template after gain and offset; grey: none")
    surface_png: bytes = scalar("correlation surface of the search around that position; empty: of a star")
    surface_low: float = scalar("correlation shown black; of a star the counts that its strip shows black")
    surface_high: float = scalar("correlation shown white; of a star counts")
    place_x: float = scalar("column of the target's point in chip and strip, px; NaN: star", default=np.nan)
    place_y: float = scalar("its row", default=np.nan)
    off_x_px: float = scalar("its sample found minus that predicted; NaN: not found", default=np.nan)
    off_y_px: float = scalar("the same of the line", default=np.nan)
    surface_x: float = scalar("column of the predicted place in the surface", default=np.nan)
    surface_y: float = scalar("its row", default=np.nan)


NO_PICTURES = MatchPictures(b"", b"", b"", b"", 0.0, 1.0)  # of a position that was measured elsewhere


def match_pictures(
    template: NDArray,
    found: NDArray,
    residual: NDArray,
    surface: NDArray,
    *,
    in_chip: Floats,
    in_surface: Floats,
    off_px: Floats,
) -> MatchPictures:
    """Pictures of a template (H, W), the strip at its place, a fit's residual and the correlation surface.
    The target's point is at `in_chip` (2,), column and row, of template and strip, predicted at `in_surface`
    (2,); of one that was not found both are predicted and `off_px` (2,), found minus predicted, is NaN.

    Template and strip are stretched alike (1 % of the pixels black, 1 % white). The difference spans as
    many grey values of the strip from black to white as the strip's own picture.
    """
    in_chip = in_chip - _cut(template, MOST_PX)
    in_surface = in_surface - _cut(surface, SURFACE_PX)
    surface = _middle(surface, SURFACE_PX)
    finite = surface[np.isfinite(surface)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    template, found, difference = (_middle(image, MOST_PX) for image in (template, found, residual))
    black, white = _stretch(found)
    half = max(0.5 * (white - black), 1e-12)
    return MatchPictures(
        _png(template, *_stretch(template)),
        _png(found, black, white),
        _png(difference, -half, half),
        _png(surface, low, high),
        low,
        high,
        *(float(one) for at in (in_chip, off_px, in_surface) for one in at),
    )


def trace_pictures(found: NDArray, fitted: NDArray) -> MatchPictures:
    """Pictures of a star in a strip of the sky, from counts and fitted trace (H, W): both
    from the darkest to the brightest of the two, the difference with a quarter of that range as black and
    white.
    """
    low, high = float(min(found.min(), fitted.min())), float(max(found.max(), fitted.max()))
    quarter = max(0.25 * (high - low), 1e-12)
    return MatchPictures(
        _png(fitted, low, high),
        _png(found, low, high),
        _png(found - fitted, -quarter, quarter),
        b"",
        low,
        high,
    )


def _stretch(image: NDArray) -> tuple[float, float]:
    good = image[np.isfinite(image)]
    if not good.size:
        return 0.0, 1.0
    low, high = np.percentile(good, [1.0, 99.0])
    if high - low < 1e-6:  # one grey value is shown as grey
        return float(low) - 1.0, float(low) + 1.0
    return float(low), float(high)


def _middle(image: NDArray, most: int) -> NDArray:
    left, top = _cut(image, most)
    return np.asarray(image[top : top + most, left : left + most], dtype=np.float64)


def _cut(image: NDArray, most: int) -> tuple[int, int]:
    """Columns and rows that `_middle` cuts off before the first one that it keeps."""
    h, w = image.shape
    return max((w - most) // 2, 0), max((h - most) // 2, 0)


def _png(image: NDArray, low: float, high: float) -> bytes:
    scaled = (np.nan_to_num(image, nan=low) - low) / max(high - low, 1e-12)
    done, encoded = cv2.imencode(".png", np.round(255.0 * np.clip(scaled, 0.0, 1.0)).astype(np.uint8))
    if not done:
        raise OSError("a picture of a match could not be encoded")
    return encoded.tobytes()
