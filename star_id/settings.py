"""Settings of star detection, centroids and identification, with the reason for each default."""

from __future__ import annotations

from boresight.records.record import check_numbers, record, scalar

__all__ = ["StarSettings"]


@record(kw_only=True)
class StarSettings:
    """Settings of detection, centroids and identification."""

    # Detection
    false_alarms_per_frame: float = scalar("expected noise peaks per image; sets the threshold", default=0.5)
    saturation_dn: float | None = scalar("None: the top of the image's own range of values", default=None)
    gain_e_per_dn: float | None = scalar("None: from the residuals of the stars themselves", default=None)
    psf_sigma_px: float | None = scalar("None: estimated from the image", default=None)
    smear_px: tuple[float, float] | None = scalar("motion (column, row), px; None: estimated", default=None)
    max_stars: int = scalar("brightest detections kept; more stars only cost time", default=600)

    # Identification
    max_false_alarm_probability: float = scalar("an identification less certain is rejected", default=1e-9)
    camera_error: float = scalar("relative error of angles, calibrated camera", default=5e-4)
    uncalibrated_error: float = scalar("relative error of angles, other cameras", default=0.02)
    fov_tolerance: float = scalar("relative error of a stated field of view", default=0.1)
    max_identification_stars: int = scalar("brightest detections of which triangles are made", default=24)

    # Images without time
    epoch_error_years: float = scalar(
        "1-sigma error of the index's epoch for images without time; 0: the epoch is theirs", default=0.0
    )

    # Sightings for calibration
    max_photocentre_shift_px: float = scalar("limit for displaced stars, px", default=0.02)

    def __post_init__(self) -> None:
        zero = ("epoch_error_years", "max_photocentre_shift_px")
        check_numbers(self, any_value=("saturation_dn",), zero=zero)
        if self.saturation_dn is not None and not self.saturation_dn > 0.0:
            raise ValueError(f"StarSettings.saturation_dn must be positive, got {self.saturation_dn}")
