"""The correction in the operator's parameters: truth recovered with a bold mounting, and its covariance."""

import numpy as np
import pytest
from drawn_campaigns import assert_chi_square, squared
from scipy.spatial.transform import Rotation

from boresight.features.exports.operator_parameters import fit_correction

R_CS0 = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
ANGLES = np.array([[3.0e-4, -2.0e-4, 5.0e-4], [4.0e-6, 1.0e-6, -2.0e-6]])  # rad, rad/s
SCALE = -3.0e-4
T0 = 12.0


def sightings(rng, n=200, sigma=0.0, R_cs0=R_CS0):
    """Looks over a swath of 20 degrees with some depth along track, and what the star side knows."""
    u_c = np.column_stack([rng.uniform(-0.02, 0.02, n), rng.uniform(-0.18, 0.18, n), np.ones(n)])
    u_c /= np.linalg.norm(u_c, axis=1, keepdims=True)
    t = T0 + rng.uniform(-13.0, 13.0, n)
    a, b, c = (ANGLES[0] + (t - T0)[:, None] * ANGLES[1]).T
    # Q = R_y(b) R_x(a) R_z(c), written out as elementary rotations
    zero = np.zeros(n)
    Q = (
        Rotation.from_rotvec(np.column_stack([zero, b, zero]))
        * Rotation.from_rotvec(np.column_stack([a, zero, zero]))
        * Rotation.from_rotvec(np.column_stack([zero, zero, c]))
    )
    v_s = Q.inv().apply(R_cs0.inv().apply(u_c) * [1.0, 1.0, 1.0 + SCALE])
    v_s += sigma * rng.normal(size=v_s.shape)
    return v_s / np.linalg.norm(v_s, axis=1, keepdims=True), u_c, t


def test_angles_rates_and_scale_are_recovered():
    v_s, u_c, t = sightings(np.random.default_rng(4))
    found = fit_correction(v_s, u_c, t, R_CS0, T0)
    assert found.angles_rad == pytest.approx(ANGLES, abs=1e-12)
    assert found.scale == pytest.approx(SCALE, abs=1e-12)
    assert np.abs(found.residuals_rad).max() < 1e-13


def test_a_constant_correction_is_the_corrected_matrix():
    rng = np.random.default_rng(5)
    _, u_c, t = sightings(rng)
    true = Rotation.from_rotvec([2e-4, -3e-4, 4e-4]) * R_CS0
    found = fit_correction(true.inv().apply(u_c), u_c, t, R_CS0, T0, degree=0, with_scale=False)
    assert (R_CS0 * found.rotations(np.array([T0])) * true.inv()).magnitude()[0] < 1e-13


def test_stated_covariance_matches_the_scatter():
    rng, nees = np.random.default_rng(6), 0.0
    truth = np.append(ANGLES.ravel(), SCALE)
    for _ in range(100):
        found = fit_correction(*sightings(rng, sigma=2e-6), R_CS0, T0)
        off = np.append(found.angles_rad.ravel(), found.scale) - truth
        nees += squared(off, found.covariance)
    assert_chi_square(nees, 7 * 100)  # the scale of the covariance has 393 degrees of freedom: 7 % in all


def test_points_that_do_not_determine_the_parameters_are_refused():
    v_s, u_c, t = sightings(np.random.default_rng(7))
    with pytest.raises(ValueError, match="points or more"):
        fit_correction(v_s[:3], u_c[:3], t[:3], R_CS0, T0)
    with pytest.raises(ValueError, match="do not determine"):
        fit_correction(v_s, u_c, np.full(len(t), T0), R_CS0, T0)
