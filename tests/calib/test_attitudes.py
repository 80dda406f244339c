"""Attitudes of star exposures, gross errors included."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.attitudes import fit_attitudes
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
    fit = fit_attitudes(u_s, u_i, cov_s, start, robust=False)
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
