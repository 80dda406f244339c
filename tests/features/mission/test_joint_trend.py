"""Whether a mounting moved between dumps: no alarm more often than asked for, steps with an honest size and
date, and what all months share counted once.

Vectors only: results are drawn from their own information. The mounting is far from the identity, and the
information is lopsided and turned, so that a wrong frame or sign shows.
"""

import itertools
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from drawn_campaigns import BOLD, TABLE_1, assert_chi_square, squared
from drawn_mission import DrawnMission, joint_information, lopsided_pair
from numpy.testing import assert_allclose
from scipy.stats import binom, chi2

from boresight.calib.calibration import calibrate_strips
from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs
from boresight.calib.settings import CalibrationSettings
from boresight.features.mission import mounting_course
from boresight.features.mission.joint_trend import against_rest
from boresight.features.mission.mounting_course import (
    CourseModel,
    CourseSettings,
    MountingSeries,
    dated_steps,
    estimate_course,
    fit_columns,
)
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.simulator.campaign import CameraPair, draw_strips

PAIR = lopsided_pair()
MONTHS = np.array([0, 29, 62, 88, 121, 155, 180, 214, 240, 273, 300, 336.0]) * DAY_S


def drawn(course, rng, t_s=MONTHS, **conditions):
    """A series whose truth is `course` (K, 3), rad."""
    return DrawnMission(PAIR, rng).series(t_s, course, **conditions)


def test_alarms_at_rest_come_no_more_often_than_is_asked_for():
    rng, found = np.random.default_rng(1), []
    for _ in range(400):
        found.append(against_rest(drawn(np.zeros((12, 3)), rng)))
    alarms = sum(one.moved(0.05) for one in found)
    # The bound of 5 % is never passed in 400 runs but by chance: 99.9 % of the binomial.
    assert alarms <= binom(400, 0.05).ppf(0.999)
    # And the chi2 behind it is one: p-values are uniform (their mean 0.5, 1 sigma 0.0144).
    assert np.mean([one.p_value for one in found]) == pytest.approx(0.5, abs=0.05)


def test_a_step_is_found_with_its_date_and_the_interval_covers_it():
    rng, runs = np.random.default_rng(3), 40
    found = dated = covered = 0
    # 3" along x, where a result of any orientation has some weight: ten times its best direction's 1 sigma
    size = np.array([3.0, 0.0, 0.0]) * ARCSEC
    for _ in range(runs):
        t_step = rng.uniform(MONTHS[3], MONTHS[8])
        one = against_rest(drawn(np.where(MONTHS[:, None] > t_step, size, 0.0), rng))
        found += one.moved(0.01)
        low, high = one.step.interval_s
        middle = 0.5 * (MONTHS[one.step.row - 1] + MONTHS[one.step.row])
        dated += bool(abs(middle - t_step) <= 31 * DAY_S)
        covered += bool(low <= t_step <= high)
    assert found == runs
    assert dated >= 0.9 * runs  # the right gap, or its neighbour's edge
    assert covered >= binom(runs, 0.95).ppf(0.001)


def test_the_step_itself_and_its_covariance_are_honest():
    rng, step, nees, runs = np.random.default_rng(4), np.array([4.0, -9.0, 12.0]) * ARCSEC, 0.0, 60
    for _ in range(runs):  # large, so that no draw misses its gap
        one = against_rest(drawn(np.where(np.arange(12)[:, None] > 4, step, 0.0), rng)).step
        assert one.row == 5
        error = one.theta - step
        nees += squared(error, one.covariance)
    assert_chi_square(nees, 3 * runs)


def test_an_orbit_term_is_not_accepted_beside_a_step_that_it_could_follow():
    """No term is there, but a step of 12 arcsec; three terms of 1 % together are asked, 25 runs."""
    rng, accepted = np.random.default_rng(12), 0
    course = np.where(np.arange(12)[:, None] > 6, [12 * ARCSEC, 0.0, 0.0], 0.0)
    for _ in range(25):
        u = rng.uniform(0.0, 2.0 * np.pi, 12)
        found = estimate_course(drawn(course, rng, cos_sin=np.column_stack([np.cos(u), np.sin(u)])))
        accepted += "orbit phase" in found.terms
    assert accepted <= binom(25, 0.01).ppf(0.999)


def test_the_course_with_a_walk_is_the_dense_gaussian_posterior():
    """Against conditioning of the joint Gaussian of all levels; the first has a prior of 1e4 times the data,
    which is worth 1e-6 of the result.
    """
    rng, density = np.random.default_rng(6), (0.1 * ARCSEC) ** 2 / DAY_S
    series = drawn(rng.normal(size=(12, 3)) * ARCSEC, rng)
    L, right = joint_information(series)
    prior = np.kron(density * np.minimum.outer(MONTHS, MONTHS) + (1e4 * ARCSEC) ** 2, np.eye(3))
    dense = np.linalg.inv(np.linalg.inv(prior) + L)
    theta = dense @ right
    fit = fit_columns(series, np.ones((12, 1)), density)
    X = np.hstack([np.ones((12, 1)), np.tril(np.ones((12, 12)))[:, 1:]])  # a ramp has passed from its end on
    assert_allclose((X @ fit.coefficients).ravel(), theta, atol=1e-4 * ARCSEC)
    m = len(fit.coefficients)
    own = np.einsum("ni,iajb,nj->nab", X, fit.covariance.reshape(m, 3, m, 3), X)
    for k in range(12):
        block = dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        assert_allclose(own[k], block, atol=1e-4 * ARCSEC**2)


def test_the_likelihood_of_a_density_is_that_of_the_plain_normal_distribution():
    rng = np.random.default_rng(31)
    series = drawn(rng.normal(size=(12, 3)) * ARCSEC, rng)
    L, right = joint_information(series)
    theta, X = np.linalg.solve(L, right), np.kron(np.ones((12, 1)), np.eye(3))

    def plain(density):
        """Steps of a walk and the level integrated out, but for what no density changes."""
        S = np.linalg.inv(L) + density * np.kron(np.minimum.outer(MONTHS, MONTHS), np.eye(3))
        inverse = np.linalg.inv(S)
        rest = theta - X @ np.linalg.solve(X.T @ inverse @ X, X.T @ inverse @ theta)
        return rest @ inverse @ rest + np.linalg.slogdet(S)[1]

    def found(density):
        return CourseModel(density=density).loss(series)

    density = [x * ARCSEC**2 / DAY_S for x in (0.001, 0.01, 0.1, 1.0)]
    assert_allclose(np.diff([found(x) for x in density]), np.diff([plain(x) for x in density]), rtol=1e-5)


@pytest.mark.parametrize(("most_gaps", "size"), [(1000, 1.0), (5, 1.0), (1000, 300.0)])
@pytest.mark.parametrize("density", [0.0, (0.02 * ARCSEC) ** 2 / DAY_S])
def test_a_step_lies_where_its_size_integrated_out_makes_it_likely(density, most_gaps, size, monkeypatch):
    """Against the likelihood of each gap by the plain normal distribution of all results."""
    rng = np.random.default_rng(5)
    at = np.arange(12)[:, None]
    course = (at >= 4) * [0.5, -0.4, 0.3] + (at >= 5) * [0.8, 0.2, -0.9] + (at >= 9) * [0.1, -0.7, 0.9]
    series = drawn(size * course * ARCSEC, rng)
    L, right = joint_information(series)
    theta = np.linalg.solve(L, right)
    S = np.linalg.inv(L) + density * np.kron(np.minimum.outer(MONTHS, MONTHS), np.eye(3))

    def plain(*rows):
        """chi2 beside steps before these rows, coefficients of mean and steps, and their covariance."""
        A = np.kron(np.hstack([np.ones((12, 1)), at >= np.array(rows)]), np.eye(3))
        covariance = np.linalg.inv(A.T @ np.linalg.solve(S, A))
        best = covariance @ A.T @ np.linalg.solve(S, theta)
        rest = theta - A @ best
        return rest @ np.linalg.solve(S, rest), best[-3:], covariance[-3:, -3:]

    steps, told = (4, 5, 9), 0
    monkeypatch.setattr(mounting_course, "MOST_GAPS", most_gaps)
    settings = CourseSettings(confidence=0.8)
    found = dated_steps(series, CourseModel(steps=steps, density=density), (), settings)
    for one, low, high in zip(found, (1, 5, 6), (5, 9, 12), strict=True):
        others = [row for row in steps if row != one.row]
        rows = np.arange(low, high)
        if len(rows) > most_gaps:  # of the last step: those up to two results from it
            rows = rows[rows >= 7]
        fits = [plain(*others, row) for row in rows]
        chi_square = np.array([fit[0] for fit in fits])
        volume = [np.linalg.slogdet(fit[2])[1] for fit in fits]  # of the step's size
        weight = np.diff(MONTHS)[rows - 1] * np.exp(0.5 * (volume - chi_square + chi_square.min()))
        passed = np.cumsum(weight) / weight.sum()
        ends = np.interp([0.1, 0.9], np.append(0.0, passed), MONTHS[np.append(rows[0] - 1, rows)])
        here = rows.tolist().index(one.row)
        _, change, covariance = fits[here]
        # parts of the result: rounding of information of 1e13 beside that of the distortion
        assert_allclose(one.interval_s, ends, rtol=1e-4)
        assert_allclose(one.probability, weight[here] / weight.sum(), rtol=1e-4)
        assert_allclose(
            one.p_value, min(1.0, 11 * chi2(3).sf(plain(*others)[0] - chi_square[here])), rtol=1e-4
        )
        assert_allclose(one.theta, change, atol=1e-5 * ARCSEC)
        assert_allclose(one.covariance, covariance, atol=1e-6 * ARCSEC**2)
        assert not one.is_exchange
        told += 0.2 < one.probability < 0.9
    assert told or size > 1.0  # a date that is not certain
    known = dated_steps(series, CourseModel(steps=steps, density=density), (5,), settings)[1]
    assert known.is_exchange and known.interval_s == tuple(MONTHS[4:6])
    assert (known.probability, known.p_value) == (1.0, 0.0)


@pytest.mark.parametrize("row", [1, 27, 39])
def test_the_best_step_of_a_long_series_is_found_by_gaps_about_the_best_of_a_few(row, monkeypatch):
    course = np.where(np.arange(40)[:, None] >= row, [9.0, -4.0, 6.0], 0.0) * ARCSEC
    series = drawn(course, np.random.default_rng(6), 30.0 * DAY_S * np.arange(40) ** 1.1)
    of_all = CourseModel().best_step(series)
    assert of_all[0] == row
    for most_gaps in (13, 4):  # every fourth gap, every tenth
        monkeypatch.setattr(mounting_course, "MOST_GAPS", most_gaps)
        assert CourseModel().best_step(series) == pytest.approx(of_all, rel=1e-9)  # rounding


@pytest.mark.parametrize(
    ("model", "fitted"),
    [
        (CourseModel(steps=(5,)), 0),  # an exchange: its date is known, and each course has it
        (CourseModel(steps=(2, 5)), 4),  # three angles and a date
        (CourseModel(steps=(5,), terms=("annual", "beta angle")), 9),
        (CourseModel(steps=(2, 5, 8), terms=("annual",), density=1e-19), 15),
    ],
)
def test_each_number_that_a_course_has_beside_its_mean_costs_a_logarithm_of_the_count(model, fitted):
    rng = np.random.default_rng(9)
    beta = rng.uniform(-1.0, 1.0, 12)
    series = drawn(rng.normal(size=(12, 3)) * ARCSEC, rng, beta=beta, exchanges=(5,))
    assert model.cost(series) - model.loss(series) == pytest.approx(fitted * np.log(12))  # Schwarz 1978


# --- Strips of one camera with one distortion

SETTINGS = CalibrationSettings(robust=False)  # the same targets in months and in all
N_MONTHS, STRIPS = 6, 4
PLAN = replace(TABLE_1, strips=N_MONTHS * STRIPS)


def series_of_pairs(pairs, prior):
    """The series of results a month apart."""
    K, nan = len(pairs.F), np.full(len(pairs.F), np.nan)
    return MountingSeries(
        names=tuple(pairs.names.tolist()),
        t_s=30.0 * DAY_S * np.arange(K),
        F=pairs.F[:, :3, :3],
        F_shared=pairs.F[:, :3, 3:],
        right=pairs.F_theta[:, :3],
        shared_F=pairs.F[:, 3:, 3:].sum(axis=0) + prior,
        shared_right=pairs.F_theta[:, 3:].sum(axis=0),
        cos_sin=np.column_stack([nan, nan]),
        beta_rad=nan,
        temperature_c=nan,
    )


def series_of(months):
    """A calibration each month, then the series of what they say."""
    found, none = [calibrate_strips(strips, BOLD, SETTINGS) for strips in months], np.zeros((0, 0))
    parts = [one.pairs.as_one(f"m{k}", (), none) for k, one in enumerate(found)]
    pairs = reduce(InformationPairs.merged, parts)
    return series_of_pairs(pairs, prior_information(pairs.shared)), pairs.R_cs_ref


def series_taken_as_independent(months):
    """The same from each month's own matrix and covariance."""
    found = [calibrate_strips(strips, BOLD, SETTINGS) for strips in months]
    F = np.linalg.inv(np.array([one.cov_theta for one in found]))
    right = np.einsum("kij,kj->ki", F, [one.theta for one in found])
    pairs = InformationPairs(np.array([f"m{k}" for k in range(N_MONTHS)]), F, right, BOLD)
    return series_of_pairs(pairs, np.zeros((0, 0)))


@pytest.fixture(scope="module")
def strips():
    return draw_strips(PLAN, CameraPair(BOLD), np.random.default_rng(31))[0]


def in_months(strips):
    return [strips[STRIPS * k : STRIPS * (k + 1)] for k in range(N_MONTHS)]


def test_months_merge_to_the_calibration_of_all_their_strips(strips):
    whole = calibrate_strips(strips, BOLD, SETTINGS)
    series, R_ref = series_of(in_months(strips))
    merged = against_rest(series).rest
    R_cs = deviation_from_theta(merged.coefficients[0]) * R_ref
    # Months are linearised about matrices of their own, some arcseconds away: second order, 4e-5 of sigma and
    # 3e-4 of the covariance here.
    assert np.all(np.abs(theta_between(R_cs, whole.R_cs)) < 1e-3 * whole.sigma_theta)
    assert_allclose(merged.covariance, whole.cov_theta, rtol=0, atol=2e-3 * np.diag(whole.cov_theta).min())


def remounted(strips, R_before, R_after):
    """Strips as seen by a star camera with the mounting `R_after` instead of `R_before`."""
    turn = R_after.inv() * R_before
    T = turn.as_matrix()

    def seen(exposure):
        return replace(exposure, u_s=turn.apply(exposure.u_s), cov_s=T @ exposure.cov_s @ T.T)

    return [replace(strip, exposures=tuple(map(seen, strip.exposures))) for strip in strips]


def test_what_is_shared_hides_no_step(strips):
    # 14" about Z, where each month's own 1 sigma is 4", most of it shared by all: 6 sigma of what is not.
    after = deviation_from_theta(np.array([0.0, 0.0, 14.0]) * ARCSEC) * BOLD
    months = in_months(strips)
    moved = months[:3] + [remounted(month, BOLD, after) for month in months[3:]]
    assert not against_rest(series_of(months)[0]).moved(0.01)
    found = against_rest(series_of(moved)[0])
    assert found.moved(0.01) and found.step.row == 3
    sigma = np.sqrt(np.diag(found.step.covariance))
    assert np.all(np.abs(found.step.theta - [0.0, 0.0, 14.0 * ARCSEC]) < 4.0 * sigma)
    alone = against_rest(series_taken_as_independent(moved))
    assert found.step.p_value < 0.01 * alone.step.p_value


def test_the_merged_matrix_is_the_same_in_any_order():
    rng = np.random.default_rng(10)
    series = drawn(rng.normal(size=(4, 3)) * ARCSEC, rng, MONTHS[:4])
    expected = fit_columns(series, np.ones((4, 1))).coefficients[0]
    for order in itertools.permutations(range(4)):
        at = list(order)
        parts = {name: getattr(series, name)[at] for name in ("F", "F_shared", "right")}
        # sums in another order: rounding of doubles, 1e-12 of a theta
        found = fit_columns(replace(series, **parts), np.ones((4, 1))).coefficients[0]
        assert_allclose(found, expected, rtol=1e-9)
