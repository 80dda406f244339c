"""The common motion found among candidates of which most are wrong, and chance known for what it is."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from boresight.gct_match.search.vote import (
    Candidates,
    fit_common,
    log_chance_of_ranks,
    log_chance_of_score,
    vote,
)

SIGMA = np.full(3, 0.003)  # rad
PX_PER_RAD = 1e6  # the paper's camera


def candidates(rng: np.random.Generator, theta: NDArray | None, targets: int, share: float) -> Candidates:
    """20 candidates a target over ± 9000 px; in `share` of the targets one of them is right."""
    owner, displacement, design = [], [], []
    area = np.pi * 14.0**2 / 18000.0**2  # share of the tolerance in the area searched
    chance = np.tile(log_chance_of_ranks(20, area), targets)
    for n in range(targets):
        x, y = rng.uniform(-0.012, 0.012, 2)
        D = PX_PER_RAD * np.array([[0.0, -1.0, y], [1.0, 0.0, -x]])
        d = rng.uniform(-9000.0, 9000.0, (20, 2))
        if theta is not None and rng.uniform() < share:
            d[7] = D @ theta + rng.normal(0.0, 3.0, 2)
        owner += [n] * 20
        displacement.append(d)
        design += [D] * 20
    return Candidates(np.array(owner), np.concatenate(displacement), np.array(design), chance)


def test_half_of_the_targets_are_enough():
    rng = np.random.default_rng(1)
    theta, nees = np.array([0.003, 0.002, 0.001]), []
    for _ in range(60):
        given = candidates(rng, theta, 14, 0.5)
        right = np.hypot(*(given.displacement_px - given.design @ theta).T) < 14.0
        outcome = vote(given, SIGMA, 3.0, 14.0, 3.0)
        if right.sum() < 5:
            assert len(outcome.supporters) < 7  # fewer than five of the fourteen happened to be visible
            continue
        assert outcome.log_probability_chance < np.log(1e-6)
        assert np.mean(right[outcome.supporters]) > 0.8
        error = outcome.parameters - theta
        nees.append(error @ np.linalg.solve(outcome.covariance, error))
        # the angles about x and y are fixed by 3 px over the supporters, that about z by them over 0.024
        # rad of field
        assert outcome.parameters[:2] == pytest.approx(theta[:2], abs=1.5e-5)
        assert outcome.parameters[2] == pytest.approx(theta[2], abs=1.5e-3)
    low, high = chi2(df=3 * len(nees)).ppf([0.0005, 0.9995])
    assert len(nees) > 40 and low < sum(nees) < high


def test_chance_is_no_rarer_than_stated():
    rng = np.random.default_rng(4)
    stated = [
        np.exp(vote(candidates(rng, None, 6, 0.0), SIGMA, 3.0, 14.0, 4.0).log_probability_chance)
        for _ in range(200)
    ]
    assert np.mean(np.array(stated) < 0.1) < 0.1 + 3.0 * np.sqrt(0.1 * 0.9 / 200)  # 3 standard errors
    assert np.mean(np.array(stated) < 0.01) < 0.01 + 3.0 * np.sqrt(0.01 * 0.99 / 200)


def test_chance_of_rank_one_in_every_target_is_the_share_to_their_number():
    # Four targets at rank one: three must fall by accident into a spot of 1/1000 about the fourth.
    spread = np.random.default_rng(5).uniform(-1e3, 1e3, (4, 50, 2))
    spread[:, 0] = 5.0
    every = Candidates(
        np.repeat(np.arange(4), 50),
        spread.reshape(-1, 2),
        np.broadcast_to(np.eye(2), (200, 2, 2)),
        np.tile(log_chance_of_ranks(50, 1e-3), 4),
    )
    outcome = vote(every, np.full(2, 400.0), 3.0, 2.0, 1.0)
    # Boole over the four as the first one: nothing else reaches that score
    assert outcome.log_probability_chance == pytest.approx(np.log(4.0 * 1e-3**3), abs=1e-9)


@pytest.mark.parametrize("score", [3.0, 5.0, 7.5, 10.0])
def test_chance_of_a_score_is_that_of_all_cases_counted_one_by_one(score: float):
    ranks = [log_chance_of_ranks(count, share) for count, share in ((4, 0.02), (6, 0.01), (3, 0.05))]
    found = Candidates(
        np.repeat(np.arange(3), [4, 6, 3]), np.zeros((13, 2)), np.zeros((13, 2, 3)), np.concatenate(ranks)
    )
    cases = [  # of each target: log chance and probability of its best rank, or of none
        [(0.0, 1.0 - np.exp(log_p[-1])), *zip(log_p, np.diff(np.exp(log_p), prepend=0.0))] for log_p in ranks
    ]
    expected = sum(
        float(p_one * p_other)
        for t in range(3)
        for first in ranks[t]
        for (one, p_one), (other, p_other) in itertools.product(*(cases[u] for u in range(3) if u != t))
        if first + one + other <= -score
    )
    bound = np.exp(log_chance_of_score(found, score))
    assert expected <= bound * (1.0 + 1e-12)
    assert bound < 1.3 * expected  # shares are rounded up to 1/480 of the score, cases at its edge with them


def test_ranks_of_random_positions_are_as_rare_as_stated():
    # 20 000 sets of 5 random positions: share of sets of which one of the first k + 1 lies in 2 % of the area
    inside = np.random.default_rng(6).uniform(size=(20_000, 5)) < 0.02
    seen = np.logical_or.accumulate(inside, axis=1).mean(axis=0)
    stated = np.exp(log_chance_of_ranks(5, 0.02))
    assert (
        seen <= stated + 4.0 * np.sqrt(stated / 20_000)
    ).all()  # 4 standard errors: never rarer than stated
    assert (
        seen > 0.9 * stated
    ).all()  # Boole's bound is 1 - 0.98^5 / 0.1 = 4 % too high at most, scatter 3 %
    assert log_chance_of_ranks(60, 0.02).max() == 0.0


def test_every_value_of_the_third_parameter_is_one_more_opportunity_for_chance():
    # Five targets agree on zero. The third parameter has a lever of at most 50 px per unit and is searched
    # over ±1.5 in steps of 2 px: 2 * ceil(1.5 * 50 / 2) + 1 = 77 values, cut to 61.
    rng = np.random.default_rng(9)
    lever = np.array([[-50.0, 20.0], [50.0, -20.0], [10.0, 30.0], [-10.0, -30.0], [0.0, 0.0]])
    for steps, reach in ((61, 3.0), (39, 1.5)):
        d = rng.uniform(-900.0, 900.0, (5, 20, 2))
        d[:, 0] = 0.0
        design = np.concatenate([np.broadcast_to(np.eye(2), (5, 2, 2)), lever[:, :, None]], axis=2)
        chance = np.tile(log_chance_of_ranks(20, 1e-4), 5)
        owner = np.repeat(np.arange(5), 20)
        two = Candidates(owner, d.reshape(-1, 2), np.repeat(design[:, :, :2], 20, axis=0), chance)
        three = Candidates(owner, d.reshape(-1, 2), np.repeat(design, 20, axis=0), chance)
        sigma = np.array([400.0, 400.0, 0.5])
        plain = vote(two, sigma[:2], reach, 2.0, 1.0).log_probability_chance
        searched = vote(three, sigma, reach, 2.0, 1.0).log_probability_chance
        assert searched - plain == pytest.approx(np.log(steps), abs=1e-9)


def test_no_candidates_elect_nothing():
    none = Candidates(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros(0))
    outcome = vote(none, SIGMA, 3.0, 14.0, 4.0)
    assert outcome.log_probability_chance == 0.0
    assert len(outcome.supporters) == 0


def test_common_parameters_are_those_of_least_squares_with_their_prior() -> None:
    rng = np.random.default_rng(9)
    design, displacement = rng.normal(size=(3, 2, 3)), rng.normal(size=(3, 2))
    cov_px = np.array([[[0.5, 0.2], [0.2, 0.3]]] * 3)
    prior = np.array([0.2, 0.3, 0.5])  # as strong as the data
    p, covariance = fit_common(displacement, design, cov_px, prior)
    W = np.kron(np.eye(3), np.linalg.inv(cov_px[0]))
    D = design.reshape(6, 3)
    expected = np.linalg.inv(D.T @ W @ D + np.diag(prior**-2.0))
    np.testing.assert_allclose(covariance, expected, rtol=1e-10)
    np.testing.assert_allclose(p, expected @ D.T @ W @ displacement.ravel(), rtol=1e-10)
