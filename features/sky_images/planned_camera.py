"""A star camera that is not yet built, by the numbers of its design: geometry, and images of stars.

All brightness follows from one number, the limiting magnitude: a star of it has the SNR 5.5 in a matched
filter, the detection limit of an image with one false star in two frames. With the noise of a pixel in
electrons the photon noise of brighter stars follows, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from boresight.features.sky_images.sky_plan import StarImageModel
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.star_id.field import nominal_camera
from boresight.star_id.finding.psf import Psf

__all__ = ["CameraNumbers", "camera_of_numbers", "images_of_numbers"]

# SNR of a star of the limiting magnitude: the detection limit of images of a megapixel
# (`false_alarms_per_frame` 0.5).
LIMIT_SNR = 5.5


@dataclass(frozen=True, slots=True)
class CameraNumbers:
    """The design of a camera; field of view or focal length, and pitch with the latter."""

    size_px: tuple[int, int] | None = None  # columns, rows
    fov_deg: float | None = None  # along the columns' direction
    focal_mm: float | None = None
    pitch_um: float | None = None
    limit_mag: float | None = None  # V of a star of SNR 5.5
    psf_sigma_px: float = 1.0
    noise_e: float = 10.0  # of one pixel: read noise and sky
    full_e: float = math.inf  # electrons that fill a pixel


def camera_of_numbers(numbers: CameraNumbers, given: StarCamera | None) -> StarCamera:
    """The camera of a design without distortion, or the one given in its place.

    `RawDataError` names the option that is missing, superfluous or out of range.
    """
    if given is not None:
        if numbers.size_px or numbers.focal_mm or numbers.pitch_um or numbers.fov_deg:
            raise RawDataError("--camera", "and --size, --fov, --focal-mm", "both", "one of them")
        return given
    if numbers.size_px is None:
        raise RawDataError(
            "--size", "value", "nothing", "columns and rows of the detector, such as 2048 2048, or an image"
        )
    if min(numbers.size_px) < 32:
        raise RawDataError("--size", "value", f"{numbers.size_px}", "at least 32 pixels a side")
    if (numbers.fov_deg is None) == (numbers.focal_mm is None):
        found = "both" if numbers.fov_deg is not None else "neither"
        raise RawDataError("--fov and --focal-mm", "options", found, "one of them")
    if numbers.pitch_um is not None and numbers.focal_mm is None:
        raise RawDataError("--pixel-um", "option", "with --fov", "with --focal-mm only")
    if numbers.fov_deg is not None:
        if not 0.5 < numbers.fov_deg < 90.0:
            raise RawDataError("--fov", "value", f"{numbers.fov_deg}", "between 0.5 and 90 degrees")
        return nominal_camera(numbers.size_px, math.radians(numbers.fov_deg))
    assert numbers.focal_mm is not None
    if numbers.pitch_um is None:
        raise RawDataError("--pixel-um", "value", "nothing", "the pitch of the pixels, beside --focal-mm")
    width, height = numbers.size_px
    return StarCamera(
        focal_m=1e-3 * numbers.focal_mm,
        pixel_m=1e-6 * numbers.pitch_um,
        width_px=width,
        height_px=height,
        principal_px=(0.5 * (width - 1), 0.5 * (height - 1)),
    )


def images_of_numbers(numbers: CameraNumbers, camera: StarCamera) -> StarImageModel:
    """Brightness and noise of stars in that camera, in electrons (1 e-/DN).

    `RawDataError` without a limiting magnitude.
    """
    if numbers.limit_mag is None:
        expected = f"the magnitude V of stars of SNR {LIMIT_SNR:g}, or an image of the sky"
        raise RawDataError("--limit-mag", "value", "nothing", expected)
    sigma = numbers.psf_sigma_px
    # flux of SNR 1 in a matched filter: noise times the root of the PSF's effective area
    faintest = LIMIT_SNR * numbers.noise_e * math.sqrt(4.0 * math.pi) * sigma
    return StarImageModel(
        psf=Psf(sigma, sigma, (0.0, 0.0), camera.width_px, camera.height_px),
        noise_dn=numbers.noise_e,
        gain_e_per_dn=1.0,
        full_dn=numbers.full_e,
        flux_of_v0_dn=faintest * 10.0 ** (0.4 * numbers.limit_mag),
        faintest_dn=faintest,
    )
