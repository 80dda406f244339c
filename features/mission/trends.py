"""What a mission's archive says at a date: course, terms, steps, the matrix to use, and whether to look.

A matrix R that is held from t on is wrong at another date t' by the course's change and by the covariance
there: about each axis the root mean square error is

    e(t')² = (theta(t') - theta(t))² + var theta(t')

and it is valid while no e exceeds what is required, from the first result on, and after the last no longer
than the results span, nor than a year: what a course does later, its results do not tell.

An alarm is raised where the last result is refuted or contradicts the course, where a step lies in the days
before the date, or where the matrix misses what is required.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from boresight.features.mission.archive import ArchivedSeries
from boresight.features.mission.mounting_course import (
    CourseSettings,
    CourseStep,
    MountingCourse,
    aliases,
    estimate_course,
)
from boresight.features.mission.saved_mounting import utc_at
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.installation import deviation_from_theta
from boresight.pipeline.results.requirement import Requirement
from boresight.records.record import Floats, array, record, scalar

__all__ = ["MountingPrediction", "Trend", "predict", "required_rad", "trend_of"]

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


LAST_LIMIT = 1e-3  # p-value below which the last result contradicts the course
NEW_STEP_DAYS = 90.0  # a step that may be younger raises an alarm
# Facts whose changes are listed, by the names that the table gives them.
CHANGES = {"program": "program", "star_camera": "star camera"}


@record(kw_only=True)
class Trend:
    """One series of an archive."""

    archived: ArchivedSeries = scalar("its results")
    course: MountingCourse = scalar("the accepted model")
    now: MountingPrediction = scalar("the matrix for the date asked for")
    required_rad: Floats | None = scalar("(3,) largest rms error about each axis; None: none required")
    aliases: tuple[str, ...] = scalar("what the results cannot tell apart")
    alarms: tuple[str, ...] = scalar("reasons to look; empty: none")

    @property
    def name(self) -> str:
        """Mission, satellite, camera and star camera."""
        return " / ".join(part for part in self.archived.key[:4] if part) or "mission without a name"

    def summary(self) -> str:
        """Lines for the terminal."""
        course, t_s = self.course, self.course.series.t_s
        now, sigma = self.now, np.sqrt(np.diag(self.now.covariance)) / ARCSEC
        chi2 = f"{course.chi2:.1f} / {course.dof}, p {course.p_value:.2g}"
        lines = [f"{self.name}: {len(t_s)} results, {utc_at(t_s[0])[:10]} to {utc_at(t_s[-1])[:10]}"]
        lines += [f"terms                     {', '.join(('mean', *course.terms))}; chi2 / dof {chi2}"]
        lines += [f"step                      {step_words(course, step)}" for step in course.steps]
        if course.walks:
            lines.append(f"random walk               {course.walk_arcsec:.3g} arcsec per root day")
        of_axes = "".join(f"{value:10.4f}" for value in sigma)
        lines.append(f"matrix for {utc_at(now.t_s)[:10]}     1 sigma, arcsec{of_axes}")
        if now.valid_s is not None:
            lines.append(f"valid                     {' to '.join(utc_at(t)[:10] for t in now.valid_s)}")
        lines += [f"cannot be told            {text}" for text in self.aliases]
        for row in self.archived.left_out:
            lines.append(f"not in the course         {row['id']} of {row['utc'][:10]}: {row['reason']}")
        return "\n".join([*lines, *(f"ALARM                     {text}" for text in self.alarms)])

    def content(self) -> dict[str, Any]:
        """For programs."""
        course = self.course
        return {
            **dict(zip(("mission", "satellite", "camera", "star_camera", "model"), self.archived.key)),
            "results": len(course.series.t_s),
            "alarm": bool(self.alarms),
            "alarms": list(self.alarms),
            "now": self.now.content(),
            **course.content(),
            "cannot_be_told": list(self.aliases),
            "left_out": [
                {key: row[key] for key in ("id", "utc", "reason")} for row in self.archived.left_out
            ],
            "changes": [list(one) for one in changes_of(self.archived)],
        }


def trend_of(
    archived: ArchivedSeries,
    at_s: float,
    requirement: Requirement | None = None,
    settings: CourseSettings | None = None,
) -> Trend | None:
    """The trend of a series at a date; None for fewer than two results."""
    if len(archived.series.t_s) < 2:
        return None
    course = estimate_course(archived.series, settings)
    required = required_rad(archived, requirement or Requirement())
    now = predict(archived, course, at_s, required)
    return Trend(
        archived=archived,
        course=course,
        now=now,
        required_rad=required,
        aliases=tuple(aliases(archived.series)),
        alarms=tuple(_alarms(archived, course, now)),
    )


def required_rad(archived: ArchivedSeries, requirement: Requirement) -> Floats | None:
    """(3,) largest error about each axis that a requirement allows; None where nothing is required."""
    if not requirement:
        return None
    per_rad = np.array(json.loads(archived.rows[-1]["ground_m_per_rad"]), dtype=float)
    limits = np.full(3, np.inf)
    if requirement.arcsec is not None:
        limits = np.minimum(limits, requirement.arcsec * ARCSEC)
    return limits if requirement.m is None else np.fmin(limits, requirement.m / per_rad)


def step_words(course: MountingCourse, step: CourseStep) -> str:
    """Date, interval, probability and size of a step."""
    low, high = (utc_at(t_s)[:10] for t_s in step.interval_s)
    sigma = np.sqrt(np.diag(step.covariance)) / ARCSEC
    size = ", ".join(f"{a} {v:+.2f} ± {s:.2f}" for a, v, s in zip("XYZ", step.theta / ARCSEC, sigma))
    kind = (
        "star camera exchanged" if step.is_exchange else f"p {step.p_value:.2g}, {step.probability:.0%} there"
    )
    return f"{utc_at(step.t_s(course.series))[:10]} ({low} to {high}; {kind}): {size} arcsec"


def changes_of(archived: ArchivedSeries) -> Iterator[tuple[str, str, str]]:
    """Date, what, and the new value, of what changed from one result to the next."""
    for before, after in zip(archived.rows[:-1], archived.rows[1:]):
        for key, name in CHANGES.items():
            if before[key] != after[key]:
                yield after["utc"], name, str(after[key])


def _alarms(archived: ArchivedSeries, course: MountingCourse, now: MountingPrediction) -> Iterator[str]:
    last = course.series.t_s[-1]
    for row in archived.left_out:
        if row["reason"] == "refuted" and row["t_s"] > last:
            yield f"the last result, {row['id']} of {row['utc'][:10]}, is refuted"
    free, covariance = course.free
    there, own = course.at(course.series.t_s[-1:])
    apart = free[-1] - course.of_conditions()[-1] - there[0]
    chi2 = float(apart @ np.linalg.solve(covariance[-1] + own[0], apart))
    if (p := float(chdtrc(3, chi2))) < LAST_LIMIT:
        yield f"the last result, {course.series.names[-1]}, contradicts the course (p {p:.2g})"
    for step in course.steps:
        if step.interval_s[1] > now.t_s - NEW_STEP_DAYS * DAY_S:
            yield f"a step in the last {NEW_STEP_DAYS:.0f} days: {step_words(course, step)}"
    if not now.is_met:
        yield "the matrix for the date does not reach what is required"
