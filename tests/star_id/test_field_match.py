"""Detections matched with predicted stars by probability, and what false detections do to a fitted lens."""

import numpy as np
import pytest
from foreign_lenses import SIZE, ForeignLens
from frames import PLACES, WIDE, direction, listed_stars
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.field import FieldSolution, solve_list
from boresight.star_id.field_fit import fit_attitude_and_lens
from boresight.star_id.field_match import match_field
from boresight.star_id.lens_misfit import _largest
from boresight.star_id.settings import StarSettings


def test_a_star_is_matched_as_far_as_its_prediction_is_uncertain():
    rng = np.random.default_rng(3)
    predicted = rng.uniform(0, 2048, (200, 2))
    for sigma in (0.2, 3.0):
        seen = predicted + sigma * rng.normal(size=predicted.shape)
        clutter = rng.uniform(0, 2048, (200, 2))
        xy, each = np.vstack([seen, clutter]), np.array([1e-4 * np.eye(2)])
        found = match_field(
            xy, each.repeat(400, axis=0), predicted, (sigma**2 * np.eye(2))[None].repeat(200, 0), 2048.0**2
        )
        right = found.detections == found.stars
        # a false detection within 4 sigma of an own place comes up 200 * 200 * 16 pi sigma^2 / 2048^2 times
        assert right.sum() >= 196 - 20 * (sigma > 1)
        assert (~right).sum() <= 0.5 * 200 * 200 * 16 * np.pi * sigma**2 / 2048**2 + 1


def test_a_star_that_is_not_seen_is_not_matched_with_clutter():
    rng = np.random.default_rng(5)
    clutter, stars = rng.uniform(0, 2048, (400, 2)), rng.uniform(0, 2048, (300, 2))
    small = np.array([0.04 * np.eye(2)])
    found = match_field(clutter, small.repeat(400, 0), stars, small.repeat(300, 0), 2048.0**2)
    assert len(found.stars) <= 2


def test_false_detections_bend_neither_lens_nor_its_stated_error(wide_index):
    """120 stars and 300 faint false ones in 50 deg: the field's error was nine times the stated one."""
    squares, rng = [], np.random.default_rng(11)
    for _ in range(12):
        R_si = Rotation.random(random_state=rng)
        stars = listed_stars(WIDE, R_si, PLACES, rng, brightest=2000.0)
        stars = stars.take(np.arange(min(120, len(stars.xy_px))))
        found = solve_list(_with_false(stars, 300, rng), (2048, 2048), wide_index, StarSettings())
        assert isinstance(found, FieldSolution), found
        axes, true = found.R_si.inv().as_matrix() @ found.camera.middle_axes(), WIDE.middle_axes()
        off = Rotation.from_matrix(axes.T @ R_si.inv().as_matrix() @ true).as_rotvec()
        axes = found.camera.middle_axes()
        sigma = np.sqrt(np.diag(axes.T @ found.cov_s @ axes))
        field = (found.fov_x_rad - WIDE.fov_x_rad) / found.fov_x_sigma_rad
        squares.append([*(off / sigma) ** 2, field**2])
    mean = np.mean(squares, axis=0)
    assert mean[:2].mean() < 2.0  # chi-square of 24 degrees of freedom: 2.0 is exceeded once in 500
    assert mean[2] < 2.7 and mean[3] < 2.7  # of 12: 2.7 is exceeded once in 1000


@pytest.mark.parametrize("seed", [28, 49])
def test_of_two_nominal_fields_of_view_that_name_stars_the_likelier_is_taken(seed, wide_index):
    # at the edge of the larger one a third of the stars were named, some wrongly, and another lens was fitted
    rng = np.random.default_rng(seed)
    R_si = Rotation.random(random_state=rng)
    stars = listed_stars(WIDE, R_si, PLACES, rng, brightest=2000.0)
    stars = _with_false(stars.take(np.arange(120)), 300, rng)
    found = solve_list(stars, (2048, 2048), wide_index, StarSettings())
    assert found.matches > 100
    assert abs(found.fov_x_rad - WIDE.fov_x_rad) < 4.0 * found.fov_x_sigma_rad < np.radians(0.05)


def _with_false(stars, count, rng):
    """The list with faint false detections among the fainter stars."""
    rows = rng.integers(len(stars.xy_px) // 2, len(stars.xy_px), count)
    false = stars.take(rows)
    false.xy_px[:] = rng.uniform(0, 2047, (count, 2))
    both = np.append(stars.flux_dn, false.flux_dn)
    order = np.argsort(-both, kind="stable")
    everything = stars.take(np.append(np.arange(len(stars.xy_px)), rows))
    everything.xy_px[len(stars.xy_px) :] = false.xy_px
    return everything.take(order)


def test_a_lens_beyond_the_model_states_an_error_that_holds():
    """The lens images radius f theta, but for the paper's polynomial: 100 ppm of the field are left over."""
    rng, ratios = np.random.default_rng(2), []
    for _ in range(6):
        R_si = Rotation.random(random_state=rng)
        u_i = direction(PLACES.ra_rad, PLACES.dec_rad)
        u_s = R_si.apply(u_i)
        theta = np.arccos(np.clip(u_s[:, 2], -1, 1))
        focal_px = 1700.0
        xy = 1023.5 - focal_px * (theta / np.sin(theta))[:, None] * u_s[:, :2]
        inside = np.flatnonzero((u_s[:, 2] > 0.5) & ((xy > 0) & (xy < 2047)).all(axis=1))[:200]
        cov = np.full((len(inside), 1, 1), 0.05**2) * np.eye(2)
        start = StarCamera(
            focal_m=focal_px * 5e-6,
            pixel_m=5e-6,
            width_px=2048,
            height_px=2048,
            principal_px=(1023.5, 1023.5),
        )
        measured = xy[inside] + 0.05 * rng.normal(size=(len(inside), 2))
        fit = fit_attitude_and_lens(start, R_si, measured, cov, u_i[inside])
        ratios.append((fit.field.camera.fov_x_rad - 2048 / focal_px) / fit.field.fov_x_sigma_rad)
    assert np.mean(np.square(ratios)) < 3.7  # of 6 degrees of freedom: exceeded once in 1000


def test_the_evidence_of_a_misfit_is_followed_along_a_ridge():
    # the sizes of common error and distortion are correlated: along the axes nothing is better
    def ridge(p):
        return -40.0 * (p[0] - p[1]) ** 2 - 2.0 * (p[0] + p[1] - 3.0) ** 2

    place, value = _largest(ridge, np.array([0.0, 0.0]), np.array([-np.inf, -np.inf]))
    assert np.abs(place - 1.5).max() < 0.15 and value > -0.3
    place, _ = _largest(ridge, np.array([3.0, 0.0]), np.array([2.0, -np.inf]))  # not below 2
    np.testing.assert_allclose(place, [2.0, 164.0 / 84.0], atol=1e-3)  # where it ends a search


@pytest.mark.parametrize(
    ("fov_deg", "projection", "seed"),
    # of 60 deg, stars that an equidistant lens names first: it left up to 0.3 px and a field 5 sigma off
    [(60, "tangent", 2), (60, "tangent", 4), (75, "equidistant", 0)],
)
def test_wide_and_fisheye_lenses_of_known_field_are_fitted_to_the_end(wide_index, fov_deg, projection, seed):
    radius = np.tan if projection == "tangent" else lambda angle: angle
    lens, rng = ForeignLens(fov_deg, radius), np.random.default_rng([seed, fov_deg])
    stars = listed_stars(lens, Rotation.random(random_state=rng), PLACES, rng)
    found = solve_list(stars, SIZE, wide_index, StarSettings(), fov_x_rad=np.radians(fov_deg))
    assert isinstance(found, FieldSolution) and found.camera.projection == projection
    assert found.matches > 0.9 * len(stars.xy_px)  # a quarter, where the lens was still changing
    error_px = np.hypot(*lens.error_px(found.camera, stars.xy_px).T)
    assert error_px.max() < 0.05  # 0.015 to 0.03 px at the corners, by the stars' own errors
    assert abs(found.fov_x_rad - lens.fov_x_rad) < 4.0 * found.fov_x_sigma_rad < np.radians(0.001)
