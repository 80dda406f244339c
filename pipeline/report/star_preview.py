"""Stretched picture of one star image with the detections in it and how each was used."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.geometry.sightings import StarSightings
from boresight.records.record import Floats, Ints, Texts, array, record, scalar
from boresight.star_id.beyond_chance import MAD_SIGMA
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings

__all__ = ["STATES", "StarPreview", "jpeg_of", "sky_stretch", "star_preview", "stretched_jpeg"]

# What became of a detection, and the words for it.
STATES = {
    "used": "identified and used",
    "rejected": "identified, rejected as an outlier",
    "saturated": "saturated, wings not consistent with the PSF: not used",
    "blended": "blended with a neighbour: not used",
    "unused": "not identified, or flagged in the catalogue: not used",
}
LONG_SIDE_PX = 2048  # of the picture; a larger image is reduced by powers of two
# Black and white of the picture: the median of the image plus so many 1-sigma of its noise.
SKY_SIGMAS = (-1.5, 25.0)


@record(kw_only=True)
class StarPreview:
    """Picture and detections of one exposure. Row n of every array is the same detection."""

    exposure_id: str = scalar("id of the exposure")
    jpeg: bytes = scalar("stretched picture, JPEG")
    shrunk: int = scalar("reduction: image pixels per picture pixel along each axis")
    xy_px: Floats = array("N, 2", "(column, row) in pixels of the image")
    snr: Floats = array("N", "signal-to-noise ratio")
    state: Texts = array("N", "key of `STATES`")
    hip: Ints = array("N", "Hipparcos number, 0 where not identified")
    hot_pixels: int = scalar("detections rejected as hot pixels")
    misshapen: int = scalar("detections rejected as cosmic rays or trails")


def star_preview(
    image: NDArray[np.uint16], sighted: StarSightings, kept: NDArray[np.bool_], settings: StarSettings
) -> StarPreview:
    """Preview of a raw exposure `image` (H, W) with its identified stars; `kept` (N,) marks those used."""
    found = list_stars(image, settings)
    displaced = np.where(found.saturated, "saturated", "blended")
    state = np.where(found.blended, displaced, "unused").astype("U9")
    hip = np.zeros(len(state), dtype=np.int64)
    if len(state) and len(sighted.hip):
        distance = np.linalg.norm(found.xy_px[:, None, :] - sighted.xy_px[None, :, :], axis=2)
        nearest = distance.argmin(axis=0)
        same = distance.min(axis=0) < 1e-3
        hip[nearest[same]] = sighted.hip[same]
        state[nearest[same]] = np.where(kept[same], "used", "rejected")
    jpeg, shrunk = stretched_jpeg(image)
    return StarPreview(
        exposure_id=sighted.exposure_id,
        jpeg=jpeg,
        shrunk=shrunk,
        xy_px=found.xy_px,
        snr=found.snr,
        state=state,
        hip=hip,
        hot_pixels=found.hot_pixels,
        misshapen=found.misshapen,
    )


def stretched_jpeg(image: NDArray[np.generic]) -> tuple[bytes, int]:
    """Stretched JPEG of an image (H, W) and its reduction factor; a reduced pixel is a block's brightest.

    Raises `OSError` if it cannot be encoded.
    """
    shrunk = 1
    while max(image.shape) / shrunk > LONG_SIDE_PX:
        shrunk *= 2
    h, w = (side // shrunk * shrunk for side in image.shape)
    small = image[:h, :w].reshape(h // shrunk, shrunk, w // shrunk, shrunk).max(axis=(1, 3))
    return jpeg_of((255.0 * sky_stretch(small.astype(np.float32))).astype(np.uint8), 72), shrunk


def jpeg_of(grey: NDArray[np.uint8], quality: int) -> bytes:
    """A grey picture (H, W) as JPEG. Raises `OSError` if it cannot be encoded."""
    done, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OSError("a picture could not be encoded")
    return encoded.tobytes()


def sky_stretch(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Brightness from 0 to 1 of an image (H, W): sky and its noise dark, stars bright."""
    sky = float(np.median(image))
    sigma = max(MAD_SIGMA * float(np.median(np.abs(image - sky))), 0.5)
    low, high = (sky + s * sigma for s in SKY_SIGMAS)
    return ((np.clip(image, low, high) - low) / (high - low)) ** 0.6
