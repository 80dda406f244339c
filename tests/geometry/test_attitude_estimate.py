"""Attitudes of star exposures, gross errors included."""

import numpy as np
import pytest
from plain_attitude import plain_attitude
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.geometry.attitude_estimate import AttitudeSettings, fit_attitudes, wahba_matrices
from boresight.geometry.sightings import isotropic_covariance

SIGMA = 4e-6  # rad


def stars(counts, seed=0, wrong=0.0):
    rng = np.random.default_rng(seed)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    R_si = Rotation.random(len(counts), rng=rng)
    n = int(start[-1])
    field = np.column_stack([rng.uniform(-0.16, 0.16, n), rng.uniform(-0.12, 0.12, n), np.ones(n)])
    u_s = field / np.linalg.norm(field, axis=1, keepdims=True)
    group = np.repeat(np.arange(len(counts)), counts)
    u_i = R_si[group].inv().apply(u_s)
    bad = rng.random(n) < wrong
    u_i[bad] = R_si[group[bad]].inv().apply(u_s[bad] * [-1, 1, 1])  # another star, mirrored across the field
    bad &= np.abs(u_s[:, 0]) > 1e-4  # those in the middle have not moved
    noisy = u_s + SIGMA * rng.standard_normal((n, 3))
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    return noisy, u_i, isotropic_covariance(noisy, SIGMA), start, R_si, bad


def test_attitude_is_scipys():
    u_s, u_i, cov_s, start, _, _ = stars([12, 5, 30])
    fit = fit_attitudes(u_s, u_i, cov_s, start)
    for k in range(3):
        rows = slice(start[k], start[k + 1])
        theirs, _ = Rotation.align_vectors(u_s[rows], u_i[rows])
        turn = (Rotation.from_matrix(fit.R_si[k]) * theirs.inv()).magnitude()
        assert turn < 1e-9  # rad: same optimum but for the tangent plane's curvature at 4 µrad of noise


def test_stated_covariance_is_the_scatter_of_the_attitudes():
    counts = [20] * 400
    u_s, u_i, cov_s, start, R_si, _ = stars(counts, seed=3)
    fit = fit_attitudes(u_s, u_i, cov_s, start, AttitudeSettings(robust=False))
    psi = (R_si * Rotation.from_matrix(fit.R_si).inv()).as_rotvec()
    nees = np.einsum("ka,kab,kb->", psi, np.linalg.inv(fit.covariance_s), psi)
    low, high = chi2(df=3 * len(counts)).ppf([0.0005, 0.9995])
    assert low < nees < high
    low, high = chi2(df=int(fit.dof.sum())).ppf([0.0005, 0.9995])
    assert low < fit.chi2.sum() < high


@pytest.mark.parametrize("wrong", [0.1, 0.2, 0.3])
def test_wrong_identities_are_left_out_and_do_not_move_the_attitude(wrong):
    u_s, u_i, cov_s, start, R_si, bad = stars([40] * 50, seed=5, wrong=wrong)
    fit = fit_attitudes(u_s, u_i, cov_s, start)
    assert not np.any(fit.kept & bad)
    assert np.mean(fit.kept[~bad]) > 0.99  # 0.1 % false alarms are asked for
    psi = (R_si * Rotation.from_matrix(fit.R_si).inv()).as_rotvec()
    nees = np.einsum("ka,kab,kb->k", psi, np.linalg.inv(fit.covariance_s), psi)
    assert nees.mean() < 4.2  # expected 3; 99.9 % of means of 50 lie below 4.2


def test_an_exposure_whose_stars_do_not_fix_it_is_not_usable():
    u_s, u_i, cov_s, start, _, _ = stars([12, 2, 0, 8])
    u_s[start[3] :], u_i[start[3] :] = u_s[start[3]], u_i[start[3]]  # eight times the same star
    fit = fit_attitudes(u_s, u_i, cov_s, start)
    assert fit.usable.tolist() == [True, False, False, False]


def test_slanted_covariances_are_weighted_as_a_plain_least_squares_solver_does():
    """One exposure by scipy's general solver, three angles and residuals whitened in each star's tangent
    plane."""
    rng = np.random.default_rng(17)
    u_s, u_i, _, _, R_si, _ = stars([15], seed=17)
    T = np.linalg.svd(u_s[:, None, :])[2][:, 1:]  # (N, 2, 3) tangent axes
    L = SIGMA * np.tril(rng.uniform(-2.0, 2.0, (15, 2, 2))) + SIGMA * np.eye(2)
    cov_s = np.swapaxes(T, 1, 2) @ L @ np.swapaxes(L, 1, 2) @ T

    def residuals(psi):
        off = u_s - (Rotation.from_rotvec(psi) * R_si[0]).apply(u_i)
        return np.linalg.solve(L, T @ off[:, :, None]).ravel()

    theirs = least_squares(residuals, np.zeros(3), x_scale=SIGMA, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    cov = np.linalg.inv(theirs.jac.T @ theirs.jac)
    fit = plain_attitude(u_s, u_i, cov_s, AttitudeSettings(robust=False))
    apart = (fit.R_si * (Rotation.from_rotvec(theirs.x) * R_si[0]).inv()).as_rotvec()
    assert np.all(np.abs(apart) < 1e-3 * np.sqrt(np.diag(cov)))  # sigma: numerical derivatives of scipy
    np.testing.assert_allclose(fit.cov_s, cov, rtol=1e-3, atol=1e-3 * np.abs(np.diag(cov)).min())
    assert fit.chi2 == pytest.approx(2.0 * theirs.cost, rel=1e-6)


def test_good_stars_are_rejected_at_the_stated_rate():
    u_s, u_i, cov_s, start, _, _ = stars([25] * 800, seed=9)
    fit = fit_attitudes(u_s, u_i, cov_s, start, AttitudeSettings(probability_false_alarm=1e-2))
    rate = np.mean(~fit.kept)
    # 3 of 50 degrees of freedom go to the attitude: 0.0087 expected of 0.01; 5 sigma of 20000 draws is 0.0035
    assert rate == pytest.approx(0.0087, abs=0.0035)


def test_attitudes_taken_from_a_set_are_those_of_the_exposures():
    u_s, u_i, cov_s, start, _, _ = stars([12, 0, 5, 30], seed=2, wrong=0.1)
    fit = fit_attitudes(u_s, u_i, cov_s, start)
    some = fit.take(np.array([3, 1, 0]))
    assert np.diff(some.start).tolist() == [30, 0, 12]
    np.testing.assert_array_equal(some.kept[some.stars(0)], fit.kept[fit.stars(3)])
    np.testing.assert_array_equal(some.squared_mahalanobis[some.stars(2)], fit.squared_mahalanobis[:12])
    np.testing.assert_array_equal(some.R_si, fit.R_si[[3, 1, 0]])
    np.testing.assert_array_equal(some.dof, fit.dof[[3, 1, 0]])


def test_directions_too_close_together_fix_no_attitude():
    u_s, u_i, cov_s, _, _, _ = stars([4], seed=3)
    fit = fit_attitudes(u_s[[0, 0, 0]], u_i[[0, 0, 0]], cov_s[[0, 0, 0]], np.array([0, 3]))
    assert not fit.usable.any()


def test_the_rotation_of_a_wahba_problem_is_that_of_its_vectors():
    rng = np.random.default_rng(17)
    for n in (2, 3, 50):
        R, b = Rotation.random(random_state=rng), rng.normal(size=(n, 3))
        profile = (R.apply(b) + 1e-3 * rng.normal(size=(n, 3))).T @ b
        found = Rotation.from_matrix(wahba_matrices(profile[None])[0])
        assert (found * R.inv()).magnitude() < 0.02  # rad: errors of 1e-3 on few vectors
