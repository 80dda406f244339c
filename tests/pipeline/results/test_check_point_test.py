"""Errors of check points against those that were predicted: the probability, and the line on the console."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from boresight.pipeline.results.check_point_test import probability_beyond, rms_test
from boresight.pipeline.results.summary import check_point_words


@pytest.mark.parametrize("dof", [1, 2, 5, 40])
@pytest.mark.parametrize("p", [0.7, 0.3, 1e-2, 1e-4, 1e-8])
def test_equal_eigenvalues_are_a_chi_square(dof: int, p: float) -> None:
    # The saddlepoint approximation errs as Stirling's formula of gamma(dof / 2): by 14 % at one degree of
    # freedom, 8 % at two, less at more.
    x = 2.5 * chi2(dof).isf(p)
    assert probability_beyond(np.full(dof, 2.5), x) == pytest.approx(p, rel=0.15 / dof)


def test_at_the_mean_it_is_the_chi_square_too() -> None:
    for near in (0.0, 1e-7, 1e-3):
        assert probability_beyond(np.ones(7), 7.0 + near) == pytest.approx(chi2(7).sf(7.0 + near), rel=2e-3)


def test_unequal_eigenvalues_agree_with_draws() -> None:
    lam = np.array([4.0, 1.0, 0.3, *np.full(20, 0.05)])
    drawn = np.random.default_rng(2).standard_normal((200_000, len(lam))) ** 2 @ lam
    for p in (0.5, 0.1, 1e-2):
        # 200 000 draws: 2 % of 0.01 is one standard error, and the approximation errs by some 3 %
        assert probability_beyond(lam, float(np.quantile(drawn, 1.0 - p))) == pytest.approx(p, rel=0.08)


def test_a_right_prediction_is_allowed_and_a_wrong_one_is_told() -> None:
    # Twenty points of each of three strips, 2.5 m of a strip in common, 0.3 m each point by itself.
    strips = np.kron(np.eye(3), np.ones((20, 20)))
    truth = 2.5**2 * strips + 0.3**2 * np.eye(60)
    rng, root = np.random.default_rng(11), np.linalg.cholesky(truth)
    of_right = [rms_test("along", root @ rng.standard_normal(60), truth) for _ in range(300)]
    assert np.mean([one.p_value < 0.05 for one in of_right]) == pytest.approx(0.05, abs=0.04)  # 3 sigma
    assert sum(not one.allowed for one in of_right) <= 2  # 0.15 are expected at a rate of 0.0005 a direction
    far = rms_test("along", 4.0 * root @ np.ones(60) / np.sqrt(3.0), truth)
    assert far.predicted_m == pytest.approx(np.sqrt(2.5**2 + 0.3**2), rel=1e-9)
    wrong = rms_test("along", 9.0 + np.zeros(60), truth)
    assert not wrong.allowed and wrong.p_value < 1e-4
    assert "9.00 m along track where 2.52 m was predicted: not allowed" in check_point_words(wrong)
    assert "dump.toml" in check_point_words(wrong)
    assert check_point_words(replace(wrong, allowed=True, p_value=0.09)).endswith(": allowed (p = 0.09)")
