"""What an image's own file says of its time and lens (FITS, EXIF); what a user states of time and place.

Cameras write local time where EXIF states no offset; it is then taken as UTC, which changes the direction of
the Earth's velocity by half a degree at most (0.2 arc-seconds of aberration).
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from boresight.pipeline.files.images.image_file import ImageFile, open_image
from boresight.pipeline.files.images.star_images import opened_fits
from boresight.records.record import record, scalar
from boresight.star_id.field import FieldSolution

__all__ = ["NOWHERE", "Whereabouts", "time_of_image", "with_error_of_focus"]

_HEAD_BYTES = 2**17  # EXIF stands before the pixels
# Tags of EXIF 2.32: its directory, DateTimeOriginal, OffsetTimeOriginal, ExposureTime, FNumber, FocalLength.
_EXIF_IFD, _TAKEN, _OFFSET, _EXPOSURE_S, _F_NUMBER, _FOCAL_MM = 0x8769, 0x9003, 0x9011, 0x829A, 0x829D, 0x920A
_GREEN_MM = 550e-6  # wavelength in the middle of what cameras see
_ISO = re.compile(r"\d{4}-\d\d-\d\d(T\d\d:\d\d(:\d\d(\.\d+)?)?)?Z?")  # a date of FITS, with or without time
_UTC_NAMES = ("UTC", "UT1", "UT", "")  # values of TIMESYS that are UTC within 1 s
_YEARS = (1972, 2100)  # from the first leap second on; a clock that was never set is mostly before


def time_of_image(path: Path) -> str | None:
    """Middle of the exposure, UTC (ISO 8601), or None where the file does not say it."""
    try:
        image = open_image(path, str(path), whole=False)
        when = _of_fits(image) if image.format == "FITS" else _of_exif(_exif(image))
    except Exception:  # no file, or a damaged header, of which libraries raise many kinds, states no time
        return None
    if when is None or not _YEARS[0] <= when.year <= _YEARS[1]:
        return None
    return when.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def with_error_of_focus(found: FieldSolution, path: Path) -> FieldSolution:
    """The solution of an image with a fitted camera, with the error of focus in that of the field of view.

    Stars look alike while the image is less than 2 wavelengths times N² out of focus, a quarter of a wave
    (Rayleigh), N the f-number. Temperature and focusing change its distance within that, all distances alike,
    and so the scale: a lens of 3 mm at f/2 by 1450 ppm. A file that names no lens leaves the error as it is.
    """
    try:
        tags = _exif(open_image(path, str(path), whole=False))
        scale = 2.0 * _GREEN_MM * float(tags[_F_NUMBER]) ** 2 / float(tags[_FOCAL_MM]) / np.sqrt(3.0)
    except Exception:  # not stated, not a number, or a damaged header
        return found
    wider = float(np.hypot(found.fov_x_sigma_rad, scale * found.fov_x_rad))
    return replace(found, fov_x_sigma_rad=wider) if found.fov_x_sigma_rad and 0.0 < scale < 1.0 else found


def _of_fits(image: ImageFile) -> datetime | None:
    with opened_fits(image) as hdus:
        return next((when for hdu in hdus[:2] if (when := _of_cards(hdu.header)) is not None), None)


def _of_cards(header: Mapping[str, Any]) -> datetime | None:
    if str(header.get("TIMESYS", "UTC")).strip().upper() not in _UTC_NAMES:
        return None
    for key in ("DATE-AVG", "DATE-BEG", "DATE-OBS"):
        text = str(header.get(key, "")).strip()
        if key == "DATE-OBS" and "T" not in text and (clock := str(header.get("TIME-OBS", "")).strip()):
            text = f"{text}T{clock}"
        if not _ISO.fullmatch(text):
            continue
        when = datetime.fromisoformat(text.rstrip("Z")).replace(tzinfo=UTC)
        if "T" not in text:
            return when + timedelta(hours=12)
        exposure_s = 0.0 if key == "DATE-AVG" else float(header.get("EXPTIME", header.get("EXPOSURE", 0.0)))
        return when + timedelta(seconds=0.5 * exposure_s)
    return None


def _exif(image: ImageFile) -> Mapping[int, Any]:
    """The tags of an image's EXIF directory, by number; none where it has no such directory."""
    head = image.first(_HEAD_BYTES)
    if image.format == "FITS" or not (b"Exif" in head or b"eXIf" in head or head[:2] in (b"II", b"MM")):
        return {}
    with Image.open(io.BytesIO(image.whole())) as picture:
        return picture.getexif().get_ifd(_EXIF_IFD)


def _of_exif(tags: Mapping[int, Any]) -> datetime | None:
    if not (text := str(tags.get(_TAKEN, "")).strip("\0 ")):
        return None
    when = datetime.strptime(text, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    if match := re.fullmatch(r"([+-])(\d\d):(\d\d)", str(tags.get(_OFFSET, ""))):
        when -= timedelta(hours=int(match[1] + match[2]), minutes=int(match[1] + match[3]))
    return when + timedelta(seconds=0.5 * float(tags.get(_EXPOSURE_S, 0.0)))


@record
class Whereabouts:
    """Times and position of single images, as far as the user states them."""

    times: Path | None = scalar("CSV with columns file, utc_mid", default=None)
    orbit: Path | None = scalar("OEM of a satellite", default=None)
    site_deg_m: tuple[float, float, float] | None = scalar(
        "latitude, longitude (degrees), ellipsoidal height (m)", default=None
    )


NOWHERE = Whereabouts()  # neither times nor place are known
