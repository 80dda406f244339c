"""Whether a matrix is as accurate as required, as the console says it."""

import numpy as np
import pytest

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.results.requirement import requirement_lines

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
