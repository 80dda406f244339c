"""Forecasts from example strips: of a plan, drawn at random, and of a calibration repeated with changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import strip_pairs
from boresight.calib.heads import carried
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.line_camera import LineSensor
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.pipeline.forecast.accuracy import Forecast, forecast_from_strips
from boresight.records.record import Floats, array, record, scalar
from boresight.simulator.campaign import CameraPair, StripPlan, draw_sky_strips, draw_strips
from boresight.simulator.drawn_gyro import with_gyro

__all__ = [
    "PLAN_DRAWS",
    "SkyPart",
    "compare_campaigns",
    "forecast_of_plan",
    "improvements",
    "settings_of_plan",
]

# Example strips of each kind that stand for a plan, the same in all its forecasts that are compared.
PLAN_DRAWS = 100
OUTER_SHARE = 0.1  # of the swath, at each end: where targets determine the rotation about the boresight best


def settings_of_plan(plan: StripPlan, cameras: CameraPair | None = None) -> CalibrationSettings:
    """Calibration settings with the plan's errors as priors; those of CCDs need the cameras."""
    shift, slope, bend = plan.sigma_ccd_rad
    same = "sigma_position_m sigma_clock_s sigma_vibration_rad sigma_motion_rad motion_time_s".split()
    same += "sigma_distortion_rad distortion_length_px distortion_pixel_rad".split()
    return CalibrationSettings(
        **{name: getattr(plan, name) for name in same},
        sigma_ccd_shift_rad=shift,
        sigma_ccd_slope_rad=slope,
        sigma_ccd_bend_rad=bend,
        ccd_px=(cameras.ccd_px,) * cameras.n_ccds if cameras else (),
    )


def forecast_of_plan(plan: StripPlan, cameras: CameraPair, *, draws: int = PLAN_DRAWS) -> Forecast:
    """The forecast of a plan from `draws` of its strips, with targets and stars at random positions."""
    settings = replace(settings_of_plan(plan, cameras), robust=False)
    strips = _drawn(plan, draws, cameras, np.random.default_rng(0))
    return forecast_from_strips(strips, cameras.R_cs, settings)


def _drawn(
    plan: StripPlan, draws: int, cameras: CameraPair, rng: np.random.Generator
) -> list[StripSightings]:
    """Strips of a plan, with the rows of its gyro from the first exposure of each to the last."""
    strips, truth = draw_strips(replace(plan, strips=draws), cameras, rng)
    if plan.gyro is None:
        return strips
    rows = int(np.ceil((plan.duration_s + 2.0 * plan.exposure_margin_s) / plan.gyro_step_s)) + 1
    t_s: Floats = plan.gyro_step_s * np.arange(rows, dtype=np.float64) - plan.exposure_margin_s
    return with_gyro(strips, truth, cameras.R_cs, plan.gyro, t_s, rng)


@record(by_value=True)
class SkyPart:
    """The strips of the sky of a planned campaign."""

    plan: StripPlan  # of one strip; `targets` is the number of stars in it
    strips: int
    rate_rad_s: float  # of the scan; forward and backward in turn


def compare_campaigns(ground: StripPlan, sky: SkyPart, cameras: CameraPair) -> dict[str, Floats]:
    """1-sigma (3,) about the axes of c, rad, of the ground's strips alone, the sky's alone, and both; NaN
    about an axis that is not observable.
    """
    rng = np.random.default_rng(0)
    settings = replace(settings_of_plan(ground, cameras), robust=False)
    below = _drawn(ground, PLAN_DRAWS, cameras, rng)
    rates = (-sky.rate_rad_s, sky.rate_rad_s)
    above = draw_sky_strips(replace(sky.plan, strips=PLAN_DRAWS), cameras, rng, rates_rad_s=rates)
    both = with_attitudes([*below, *above], settings.attitudes)  # once for the three forecasts
    below, above = both[: len(below)], both[len(below) :]
    pairs, prior = strip_pairs(both, cameras.R_cs, settings)
    of_sky = np.char.startswith(pairs.names, "sky")
    total = ground.strips * pairs.F[~of_sky].mean(axis=0) + sky.strips * pairs.F[of_sky].mean(axis=0)
    return {
        "ground": forecast_from_strips(below, cameras.R_cs, settings).sigma(ground.strips),
        "sky": forecast_from_strips(above, cameras.R_cs, settings).sigma(sky.strips),
        "both": Forecast(total, prior, settings.sigma_observable_rad).sigma(1.0),
    }


@record(kw_only=True)
class Improvement:
    """Accuracy if one thing had been different."""

    change: str = scalar("what is different, in words")
    sigma_ratio: Floats = array("3", "1-sigma about X, Y, Z of c, over that of the data as they are")


def improvements(
    strips: Sequence[StripSightings], R_cs: Rotation, settings: CalibrationSettings, camera: LineSensor
) -> tuple[Improvement, ...]:
    """What more or other data would change in a calibration of `strips` with `settings`: twice as many
    strips, twice as many targets, targets at the ends of the swath of `camera`, half the error of position,
    half that of the clock; in this order. `ValueError` if no strip has a target between usable exposures.
    """
    model, n = replace(settings, robust=False), len(strips)
    strips = [carried(strip) for strip in strips]
    now = forecast_from_strips(strips, R_cs, model)
    before = now.sigma(n)

    def sigma(these: Sequence[StripSightings], model: CalibrationSettings) -> Floats:
        return forecast_from_strips(these, R_cs, model).sigma(n)

    def half(name: str) -> CalibrationSettings:
        return replace(model, **{name: 0.5 * getattr(model, name)})

    moved = [_with_targets_at_ends(strip, R_cs, camera) for strip in strips]
    cases = {
        "twice as many strips": now.sigma(2 * n),
        "twice as many targets in each strip": sigma([_with_targets_twice(strip) for strip in strips], model),
        "the same number of targets, all near the ends of the swath": sigma(moved, model),
        "half the error of position": sigma(strips, half("sigma_position_m")),
        "half the error of the clock": sigma(strips, half("sigma_clock_s")),
    }
    return tuple(Improvement(change=text, sigma_ratio=after / before) for text, after in cases.items())


def _with_targets_twice(strip: StripSightings) -> StripSightings:
    """The strip with a second target beside each, as accurate as the first."""
    ground = strip.ground
    second = replace(ground, target_id=np.char.add(ground.target_id, " (second)"))
    R_oi = Rotation.concatenate([strip.R_oi_targets] * 2)
    return replace(strip, ground=GroundSightings.together([ground, second]), R_oi_targets=R_oi)


def _with_targets_at_ends(strip: StripSightings, R_cs: Rotation, camera: LineSensor) -> StripSightings:
    """The strip with its targets moved, at their instants, to the two ends of the swath in turn."""
    ground = strip.ground
    pixels = [camera.n_px(k) for k in range(camera.n_ccds)]
    ends = [camera.directions_from_pixels(k, np.array([0.0, n - 1.0]))[:, 1] for k, n in enumerate(pixels)]
    left, right = int(np.argmin([y.sum() for y in ends])), int(np.argmax([y.sum() for y in ends]))
    width = OUTER_SHARE * sum(pixels)
    share = (np.arange(len(ground.t_s)) // 2 + 0.5) / max(1, (len(ground.t_s) + 1) // 2)
    at_left = np.arange(len(ground.t_s)) % 2 == 0
    ccd = np.where(at_left, left, right)
    sample, u_c = np.zeros(len(ccd)), np.zeros((len(ccd), 3))
    for k, here, sign in ((left, at_left, -1.0), (right, ~at_left, 1.0)):
        n_px = pixels[k]
        from_end = share[here] * min(width, n_px - 1.0)
        sample[here] = from_end if sign * ends[k][0] > sign * ends[k][1] else n_px - 1.0 - from_end
        u_c[here] = camera.directions_from_pixels(k, sample[here])
    nearest = np.argmin(np.abs(strip.times_s[:, None] - ground.t_s), axis=0)
    R_ci = R_cs * Rotation.from_matrix(strip.fitted.R_si[nearest])
    turn = Rotation.concatenate(
        [Rotation.align_vectors([b], [a])[0] for a, b in zip(ground.u_c, u_c)]
    ).as_matrix()
    cov_c = turn @ ground.cov_c @ np.swapaxes(turn, 1, 2)
    xy_px = np.column_stack([sample, ground.xy_px[:, 1]])
    moved = replace(ground, ccd=ccd, xy_px=xy_px, u_c=u_c, u_i=R_ci.inv().apply(u_c), cov_c=cov_c)
    return replace(strip, ground=moved)
