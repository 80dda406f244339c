"""Settings of stars in strips of the sky, with the reason for each default."""

from __future__ import annotations

from boresight.records.record import check_numbers, record, scalar

__all__ = ["StripStarSettings"]


@record(kw_only=True)
class StripStarSettings:
    """Settings of detection, centroids and identification in strips of the sky."""

    false_alarms_per_strip: float = scalar("expected noise peaks; sets the threshold", default=1.0)
    psf_sigma_px: float | None = scalar("of the optics alone; None: estimated from the stars", default=None)
    gain_e_per_dn: float | None = scalar("None: from the residuals of the stars", default=None)
    saturation_dn: float | None = scalar("None: the top of the bit depth", default=None)
    max_smear_rows: float = scalar("longer traces are not measured: the rate is wrong", default=48.0)
    max_stars_per_deg2: float = scalar("more: the Milky Way, where stars overlap", default=2000.0)
    sigmas: float = scalar("the mounting is searched within so many sigma of each angle", default=3.0)
    max_false_alarm_probability: float = scalar("a less certain identification is rejected", default=1e-6)
    max_name_error: float = scalar("a star whose name is less certain is not used", default=1e-3)
    brightest: int = scalar("detections, and catalogue stars, that vote for the mounting", default=150)
    magnitude_error: float = scalar(
        "larger differences from catalogue and zero point: another star", default=1.5
    )

    def __post_init__(self) -> None:
        check_numbers(self, zero=("max_name_error",))
