"""Limits for continuous integration: kept, missed, and the JUnit file of both."""

from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from boresight.features.sky_images.centroid_report import centroid_limits
from boresight.pipeline.results.limits import junit_xml, limit_lines, validation_limits


def validation(points: int = 3) -> Any:
    after = SimpleNamespace(along_m=np.ones(points), rms_m=(4.25, 1.28))
    return SimpleNamespace(
        error_rad=np.array([3e-6, -8e-6, 1e-5]),
        sigma_rad=np.array([2e-6, 4e-6, 4e-5]),
        nees=4.98,
        after=after,
    )


def score(**changed: Any) -> Any:
    """Three bins: of SNR 5 to 10 (not counted), of 10 to 20, of 20 and more."""
    figures = {
        "snr_edges": np.array([5.0, 10.0, 20.0, 1e4]),
        "stars": np.array([50, 100, 300]),
        "found": np.array([10, 96, 300]),
        "over_bound": np.array([9.0, 1.2, 1.0]),
    }
    return SimpleNamespace(**(figures | changed))


def test_limits_that_are_not_given_are_not_held() -> None:
    assert validation_limits(validation()) == [] and centroid_limits(score()) == []
    assert limit_lines([]) == []


def test_the_largest_error_in_sigmas_is_held_whatever_its_sign() -> None:
    (limit,) = validation_limits(validation(), max_error_sigma=1.9)
    assert limit.found == pytest.approx(2.0) and not limit.holds
    assert validation_limits(validation(), max_error_sigma=2.0)[0].holds


def test_a_result_without_check_points_misses_a_limit_on_the_ground() -> None:
    assert validation_limits(validation(), max_ground_m=4.3)[0].holds
    assert not validation_limits(validation(), max_ground_m=4.2)[0].holds
    assert not validation_limits(validation(0), max_ground_m=1e9)[0].holds


def test_centroids_are_held_from_a_signal_to_noise_ratio_on() -> None:
    x_bound, complete = centroid_limits(score(), 1.1, 0.99)
    assert complete.found == pytest.approx(396 / 400) and complete.holds
    assert x_bound.found == pytest.approx(np.sqrt((96 * 1.44 + 300) / 396)) and x_bound.holds
    assert not centroid_limits(score(), 1.1, 0.99, from_snr=5.0)[0].holds
    none = centroid_limits(score(stars=np.zeros(3, int), found=np.zeros(3, int)), 1.1, 0.5)
    assert [one.holds for one in none] == [False, False]


def test_junit_counts_the_missed_limits_and_says_which() -> None:
    limits = validation_limits(validation(), max_error_sigma=4.0, max_nees=4.0, max_ground_m=6.0)
    root = ElementTree.fromstring(junit_xml("validate", limits, 1.5).encode())
    suite = root.find("testsuite")
    assert suite is not None and (suite.get("tests"), suite.get("failures")) == ("3", "1")
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert failed == ["max-nees"]
    assert "NEES 4.98, at most 4" in str(suite.findtext("testcase/failure"))
    assert limit_lines(limits)[-1] == "1 of 3 limits missed"
