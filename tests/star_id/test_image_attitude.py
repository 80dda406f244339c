"""The attitude of one image beside the plain form of the same estimate."""

import numpy as np
import pytest
from frames import SMALL_CAMERA
from plain_attitude import attitude_by_scatter
from scipy.spatial.transform import Rotation

from boresight.star_id.image_attitude import fit_image_attitude, rotation_from_matrix

SIZE = np.array([SMALL_CAMERA.width_px, SMALL_CAMERA.height_px])
FALSE_ALARM = 1e-4
START_RAD = 2e-4  # error of the start: some pixels of `SMALL_CAMERA`


def measured(seed: int, outliers: float, scatter: float = 1.0):
    """Centroids (N, 2) with correlated errors, covariances, directions, GCRS, and the true attitude; a share
    of the stars is off by some pixels."""
    rng = np.random.default_rng([seed, 8])
    n = int(rng.integers(8, 150))
    xy, R_si = rng.uniform(0, SIZE - 1.0, (n, 2)), Rotation.random(random_state=rng)
    u_i = R_si.inv().apply(SMALL_CAMERA.directions_from_pixels(xy))
    L = np.exp(rng.normal(-3.0, 1.0, n))[:, None, None] * np.array([[1.0, 0.0], [0.3, 0.9]])
    xy = xy + scatter * (L @ rng.normal(size=(n, 2, 1)))[:, :, 0]
    far = rng.random(n) < outliers
    xy[far] += rng.normal(0.0, 1.5, (far.sum(), 2))
    return xy, L @ L.transpose(0, 2, 1), u_i, R_si


@pytest.mark.parametrize(("outliers", "scatter"), [(0.0, 1.0), (0.0, 3.0), (0.03, 1.0), (0.15, 2.0)])
def test_attitude_covariance_and_rejected_stars_are_those_of_the_plain_form(outliers, scatter):
    for seed in range(20):
        xy, cov, u_i, R_si = measured(seed, outliers, scatter)
        u_s, J = SMALL_CAMERA.directions_and_jacobian(xy)
        plain = attitude_by_scatter(u_s, u_i, J @ cov @ J.transpose(0, 2, 1), FALSE_ALARM)
        start = Rotation.from_rotvec(np.random.default_rng(seed).normal(0.0, START_RAD, 3)) * R_si
        found = fit_image_attitude(SMALL_CAMERA.pixel_slopes(xy), cov, u_i, start, FALSE_ALARM)
        assert np.array_equal(found.kept, plain.kept) and found.dof == plain.dof
        off = (found.R_si * plain.R_si.inv()).as_rotvec()
        # both iterate until a step is below 1e-9 of a radian; errors are 1e-6 of it and more
        assert off @ np.linalg.solve(plain.cov_s, off) < 1e-8
        np.testing.assert_allclose(found.cov_s, plain.cov_s, rtol=1e-6)
        np.testing.assert_allclose(found.chi2, plain.chi2, rtol=1e-6)


def test_residuals_are_the_measured_minus_the_predicted_pixels():
    xy, cov, u_i, R_si = measured(3, 0.0)
    found = fit_image_attitude(SMALL_CAMERA.pixel_slopes(xy), cov, u_i, R_si, FALSE_ALARM)
    predicted = SMALL_CAMERA.pixels_from_directions(found.R_si.apply(u_i))
    # px: the second order of a residual of a pixel over the focal length
    np.testing.assert_allclose(found.residual_px, xy - predicted, atol=1e-4)


def test_stars_at_one_place_fix_no_attitude():
    xy, cov, u_i, R_si = measured(4, 0.0)
    one = [0] * 6
    with pytest.raises(ValueError, match="6 directions, too few or too close together"):
        fit_image_attitude(SMALL_CAMERA.pixel_slopes(xy[one]), cov[one], u_i[one], R_si, FALSE_ALARM)


@pytest.mark.parametrize(("apart_px", "fixed"), [(1e-4, False), (300.0, True)])
def test_stars_that_are_too_close_for_the_roll_fix_no_attitude_however_well_they_are_measured(
    apart_px, fixed
):
    xy = np.array([400.0, 300.0]) + apart_px * np.array([[0.0, 0.0], [1.0, 0.3], [0.2, 0.9]])
    R_si = Rotation.from_rotvec([0.4, -1.1, 0.7])
    u_i = R_si.inv().apply(SMALL_CAMERA.directions_from_pixels(xy))
    cov = np.broadcast_to(1e-4 * np.eye(2), (3, 2, 2))
    if fixed:
        found = fit_image_attitude(SMALL_CAMERA.pixel_slopes(xy), cov, u_i, R_si, FALSE_ALARM)
        assert (found.R_si * R_si.inv()).magnitude() < 1e-9
    else:
        with pytest.raises(ValueError, match="too close together"):
            fit_image_attitude(SMALL_CAMERA.pixel_slopes(xy), cov, u_i, R_si, FALSE_ALARM)


@pytest.mark.parametrize("axis", range(4))
def test_a_rotation_of_a_matrix_is_that_of_scipy_whichever_component_is_the_largest(axis):
    quaternions = np.random.default_rng(axis).normal(size=(50, 4)) + 3.0 * np.eye(4)[axis]
    for R in [*Rotation.from_quat(quaternions), Rotation.from_quat(np.eye(4)[axis])]:
        M = R.as_matrix()
        assert rotation_from_matrix(M).as_matrix() == pytest.approx(M, abs=1e-14)  # rounding
        assert (rotation_from_matrix(M) * Rotation.from_matrix(M).inv()).magnitude() < 1e-14
