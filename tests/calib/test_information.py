"""Sums that do not depend on their order, and what may be concluded from them."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boresight.calib.information import InformationPairs, exact_sum, solve_total
from boresight.geometry.installation import deviation_from_theta, theta_between

REFERENCE = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)


def pairs_of(n, seed=0, prefix="p", shared=()):
    rng = np.random.default_rng(seed)
    size = 3 + len(shared)
    root = rng.normal(size=(n, size, size)) * 10.0 ** rng.uniform(3, 9, (n, 1, 1))
    F = root @ np.swapaxes(root, 1, 2)
    F = 0.5 * (F + np.swapaxes(F, 1, 2))
    names = np.array([f"{prefix}{k}" for k in range(n)])
    return InformationPairs(names, F, rng.normal(size=(n, size)) * 1e9, REFERENCE, shared)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-1e30, 1e30, allow_subnormal=False), min_size=1, max_size=30),
    st.randoms(use_true_random=False),
)
def test_exact_sum_is_that_of_fractions_in_any_order(numbers, random):
    shuffled = list(numbers)
    random.shuffle(shuffled)
    both = np.column_stack([numbers, shuffled])
    F, right = exact_sum(np.zeros((len(both), 2, 2)), both)
    assert right.tolist() == [float(sum(map(Fraction, numbers)))] * 2
    assert not F.any()


def test_what_is_no_number_is_not_added():
    with pytest.raises(ValueError, match="not a finite number"):
        exact_sum(np.zeros((2, 2, 2)), np.array([[1.0, np.inf], [0.0, -np.inf]]))


def test_pairs_merge_to_the_same_bits_in_any_order():
    a, b = pairs_of(7, 1, "a"), pairs_of(5, 2, "b")
    for one, two in zip(a.merged(b).total(), b.merged(a).total()):
        assert two.tobytes() == one.tobytes()


def test_nothing_is_counted_twice():
    with pytest.raises(ValueError, match="2 names are in both sets of pairs, first 'p0'"):
        pairs_of(4).merged(pairs_of(2, seed=5))


def test_pairs_survive_their_table_bit_for_bit():
    pairs = pairs_of(4, shared=("distortion/x/0/1", "distortion/y/0/1"))
    back = InformationPairs.from_numbers(pairs.names, *pairs.numbers())
    assert back.shared == pairs.shared and back.names.tolist() == pairs.names.tolist()
    assert back.F.tobytes() == pairs.F.tobytes() and back.F_theta.tobytes() == pairs.F_theta.tobytes()
    assert back.merged(pairs_of(1, 9, "q", pairs.shared)).F_theta[0].tobytes() == pairs.F_theta[0].tobytes()


def test_another_reference_leaves_the_matrix_where_it_was():
    pairs = pairs_of(6)
    moved = deviation_from_theta(np.array([2e-6, -3e-6, 1e-6])) * REFERENCE
    estimates = []
    for about in (pairs, pairs.about(moved)):
        theta = np.linalg.solve(*about.total())
        estimates.append(deviation_from_theta(theta) * about.R_cs_ref)
    assert np.linalg.norm(theta_between(*estimates)) < 1e-10  # rad: second order in micro-radians


def test_sets_with_different_shared_unknowns_merge_by_name():
    a, b = pairs_of(2, 1, "a", ("u",)), pairs_of(2, 2, "b", ("t", "u"))
    both = a.merged(b)
    assert both.shared == ("t", "u")
    np.testing.assert_array_equal(both.F[:2, 4, 4], a.F[:, 3, 3])
    assert np.all(both.F[:2, 3] == 0.0)


def test_shared_unknowns_are_eliminated_with_their_prior():
    pairs = pairs_of(5, shared=("u", "v"))
    (whole, right), prior = pairs.total(), np.diag([1e12, 3e13])
    solution = solve_total(whole, right, prior, sigma_observable_rad=1e-3)
    whole[3:, 3:] += prior
    np.testing.assert_allclose(solution.covariance_all, np.linalg.inv(whole), rtol=1e-6)
    x = np.linalg.solve(whole, right)
    np.testing.assert_allclose(solution.theta, x[:3], rtol=1e-6)
    np.testing.assert_allclose(solution.shared, x[3:], rtol=1e-6)


def test_a_turn_without_information_is_named_and_gets_no_number():
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    F = 1e14 * (np.eye(3) - np.outer(axis, axis))
    solution = solve_total(F, F @ np.array([1e-6, 2e-6, -1e-6]), sigma_observable_rad=1e-3)
    np.testing.assert_allclose(np.abs(solution.unobservable @ axis), 1.0, atol=1e-9)
    assert abs(solution.theta @ axis) < 1e-15 and abs(axis @ solution.covariance @ axis) < 1e-20


def test_pairs_made_one_say_the_same_of_what_is_left():
    pairs = pairs_of(6, 3, shared=("a", "b", "c", "d"))
    prior_bd, prior_ac = (
        1e16 * np.array([[2.0, 0.5], [0.5, 1.0]]),
        1e16 * np.array([[1.0, -0.3], [-0.3, 1.5]]),
    )
    prior = np.zeros((4, 4))
    prior[np.ix_([1, 3], [1, 3])], prior[np.ix_([0, 2], [0, 2])] = prior_bd, prior_ac
    whole = solve_total(*pairs.total(), prior, sigma_observable_rad=1.0)
    one = pairs.as_one("all", ("b", "d"), prior_bd)
    assert one.names.tolist() == ["all"] and one.shared == ("a", "c")
    left = solve_total(one.F[0], one.F_theta[0], prior_ac, sigma_observable_rad=1.0)
    # Rounding of sums whose terms span six decades.
    np.testing.assert_allclose(left.theta, whole.theta, rtol=1e-6)
    np.testing.assert_allclose(left.covariance, whole.covariance, rtol=1e-6)
