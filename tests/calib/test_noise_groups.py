"""Groups of observations with larger errors than stated, by their statistics alone."""

import numpy as np
import pytest
from scipy.stats import chi2

from boresight.calib.noise_groups import noisiest

LIMIT = float(chi2.ppf(0.999, 2))
STRIP = np.repeat(np.array(["s1", "s2", "s3"]), 40)
CCD = np.arange(120) % 4
SKY = STRIP == "s3"


def found(statistic, tolerated=1.0):
    inside = np.ones(len(STRIP), dtype=bool)
    return noisiest(statistic, LIMIT, tolerated, STRIP, CCD, SKY, inside)


def drawn(seed):
    return np.random.default_rng(seed).chisquare(2, len(STRIP))


def test_stated_errors_that_hold_make_no_group_in_200_draws():
    assert not any(found(drawn(seed), tolerated=1.1) for seed in range(200))


@pytest.mark.parametrize(
    ("group", "item"),
    [
        (STRIP == "s2", "strip s2"),
        (CCD == 3, "CCD 3"),
        (SKY, "strips of the sky"),
        (STRIP != "", "all strips"),
    ],
)
def test_the_group_whose_errors_are_four_times_as_large_is_named_with_that_factor(group, item):
    one = found(drawn(3) * np.where(group, 16.0, 1.0))
    # 30 observations of two parts each tell a standard deviation to 1 / sqrt(120) = 9 %: 3.5 of them.
    assert one is not None and one.item == item
    assert one.factor == pytest.approx(4.0, rel=0.32)


def test_a_few_gross_errors_make_no_group():
    statistic = drawn(4)
    statistic[[1, 5, 9]] = 1e4
    assert found(statistic, tolerated=1.1) is None
