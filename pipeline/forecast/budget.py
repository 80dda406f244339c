"""Uncertainty budget: what each source of error contributes to the covariance of the installation matrix.

A best linear estimate x = G y of data whose errors are independent parts, R = R_1 + R_2 + ..., has the
covariance C = sum of G R_s G'. If the variance of one part grows by the factor 1 + d, G changes too, but C
does so only to second order through G, whose choice makes C least. So G R_s G' = dC / d ln(variance of s),
a derivative that needs no more than the covariance of data with slightly larger errors. The parts sum to C:
with all variances times k, C is k times as large (Euler's theorem on homogeneous functions).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.heads import carried
from boresight.calib.settings import CalibrationSettings
from boresight.calib.simultaneous_strips import passes_of
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.gyro import GyroNoise
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.forecast.accuracy import forecast_from_strips
from boresight.records.record import Floats, array, record, scalar

__all__ = ["ErrorShare", "uncertainty_budget"]

Noise = TypeVar("Noise", AttitudeNoise, GyroNoise)
STEP = 1e-3  # relative change of a variance: what it leaves out is of its own size, a thousandth of a share
LARGER = 1.0 + STEP
ROOT = float(np.sqrt(LARGER))  # the same of a standard deviation


@record(kw_only=True)
class ErrorShare:
    """What one source of error contributes."""

    source: str = scalar("the source, in words")
    covariance: Floats = array("T, T", "its part of the covariance of theta, axes of c, rad²")


def uncertainty_budget(
    strips: Sequence[StripSightings], R_cs: Rotation | Mapping[str, Rotation], settings: CalibrationSettings
) -> tuple[ErrorShare, ...]:
    """The budget of a calibration, the source with the largest shares of the three variances first.

    Of the sources that contribute; no target is rejected. Their covariances sum to that of the strips, but
    for `STEP`. `ValueError` if no strip has a target between usable star exposures.
    """
    model = replace(settings, robust=False)
    fitted = [carried(one) for one in passes_of(strips, model.attitudes)]

    def covariance(these: Sequence[StripSightings], model: CalibrationSettings) -> Floats:
        return forecast_from_strips(these, R_cs, model).after(len(these)).covariance

    now = covariance(fitted, model)
    changed = {name: [of(one) for one in fitted] for name, of in OF_SIGHTINGS.items()}
    larger = {name: covariance(these, model) for name, these in changed.items() if these != fitted}
    for source, names in OF_SETTINGS.items():
        stated = {name: ROOT * getattr(model, name) for name in names}
        if any(stated.values()):
            larger[source] = covariance(fitted, replace(model, **stated))
    found = [ErrorShare(source=source, covariance=(C - now) / STEP) for source, C in larger.items()]
    shares = [np.diag(one.covariance) / np.diag(now) for one in found]
    order = np.argsort([-float(share.sum()) for share in shares], kind="stable")
    return tuple(found[n] for n in order.tolist() if shares[n].max() > STEP)


def _larger(noise: Noise) -> Noise:
    sigmas = (field.name for field in fields(noise) if "_rad" in field.name)
    return replace(noise, **{name: ROOT * getattr(noise, name) for name in sigmas})


def _attitudes(strip: StripSightings) -> StripSightings:
    """The strip with attitudes of larger variance, of all heads."""
    others = tuple(
        replace(one, covariance_h=LARGER * one.covariance_h, noise=_larger(one.noise)) for one in strip.others
    )
    fitted = replace(strip.fitted, covariance_s=LARGER * strip.fitted.covariance_s)
    gyro = strip.gyro and replace(strip.gyro, noise=_larger(strip.gyro.noise))
    return replace(strip, attitudes=fitted, noise=_larger(strip.noise), others=others, gyro=gyro)


def _images(of_stars: bool) -> Callable[[StripSightings], StripSightings]:
    def change(strip: StripSightings) -> StripSightings:
        ground, larger = strip.ground, strip.ground.is_star == of_stars
        if not larger.any():
            return strip
        factor = np.where(larger, LARGER, 1.0)[:, None, None]
        return replace(strip, ground=replace(ground, cov_c=factor * ground.cov_c))

    return change


def _coordinates(strip: StripSightings) -> StripSightings:
    ground = strip.ground
    return replace(strip, ground=replace(ground, cov_target_i=LARGER * ground.cov_target_i))


def _earth(strip: StripSightings) -> StripSightings:
    ground = strip.ground
    return (
        replace(strip, ground=replace(ground, earth_i=ROOT * ground.earth_i))
        if ground.earth_i.any()
        else strip
    )


# Sources that the sightings hold, by name: how a strip looks with its variance larger by `STEP`.
OF_SIGHTINGS: Mapping[str, Callable[[StripSightings], StripSightings]] = {
    "attitudes of the star exposures": _attitudes,
    "image points of the targets": _images(of_stars=False),
    "image points of stars in strips": _images(of_stars=True),
    "coordinates of targets and stars": _coordinates,
    "predicted Earth orientation": _earth,
}
# Sources that the settings hold, by name: their standard deviations.
OF_SETTINGS: Mapping[str, tuple[str, ...]] = {
    "position of the satellite": ("sigma_position_m",),
    "clock": ("sigma_clock_s",),
    "vibration": ("sigma_vibration_rad", "sigma_vibration_exposure_rad"),
    "motion between exposures": ("sigma_motion_rad",),
    "distortion over the field": ("sigma_distortion_rad",),
    "place and shape of each CCD": ("sigma_ccd_shift_rad", "sigma_ccd_slope_rad", "sigma_ccd_bend_rad"),
}
