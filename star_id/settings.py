"""What a user may set about finding and naming stars. Every default has its reason beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

__all__ = ["CentroidMethod", "StarSettings"]

CentroidMethod = Literal["fit", "window"]


@dataclass(frozen=True, slots=True)
class StarSettings:
    """Settings of detection, centroids and identification."""

    # Detection
    false_alarms_per_frame: float = 0.5  # expected peaks of pure noise a frame; sets the threshold
    saturation_dn: float | None = None  # None: the top of the image's own range of values
    gain_e_per_dn: float | None = (
        None  # None: photon noise is judged from the residuals of the stars themselves
    )
    psf_sigma_px: float | None = None  # None: estimated from the image
    smear_px: tuple[float, float] | None = (
        None  # blur by motion in the exposure, (column, row); None: looked for
    )
    centroid_method: CentroidMethod = (
        "fit"  # "window": first moments; nearly as good, and ask for symmetry alone
    )
    max_stars: int = 600  # brightest detections kept; beyond it more stars only cost time

    # Identification
    max_false_alarm_probability: float = 1e-9  # an identification less sure than this is "not identified"
    camera_error: float = 5e-4  # relative error of angles by a known camera: half a pixel in 1000
    uncalibrated_error: float = 0.02  # the same for a camera of which only the field of view is known
    fov_tolerance: float = 0.1  # a stated field of view is good to this fraction
    max_identification_stars: int = 24  # brightest detections of which triangles are made

    # Sightings for calibration
    max_photocentre_shift_px: float = 0.02  # catalogue pairs that displace the light further are left out

    def __post_init__(self) -> None:
        if self.centroid_method not in get_args(CentroidMethod):
            methods = " or ".join(get_args(CentroidMethod))
            raise ValueError(f"StarSettings.centroid_method must be {methods}, got {self.centroid_method}")
        for name in ("false_alarms_per_frame", "max_stars", "max_false_alarm_probability", "camera_error"):
            if not getattr(self, name) > 0:
                raise ValueError(f"StarSettings.{name} must be positive, got {getattr(self, name)}")
