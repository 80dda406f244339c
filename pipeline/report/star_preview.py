"""A star image made fit to be looked at, and what was found in it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.geometry.sightings import StarSightings
from boresight.star_id.finding.star_list import find_stars
from boresight.star_id.settings import StarSettings

__all__ = ["STATES", "StarPreview", "star_preview"]

Array = NDArray[np.float64]

STATES = {
    "used": "named and used",
    "rejected": "named, left out by the calibration",
    "saturated": "saturated, its skirt not that of a star: not used",
    "blended": "displaced by a neighbour: not used",
    "unused": "not named, or marked in the catalogue: not used",
}
LONG_SIDE_PX = 2048  # of the picture; a larger image is halved until it fits
SKY_SIGMAS = (-1.5, 25.0)  # black and white of the picture, about the median of the image


@dataclass(frozen=True, slots=True, eq=False)
class StarPreview:
    """Picture and detections of one exposure. Row n of every array speaks of one detection."""

    exposure_id: str
    jpeg: bytes
    shrunk: int  # pixels of the image a pixel of the picture, each way
    xy_px: Array  # (N, 2) in pixels of the image
    snr: Array  # (N,)
    state: NDArray[np.str_]  # (N,) a key of STATES
    hip: NDArray[np.int64]  # (N,) 0 where not named
    hot_pixels: int  # refused as such
    misshapen: int  # refused: cosmic rays, trails


def star_preview(
    image: NDArray[np.uint16], sighted: StarSightings, kept: NDArray[np.bool_], settings: StarSettings
) -> StarPreview:
    """`image` (H, W) is the raw exposure, `sighted` what identification made of it, `kept` (N,) what of that
    the calibration used."""
    found = find_stars(image, settings)
    displaced = np.where(found.saturated, "saturated", "blended")
    state = np.where(found.blended, displaced, "unused").astype("U9")
    hip = np.zeros(len(state), dtype=np.int64)
    if len(state) and len(sighted.hip):
        distance = np.linalg.norm(found.xy_px[:, None, :] - sighted.xy_px[None, :, :], axis=2)
        nearest = distance.argmin(axis=0)
        same = distance.min(axis=0) < 1e-3
        hip[nearest[same]] = sighted.hip[same]
        state[nearest[same]] = np.where(kept[same], "used", "rejected")
    jpeg, shrunk = _picture(image)
    return StarPreview(
        sighted.exposure_id,
        jpeg,
        shrunk,
        found.xy_px,
        found.snr,
        state,
        hip,
        found.hot_pixels,
        found.misshapen,
    )


def _picture(image: NDArray[np.uint16]) -> tuple[bytes, int]:
    """JPEG of the image, stretched; of pixels put together the brightest is shown, so no star is lost."""
    shrunk = 1
    while max(image.shape) / shrunk > LONG_SIDE_PX:
        shrunk *= 2
    h, w = (side // shrunk * shrunk for side in image.shape)
    small = (
        image[:h, :w].reshape(h // shrunk, shrunk, w // shrunk, shrunk).max(axis=(1, 3)).astype(np.float32)
    )
    sky = float(np.median(small))
    sigma = max(1.4826 * float(np.median(np.abs(small - sky))), 0.5)
    low, high = (sky + s * sigma for s in SKY_SIGMAS)
    grey = np.clip((small - low) / (high - low), 0.0, 1.0) ** 0.6
    done, encoded = cv2.imencode(".jpg", (255.0 * grey).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 72])
    if not done:
        raise OSError("the star image could not be encoded")
    return encoded.tobytes(), shrunk
