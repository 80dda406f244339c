"""Derivatives that the camera's fit uses, against differences of the camera model itself."""

from dataclasses import replace

import numpy as np
import pytest
from frames import PAPER_CAMERA
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_fit import (
    DRIFT,
    PARAMETERS,
    Q3,
    IdentifiedStars,
    detector_grid,
    fit_camera,
    pixel_derivatives,
    visible_derivatives,
)
from boresight.star_id.field import nominal_camera
from boresight.star_id.lens_misfit import LensEquations

# bolder than the paper's lens: every term of the distortion shows
CAMERA = replace(
    PAPER_CAMERA, principal_px=(2611.3, 1790.2), p1=9e-5, p2=-7e-5, q1=-6e-6, q2=-2.3e-8, focal_m=0.07
)

FISHEYE = replace(CAMERA, q1=3e-6, q3=2e-12, projection="equidistant")
STEREOGRAPHIC = replace(FISHEYE, projection="stereographic")


def perturbed(camera: StarCamera, name: str, step: float) -> StarCamera:
    """The camera with one of PARAMETERS, or Q3, changed by `step`."""
    if name in ("x0_px", "y0_px"):
        x0, y0 = camera.principal_px
        return replace(camera, principal_px=(x0 + step, y0) if name == "x0_px" else (x0, y0 + step))
    return replace(camera, **{name: getattr(camera, name) + step})


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, STEREOGRAPHIC])
def test_derivatives_are_those_of_the_camera(camera):
    xy = detector_grid(camera)
    u_s = camera.directions_from_pixels(xy)
    free = (*PARAMETERS, Q3)
    steps = dict(zip(free, (1e-6, 1e-2, 1e-2, 1e-7, 1e-7, 1e-9, 1e-11, 1e-14)))
    by_camera, turns = pixel_derivatives(camera, u_s, free)
    for k, (name, h) in enumerate(steps.items()):
        more, less = perturbed(camera, name, h), perturbed(camera, name, -h)
        difference = (more.pixels_from_directions(u_s) - less.pixels_from_directions(u_s)) / (2.0 * h)
        assert np.abs(by_camera[:, :, k] - difference).max() < 1e-6 * np.abs(difference).max()
    for k, axis in enumerate(np.eye(3)):
        turn = Rotation.from_rotvec(1e-6 * axis)
        forth, back = (camera.pixels_from_directions(R.apply(u_s)) for R in (turn, turn.inv()))
        difference = (forth - back) / 2e-6
        assert np.abs(turns[:, :, k] - difference).max() < 1e-6 * np.abs(difference).max()


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, STEREOGRAPHIC])
def test_a_parameter_turns_the_image_and_changes_its_width_as_its_slopes_say(camera):
    """Slopes of the equations about one image, against the directions of cameras that differ by a step."""
    xy = detector_grid(camera)
    u_i, none = camera.directions_from_pixels(xy), np.zeros(len(xy), dtype=np.int64)
    cov_px, R = np.broadcast_to(1e-2 * np.eye(2), (len(xy), 2, 2)), Rotation.identity(1)
    stars = IdentifiedStars(xy_px=xy, cov_px=cov_px, u_i=u_i, frame=none, t_s=np.zeros(1))
    equations = LensEquations.of(fit_camera(stars, camera, R), u_i, cov_px, {})
    assert equations.free == PARAMETERS
    for name, h, slope in zip(PARAMETERS, (1e-6, 1e-2, 1e-2, 1e-8, 1e-8, 1e-9, 1e-11), equations.slopes[3:]):
        more, less = (perturbed(equations.camera, name, step) for step in (h, -h))
        turn = Rotation.from_matrix(more.middle_axes() @ less.middle_axes().T).as_rotvec()
        difference = np.append(turn, more.fov_x_rad - less.fov_x_rad) / (2.0 * h)
        unit = (
            np.linalg.norm(pixel_derivatives(camera, u_i, (name,))[0], axis=(1, 2)).max()
            * camera.pixel_m
            / camera.focal_m
        )
        assert slope == approx(difference, rel=1e-4, abs=1e-5 * unit)


def test_the_variance_that_stars_share_is_not_less_where_few_determine_the_camera():
    """Ten unknowns of 14 stars take a third of the residuals: the mean of 100 estimates of 1 px^2 is known to
    4 %, and would be 0.6 by the residuals as they are."""
    rng, found, none = np.random.default_rng(12), [], np.zeros(14, dtype=np.int64)
    for _ in range(100):
        xy = rng.uniform([0, 0], [CAMERA.width_px - 1, CAMERA.height_px - 1], (14, 2))
        u_i, cov_px = CAMERA.directions_from_pixels(xy), np.broadcast_to(1e-4 * np.eye(2), (14, 2, 2))
        seen = xy + rng.normal(size=xy.shape)
        stars = IdentifiedStars(xy_px=seen, cov_px=cov_px, u_i=u_i, frame=none, t_s=np.zeros(1))
        fit = fit_camera(stars, CAMERA, Rotation.identity(1), common_px2=0.5)
        found.append(fit.common_px2)
    assert np.mean(found) == approx(1.0, abs=0.15)


def test_what_is_visible_of_a_number_is_less_than_any_turn_leaves():
    xy = detector_grid(CAMERA)
    visible = visible_derivatives(CAMERA, xy).reshape(-1, 7)
    turns = pixel_derivatives(CAMERA, CAMERA.directions_from_pixels(xy))[1].reshape(-1, 3)
    assert np.abs(turns.T @ visible).max() < 1e-8 * np.abs(turns).max() * np.abs(visible).max() * len(xy)


def test_a_drift_and_a_prior_do_what_they_say():
    """Two images half a year apart, no noise: the drift between them is found; a firm prior holds its
    number."""
    rng, half_year_s = np.random.default_rng(6), 1.58e7
    drift_per_s = 3e-12
    xy = rng.uniform([0, 0], [5119, 3839], (200, 2))
    frame, t_s = np.repeat([0, 1], 100), np.array([0.0, half_year_s])
    R = Rotation.random(2, random_state=rng)
    cameras = [replace(CAMERA, focal_m=CAMERA.focal_m * np.exp(drift_per_s * (t - t_s.mean()))) for t in t_s]
    u_s = np.vstack([camera.directions_from_pixels(xy[frame == k]) for k, camera in enumerate(cameras)])
    u_i = np.einsum("nji,nj->ni", R.as_matrix()[frame], u_s)
    stars = IdentifiedStars(xy, np.tile(1e-4 * np.eye(2), (200, 1, 1)), u_i, frame, t_s)
    start = replace(CAMERA, focal_m=1.0002 * CAMERA.focal_m, q2=0.0)
    found = fit_camera(stars, start, R, (*PARAMETERS, DRIFT))
    assert abs(found.focal_drift_per_s / drift_per_s - 1.0) < 1e-6
    assert abs(found.camera.focal_m / CAMERA.focal_m - 1.0) < 1e-10
    held = fit_camera(stars, start, R, (*PARAMETERS, DRIFT), {"q2": 1e-16})
    assert abs(held.camera.q2) < 1e-12 < abs(found.camera.q2)


def test_a_prior_as_strong_as_the_data_meets_them_halfway():
    rng = np.random.default_rng(7)
    xy = rng.uniform([0, 0], [5119, 3839], (200, 2))
    R = Rotation.random(1, random_state=rng)
    u_i = R[0].inv().apply(CAMERA.directions_from_pixels(xy))
    stars = IdentifiedStars(
        xy, np.tile(1e-2 * np.eye(2), (200, 1, 1)), u_i, np.zeros(200, dtype=np.int64), np.zeros(1)
    )
    start = replace(CAMERA, q1=1.01 * CAMERA.q1)
    by_data = fit_camera(stars, start, R, ("q1",))
    both = fit_camera(stars, start, R, ("q1",), {"q1": float(np.sqrt(by_data.covariance[0, 0]))})
    assert by_data.camera.q1 == approx(CAMERA.q1, rel=1e-9)
    # the model is not quite linear over 1 % of q1
    assert both.camera.q1 == approx(0.5 * (start.q1 + CAMERA.q1), rel=1e-5)


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, -1.0), (-0.6, 0.8)])
@pytest.mark.parametrize(("chi2", "kept"), [(14.5, True), (17.5, False)])
def test_a_star_is_an_outlier_where_half_its_squared_residual_exceeds_16_mean_variances(
    direction, chi2, kept
):
    """One star of 200 without noise is displaced; the fit follows it by its leverage, about 1 %."""
    rng = np.random.default_rng(9)
    xy = rng.uniform([0, 0], [5119, 3839], (200, 2))
    xy[17] = 3400.0, 1200.0
    R = Rotation.random(1, random_state=rng)
    u_i = R[0].inv().apply(CAMERA.directions_from_pixels(xy))
    var_x, var_y = 4e-2, 1e-2
    xy[17] += np.sqrt(2.0 * chi2 * 0.5 * (var_x + var_y)) * np.array(direction)
    covariances = np.tile(np.diag([var_x, var_y]), (200, 1, 1))
    stars = IdentifiedStars(xy, covariances, u_i, np.zeros(200, dtype=np.int64), np.zeros(1))
    found = fit_camera(stars, CAMERA, R, ("q1",))
    assert found.keep[17] == kept
    assert np.delete(found.keep, 17).all()


@pytest.mark.parametrize("seed", range(10))
def test_a_star_that_a_step_carries_behind_the_camera_spoils_no_fit(seed):
    """A fisheye images stars up to 90 degrees from its axis; 0.03 degrees less, the start has them beyond."""
    rng, lens = np.random.default_rng(seed), nominal_camera((2000, 1500), np.radians(172.0), "stereographic")
    azimuth, noise_px = rng.uniform(0.0, 2.0 * np.pi, 4), 0.05
    rim = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(4, np.radians(0.03))])
    u_s = rng.normal(size=(2000, 3))
    u_s = u_s[u_s[:, 2] > 0.0]
    u_s = np.vstack([u_s[lens.contains(lens.pixels_from_directions(u_s))][:216], rim])
    u_s /= np.linalg.norm(u_s, axis=1)[:, None]
    stars = IdentifiedStars(
        xy_px=lens.pixels_from_directions(u_s) + rng.normal(0.0, noise_px, (len(u_s), 2)),
        cov_px=np.tile(noise_px**2 * np.eye(2), (len(u_s), 1, 1)),
        u_i=u_s,
        frame=np.zeros(len(u_s), dtype=np.int64),
        t_s=np.zeros(1),
    )
    turned = Rotation.from_rotvec([[2e-3, -1e-3, 0.0]])
    fit = fit_camera(stars, replace(lens, focal_m=1.002 * lens.focal_m), turned, common_px2=0.5)
    assert fit.keep.mean() > 0.98 and fit.common_px2 < noise_px**2
    assert fit.camera.focal_m / lens.focal_m == approx(1.0, abs=2e-3)  # one image alone leaves 3e-4
