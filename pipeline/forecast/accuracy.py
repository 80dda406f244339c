"""Accuracy that a campaign will reach, before any data: the information of strips of a planned geometry.

The information of a strip does not depend on what is measured, so the mean over example strips, times their
number, is that of the campaign, and its inverse the covariance (the Cramér-Rao bound). The distortion of the
camera, which all strips share, does not average: it sets a floor.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from itertools import count

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import strip_pairs
from boresight.calib.information import Solution, solve_total
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats, array, record, scalar

__all__ = ["Forecast", "forecast_from_strips"]

BLIND = 1e-3  # component of an unobservable direction, from which its axis has no error
ENDLESS = 1e9  # strips, and the part of the error of one that is then zero
AVERAGED = 1e-3


@record
class Forecast:
    """Mean information of one strip of a plan, and the prior information of shared unknowns."""

    F_strip: Floats = array("N, N", "information of one strip, theta first, rad⁻²")
    prior_shared: Floats = array("G, G", "prior information of the N - 3 unknowns that strips share")
    sigma_observable_rad: float = scalar("1-sigma beyond which a rotation counts as not observable")

    def after(self, strips: float) -> Solution:
        """Covariance of theta after so many strips, and the axes that are not observable."""
        F = strips * self.F_strip
        limit = self.sigma_observable_rad
        return solve_total(F, np.zeros(len(F)), self.prior_shared, sigma_observable_rad=limit)

    def sigma(self, strips: float) -> Floats:
        """1-sigma (3,) about the axes of c, rad; NaN about an axis that is not observable."""
        solution = self.after(strips)
        sigma = np.sqrt(np.diag(solution.covariance))
        blind = np.any(np.abs(solution.unobservable) > BLIND, axis=0)
        return np.where(blind, np.nan, sigma)

    def floor(self) -> Floats:
        """1-sigma (3,) that no number of strips falls below, rad; 0 where everything averages."""
        one, many = self.sigma(1.0), self.sigma(ENDLESS)
        return np.where(many < AVERAGED * one, 0.0, many)

    def strips_for(self, target_rad: float) -> int | None:
        """The least number of strips with which every axis is known to `target_rad`; None if none does."""
        if not np.all(self.floor() <= target_rad):
            return None

        def reached(strips: int) -> bool:
            return bool(np.all(self.sigma(strips) <= target_rad))

        most = next(2**n for n in count() if reached(2**n))
        return bisect_left(range(most), True, lo=most // 2 + 1, key=reached)


def forecast_from_strips(
    strips: Sequence[StripSightings], R_cs: Rotation | Mapping[str, Rotation], settings: CalibrationSettings
) -> Forecast:
    """The forecast from example strips of a plan; the more, the nearer their mean is to that of all strips.

    `R_cs` is the matrix with which they were made, star camera to remote-sensing camera. `ValueError` if no
    strip has a target between usable star exposures.
    """
    pairs, prior_shared = strip_pairs(strips, R_cs, settings)
    return Forecast(pairs.total()[0] / len(strips), prior_shared, settings.sigma_observable_rad)
