"""What a plan will reach, before any data: the information of its strips, from the geometry and the noise
alone.

The information of a strip does not depend on what will be measured, so the mean over drawn strips of the
plan, times their number, is that of the campaign, and its inverse the covariance (the Cramér-Rao bound).
What strips share, the camera's distortion, does not average: it sets a floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boresight.calib.calibration import strip_pairs
from boresight.calib.information import Solution, solve_total
from boresight.calib.settings import CalibrationSettings
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

__all__ = ["Forecast", "forecast", "settings_of_plan"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """Mean information of one strip of a plan, and what is known before any."""

    F_strip: Array  # (n, n), theta first, rad⁻²
    prior_shared: Array  # (n - 3, n - 3)
    settings: CalibrationSettings

    def after(self, strips: float) -> Solution:
        """Covariance of theta after so many strips, and the turns that are not observable."""
        F = strips * self.F_strip
        limit = self.settings.sigma_observable_rad
        return solve_total(F, np.zeros(len(F)), self.prior_shared, sigma_observable_rad=limit)

    def sigma(self, strips: float) -> Array:
        """(3,) rad about the axes of c; NaN about an axis that shares in an unobservable turn."""
        solution = self.after(strips)
        sigma = np.sqrt(np.diag(solution.covariance))
        blind = np.any(np.abs(solution.unobservable) > 1e-3, axis=0)
        return np.where(blind, np.nan, sigma)

    def floor(self) -> Array:
        """(3,) rad, what no number of strips falls below; 0 where nothing is shared that would not
        average.
        """
        one, many = self.sigma(1.0), self.sigma(1e9)
        return np.where(many < 1e-3 * one, 0.0, many)

    def strips_for(self, target_rad: float) -> int | None:
        """The least number of strips with which every axis is known to `target_rad`; None if no number
        does it.
        """
        if not np.all(self.floor() <= target_rad):
            return None
        low, high = 0, 1
        while not np.all(self.sigma(high) <= target_rad):
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if np.all(self.sigma(middle) <= target_rad) else (middle, high)
        return high


def settings_of_plan(plan: StripPlan) -> CalibrationSettings:
    """An estimator that believes of the errors what the plan says of them."""
    return CalibrationSettings(
        sigma_position_m=plan.sigma_position_m,
        sigma_clock_s=plan.sigma_clock_s,
        sigma_vibration_rad=plan.sigma_vibration_rad,
        sigma_distortion_rad=plan.sigma_distortion_rad,
        distortion_length_px=plan.distortion_length_px,
        distortion_scope="camera" if plan.distortion_scope == "camera" else "strip",
    )


def forecast(plan: StripPlan, cameras: CameraPair, *, draws: int = 100, seed: int = 0) -> Forecast:
    """The information of a plan from `draws` of its strips, their targets and stars placed at random."""
    settings = replace(settings_of_plan(plan), robust=False)
    strips, truth = draw_strips(replace(plan, strips=draws), cameras, np.random.default_rng(seed))
    pairs, prior_shared = strip_pairs(strips, truth.R_cs, settings)
    return Forecast(pairs.total().F / draws, prior_shared, settings)
