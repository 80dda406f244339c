"""Which targets of a strip contradict the others: the covariance that they share, and the common rotation."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import block_diag

from boresight.gct_match.consistency import _from_the_others, _information, _scatter
from boresight.gct_match.match import _log_chance
from boresight.gct_match.search.vote import Vote
from boresight.gct_match.settings import MatchSettings

SETTINGS = MatchSettings(attitude_sigma_px=0.4, attitude_step_s=0.2, consistency_sigma_px=0.3)


def test_targets_between_the_same_exposures_share_the_attitude_error() -> None:
    cov_px = np.array([[[0.04, 0.01], [0.01, 0.09]]] * 3)
    scatter = _scatter(SETTINGS, cov_px, np.array([0.0, 0.05, 0.9]))  # s
    np.testing.assert_allclose(
        scatter[0, 1], 0.16 * 0.75 * np.eye(2), atol=1e-12
    )  # a quarter of a step apart
    np.testing.assert_array_equal(scatter[0, 2], np.zeros((2, 2)))
    np.testing.assert_allclose(scatter[1, 1], cov_px[1] + (0.16 + 0.09) * np.eye(2), atol=1e-12)


def test_common_rotation_is_that_of_least_squares_with_its_prior() -> None:
    rng = np.random.default_rng(5)
    design = rng.normal(size=(4, 2, 3)) * 1e6
    d, cov_px = rng.normal(size=(4, 2)), np.array([[[0.5, 0.2], [0.2, 0.3]]] * 4)
    sigma_rad = np.array([2e-7, 3e-7, 1e-6])  # as strong as the data, about x and y
    scatter = np.zeros((4, 4, 2, 2))
    scatter[range(4), range(4)] = cov_px
    normal, towards = _information(d, design, scatter)
    covariance = np.linalg.inv(normal + np.diag(sigma_rad**-2.0))
    found = covariance @ towards
    D, W = design.reshape(8, 3), np.linalg.inv(block_diag(*cov_px))
    expected = np.linalg.inv(D.T @ W @ D + np.diag(sigma_rad**-2.0))
    np.testing.assert_allclose(covariance, expected, rtol=1e-9)
    np.testing.assert_allclose(found, expected @ D.T @ W @ d.ravel(), rtol=1e-9)


def test_a_target_is_compared_with_what_the_others_predict() -> None:
    rng = np.random.default_rng(6)
    design = rng.normal(size=(5, 2, 3)) * 1e6
    d, sigma_rad = rng.normal(size=(5, 2)), np.full(3, 1e-6)
    scatter = _scatter(SETTINGS, np.tile(0.05 * np.eye(2), (5, 1, 1)), np.linspace(0.0, 0.3, 5))
    off, distance = _from_the_others(d, design, scatter, sigma_rad)
    prior = np.einsum("nap,p,mbp->nmab", design, sigma_rad**2, design)
    S = (scatter + prior).transpose(0, 2, 1, 3).reshape(10, 10)
    mine, others = slice(0, 2), slice(2, 10)
    gain = S[mine, others] @ np.linalg.inv(S[others, others])  # conditional mean of a Gaussian
    left = d[0] - gain @ d[1:].ravel()
    np.testing.assert_allclose(off[0], left, rtol=1e-8)
    conditional = S[mine, mine] - gain @ S[others, mine]
    np.testing.assert_allclose(distance[0] ** 2, left @ np.linalg.solve(conditional, left), rtol=1e-8)


def test_each_matched_target_lowers_the_chance_of_the_vote_once() -> None:
    vote = Vote(np.zeros(3), np.eye(3), np.zeros(0, dtype=np.int64), -3.0)
    matches = [SimpleNamespace(target_id=name) for name in ("a", "b", "b")]  # b on two CCDs
    expected = -3.0 + 2.0 * np.log(SETTINGS.probability_chance_match)
    assert _log_chance(vote, matches, SETTINGS) == pytest.approx(expected, rel=1e-12)
