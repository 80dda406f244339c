"""Settings of the estimator: prior sigmas, robustness and convergence limits, with units and reasons."""

from __future__ import annotations

from dataclasses import fields

from boresight.geometry.attitude_estimate import AttitudeSettings
from boresight.geometry.constants import ARCSEC
from boresight.records.record import check_numbers, record

__all__ = ["CalibrationSettings"]


@record(by_value=True)
class CalibrationSettings:
    """Priors of the errors that the sightings' own covariances do not hold, and the solver's limits.

    A prior of zero switches its error off. The defaults are the paper's Table 1.
    """

    sigma_position_m: float = 2.0  # per axis, common to a pass (Table 1, GPS)
    position_time_s: float = 0.0  # to a correlation of 1/e; 0: constant over a pass, new in each
    sigma_clock_s: float = 1e-4  # common to a pass: its rows against orbit and star camera (Table 1)
    clock_time_s: float = 0.0  # as that of the position
    sigma_vibration_rad: float = (
        0.1 * ARCSEC
    )  # per axis and target: motion that the exposures cannot follow (Table 1)
    sigma_vibration_exposure_rad: float = 0.0  # the same seen by an exposure: its own time averages it away
    sigma_motion_rad: float = 0.0  # about each axis, rms: slow motion between exposures; 0: none
    motion_time_s: float = 0.8  # over which it is smooth; a wave of period P has P / (2 pi)
    sigma_distortion_rad: float = 3e-7  # per axis: 0.3 px of 10 µm behind 10 m (Tables 1 and 3)
    distortion_length_px: float = 2000.0  # along a CCD: left by a calibration with a few knots a CCD
    distortion_pixel_rad: float = 0.0  # of a pixel: one curve over the field; 0: one for each CCD
    sigma_ccd_shift_rad: float = 0.0  # per axis: residual distortion of each CCD by itself, its mean,
    sigma_ccd_slope_rad: float = 0.0  # its linear part, rms over it: rotation (along x), scale (along y),
    sigma_ccd_bend_rad: float = 0.0  # and its quadratic part, rms over the CCD
    ccd_px: tuple[int, ...] = ()  # samples of each CCD; none: CCDs have no residual of their own
    sigma_mounting_rad: float = (
        10.0 * ARCSEC
    )  # about each axis, between strips: weighs causes, moves no matrix
    most_shared_targets: int = 100  # seen in several strips as one point each; the rest as many points
    probability_false_alarm: float = 1e-3  # of rejecting a good star or target
    robust: bool = True  # look for gross errors at all
    fewest_stars: int = 3  # an exposure with fewer is not used: nothing checks its attitude
    sigma_observable_rad: float = 1e-3  # a ground measurement is better; a weaker direction gets no number
    of_cameras: tuple[tuple[str, CalibrationSettings], ...] = ()  # by name, of those with other distortions
    tolerance_rad: float = 1e-11  # M -> I: 2e-6 arcsec
    tolerance_sigma: float = 0.01  # M -> I in units of the predicted sigma
    most_iterations: int = 20

    def of(self, camera: str) -> CalibrationSettings:
        """The settings whose distortion is that of one of several cameras."""
        return dict(self.of_cameras).get(camera, self)

    @property
    def sigma_ccd_rad(self) -> tuple[float, float, float]:
        """1-sigma of shift, slope and bend of a CCD, rad."""
        return self.sigma_ccd_shift_rad, self.sigma_ccd_slope_rad, self.sigma_ccd_bend_rad

    @property
    def attitudes(self) -> AttitudeSettings:
        """How the attitudes of the star exposures are fitted."""
        return AttitudeSettings(
            robust=self.robust,
            probability_false_alarm=self.probability_false_alarm,
            fewest_stars=self.fewest_stars,
        )

    def __post_init__(self) -> None:
        sigmas = (field.name for field in fields(self) if field.name.startswith("sigma_"))
        others = ("position_time_s", "clock_time_s", "distortion_pixel_rad", "most_shared_targets")
        check_numbers(self, zero=(*sigmas, *others))
        if any(samples < 2 for samples in self.ccd_px):
            raise ValueError(f"ccd_px must be 2 or more for every CCD, got {self.ccd_px}")
        if not 0.0 < (p := self.probability_false_alarm) < 0.5:
            raise ValueError(f"probability_false_alarm must lie in (0, 0.5), got {p}")
