"""Example strips of a plan, drawn at random, and the accuracy that their information forecasts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from boresight.calib.forecast import Forecast, forecast_from_strips
from boresight.calib.settings import CalibrationSettings
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

__all__ = ["forecast", "settings_of_plan"]


def settings_of_plan(plan: StripPlan) -> CalibrationSettings:
    """Calibration settings whose priors are the errors that the plan states."""
    return CalibrationSettings(
        sigma_position_m=plan.sigma_position_m,
        sigma_clock_s=plan.sigma_clock_s,
        sigma_vibration_rad=plan.sigma_vibration_rad,
        sigma_distortion_rad=plan.sigma_distortion_rad,
        distortion_length_px=plan.distortion_length_px,
        distortion_scope="camera" if plan.distortion_scope == "camera" else "strip",
    )


def forecast(plan: StripPlan, cameras: CameraPair, *, draws: int = 100, seed: int = 0) -> Forecast:
    """The forecast of a plan from `draws` of its strips, with targets and stars at random positions."""
    settings = replace(settings_of_plan(plan), robust=False)
    strips, truth = draw_strips(replace(plan, strips=draws), cameras, np.random.default_rng(seed))
    return forecast_from_strips(strips, truth.R_cs, settings)
