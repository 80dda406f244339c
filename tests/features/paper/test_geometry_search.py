"""Closed-form covariance against that of the estimator, the outcome of the search, the law of Table 5."""

import numpy as np
import pytest
from scipy.integrate import dblquad

from boresight.features.paper.comparison import compare_geometry, noise_law
from boresight.features.paper.frames import calibrate_frames
from boresight.features.paper.geometry_search import (
    GeometrySearch,
    _per_direction,
    covariance_shapes,
    geometry_map,
    predicted_sigma,
    star_camera_rotation,
)
from boresight.geometry.constants import ARCSEC
from boresight.simulator.campaign import CameraPair, draw_frames


@pytest.mark.parametrize(("zenith", "azimuth", "roll"), [(15.0, 90.0, 0.0), (40.0, 20.0, 90.0)])
def test_closed_form_equals_the_estimator_s_covariance(zenith, azimuth, roll):
    cameras = CameraPair(star_camera_rotation(zenith, azimuth, roll))
    frames = draw_frames(200, 60, 40, 0.07, 0.5, cameras, np.random.default_rng(5))
    stated = np.sqrt(np.diag(calibrate_frames(frames, cameras.R_cs).solution.covariance)) / ARCSEC
    cells, numbers = [(0.07, 0.5)], np.array([200.0 * 60, 200.0 * 40])
    found = predicted_sigma(cameras.R_cs, covariance_shapes(cameras), cells, *numbers[:, None])[0]
    # a frame's 60 stars and 40 targets fill fields unevenly
    np.testing.assert_allclose(found, stated, rtol=0.03)


def test_information_of_a_direction_is_the_mean_over_the_field():
    half = np.array([0.16, 0.12])  # rad; the paper's star camera has half of 18.6 and 14 degrees

    def of_elements(i: int, j: int) -> float:
        def element(y: float, x: float) -> float:
            u = np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1.0)
            return float((i == j) - u[i] * u[j])

        return dblquad(element, -half[0], half[0], -half[1], half[1])[0] / (4.0 * half.prod())

    mean = [[of_elements(i, j) for j in range(3)] for i in range(3)]
    # Sums over 64 cells a side err by (1 / 64)² of a square's mean.
    np.testing.assert_allclose(np.linalg.inv(_per_direction(half)), mean, rtol=3e-4, atol=1e-9)


def test_axis_of_the_star_camera_points_where_the_angles_say():
    axis_c = star_camera_rotation(30.0, 0.0, 77.0).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(axis_c, [0.5, 0.0, -np.sqrt(0.75)], atol=1e-15)
    axis_c = star_camera_rotation(30.0, 90.0, 0.0).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(axis_c, [0.0, 0.5, -np.sqrt(0.75)], atol=1e-15)


def test_no_geometry_gives_both_the_figure_and_the_table():
    coarse = GeometrySearch(
        from_zenith_deg=np.arange(0.0, 91.0, 10.0),
        azimuth_deg=np.arange(0.0, 91.0, 10.0),
        roll_deg=np.zeros(1),
    )
    table = geometry_map(CameraPair(star_camera_rotation(0.0, 0.0, 0.0)), coarse)
    best = table.groupby("goal")["misfit"].min()
    assert best["figure7"] < 1.1 and best["table4"] < 1.1
    # All geometries give Table 4's Z 1.04 to 1.07 times Fig. 7's, the paper 5.35: so sqrt(5.35 / 1.07)
    assert best["both"] > 2.2
    text = "\n".join(compare_geometry(table))
    assert "both: no direction within 20 %" in text and "0.0159  0.0105  0.0927" in text


def test_noise_law_returns_what_was_put_in():
    sigma = np.linspace(0.05, 0.1, 6)
    assert noise_law(sigma, np.hypot(4.0, 34.0 * sigma)) == pytest.approx((4.0, 34.0), rel=1e-9)
