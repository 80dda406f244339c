"""The star camera against OpenCV's own projection, and the laws that its two ways must obey."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boresight.geometry.star_camera import SmoothDistortion, StarCamera

# Table 2 of the paper: f = 100 mm, 6.4 um, (p1, p2, q1, q2) for millimetres.
PINHOLE = StarCamera(
    focal_m=0.1, pixel_m=6.4e-6, width_px=5120, height_px=3840, principal_px=(2560.0, 1920.0)
)
PAPER = replace(PINHOLE, p1=2.29e-5, p2=-2.96e-5, q1=-9.30e-7, q2=-4.25e-9)
# Stronger distortion than any real lens's: 60 px in the corner, principal point far from the middle.
BOLD = StarCamera(
    focal_m=0.03,
    pixel_m=5e-6,
    width_px=2000,
    height_px=1400,
    principal_px=(777.3, 912.8),
    p1=-9e-5,
    p2=2.1e-4,
)
BOLD = replace(BOLD, q1=-2.5e-4, q2=3e-6)
SIXTH = replace(BOLD, q3=-3e-8)  # Brown to r^6
CAMERAS = [PAPER, BOLD, SIXTH]
# Kannala and Brandt's lens, 60 deg wide, and a detector that is not flat
FISHEYE = replace(BOLD, focal_m=0.009, p1=0.0, p2=0.0, q1=-6e-4, q2=2e-6, q3=-4e-8, projection="equidistant")
STEREOGRAPHIC = replace(FISHEYE, projection="stereographic")
WAVY = replace(
    BOLD,
    smooth=SmoothDistortion(
        degree=4, coefficients_px=np.random.default_rng(4).normal(size=(2, 12)), width_px=2000, height_px=1400
    ),
)


def detector_points(camera, number=20_000, seed=1):
    rng = np.random.default_rng(seed)
    columns, rows = (-0.5, camera.width_px - 0.5), (-0.5, camera.height_px - 0.5)
    corners = np.array([[x, y] for x in columns for y in rows])
    inside = rng.uniform(-0.5, [camera.width_px - 0.5, camera.height_px - 0.5], (number, 2))
    return np.vstack([corners, [camera.principal_px], inside])


@pytest.mark.parametrize("camera", CAMERAS)
def test_projection_agrees_with_opencv(camera):
    # 1e-6 px, as asked; measured: 2e-12 px.
    u_s = camera.directions_from_pixels(detector_points(camera))
    lens = camera.opencv_parameters()
    v_cv = u_s * [-1.0, -1.0, 1.0]
    opencv, _ = cv2.projectPoints(v_cv, np.zeros(3), np.zeros(3), lens.camera_matrix, lens.distortion)
    assert np.abs(camera.pixels_from_directions(u_s) - opencv[:, 0]).max() < 1e-6


@pytest.mark.parametrize("camera", CAMERAS)
def test_removal_of_distortion_agrees_with_opencv(camera):
    # OpenCV iterates; its limit is set to 1e-13. 1e-6 px, as asked.
    xy_px = detector_points(camera)
    lens = camera.opencv_parameters()
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    named = {"R": None, "P": None, "criteria": until}
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # one function from OpenCV 5 on
    ideal = undistort(xy_px.reshape(-1, 1, 2), lens.camera_matrix, lens.distortion, **named)[:, 0]
    u_s = camera.directions_from_pixels(xy_px)
    ours = -u_s[:, :2] / u_s[:, 2:]
    assert np.abs(ours - ideal).max() * camera.focal_m / camera.pixel_m < 1e-6


def test_a_fisheye_projects_as_opencv_does():
    # 1e-6 px; OpenCV's k1 to k4 multiply powers of the angle.
    u_s = FISHEYE.directions_from_pixels(detector_points(FISHEYE))
    f = FISHEYE.focal_m * 1e3
    K = replace(FISHEYE, projection="tangent").opencv_parameters().camera_matrix
    k = np.array([FISHEYE.q1 * f**2, FISHEYE.q2 * f**4, FISHEYE.q3 * f**6, 0.0])
    v_cv = (u_s * [-1.0, -1.0, 1.0])[:, None]
    opencv, _ = cv2.fisheye.projectPoints(v_cv, np.zeros(3), np.zeros(3), K, k)
    assert np.abs(FISHEYE.pixels_from_directions(u_s) - opencv[:, 0]).max() < 1e-6


def test_a_stereographic_lens_projects_from_the_opposite_point_of_the_sphere():
    """To 89 deg from the axis: Snyder 1987, eqs. 21-2 to 21-4, a sphere seen from its far end."""
    lens = replace(STEREOGRAPHIC, q1=0.0, q2=0.0, q3=0.0)
    angle, about = np.radians(np.linspace(0.5, 89.0, 60)), np.linspace(0.0, 9.0, 60)
    u_s = np.column_stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])
    k = 2.0 / (1.0 + u_s[:, 2])
    expected = lens.principal_px - lens.focal_m / lens.pixel_m * k[:, None] * u_s[:, :2]
    np.testing.assert_allclose(lens.pixels_from_directions(u_s), expected, atol=1e-9)  # px
    np.testing.assert_allclose(lens.directions_from_pixels(expected), u_s, atol=1e-12)  # rad
    assert np.isnan(lens.directions_from_pixels([[lens.principal_px[0] + 3601.0, 912.8]])).all()  # 90.02 deg


@pytest.mark.parametrize("camera", [*CAMERAS, FISHEYE, STEREOGRAPHIC, WAVY])
def test_pixels_come_back_from_their_directions(camera):
    # 1e-9 px over the whole detector, as asked.
    xy_px = detector_points(camera)
    there_and_back = camera.pixels_from_directions(camera.directions_from_pixels(xy_px))
    assert np.abs(there_and_back - xy_px).max() < 1e-9


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("error_px", [0.02, 0.5])
def test_quick_tangents_err_by_no_more_than_they_may(camera, error_px):
    xy_px = detector_points(camera)
    quick, exact = camera.tangents_from_pixels(xy_px, error_px=error_px), camera.tangents_from_pixels(xy_px)
    off_px = np.abs(quick - exact) * camera.focal_m / camera.pixel_m
    assert 1e-9 < off_px.max() < error_px  # quick indeed, and good enough


def test_the_lens_turns_the_image_round():
    # Equation (3): a star right of the centre in the image (larger column) has a negative x in frame s.
    u_s = PINHOLE.directions_from_pixels([[3060.0, 1920.0]])
    assert u_s[0, 0] == pytest.approx(-np.sin(np.arctan(500 * 6.4e-6 / 0.1)), abs=1e-15)
    assert u_s[0, 1] == pytest.approx(0.0, abs=1e-15) and u_s[0, 2] > 0.0


def test_the_corner_of_table_2_moves_by_a_few_pixels():
    # The only order and unit of Table 2's numbers in which it does (in the wrong ones: 0.05 px, or 85 mm).
    corner = np.array([[0.0, 0.0]])
    moved = PAPER.pixels_from_directions(PINHOLE.directions_from_pixels(corner)) - corner
    assert 3.0 < np.linalg.norm(moved) < 12.0


@pytest.mark.parametrize("camera", [*CAMERAS, FISHEYE, STEREOGRAPHIC, WAVY])
def test_jacobian_is_the_derivative(camera):
    # Central differences over 2e-3 px: error 1e-16 / 1e-3 of rounding against 2e-4 rad/px.
    xy_px = detector_points(camera, 200)
    J = camera.pixel_jacobian(xy_px)
    for axis in (0, 1):
        h = np.eye(2)[axis] * 1e-3
        ahead, behind = camera.directions_from_pixels(xy_px + h), camera.directions_from_pixels(xy_px - h)
        difference = (ahead - behind) / 2e-3
        assert np.abs(J[:, :, axis] - difference).max() < 1e-12
    u_s = camera.directions_from_pixels(xy_px)
    assert np.abs(np.einsum("ni,nij->nj", u_s, J)).max() < 1e-18  # nothing along u


def test_what_lies_behind_or_beyond_the_fold_is_no_image():
    # With Table 2 the polynomial turns back at r = 82 mm, 39 deg off the axis; at 50 deg it points into the
    # image.
    for angle in (30.0, 38.0, 45.0, 50.0, 89.0, 120.0):
        u_s = np.array([[np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))]])
        assert np.isfinite(PAPER.pixels_from_directions(u_s)).all() == (angle < 39.0)
    assert np.isnan(PAPER.directions_from_pixels([[1e5, 1e5]])).all()  # nothing is imaged there
    assert np.isnan(PAPER.directions_from_pixels([[np.nan, 5.0]])).all()
    mixed = PAPER.directions_from_pixels([[np.nan, 5.0], [100.0, 5.0]])
    assert np.isfinite(mixed[1]).all()
    assert PAPER.directions_from_pixels(np.zeros((0, 2))).shape == (0, 3)


def test_lenses_that_the_model_cannot_hold_are_refused():
    with pytest.raises(ValueError, match="focal_m"):
        replace(PINHOLE, focal_m=-0.1)
    with pytest.raises(ValueError, match=r"\(N, 2\)"):
        PAPER.directions_from_pixels(np.zeros(2))


def test_pixels_reach_half_a_pixel_beyond_their_centres():
    on = PAPER.contains([[-0.5, 0.0], [5119.5, 3839.5], [-0.51, 0.0], [5119.6, 0.0], [np.nan, 0.0]])
    assert on.tolist() == [True, True, False, False, False]


@settings(max_examples=50, deadline=None)
@given(
    x=st.floats(-0.5, 1999.5), y=st.floats(-0.5, 1399.5), p=st.floats(-1e-4, 1e-4), q=st.floats(-2e-4, 2e-4)
)
def test_any_moderate_lens_is_inverted(x, y, p, q):
    camera = replace(BOLD, principal_px=(1100.0, 650.0), p1=p, p2=-0.7 * p, q1=q, q2=0.0)
    back = camera.pixels_from_directions(camera.directions_from_pixels([[x, y]]))
    assert np.abs(back - [[x, y]]).max() < 1e-9  # px


@pytest.mark.parametrize("camera", [*CAMERAS, FISHEYE, STEREOGRAPHIC, WAVY])
def test_slopes_of_pixels_are_the_pseudo_inverse_of_the_jacobian_everywhere(camera):
    xy = np.random.default_rng(3).uniform(0, [camera.width_px - 1, camera.height_px - 1], (200, 2))
    found, expected = camera.pixel_slopes(xy), np.linalg.pinv(camera.pixel_jacobian(xy))
    # the fast form works from an ideal point known to some 1e-6 of its place
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("principal_px", [(0.3, 0.8), (0.3, 0.1), (1.7, 0.8), (1.7, 0.1)])
def test_the_radius_of_the_field_is_the_angle_to_the_outer_edge_of_the_corner_pixel(principal_px):
    tiny = StarCamera(focal_m=1e-3, pixel_m=1e-3, width_px=3, height_px=2, principal_px=principal_px)
    # f = 1 pixel; corners are (-0.5 or 2.5, -0.5 or 1.5): the farthest is another one each time
    far = [max(at + 0.5, size - 0.5 - at) for at, size in zip(principal_px, (3, 2))]
    assert tiny.field_radius_rad == pytest.approx(np.arctan(np.hypot(*far)), abs=1e-12)


def test_the_field_of_view_of_a_fisheye_with_edges_behind_the_camera_ends_89_degrees_from_its_axis():
    given = {"width_px": 401, "height_px": 101, "principal_px": (170.0, 50.0), "projection": "equidistant"}
    lens = StarCamera(focal_m=1e-3, pixel_m=1e-5, **given)
    # 100 px a radian: the left edge is 97.7 deg from the axis, the right one farther; 89 deg are 155.3 px
    assert lens.row_ends_px().tolist() == [[15.0, 50.0], [325.0, 50.0]]
    assert lens.fov_x_rad == pytest.approx(3.10, abs=1e-6)
    narrow = replace(lens, focal_m=2e-3)  # its edges are seen
    assert narrow.row_ends_px().tolist() == [[-0.5, 50.0], [400.5, 50.0]]
