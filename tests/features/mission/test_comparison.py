"""Two results compared: the covariance of their difference is honest where they share camera or strips."""

import json

import numpy as np
import pytest
from command_line import invoked, ran
from drawn_mission import DrawnMission, bare_result, lopsided_pair
from scipy.stats import binom, chi2, kstest, ncx2

from boresight.calib.distortion import prior_information
from boresight.features.mission import mounting_comparison as comparison
from boresight.features.mission.api import compare, what_if
from boresight.features.mission.mounting_comparison import compare_mountings
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.pipeline.errors import DataNotSufficientError

PAIR, DAY_S = lopsided_pair(), 86400.0


def pairs(count, step=0.0):
    """Comparisons of results of one camera a day apart, the second three times as informative."""
    like = bare_result(PAIR)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        mission = DrawnMission(PAIR, rng)
        theta = rng.normal(size=3) * 5 * ARCSEC
        first = mission.result(like, "a", 0.0, theta)
        second = mission.result(like, "b", DAY_S, theta + np.array([step, 0.0, 0.0]) * ARCSEC, scale=3.0)
        yield compare_mountings(first, second)


def test_p_values_of_consistent_results_of_one_camera_are_uniform():
    found = list(pairs(120))
    assert kstest([one.p_value for one in found], "uniform").pvalue > 0.01
    # taken as independent, both results' distortion would be counted twice
    one = found[0]
    assert np.linalg.eigvalsh(one.first.covariance + one.second.covariance - one.covariance_c)[0] > 0.0


def test_a_difference_is_found_as_often_as_its_covariance_predicts():
    found = list(pairs(100, step=2.0))
    size = np.array([2.0 * ARCSEC, 0.0, 0.0])
    power = ncx2(3, size @ np.linalg.solve(found[0].covariance_c, size)).sf(chi2(3).isf(0.01))
    low, high = binom(100, power).ppf([0.0005, 0.9995])
    assert low <= sum(one.differs for one in found) <= high and 0.1 < power < 0.999


def test_the_difference_turns_the_first_matrix_into_the_second():
    (one,) = pairs(1)
    turned = theta_between(one.second.R_cs, one.first.R_cs)
    np.testing.assert_allclose(one.theta_c, turned, rtol=1e-12)
    np.testing.assert_allclose(one.second.R_cs.apply(one.theta_s), one.theta_c, rtol=1e-9, atol=1e-15)


def test_a_strip_in_both_results_is_not_counted_as_two(monkeypatch):
    """The second result is the strip of the first and another: Hausman's difference of variances."""
    errors, like = [], bare_result(PAIR)
    monkeypatch.setattr(comparison, "read_mounting", lambda folder, name, scale, camera: PAIR)
    for seed in range(80):
        mission = DrawnMission(PAIR, np.random.default_rng(seed))
        first = mission.result(like, "a", 0.0, np.zeros(3))
        more = mission.result(like, "x", DAY_S, np.zeros(3))
        F = first.pair.F + more.pair.F
        both = type(first.pair)(
            np.array(["b"]), F, first.pair.F_theta + more.pair.F_theta, PAIR.R_cs_ref, PAIR.shared
        )
        N = F[0].copy()
        N[3:, 3:] += prior_information(PAIR.shared)
        theta = np.linalg.solve(N, both.F_theta[0])[:3]
        second = mission.result(
            like,
            "b",
            0.5 * DAY_S,
            np.zeros(3),
            pair=both,
            R_cs=deviation_from_theta(theta) * PAIR.R_cs_ref,
            covariance=np.linalg.inv(N)[:3, :3],
            strips=np.array(["s1", "s2"]),
            track_deg=np.zeros((2, 4)),
            strips_utc=np.array([first.utc, more.utc]),
        )
        found = compare_mountings(first, second)
        assert found.common_strips == ("s1",)
        less = first.covariance - second.covariance
        np.testing.assert_allclose(found.covariance_c, less, rtol=1e-6, atol=1e-18)
        errors.append(found.p_value)
    assert kstest(errors, "uniform").pvalue > 0.001


def test_a_result_is_equal_to_itself_and_nothing_is_tested(finished, tmp_path):
    card = tmp_path / "card.html"
    content = json.loads(ran("compare", finished[1], finished[1], "--html", card, "--json").stdout)["result"]
    assert content["dof"] == 0 and content["p_value"] == 1.0 and not content["differing"]
    assert len(content["common_strips"]) == 1 and content["shares_camera"]
    assert "no test" in card.read_text() and "http" not in card.read_text().replace("http-equiv", "")
    assert compare(finished[1], finished[1]).table().empty


@pytest.mark.parametrize(
    ("false_alarm", "accepted"), [(0.5, True), (1e-9, True), (0.51, False), (0.0, False)]
)
def test_a_probability_of_a_false_alarm_is_at_most_a_half_at_both_doors(finished, false_alarm, accepted):
    result = finished[1]
    told = invoked("compare", result, result, "--false-alarm", false_alarm)
    assert (told.exit_code == 0) == accepted
    if accepted:
        assert compare(result, result, false_alarm=false_alarm).false_alarm == false_alarm
    else:
        with pytest.raises(ValueError, match="false_alarm"):
            compare(result, result, false_alarm=false_alarm)


def test_strips_left_out_or_worse_change_the_matrix_as_their_information_says(finished):
    (name,) = what_if(finished[1], {}).strips
    twice = what_if(finished[1], {name: 2.0})
    sigma, now = (np.sqrt(np.diag(C)) for C in (twice.covariance, twice.covariance_now))
    assert np.all(sigma[:2] > 1.5 * now[:2]) and np.all(sigma <= 2.0 * now * (1 + 1e-9))
    np.testing.assert_allclose(what_if(finished[1], {}).shift, 0.0, atol=1e-18)
    with pytest.raises(DataNotSufficientError, match="do not determine"):
        what_if(finished[1], {name: np.inf})
    with pytest.raises(ValueError, match="no strip 'other'"):
        what_if(finished[1], {"other": 2.0})
    assert "1 sigma now" in ran("what-if", finished[1], "--sigma", f"{name}=2").output
