"""The mounting's course over months: steps found with their date, no alarm at rest, honest densities.

Vectors only: estimates are drawn from their own covariances. The mounting is far from the identity, and the
covariances are lopsided and turned, so that a wrong frame or sign shows.
"""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from boresight.calib.information import InformationPairs
from boresight.features.drift.matrix_drift import DriftSettings, MountingSeries, estimate_drift
from boresight.features.drift.random_walk import WalkProblem
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between

R_CS = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
DAY_S = 86400.0
MONTHS = np.array([0, 29, 62, 88, 121, 155, 180, 214, 240, 273, 300, 336.0]) * DAY_S


def covariances(K, rng):
    """Axes of 0.1", 0.15" and 1" (1 sigma), give or take half, turned anew for each."""
    sigma = np.array([0.1, 0.15, 1.0]) * ARCSEC * rng.uniform(0.5, 1.5, (K, 1))
    Q = Rotation.random(K, random_state=rng).as_matrix()
    return np.einsum("kij,kj,klj->kil", Q, sigma**2, Q)


def drawn(course, t_s, rng, *, cos_sin=None, C=None):
    """A series whose truth is `course` (K, 3) rad about R_CS."""
    C = covariances(len(t_s), rng) if C is None else C
    noise = np.einsum("kij,kj->ki", np.linalg.cholesky(C), rng.normal(size=(len(t_s), 3)))
    names = [f"d{k:02d}" for k in range(len(t_s))]
    return independent(names, t_s, course + noise, C, cos_sin)


def independent(names, t_s, theta, C, cos_sin=None):
    """Calibrations that share nothing: theta (K, 3) rad about R_CS with covariances C (K, 3, 3)."""
    F = np.linalg.inv(np.asarray(C))
    pairs = InformationPairs(np.array(names, dtype=str), F, np.einsum("kij,kj->ki", F, theta), R_CS)
    return MountingSeries.of(pairs, np.zeros((0, 0)), t_s, cos_sin)


def test_alarms_at_rest_come_no_more_often_than_is_asked_for():
    rng = np.random.default_rng(1)
    settings = DriftSettings(density_rad2_s=0.0, probability_false_alarm=0.05)
    alarms = 0
    p_values = []
    for _ in range(400):
        drift = estimate_drift(drawn(np.zeros((12, 3)), MONTHS, rng), settings)
        alarms += drift.moved
        p_values.append(drift.constant.p_value)
    # The bound of 5 % is never passed in 400 runs but by chance: 99.9 % of the binomial.
    assert alarms <= binom(400, 0.05).ppf(0.999)
    # And the chi2 behind it is one: p-values are uniform (their mean 0.5, 1 sigma 0.0144).
    assert np.mean(p_values) == pytest.approx(0.5, abs=0.05)


def test_a_constant_mounting_gives_no_alarm_in_95_of_100_runs():
    rng = np.random.default_rng(2)
    settings = DriftSettings(density_rad2_s=0.0)
    alarms = sum(estimate_drift(drawn(np.zeros((6, 3)), MONTHS[:6], rng), settings).moved for _ in range(100))
    assert alarms <= 5


def test_a_step_of_one_arcsec_is_found_with_its_date():
    # 1" along x, where a calibration of any orientation has some weight: the step stands at 5 to 20 sigma.
    rng, settings = np.random.default_rng(3), DriftSettings(density_rad2_s=0.0)
    found = dated = covered = 0
    runs = 100
    for _ in range(runs):
        t_step = rng.uniform(MONTHS[3], MONTHS[8])
        course = np.where(MONTHS[:, None] > t_step, [ARCSEC, 0.0, 0.0], 0.0)
        drift = estimate_drift(drawn(course, MONTHS, rng), settings)
        found += drift.moved
        low, high = drift.step.interval_s
        dated += bool(abs(drift.step.t_s - t_step) <= 31 * DAY_S)
        covered += bool(low <= t_step <= high)
    assert found == runs
    assert dated >= 0.9 * runs  # the right gap, or its neighbour's edge
    assert covered >= binom(runs, 0.95).ppf(0.001)


def test_the_step_itself_and_its_covariance_are_honest():
    rng, settings = np.random.default_rng(4), DriftSettings(density_rad2_s=0.0)
    step = np.array([2.0, -5.0, 7.0]) * ARCSEC  # large, so that no draw misses its gap
    nees, runs = 0.0, 150
    for _ in range(runs):
        drift = estimate_drift(drawn(np.where(np.arange(12)[:, None] > 4, step, 0.0), MONTHS, rng), settings)
        assert (drift.step.after, drift.step.before) == ("d04", "d05")
        error = drift.step.theta_step - step
        nees += error @ np.linalg.solve(drift.step.covariance, error)
    low, high = chi2(3 * runs).ppf([0.0005, 0.9995])
    assert low < nees < high


def test_the_density_of_a_random_walk_is_recovered_within_its_interval():
    # 0.2" per root day, 40 calibrations at uneven times.
    rng, density = np.random.default_rng(5), (0.2 * ARCSEC) ** 2 / DAY_S
    inside, ratios, nees, runs = 0, [], 0.0, 30
    for _ in range(runs):
        t = np.cumsum(rng.uniform(5.0, 25.0, 40)) * DAY_S
        steps = rng.normal(size=(39, 3)) * np.sqrt(density * np.diff(t))[:, None]
        course = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        drift = estimate_drift(drawn(course, t, rng), DriftSettings())
        low, high = drift.walk.density_interval
        inside += low <= density <= high
        ratios.append(np.log(drift.walk.density_rad2_s / density))
        error = theta_between(
            deviation_from_theta(drift.walk.theta) * drift.series.R_cs_ref,
            deviation_from_theta(course) * R_CS,
        )[20]
        nees += error @ np.linalg.solve(drift.walk.covariance[20], error)
        assert drift.moved
    assert inside >= binom(runs, 0.95).ppf(0.001)
    # 1 sigma of one log density is about 0.2, of the mean of 30 about 0.04.
    assert np.mean(ratios) == pytest.approx(0.0, abs=0.15)
    low, high = chi2(3 * runs).ppf([0.0005, 0.9995])
    assert low < nees < high


def test_the_smoother_is_the_dense_gaussian_posterior():
    # Against conditioning of the joint Gaussian of all levels, phase term with it; first level and
    # coefficients get a wide prior (1e4 times the data), which is worth 1e-6 of the result.
    rng, density = np.random.default_rng(6), (0.1 * ARCSEC) ** 2 / DAY_S
    u = rng.uniform(0.0, 2.0 * np.pi, 12)
    cos_sin = np.column_stack([np.cos(u), np.sin(u)])
    series = drawn(rng.normal(size=(12, 3)) * ARCSEC, MONTHS, rng, cos_sin=cos_sin)
    drift = estimate_drift(series, DriftSettings(density_rad2_s=density, orbit_phase=True))
    wide = (1e4 * ARCSEC) ** 2
    walk = np.kron(density * np.minimum.outer(MONTHS, MONTHS) + wide, np.eye(3))
    phase = np.kron(wide * cos_sin @ cos_sin.T, np.eye(3))
    total = walk + phase
    for k in range(12):
        total[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += series.covariance[k]
    gain = np.linalg.solve(total, walk).T
    theta = drift.series.theta.ravel()
    assert_allclose(drift.walk.theta.ravel(), gain @ theta, atol=1e-4 * ARCSEC)
    dense = walk - gain @ walk
    for k in range(12):
        block = dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        assert_allclose(drift.walk.covariance[k], block, atol=1e-4 * ARCSEC**2)


def test_a_walk_of_density_nothing_is_the_merged_matrix():
    series = drawn(np.zeros((12, 3)), MONTHS, np.random.default_rng(7))
    drift = estimate_drift(series, DriftSettings(density_rad2_s=0.0))
    assert_allclose(drift.walk.theta, 0.0, atol=1e-6 * ARCSEC)  # the series is about the merged matrix
    assert_allclose(drift.walk.covariance[5], drift.merged.covariance, rtol=1e-9)
    near = estimate_drift(series, DriftSettings(density_rad2_s=1e-8 * ARCSEC**2 / DAY_S))
    assert_allclose(near.walk.theta, 0.0, atol=1e-3 * ARCSEC)


def test_an_orbit_term_is_recovered_and_is_no_drift():
    rng = np.random.default_rng(8)
    a, b = np.array([1.0, 0.3, -0.5]) * ARCSEC, np.array([-0.4, 0.8, 0.6]) * ARCSEC
    nees, alarms, unmodelled, runs = 0.0, 0, 0, 100
    for _ in range(runs):
        u = rng.uniform(0.0, 2.0 * np.pi, 12)
        cos_sin = np.column_stack([np.cos(u), np.sin(u)])
        series = drawn(cos_sin @ np.vstack([a, b]), MONTHS, rng, cos_sin=cos_sin)
        drift = estimate_drift(series, DriftSettings(density_rad2_s=0.0, orbit_phase=True))
        error = np.concatenate([drift.orbit_phase.cosine - a, drift.orbit_phase.sine - b])
        nees += error @ np.linalg.solve(drift.orbit_phase.covariance, error)
        alarms += drift.moved
        unmodelled += estimate_drift(series, DriftSettings(density_rad2_s=0.0)).moved
    low, high = chi2(6 * runs).ppf([0.0005, 0.9995])
    assert low < nees < high
    assert alarms <= binom(runs, 0.05).ppf(0.999)
    assert unmodelled == runs  # left out, the same term looks like a moving mounting


def test_an_orbit_term_stays_honest_beside_a_step():
    # No term is there, but a step of 5". Of 60 p-values 3 should lie below 5 %, binomial: beside a constant
    # the term would try to follow the step, and nearly all would.
    rng, small = np.random.default_rng(12), 0
    for _ in range(60):
        u = rng.uniform(0.0, 2.0 * np.pi, 12)
        cos_sin = np.column_stack([np.cos(u), np.sin(u)])
        course = np.where(np.arange(12)[:, None] > 6, [5 * ARCSEC, 0.0, 0.0], 0.0)
        drift = estimate_drift(drawn(course, MONTHS, rng, cos_sin=cos_sin), DriftSettings(orbit_phase=True))
        small += drift.orbit_phase.p_value < 0.05
    assert small <= binom(60, 0.05).ppf(0.999)


def test_merging_gives_the_same_bits_in_any_order():
    rng = np.random.default_rng(9)
    series = drawn(rng.normal(size=(4, 3)) * ARCSEC, MONTHS[:4], rng)
    theta, C = series.theta, series.covariance
    expected = independent(series.names, series.t_s, theta, C).merged()
    for order in itertools.permutations(range(4)):
        at = list(order)
        other = independent([series.names[k] for k in at], series.t_s[at], theta[at], C[at]).merged()
        assert other.R_cs.as_quat().tobytes() == expected.R_cs.as_quat().tobytes()
        assert other.covariance.tobytes() == expected.covariance.tobytes()


def test_the_merged_matrix_and_its_covariance_are_honest():
    rng, nees, runs = np.random.default_rng(10), 0.0, 200
    for _ in range(runs):
        merged = drawn(np.zeros((5, 3)), MONTHS[:5], rng).merged()
        error = theta_between(merged.R_cs, R_CS)
        nees += error @ np.linalg.solve(merged.covariance, error)
    low, high = chi2(3 * runs).ppf([0.0005, 0.9995])
    assert low < nees < high


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"names": ["a", "a", "c"]}, "'a' is given twice"),
        ({"t_s": np.array([0.0, 5.0, 5.0])}, "have the same time"),
        ({"t_s": np.array([0.0, 5.0, np.nan])}, "needs a time"),
        ({"theta": np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.03]])}, "not one mounting"),
        ({"C": np.tile(np.diag([1.0, 1.0, -1.0]), (3, 1, 1))}, "not positive definite"),
        ({"names": [], "t_s": np.zeros(0), "theta": np.zeros((0, 3)), "C": np.zeros((0, 3, 3))}, "0 calib"),
        ({"t_s": np.zeros(2)}, "need t_s"),
    ],
)
def test_what_is_not_a_series_is_refused(change, says):
    given = {
        "names": ["a", "b", "c"],
        "t_s": np.arange(3.0),
        "theta": np.zeros((3, 3)),
        "C": np.tile(ARCSEC**2 * np.eye(3), (3, 1, 1)),
    } | change
    with pytest.raises(ValueError, match=says):
        independent(**given)


def test_an_orbit_term_that_nothing_tells_is_refused():
    rng = np.random.default_rng(11)
    with pytest.raises(ValueError, match="12 calibrations is not known, first 'd00'"):
        estimate_drift(drawn(np.zeros((12, 3)), MONTHS, rng), DriftSettings(orbit_phase=True))
    alike = np.tile([0.6, 0.8], (12, 1))
    with pytest.raises(ValueError, match="do not tell an orbit term"):
        estimate_drift(drawn(np.zeros((12, 3)), MONTHS, rng, cos_sin=alike), DriftSettings(orbit_phase=True))


@pytest.mark.parametrize(
    "wrong", [{"probability_false_alarm": 0.0}, {"confidence": 1.0}, {"density_rad2_s": -1.0}]
)
def test_settings_that_mean_nothing_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        DriftSettings(**wrong)


def test_the_likelihood_of_a_density_is_that_of_the_plain_normal_distribution():
    rng = np.random.default_rng(31)
    t = np.array([0.0, 3.0, 4.0, 9.0, 11.0, 17.0])
    C = covariances(6, rng) / ARCSEC**2
    theta, regressors = rng.normal(size=(6, 3)), rng.normal(size=(6, 2))
    problem = WalkProblem.of(theta, block_diag(*np.linalg.inv(C)), t, regressors)

    def plain(density):
        """Steps of a walk, levels and coefficients integrated out: residuals of a linear model."""
        S = block_diag(*C) + density * np.kron(np.minimum(t[:, None], t), np.eye(3))
        X = np.kron(np.column_stack([np.ones(6), regressors]), np.eye(3))
        inverse = np.linalg.inv(S)
        normal = X.T @ inverse @ X
        rest = theta.ravel() - X @ np.linalg.solve(normal, X.T @ inverse @ theta.ravel())
        return rest @ inverse @ rest + np.linalg.slogdet(S)[1] + np.linalg.slogdet(normal)[1]

    density = (0.003, 0.04, 0.3, 2.0)
    found, expected = ([f(one) for one in density] for f in (problem.loss, plain))
    # the constant that loss leaves out includes that of the density's own determinant
    assert_allclose(np.diff(found), np.diff(expected), rtol=1e-6, atol=1e-8)


def test_two_phases_of_the_orbit_tell_no_orbit_term():
    phase = np.radians([10.0, 100.0, 10.0, 100.0, 10.0, 100.0])
    two = np.column_stack([np.cos(phase), np.sin(phase)])
    rng = np.random.default_rng(32)
    settings = DriftSettings(density_rad2_s=0.0, orbit_phase=True)
    with pytest.raises(ValueError, match="so much alike"):
        estimate_drift(drawn(np.zeros((6, 3)), MONTHS[:6], rng, cos_sin=two), settings)
