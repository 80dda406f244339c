"""Normal numbers by table: distribution, tails and independence."""

import cv2
import numpy as np
from pytest import approx
from scipy.stats import kstest, norm

from boresight.simulator.normal_numbers import normal_numbers, normal_rows, random_bytes


def test_numbers_have_the_normal_distribution():
    numbers = normal_numbers((1000, 2000), np.random.default_rng(1)).astype(float)
    count = numbers.size
    assert abs(numbers.mean()) < 5 / np.sqrt(count)
    assert numbers.var() == approx(1.0, abs=5 * np.sqrt(2 / count))
    assert (numbers**4).mean() == approx(3.0, abs=5 * np.sqrt(96 / count))  # variance of the fourth power
    assert kstest(numbers[::10].ravel(), norm.cdf).pvalue > 1e-3


def test_numbers_beyond_four_and_a_half_sigmas_are_as_frequent_as_they_should_be():
    rng = np.random.default_rng(2)
    numbers = np.concatenate([normal_numbers((1000, 4000), rng) for _ in range(5)])  # 20 million
    for sigmas in (4.0, 4.5, 5.0):
        for tail in (numbers > sigmas, numbers < -sigmas):
            expected = norm.sf(sigmas) * numbers.size
            assert abs(tail.sum() - expected) < 5 * np.sqrt(expected)


def test_neighbours_are_independent():
    numbers = normal_numbers((1000, 1000), np.random.default_rng(3)).astype(float)
    for one, other in ((numbers[1:], numbers[:-1]), (numbers[:, 1:], numbers[:, :-1])):
        assert abs((one * other).mean()) < 5e-3  # a million pairs
        assert abs((one**2 * other**2).mean() - 1.0) < 5 * np.sqrt(8) * 1e-3


def test_equal_seeds_give_equal_numbers_of_any_odd_shape():
    one, two = (normal_numbers((7, 13), np.random.default_rng(4)) for _ in range(2))
    assert np.array_equal(one, two) and one.dtype == np.float32
    assert len(random_bytes(13, np.random.default_rng(5))) == 13


def test_rows_of_a_table_are_normal_and_without_memory():
    numbers = normal_rows(2000, 512, np.random.default_rng(4)).astype(float)
    again = normal_rows(2000, 512, np.random.default_rng(4))
    assert numbers.shape == (2000, 512) and np.array_equal(numbers, again)
    # The table's million numbers: mean and variance to 0.001 and 0.0014; rows repeat some of them.
    assert abs(numbers.mean()) < 0.007 and abs(numbers.var() - 1.0) < 0.01
    assert abs((numbers**4).mean() / 3.0 - 1.0) < 0.03
    for shifted in (numbers[1:], numbers[:, 1:], numbers[1:, 3:]):
        other = numbers[: shifted.shape[0], : shifted.shape[1]]
        assert abs((shifted * other).mean()) < 0.006  # five sigma of a million pairs


def test_no_area_of_rows_comes_twice():
    numbers = normal_rows(1024, 512, np.random.default_rng(4))
    found = cv2.matchTemplate(numbers, numbers[200:232, 100:132], cv2.TM_CCOEFF_NORMED)
    found[198:203, 98:103] = 0.0
    # Half a million places of sigma 1 / 32: 5 sigma, more by rows that are alike.
    assert found.max() < 0.25
