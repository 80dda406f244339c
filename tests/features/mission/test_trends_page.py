"""Pictures of the page of trends, read back by their own marks: dates along, arc-seconds up."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as Of

import numpy as np
import pytest
from drawn_mission import DrawnMission, Truth, lopsided_pair
from numpy.testing import assert_allclose

from boresight.features.mission import trends_page
from boresight.features.mission.mounting_course import YEAR_S
from boresight.features.mission.saved_mounting import instant_s, utc_at
from boresight.features.mission.trends import Trend, trend_of
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.pipeline.results.requirement import Requirement

PAIR = lopsided_pair()


@pytest.fixture(scope="module")
def trend(tmp_path_factory) -> Trend:
    """60 results of unequal errors, with a season, a term of the orbit and a large step; asked for later."""
    rng = np.random.default_rng(4)
    truth = Truth(rng, results=60, steps=(6.0, 4.0))
    mission, weight = DrawnMission(PAIR, rng), rng.uniform(0.4, 2.5, 60)
    theta = truth.theta(truth.t_s, truth.cos_sin) + np.array([40.0, -70.0, 25.0]) * ARCSEC
    series = mission.series(truth.t_s, theta, truth.cos_sin)
    of_each = {"F": weight[:, None, None] * series.F, "F_shared": weight[:, None, None] * series.F_shared}
    shared = {"shared_F": weight.sum() * mission.F[3:, 3:] + mission.prior}
    series = replace(
        series, t_s=series.t_s + 20.0 * YEAR_S, right=weight[:, None] * series.right, **of_each, **shared
    )
    folder = tmp_path_factory.mktemp("archive")
    rows = [
        {"folder": str(folder / name), "utc": utc_at(t), "ground_m_per_rad": "[1, 1, 1]"}
        for name, t in zip(series.names, series.t_s)
    ]
    archived = Of(series=series, rows=rows, left_out=[], R_cs_ref=[PAIR.R_cs_ref] * 60)
    found = trend_of(archived, series.t_s[-1] + 20.0 * DAY_S, Requirement(arcsec=1.5))
    assert found is not None and found.course.terms == ("annual", "orbit phase") and found.course.steps
    return found


def of_text(path: str) -> np.ndarray:
    return np.array([point.split(",") for point in path.split()], dtype=float).T


@pytest.mark.parametrize("most_points", [400, 23])
@pytest.mark.parametrize("axis", range(3))
def test_a_picture_shows_course_results_and_limits_where_its_marks_say(trend, axis, most_points, monkeypatch):
    monkeypatch.setattr(trends_page, "MOST_POINTS", most_points)
    drawn = trends_page._picture(trend, axis, Path())
    course, series = trend.course, trend.course.series
    x, t = np.array([(float(x), instant_s(f"{name}-01")) for x, name in drawn["years"]]).T
    y, label = np.array(drawn["marks"], dtype=float).T
    assert 2 <= len(y) <= 7 and label[0] <= 0.0 <= label[-1]  # about the middle of the course
    assert np.allclose(np.diff(label), label[1] - label[0])
    to_s, to_arcsec = np.polyfit(x, t, 1), np.polyfit(y, label, 1)
    day = abs(to_s[0]) / DAY_S  # of a px
    arcsec = abs(to_arcsec[0])  # of a px; all coordinates are written to 0.1 px
    foot = trends_page.HEIGHT - trends_page.BOTTOM
    middle = float(drawn["low"]) - np.polyval(to_arcsec, foot)
    of_y = lambda px: np.polyval(to_arcsec, px) + middle  # noqa: E731
    steps = np.array([step.t_s(series) for step in course.steps])
    assert_allclose([np.polyval(to_s, float(x)) for x in drawn["steps"]], steps, atol=0.2 * day * DAY_S)

    def near(px: np.ndarray, py: np.ndarray, side: float) -> None:
        """On the course, or so many sigma beside it, but for the days about a step."""
        at_s = np.polyval(to_s, px)
        theta, covariance = course.at(at_s)
        expected = (theta[:, axis] + side * np.sqrt(covariance[:, axis, axis])) / ARCSEC
        far = np.all(np.abs(at_s[:, None] - steps) > 3.0 * DAY_S, axis=1)
        # besides rounding the season changes by 0.05 arcsec a day
        assert_allclose(of_y(py)[far], expected[far], atol=0.2 * arcsec + 0.01 + 0.05 * 0.2 * day)

    curve = of_text(drawn["curve"])
    near(*curve, 0.0)
    last = max(series.t_s[-1], trend.now.t_s) + 180.0 * DAY_S
    assert_allclose(np.polyval(to_s, curve[0][[0, -1]]), [series.t_s[0], last], atol=0.2 * day * DAY_S)
    ends = []
    for part in ("band", "ahead"):
        upper, lower = np.split(of_text(drawn[part]), 2, axis=1)
        near(*upper, 1.0)
        near(*lower, -1.0)
        ends.append(np.polyval(to_s, upper[0][[0, -1]]))
    assert ends[0][1] == pytest.approx(ends[1][0]) and ends[0][1] >= series.t_s[-1] - 0.2 * day * DAY_S

    assert curve[0][[0, -1]] == pytest.approx(
        [trends_page.LEFT, trends_page.WIDTH - trends_page.RIGHT], abs=0.06
    )
    high = np.concatenate([of_text(drawn["band"])[1], of_text(drawn["ahead"])[1]])
    high = np.append(high, [float(point["y"]) for point in drawn["points"]])
    # all is inside the frame and fills it, but for some px
    assert trends_page.TOP + 4.0 < high.min() < trends_page.TOP + 16.0
    assert foot - 16.0 < high.max() < foot - 4.0

    free, covariance = course.free
    columns = series.cos_sin - series.cos_sin.mean(axis=0)
    theta = (free - columns @ course.of_term("orbit phase")[0])[:, axis] / ARCSEC
    weight = ARCSEC**2 / covariance[:, axis, axis]
    seen = 0
    for point in drawn["points"]:
        words = point["words"].split(", ")
        own = slice(seen, seen := seen + (int(words[1].split()[0]) if len(words) > 1 else 1))
        mean, sigma = weight[own] @ theta[own] / weight[own].sum(), weight[own].sum() ** -0.5
        expected = np.clip([mean, mean + sigma, mean - sigma], of_y(foot), of_y(trends_page.TOP))
        assert_allclose(
            of_y(np.array([point[k] for k in ("y", "top", "foot")], float)),
            expected,
            atol=0.2 * arcsec + 0.01,
        )
        assert np.polyval(to_s, float(point["x"])) == pytest.approx(
            series.t_s[own].mean(), abs=0.2 * day * DAY_S
        )
        assert (
            words[0].startswith(utc_at(series.t_s[own][-1])[:10]) and series.names[own][-1] in point["page"]
        )
    assert seen == 60 and len(drawn["points"]) == min(60, most_points)
    assert np.polyval(to_s, float(drawn["now"])) == pytest.approx(trend.now.t_s, abs=0.2 * day * DAY_S)
    now = course.at(np.array([trend.now.t_s]))[0][0, axis] / ARCSEC
    limits = of_y(np.array(drawn["required"], dtype=float))
    expected = [value for value in (now - 1.5, now + 1.5) if of_y(foot) < value < of_y(trends_page.TOP)]
    assert_allclose(limits, expected, atol=0.2 * arcsec + 0.05)
    assert expected
