"""A mission's trends as one static page: of each series the course with its bands, terms, steps, changes.

Points are the results without the parts of orbit phase, beta angle and temperature that differ from the
mean; each links to its report. Of very many results a point stands for several and links to the last.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from boresight.features.mission.mounting_course import MountingCourse
from boresight.features.mission.saved_mounting import instant_s, utc_at
from boresight.features.mission.trends import Trend, changes_of, step_words
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.pipeline import __version__
from boresight.pipeline.report.page_template import template
from boresight.records.record import Floats

__all__ = ["trends_html"]

MOST_POINTS = 400  # of an axis
MOST_ROWS = 200  # of the table of results, the latest
AHEAD_DAYS = 180.0  # that the prediction is drawn
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 960, 250, 64, 12, 12, 28  # of a picture, px
TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # between marks of the axis, arcsec


def trends_html(trends: Sequence[Trend], folder: Path) -> str:
    """The page; links are relative to the folder that it stands in."""
    return template("trends.html.j2").render(
        series=[_view(trend, folder) for trend in trends],
        alarm=any(trend.alarms for trend in trends),
        version=__version__,
    )


def _view(trend: Trend, folder: Path) -> dict[str, Any]:
    course, now = trend.course, trend.now
    sigma = np.sqrt(np.diag(now.covariance)) / ARCSEC
    return {
        "name": trend.name,
        "count": len(course.series.t_s),
        "span": [utc_at(course.series.t_s[k])[:10] for k in (0, -1)],
        "alarms": trend.alarms,
        "date": utc_at(now.t_s)[:10],
        "matrix": [[f"{value:+.12f}" for value in row] for row in now.R_cs.as_matrix().tolist()],
        "sigma": [f"{value:.4f}" for value in sigma],
        "month": [f"{value:.4f}" for value in now.error_month_rad / ARCSEC],
        "valid": None if now.valid_s is None else [utc_at(t_s)[:10] for t_s in now.valid_s],
        "pictures": [_picture(trend, axis, folder) for axis in range(3)],
        "terms": [_term_row(course, term, p) for term, p in course.p_values.items()],
        "steps": [step_words(course, step) for step in course.steps],
        "walk": f"{course.walk_arcsec:.3g}" if course.walks else "",
        "chi2": f"{course.chi2:.1f} / {course.dof}, p {course.p_value:.3g}",
        "aliases": trend.aliases,
        "changes": list(changes_of(trend.archived))[-MOST_ROWS:],
        "left_out": [row | {"page": _page(row, folder)} for row in trend.archived.left_out[-MOST_ROWS:]],
        "rows": [row | {"page": _page(row, folder)} for row in reversed(trend.archived.rows[-MOST_ROWS:])],
    }


def _term_row(course: MountingCourse, term: str, p: float) -> dict[str, Any]:
    sizes = ["", "", ""]
    if term in course.terms:
        values, covariance = course.of_term(term)
        sigma = np.sqrt(np.diag(covariance)).reshape(values.shape).mean(axis=0) / ARCSEC
        sizes = [f"{a:.3f} ± {s:.3f}" for a, s in zip(np.linalg.norm(values, axis=0) / ARCSEC, sigma)]
    return {"name": term, "sizes": sizes, "p": f"{p:.2g}", "accepted": term in course.terms}


def _picture(trend: Trend, axis: int, folder: Path) -> dict[str, Any]:
    """What the template draws of one axis: coordinates in px."""
    course = trend.course
    t_s, step = course.series.t_s, 2.0 * DAY_S
    free, covariance = course.free
    theta = (free - course.of_conditions())[:, axis] / ARCSEC
    sigma = np.sqrt(covariance[:, axis, axis]) / ARCSEC
    last = max(t_s[-1], trend.now.t_s) + AHEAD_DAYS * DAY_S
    curve_t = np.linspace(t_s[0], last, int(np.clip((last - t_s[0]) / step, 60, 500)))
    values, cov = course.at(curve_t)
    # about the mean of the course, so that a common offset of all references does not hide it
    middle = float(np.median(values[:, axis])) / ARCSEC
    curve, band = values[:, axis] / ARCSEC - middle, np.sqrt(cov[:, axis, axis]) / ARCSEC
    points = _thinned(t_s, theta - middle, sigma)
    held = trend.required_rad[axis] / ARCSEC if trend.required_rad is not None else np.inf
    extent = [*(curve - band), *(curve + band), *(p[1] for p in points)]
    low, high = min(extent), max(extent)
    room = 0.06 * max(high - low, 0.1)
    low, high = low - room, high + room
    of_x = lambda t: LEFT + (WIDTH - LEFT - RIGHT) * (t - t_s[0]) / (last - t_s[0])  # noqa: E731
    of_y = lambda y: TOP + (HEIGHT - TOP - BOTTOM) * (high - y) / (high - low)  # noqa: E731
    ticks = next((one for one in TICKS if (high - low) / one < 7), TICKS[-1])
    marks = np.arange(np.ceil(low / ticks), np.floor(high / ticks) + 1) * ticks
    ahead = curve_t >= t_s[-1]
    path = lambda x, y: " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y))  # noqa: E731
    edge = lambda chosen: path(  # noqa: E731
        np.append(of_x(curve_t[chosen]), of_x(curve_t[chosen])[::-1]),
        np.append(of_y((curve + band)[chosen]), of_y((curve - band)[chosen])[::-1]),
    )
    now = float(np.interp(trend.now.t_s, curve_t, curve))
    inside = [now + sign * held for sign in (-1, 1) if low < now + sign * held < high]
    return {
        "axis": "XYZ"[axis],
        "low": f"{low + middle:.2f}",
        "curve": path(of_x(curve_t), of_y(curve)),
        "band": edge(~ahead | (np.cumsum(ahead) == 1)),
        "ahead": edge(ahead) if ahead.sum() > 1 else "",
        "points": [
            {
                "x": f"{of_x(t):.1f}",
                "y": f"{np.clip(of_y(y), TOP, HEIGHT - BOTTOM):.1f}",
                "top": f"{np.clip(of_y(y + s), TOP, HEIGHT - BOTTOM):.1f}",
                "foot": f"{np.clip(of_y(y - s), TOP, HEIGHT - BOTTOM):.1f}",
                "page": _page(trend.archived.rows[k], folder),
                "words": f"{trend.archived.rows[k]['utc'][:10]}: {y:+.2f} ± {s:.2f}″"
                + (f", {n} results" if n > 1 else ""),
            }
            for t, y, s, k, n in points
        ],
        "steps": [f"{of_x(one.t_s(course.series)):.1f}" for one in course.steps],
        "now": f"{of_x(trend.now.t_s):.1f}" if t_s[0] <= trend.now.t_s else "",
        "required": [f"{of_y(value):.1f}" for value in inside],
        "marks": [(f"{of_y(mark):.1f}", f"{mark:+.4g}") for mark in marks],
        "years": [(f"{of_x(t):.1f}", words) for t, words in _dates(float(t_s[0]), last)],
    }


def _thinned(t_s: Floats, theta: Floats, sigma: Floats) -> list[tuple[float, float, float, int, int]]:
    """Instant, weighted mean, its 1-sigma, row of the last and count of results that one point stands for."""
    groups = np.array_split(np.arange(len(t_s)), min(len(t_s), MOST_POINTS))
    return [
        (
            float(t_s[rows].mean()),
            float(np.average(theta[rows], weights=sigma[rows] ** -2.0)),
            float(np.sum(sigma[rows] ** -2.0) ** -0.5),
            int(rows[-1]),
            len(rows),
        )
        for rows in groups
    ]


def _dates(first_s: float, last_s: float) -> Iterator[tuple[float, str]]:
    """Instants of years, or of months where there are few years, with their names."""
    years = range(int(utc_at(first_s)[:4]), int(utc_at(last_s)[:4]) + 1)
    months = (1,) if len(years) > 8 else (1, 7) if len(years) > 3 else (1, 4, 7, 10)
    for name in (f"{year}-{month:02d}" for year in years for month in months):
        if first_s <= (t_s := instant_s(f"{name}-01")) <= last_s:
            yield t_s, name


def _page(row: dict[str, Any], folder: Path) -> str:
    """Address of a result's report as seen from a folder."""
    return os.path.relpath(Path(row["folder"]) / "report.html", folder.resolve())
