"""Attitudes of cameras that are not what they were given as: errors as stated, and reported."""

from dataclasses import replace

import numpy as np
import pytest
from frames import PLACES, SMALL_CAMERA, directions_of, listed_stars, stars_in_view
from plain_attitude import attitude_by_scatter
from scipy.spatial.transform import Rotation

from boresight.star_id.given_camera import fit_known_camera, focal_derivatives

SIZE = np.array([SMALL_CAMERA.width_px, SMALL_CAMERA.height_px])
MIDDLE = 0.5 * (SIZE - 1.0)
FRAMES = 60
# Mean of 60 squares (roll) and of 120 (direction) that are correct: 95 % lie within 0.66 to 1.39, and 0.76 to
# 1.27; the range asked for is wider than the latter.
LEAST, MOST = 0.66, 1.4


def shutter(px, angle):
    """Rows read one after another while the image moves by `px`, along `angle`, in all."""
    return lambda xy: xy + px * (xy[:, 1:] / (SIZE[1] - 1.0) - 0.5) * np.array([np.cos(angle), np.sin(angle)])


def scaled(by):
    return lambda xy: MIDDLE + (1.0 + by) * (xy - MIDDLE)


def cubic(px):
    """Another lens: displaced by `px` at the ends of the longer side, by the cube of the distance."""
    half = 0.5 * SIZE.max()
    return lambda xy: xy + px * (xy - MIDDLE) * ((xy - MIDDLE) ** 2).sum(axis=1)[:, None] / half**3


def rms_less_rotation(displace):
    """Rms displacement along one axis, px, over the detector, less that of a shift and a rotation."""
    x, y = (grid.ravel() for grid in np.meshgrid(*(np.linspace(0.0, size - 1.0, 40) for size in SIZE)))
    xy = np.column_stack([x, y])
    moved = displace(xy) - xy
    turned = np.column_stack([MIDDLE[1] - y, x - MIDDLE[0]])
    moved = moved - moved.mean(axis=0)
    moved -= turned * (moved * turned).sum() / (turned**2).sum()
    return np.sqrt((moved**2).mean())


def fits(displace, frames=FRAMES):
    """Squared normalised errors of direction (K, 2) and roll (K,), and the fits, of frames of `SMALL_CAMERA`
    whose stars are displaced."""
    squares, found = [], []
    for k in range(frames):
        rng = np.random.default_rng([11, k])
        R_si = Rotation.random(random_state=rng)
        rows, exact = stars_in_view(SMALL_CAMERA, R_si, PLACES)
        sigma = 10.0 ** rng.uniform(-2.0, -0.8, len(rows))
        xy = displace(rng.uniform(0.0, 2.0 * np.pi))(exact) + sigma[:, None] * rng.normal(size=exact.shape)
        u_i = directions_of(PLACES)[rows]
        fit = fit_known_camera(SMALL_CAMERA, xy, sigma[:, None, None] ** 2 * np.eye(2), u_i, R_si)
        axes = SMALL_CAMERA.middle_axes()
        error = axes.T @ (R_si * fit.R_si.inv()).as_rotvec()
        squares.append(error**2 / np.diag(axes.T @ fit.cov_s @ axes))
        found.append(fit)
    return np.array(squares), found


@pytest.mark.parametrize("px", [0.3, 1.0, 3.0])
def test_errors_are_as_stated_where_rows_were_read_one_after_another(px):
    """Before: 54 and 82 times the stated variance of roll for 1 and 3 px."""
    squares, found = fits(lambda angle: shutter(px, angle))
    assert LEAST < squares[:, :2].mean() < MOST
    assert LEAST < squares[:, 2].mean() < MOST
    sizes = [rms_less_rotation(shutter(px, angle)) for angle in (0.0, 0.5 * np.pi)]
    noise = 0.1 * px + 0.01  # stars do not cover the detector evenly
    for fit in found:
        assert min(sizes) - noise < fit.misfit_px < max(sizes) + noise


def test_half_of_a_shear_is_a_rotation_and_a_motion_along_columns_is_none():
    """A row read later is displaced sideways: the image turns by half of that."""
    sideways, along = (fits(lambda _, a=angle: shutter(3.0, a))[1] for angle in (0.0, 0.5 * np.pi))
    turn = 3.0 / (SIZE[1] - 1.0) / 2.0
    axis = SMALL_CAMERA.middle_axes()[:, 2]
    stated = [np.sqrt(axis @ fit.cov_s @ axis) for fit in sideways]
    np.testing.assert_allclose(np.median(stated), turn, rtol=0.1)
    assert np.median([np.sqrt(axis @ fit.cov_s @ axis) for fit in along]) < 0.2 * turn


def test_another_focal_length_displaces_no_attitude():
    """1e-4, as the Earth's velocity changes angles, is no misfit; 1e-3 is reported."""
    squares, found = fits(lambda _: scaled(1e-4))
    assert LEAST < squares[:, :2].mean() < MOST
    assert sum(fit.misfit_px > 0.0 for fit in found) <= 6  # 4 % ask for a stretch by chance
    squares, found = fits(lambda _: scaled(1e-3))
    assert LEAST < squares[:, :2].mean() < MOST
    np.testing.assert_allclose([fit.misfit_px for fit in found], rms_less_rotation(scaled(1e-3)), rtol=0.15)


def test_errors_are_as_stated_for_another_lens():
    """Half of the frames are displaced by 0.5 px, half by 2 px."""
    sizes = [0.5, 2.0] * 12
    displaced = iter(sizes)
    squares, found = fits(lambda _: cubic(next(displaced)), len(sizes))
    assert squares[:, :2].mean() < MOST and squares[:, 2].mean() < MOST
    assert all(fit.misfit_px > 0.1 * px for fit, px in zip(found, sizes))


def test_attitudes_of_the_camera_that_was_given_are_those_of_its_stars():
    rng = np.random.default_rng(5)
    R_si = Rotation.random(random_state=rng)
    stars = listed_stars(SMALL_CAMERA, R_si, PLACES, rng)
    rows, exact = stars_in_view(SMALL_CAMERA, R_si, PLACES)
    nearest = ((stars.xy_px[:, None] - exact) ** 2).sum(axis=2).argmin(axis=1)
    u_i = directions_of(PLACES)[rows[nearest]]
    fit = fit_known_camera(SMALL_CAMERA, stars.xy_px, stars.cov_px, u_i, R_si)
    J = SMALL_CAMERA.pixel_jacobian(stars.xy_px)
    plain = attitude_by_scatter(
        SMALL_CAMERA.directions_from_pixels(stars.xy_px), u_i, J @ stars.cov_px @ J.transpose(0, 2, 1), 1e-4
    )
    assert fit.misfit_px == 0.0
    # rad: a millionth of the error of the attitude
    assert (fit.R_si * plain.R_si.inv()).magnitude() < 1e-6 * np.sqrt(np.trace(plain.cov_s))


@pytest.mark.parametrize("projection", ["tangent", "equidistant", "stereographic"])
def test_pixels_move_with_the_focal_length_as_derived(projection):
    camera = replace(SMALL_CAMERA, focal_m=0.02, projection=projection, q1=3e-4, q2=-1e-6)
    xy = np.random.default_rng(3).uniform(0.0, SIZE - 1.0, (50, 2))
    u_s, step = camera.directions_from_pixels(xy), 1e-5
    more, less = (
        replace(camera, focal_m=0.02 * np.exp(h)).pixels_from_directions(u_s) for h in (step, -step)
    )
    found = focal_derivatives(camera, camera.pixel_slopes(xy), u_s)
    # px, of 600 at most: the slopes are differences; the factor of another projection is off by 5 px
    np.testing.assert_allclose(found, (more - less) / (2.0 * step), atol=0.01)


def test_the_covariance_of_few_stars_follows_their_scatter():
    ratios = []
    for k in range(20):
        rng = np.random.default_rng([23, k])
        R_si = Rotation.random(random_state=rng)
        rows, exact = stars_in_view(SMALL_CAMERA, R_si, PLACES)
        some = rng.permutation(len(rows))[:20]
        xy, u_i = exact[some] + 0.13 * rng.normal(size=(20, 2)), directions_of(PLACES)[rows[some]]
        cov = [
            fit_known_camera(SMALL_CAMERA, xy, np.tile(s**2 * np.eye(2), (20, 1, 1)), u_i, R_si).cov_s
            for s in (0.1, 0.13)
        ]
        ratios.append(np.trace(cov[0]) / np.trace(cov[1]))
    # chi2 of 37 degrees of freedom is 1.69 a degree where 0.1 px are stated: the covariance is then that
    # of 0.13 px, but for frames that scatter more than this; 0.59 as stated. A few frames seem to depart.
    assert 0.85 < np.median(ratios) < 1.01
