"""Drift and course of the mounting between dumps of a joint calibration: drift.json, drift.csv, drift.png.

The mounting has moved where chi2 against one matrix, or the gain of the best single step, is beyond what half
of the probability of a false alarm allows.
"""

from __future__ import annotations

from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc

from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs
from boresight.features.mission.mounting_course import (
    CourseFit,
    CourseModel,
    CourseSettings,
    CourseStep,
    MountingCourse,
    MountingSeries,
    dated_steps,
    estimate_course,
    explained_by_free,
    fit_columns,
    step_gains,
)
from boresight.features.mission.saved_mounting import SavedMounting, read_saved_mounting
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.pipeline import __version__
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_figure, write_json, write_text
from boresight.pipeline.report.panels import INK, OURS, THIRD, legend_below, panels
from boresight.pipeline.results.writing import rotation_json
from boresight.records.record import record, scalar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["AgainstRest", "against_rest", "plot_drift", "trend_of_dumps"]

FALSE_ALARM = 0.01  # that a mounting at rest is said to have moved


def trend_of_dumps(out: Path, names: list[str]) -> str:
    """Whether the mounting moved between the dumps of a joint result, written into its folder `out`."""
    saved = sorted((read_saved_mounting(out / name) for name in names), key=lambda one: one.t_s)
    if len({one.t_s for one in saved}) < max(len(saved), 2):
        return f"no drift: {len(saved)} results at {len({one.t_s for one in saved})} dates"
    pairs = reduce(InformationPairs.merged, [one.pair for one in saved])
    of_folder = {(out / name).resolve(): name for name in names}
    series = _series(saved, [of_folder[one.folder] for one in saved], pairs)
    found = against_rest(series)
    rest, step = found.rest, found.step
    course = estimate_course(series)
    R_cs = deviation_from_theta(rest.coefficients[0]) * pairs.R_cs_ref
    content: dict[str, Any] = {
        "results": list(series.names),
        "utc": [one.utc for one in saved],
        "moved": found.moved(FALSE_ALARM),
        "probability_false_alarm": FALSE_ALARM,
        "merged": rotation_json(R_cs, "R_cs", theta_between(R_cs, saved[0].R_cs0), rest.covariance),
        "constant": {"chi2": found.chi2, "dof": found.dof, "p_value": found.p_value},
        "step": step.content(series),
        "course": course.content(),
        "version": __version__,
    }
    moved = content["moved"]
    said = "the mounting has moved" if moved else "no sign that the mounting has moved"
    said += f", at a false-alarm probability of {FALSE_ALARM:.2g}"
    said += f"; terms: {', '.join(course.terms)}" if course.terms else ""
    table = _table(course, content["results"], content["utc"], rest.coefficients[0])
    write_json(out / "drift.json", content)
    write_text(out / "drift.csv", table_csv(table, "%.9g"))
    write_figure(
        out / "drift.png", plot_drift(table, content["step"]["utc_interval"] if moved else None, said)
    )
    return said


@record(kw_only=True)
class AgainstRest:
    """A series against one matrix for all, and the single step that explains most of what is left."""

    rest: CourseFit = scalar("the one matrix")
    step: CourseStep = scalar("the best step")
    chi2: float = scalar("of the results about the one matrix")
    dof: int = scalar("its degrees of freedom")

    @property
    def p_value(self) -> float:
        """Probability of so large a chi2 of a mounting at rest."""
        return float(chdtrc(self.dof, max(self.chi2, 0.0)))

    def moved(self, false_alarm: float) -> bool:
        """Whether either is beyond what half of the probability of a false alarm allows."""
        return min(self.p_value, self.step.p_value) < 0.5 * false_alarm


def against_rest(series: MountingSeries) -> AgainstRest:
    """Both tests of a series of two results or more."""
    rows = np.arange(1, len(series.t_s))
    mean = np.ones((len(series.t_s), 1))
    rest, (gains, _) = fit_columns(series, mean), step_gains(series, mean, 0.0, rows)
    (step,) = dated_steps(series, CourseModel(steps=(int(rows[np.argmax(gains)]),)), (), CourseSettings())
    chi2 = explained_by_free(series) - rest.explained
    return AgainstRest(rest=rest, step=step, chi2=float(chi2), dof=3 * len(rows))


def _series(saved: list[SavedMounting], names: list[str], pairs: InformationPairs) -> MountingSeries:
    return MountingSeries(
        names=tuple(names),
        t_s=np.array([one.t_s for one in saved]),
        F=pairs.F[:, :3, :3],
        F_shared=pairs.F[:, :3, 3:],
        right=pairs.F_theta[:, :3],
        shared_F=pairs.F[:, 3:, 3:].sum(axis=0) + prior_information(pairs.shared),
        shared_right=pairs.F_theta[:, 3:].sum(axis=0),
        cos_sin=np.array([one.cos_sin for one in saved]),
        beta_rad=np.array([one.beta_rad for one in saved]),
        temperature_c=np.array([one.temperature_c for one in saved]),
        exchanges=tuple(k for k in range(1, len(saved)) if saved[k].star_camera != saved[k - 1].star_camera),
    )


def _table(course: MountingCourse, names: list[str], utc: list[str], middle: Any) -> pd.DataFrame:
    """One row a result and axis, arcsec against the merged matrix, frame c; errors of the distortion that all
    results share are in neither sigma.
    """
    free, covariance = course.free
    there, cov = course.at(course.series.t_s)
    sigma, course_sigma = (np.sqrt(np.einsum("kaa->ka", C)) for C in (covariance, cov))
    angles = {"theta": free - middle, "sigma": sigma, "course": there - middle, "course_sigma": course_sigma}
    table = {"result": np.repeat(names, 3), "utc": np.repeat(utc, 3), "axis": [*"XYZ"] * len(names)}
    return pd.DataFrame(table | {f"{name}_arcsec": rad.ravel() / ARCSEC for name, rad in angles.items()})


def plot_drift(table: pd.DataFrame, step: list[str] | None, title: str) -> Figure:
    """Angles of the mounting against time, an axis a panel; `step`: ends of the interval of its date."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    figure, axes = panels(3, 1, 2.2, sharex=True)
    for ax, (axis, part) in zip(axes[:, 0], table.groupby("axis", sort=True)):
        when, course, sigma = _naive(part["utc"]), part["course_arcsec"], part["course_sigma_arcsec"]
        ax.fill_between(when, course - sigma, course + sigma, color=OURS, lw=0, alpha=0.25)
        ax.plot(when, course, color=OURS, lw=1.8, label="course, 1σ")
        theta, own = part["theta_arcsec"], part["sigma_arcsec"]
        ax.errorbar(when, theta, yerr=own, fmt="o", ms=4, color=INK, lw=1, capsize=2, label="each result, 1σ")
        if step is not None:
            low, high = _naive(pd.Series(step))
            ax.axvspan(
                low, high, facecolor="none", edgecolor=THIRD, hatch="///", lw=0, label="date of the step"
            )
        ax.set_ylabel(f"θ {axis}, arcsec")
    locator = AutoDateLocator()
    axes[-1, 0].xaxis.set_major_locator(locator)
    axes[-1, 0].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes[-1, 0].set_xlabel("date, UTC")
    figure.suptitle(title, fontsize=11)
    legend_below(figure, axes[0, 0])
    return figure


def _naive(utc: pd.Series) -> pd.Series:
    """Dates without time zone for matplotlib; second 60 is drawn as second 59."""
    return pd.to_datetime(utc.str.rstrip("Z").str.replace(":60", ":59"), format="%Y-%m-%dT%H:%M:%S")
