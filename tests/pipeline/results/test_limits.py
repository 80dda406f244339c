"""Limits for continuous integration: kept, missed, and the JUnit file of both; the required accuracy."""

from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from boresight.features.sky_images.centroid_report import centroid_limits
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.results.limits import junit_xml, limit_lines, validation_limits
from boresight.pipeline.results.requirement import requirement_lines


def validation(points: int = 3) -> Any:
    after = SimpleNamespace(along_m=np.ones(points), rms_m=(4.25, 1.28))
    angles = {"error_rad": np.array([3e-6, -8e-6, 1e-5]), "sigma_rad": np.array([2e-6, 4e-6, 4e-5])}
    return SimpleNamespace(nees=4.98, after=after, **angles)


def score(**changed: Any) -> Any:
    """Three bins: of SNR 5 to 10 (not counted), of 10 to 20, of 20 and more."""
    figures = {"snr_edges": np.array([5.0, 10.0, 20.0, 1e4]), "over_bound": np.array([9.0, 1.2, 1.0])}
    figures |= {"stars": np.array([50, 100, 300]), "found": np.array([10, 96, 300])}
    return SimpleNamespace(**figures | changed)


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


SIGMA = np.array([0.5, 0.6, 8.0]) * ARCSEC
INSTALLATION = {
    "covariance_rad2": np.diag(SIGMA**2).tolist(),
    "ground_m_per_rad": [530e3, 530e3, 16e3],
    "verdict": {"outcome": "consistent"},
}


@pytest.mark.parametrize(
    ("requirement", "outcome"),
    [
        ({"arcsec": 1.0, "m": None}, "1 arcsec about each axis: not met about Z 8"),
        ({"arcsec": 8.1, "m": None}, "8.1 arcsec about each axis: met"),
        ({"arcsec": None, "m": 1.4}, "1.4 m on the ground: not met about Y 1.542"),  # 530 km x 0.6 arcsec
        ({"arcsec": None, "m": 1.6}, "1.6 m on the ground: met"),
    ],
)
def test_axes_that_miss_the_limit_are_named_with_their_sigma(requirement, outcome) -> None:
    (line,) = requirement_lines(requirement, INSTALLATION)
    assert line.split(maxsplit=3)[3] == outcome


def test_no_requirement_is_no_line_and_a_refuted_matrix_meets_none() -> None:
    assert requirement_lines({}, INSTALLATION) == []
    refuted = INSTALLATION | {"verdict": {"outcome": "refuted"}}
    (line,) = requirement_lines({"arcsec": 100.0}, refuted)
    assert "cannot be judged" in line
    unseen = INSTALLATION | {"ground_m_per_rad": [None] * 3}  # strips that see no ground
    (line,) = requirement_lines({"m": 100.0}, unseen)
    assert "not known" in line
