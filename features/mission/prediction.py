"""The matrix for a date from a mission's course, and from when to when it may be used.

A matrix R that is held from t on is wrong at another date t' by the course's change and by the covariance
there: about each axis the root mean square error is

    e(t')² = (theta(t') - theta(t))² + var theta(t')

and it is valid while no e exceeds what is required, from the first result on, and after the last no longer
than the results span, nor than a year: what a course does later, its results do not tell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.mission.archive import ArchivedSeries
from boresight.features.mission.mounting_course import MountingCourse
from boresight.features.mission.saved_mounting import utc_at
from boresight.geometry.constants import DAY_S
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.record import Floats, array, record, scalar

__all__ = ["MountingPrediction", "predict"]

# Longest that a course is continued after its last result; never for longer than the results span.
MOST_AHEAD_S = 366 * DAY_S
MONTH_S = 30 * DAY_S


@record(kw_only=True)
class MountingPrediction:
    """The matrix for one date."""

    t_s: float = scalar("the date, TAI seconds since 2000-01-01T12:00:00 TAI")
    R_cs: Rotation = scalar("installation matrix")
    covariance: Floats = array("3, 3", "of theta, frame c, rad²")
    error_month_rad: Floats = array("3", "rms error of that matrix a month later")
    valid_s: tuple[float, float] | None = scalar("first and last date of its use; None: nothing is required")
    is_met: bool = scalar("whether what is required is reached at the date itself")

    def content(self) -> dict[str, Any]:
        """For programs."""
        return {
            "utc": utc_at(self.t_s),
            "R_cs": self.R_cs.as_matrix().tolist(),
            "quaternion_xyzw": self.R_cs.as_quat(canonical=True).tolist(),
            "covariance_rad2": self.covariance.tolist(),
            "error_month_later_rad": self.error_month_rad.tolist(),
            "valid_utc": None if self.valid_s is None else [utc_at(t_s) for t_s in self.valid_s],
            "is_met": self.is_met,
        }


def predict(
    archived: ArchivedSeries, course: MountingCourse, t_s: float, required_rad: Floats | None
) -> MountingPrediction:
    """The matrix for an instant; `required_rad` (3,): largest rms error about each axis, NaN: none."""
    theta, covariance = course.at(np.array([t_s]))

    def error(at_s: Floats) -> Floats:
        there, cov = course.at(at_s)
        return np.asarray(np.sqrt((there - theta) ** 2 + np.einsum("naa->na", cov)))

    valid, is_met = None, True
    if required_rad is not None:
        first, last = course.series.t_s[0], course.series.t_s[-1]
        farthest = min(2.0 * last - first, last + MOST_AHEAD_S)
        ends = []
        for end_s in (min(first, t_s), max(farthest, t_s)):
            at_s = np.append(np.arange(t_s, end_s, np.copysign(DAY_S, end_s - t_s)), end_s)
            missed = np.any(error(at_s) > required_rad, axis=1)
            ends.append(float(at_s[max(int(np.argmax(missed)) - 1, 0)] if missed.any() else end_s))
            is_met = not missed[0]
        valid = (ends[0], ends[1])
    after = int(np.searchsorted(course.series.t_s, t_s, side="right"))
    return MountingPrediction(
        t_s=t_s,
        R_cs=deviation_from_theta(theta[0]) * archived.R_cs_ref[max(after - 1, 0)],
        covariance=covariance[0],
        error_month_rad=error(np.array([t_s + MONTH_S]))[0],
        valid_s=valid,
        is_met=is_met,
    )
