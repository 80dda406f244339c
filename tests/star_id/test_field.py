"""Where one image looks, each star weighed by its covariance: bound reached, stated error true."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord, position_angle
from frames import PAPER_CAMERA, as_seen, listed_stars
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import information_of_directions
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import (
    FieldSolution,
    _fields_to_try,
    _nominal_field,
    nominal_camera,
    ra_dec_roll,
    solve_list,
    solve_stars,
)
from boresight.star_id.field_fit import fit_attitude_and_lens
from boresight.star_id.observer import Observer
from boresight.star_id.settings import StarSettings

TRUTH = replace(PAPER_CAMERA, principal_px=(2571.3, 1893.2))  # the detector is not centred on the axis
SIZE, MIDDLE = (5120, 3840), [[2559.5, 1919.5]]
SETTINGS = StarSettings()
ARCSEC = np.pi / 648000.0
IMAGES = 24


@pytest.fixture(scope="module")
def images():
    rng, places = np.random.default_rng(21), hipparcos_stars(8.0).places
    attitudes = [Rotation.random(random_state=rng) for _ in range(IMAGES)]
    return [(R_si, listed_stars(TRUTH, R_si, places, rng)) for R_si in attitudes]


def within_three_in_ten_thousand(squares, each):
    """Whether the mean of chi-squared numbers, each of `each` degrees of freedom, is one a degree."""
    n = each * len(squares)
    low, high = chi2.ppf([1.5e-4, 1.0 - 1.5e-4], n) / n
    return low < np.sum(squares) / n < high


def test_the_attitude_of_a_calibrated_camera_reaches_its_bound(index, images):
    of_weighed, of_bare, stated = [], [], []
    for R_si, stars in images:
        weighed = solve_list(stars, SIZE, index, SETTINGS, camera=TRUTH)
        bare = solve_stars(stars.xy_px, SIZE, index, SETTINGS, camera=TRUTH)
        bound = np.linalg.inv(information(stars, weighed.detections))
        for found, squares in ((weighed, of_weighed), (bare, of_bare)):
            error = (found.R_si * R_si.inv()).as_rotvec()
            squares.append(error @ np.linalg.solve(bound, error))
        error = (weighed.R_si * R_si.inv()).as_rotvec()
        stated.append(error @ np.linalg.solve(weighed.cov_s, error))
        assert bare.cov_s is None and np.isnan(bare.pointing_sigma_rad)
    # of the bound of all named stars; the few with a companion are not weighed, hence 1.2 and not 1.1
    assert np.sqrt(np.mean(of_weighed) / 3.0) < 1.2
    assert np.sqrt(np.mean(of_bare) / 3.0) > 2.0  # what all stars alike would give
    assert within_three_in_ten_thousand(stated, 3)


def information(stars, rows):
    """(3, 3) Fisher information of the attitude by the stars, each row of the derivative -[u x]."""
    u, J = TRUTH.directions_from_pixels(stars.xy_px[rows]), TRUTH.pixel_jacobian(stars.xy_px[rows])
    W = information_of_directions(u, J @ stars.cov_px[rows] @ J.transpose(0, 2, 1))
    A = np.stack([-np.cross(u, axis) for axis in np.eye(3)], axis=2)  # d(rotation x u), rotation about each
    return (A.transpose(0, 2, 1) @ W @ A).sum(axis=0)


def test_an_unknown_lens_leaves_the_middle_and_the_width_of_the_image_as_sure_as_stated(index, images):
    """Nothing is known but the field of view to 5 %: principal point and decentring are as good as unknown,
    and yet the direction of the image's middle, its roll and the field's width are what the errors say."""
    pointing, roll, width, together = [], [], [], []
    true_width = angle_between_edges(TRUTH)
    for R_si, stars in images:
        found = solve_list(stars, SIZE, index, SETTINGS, fov_x_rad=1.05 * true_width)
        turn = Rotation.from_matrix(middle_axes(found.R_si, found.camera) @ middle_axes(R_si, TRUTH).T)
        right, down, along = turn.as_rotvec() @ middle_axes(R_si, TRUTH)
        in_s = R_si.apply(turn.as_rotvec())
        together.append(in_s @ np.linalg.solve(found.cov_s, in_s))
        pointing += [(right / found.pointing_sigma_rad) ** 2, (down / found.pointing_sigma_rad) ** 2]
        roll.append((along / found.roll_sigma_rad) ** 2)
        width.append(((found.fov_x_rad - true_width) / found.fov_x_sigma_rad) ** 2)
        assert found.pointing_sigma_rad < 0.5 * ARCSEC  # 0.03 px
    assert within_three_in_ten_thousand(pointing, 1)
    assert within_three_in_ten_thousand(roll, 1)
    assert within_three_in_ten_thousand(width, 1)
    assert within_three_in_ten_thousand(together, 3)


def test_a_lens_that_confirms_its_stars_is_fitted_once_and_is_that_fitted_from_the_brightest_on(
    index, images, monkeypatch
):
    stars, width, refused, fits = images[0][1], angle_between_edges(TRUTH), [], []

    def fit(camera, R_si, xy_px, *given):
        fits.append(len(xy_px))
        if fits == refused:  # the one fit to all stars
            raise np.linalg.LinAlgError
        return fit_attitude_and_lens(camera, R_si, xy_px, *given)

    monkeypatch.setattr("boresight.star_id.field.fit_attitude_and_lens", fit)
    once = solve_list(stars, SIZE, index, SETTINGS, fov_x_rad=1.03 * width)
    refused, fits[:] = fits.copy(), []
    again = solve_list(stars, SIZE, index, SETTINGS, fov_x_rad=1.03 * width)
    assert len(refused) == 1 and refused[0] > 50
    assert fits[0] == fits[-1] == refused[0] and fits[1] <= 12
    assert again.hip.tolist() == once.hip.tolist()
    # a thousandth of the errors of places and width, where steps of a fit end
    assert again.residual_px == pytest.approx(once.residual_px, abs=1e-4)
    assert again.fov_x_rad == pytest.approx(once.fov_x_rad, abs=1e-2 * once.fov_x_sigma_rad)
    assert again.fov_x_sigma_rad == pytest.approx(once.fov_x_sigma_rad, rel=1e-3)


def middle_axes(R_si, camera):
    """(3, 3) right, down and towards the image's middle in GCRS, in columns."""
    x, y = MIDDLE[0]
    middle, below = camera.directions_from_pixels([[x, y], [x, y + 0.5]])
    down = below - middle * (below @ middle)
    down /= np.linalg.norm(down)
    return R_si.inv().as_matrix() @ np.stack([np.cross(down, middle), down, middle], axis=1)


def angle_between_edges(camera):
    left, right = camera.directions_from_pixels([[-0.5, MIDDLE[0][1]], [5119.5, MIDDLE[0][1]]])
    return float(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right))


@pytest.mark.parametrize("count", [4, 5, 8, 12, 16, 25])
def test_few_stars_bear_few_numbers(index, images, count):
    """However few stars are named, the attitude has an error, and the middle is where it says."""
    true_width = angle_between_edges(TRUTH)
    squares, solved = [], 0
    for R_si, stars in images[:12]:
        bright = stars.take(np.arange(count))
        found = solve_list(bright, SIZE, index, SETTINGS, fov_x_rad=0.98 * true_width)
        if not isinstance(found, FieldSolution):
            continue
        solved += 1
        turn = Rotation.from_matrix(middle_axes(found.R_si, found.camera) @ middle_axes(R_si, TRUTH).T)
        squares.append(np.sum((turn.as_rotvec() @ middle_axes(R_si, TRUTH))[:2] ** 2))
        assert np.isfinite(found.cov_s).all() and (np.linalg.eigvalsh(found.cov_s) > 0.0).all()
        # of a lens that bends by 15 px in the corners, with so few stars that one parameter must do
        assert squares[-1] < (8.0 * found.pointing_sigma_rad) ** 2 + (30.0 * ARCSEC) ** 2
    assert solved >= (0 if count < 8 else 9)


def test_an_observer_has_aberration_removed(index):
    """Light comes from up to 20 arc-seconds off because the Earth moves, and 5 because the satellite does."""
    epoch = Epoch.from_utc("2026-03-20T00:00:00Z")
    observer = Observer(epoch, 4.2e6, np.array([6.9e6, 0.0, 0.0]), np.array([0.0, 1.0e3, 7.5e3]))
    rng, squares, ignored = np.random.default_rng(3), [], []
    sky = as_seen(hipparcos_stars(8.0).places, observer)
    for _ in range(10):
        R_si = Rotation.random(random_state=rng)
        stars = listed_stars(TRUTH, R_si, sky, rng)
        found = solve_list(stars, SIZE, index, SETTINGS, camera=TRUTH, observer=observer)
        without = solve_list(stars, SIZE, index, SETTINGS, camera=TRUTH)
        error = (found.R_si * R_si.inv()).as_rotvec()
        squares.append(error @ np.linalg.solve(found.cov_s, error))
        ignored.append((without.R_si * R_si.inv()).magnitude())
    assert within_three_in_ten_thousand(squares, 3)
    assert 5.0 * ARCSEC < np.max(ignored) < 30.0 * ARCSEC


@pytest.mark.parametrize(("fov_deg", "fewest"), [(6.0, 6), (14.0, 30), (45.0, 400)])
def test_the_error_stated_is_true_of_narrow_and_wide_lenses_alike(wide_index, fov_deg, fewest):
    """Lenses that displace a corner by 1 % and more, their axes 20 px off: from a dozen stars to hundreds."""
    focal_m = 0.5 * 2048 * 1e-5 / np.tan(0.5 * np.radians(fov_deg))
    f_mm, corner = 1e3 * focal_m, 1280e-5 / focal_m
    lens = {"q1": -0.01 / (corner * f_mm) ** 2, "q2": 0.003 / (corner * f_mm) ** 4}
    lens |= {"p1": 1e-3 / f_mm, "p2": -1.5e-3 / f_mm}
    camera = StarCamera(
        focal_m=focal_m, pixel_m=1e-5, width_px=2048, height_px=1536, principal_px=(1038.5, 755.5), **lens
    )
    places = hipparcos_stars(8.0).places
    rng, together, width, counts = np.random.default_rng(40), [], [], []
    true_width = camera.fov_x_rad
    for _ in range(20):
        R_si = Rotation.random(random_state=rng)
        stars = listed_stars(camera, R_si, places, rng, brightest=1000.0)
        found = solve_list(stars, (2048, 1536), wide_index, SETTINGS, fov_x_rad=0.97 * true_width)
        if not isinstance(found, FieldSolution):  # six stars are few
            continue
        turn = Rotation.from_matrix(
            (found.R_si.inv().as_matrix() @ found.camera.middle_axes())
            @ (R_si.inv().as_matrix() @ camera.middle_axes()).T
        )
        in_s = R_si.apply(turn.as_rotvec())
        together.append(in_s @ np.linalg.solve(found.cov_s, in_s))
        width.append(((found.fov_x_rad - true_width) / found.fov_x_sigma_rad) ** 2)
        counts.append(found.matches)
    assert len(counts) > 10 and min(counts) >= fewest
    # the prior of lens parameters makes errors smaller than stated where the lens is better than the prior
    assert np.mean(together) / 3.0 < chi2.ppf(1.0 - 1.5e-4, 3 * len(together)) / (3 * len(together))
    assert np.mean(width) < chi2.ppf(1.0 - 1.5e-4, len(width)) / len(width)
    assert np.mean(together) / 3.0 > 0.4 and np.mean(width) > 0.3


@pytest.mark.filterwarnings("ignore:.*distance overridden")
def test_roll_is_the_position_angle_of_up_as_astropy_has_it():
    R_si = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
    x, y = MIDDLE[0]
    towards = R_si.inv().apply(TRUTH.directions_from_pixels([[x, y], [x, y - 20.0]]))
    middle, above = (SkyCoord(*u, representation_type="cartesian") for u in towards)
    ra, dec, roll = ra_dec_roll(TRUTH, R_si)
    middle, above = middle.represent_as("unitspherical"), above.represent_as("unitspherical")
    angle = position_angle(middle.lon, middle.lat, above.lon, above.lat).rad
    # 1e-5 rad: the lens bends the line over 20 px
    assert np.angle(np.exp(1j * (roll - angle))) == pytest.approx(0.0, abs=1e-5)
    assert (ra, dec) == pytest.approx((middle.lon.rad, middle.lat.rad), abs=1e-12)


def test_errors_of_the_centre_are_about_its_own_axes(index, images):
    _, stars = images[0]
    beside = replace(TRUTH, principal_px=(-2000.0, 6000.0), p1=0.0, p2=0.0, q1=0.0, q2=0.0)
    found = solve_list(stars, SIZE, index, SETTINGS, camera=TRUTH)
    assert isinstance(found, FieldSolution)
    slanted = 1e-12 * np.array([[4.0, 1.0, -3.0], [1.0, 9.0, 5.0], [-3.0, 5.0, 16.0]])  # rad2
    solution = replace(found, camera=beside, cov_s=slanted)
    middle = beside.directions_from_pixels(MIDDLE)[0]
    along = middle @ slanted @ middle
    assert solution.roll_sigma_rad == pytest.approx(np.sqrt(along), rel=1e-9)
    across = 0.5 * (np.trace(slanted) - along)
    assert solution.pointing_sigma_rad == pytest.approx(np.sqrt(across), rel=1e-9)


def test_an_error_that_all_stars_share_is_estimated_from_their_residuals():
    """Five of sixty stars state 0.003 px, but refraction or the like displaces all by 0.5 px: the five must
    not determine the attitude."""
    rng, common_px, ratios, stated = np.random.default_rng(8), 0.5, [], []
    sigma_px = np.repeat([0.003, 0.1], [5, 55])
    cov = sigma_px[:, None, None] ** 2 * np.eye(2)
    for _ in range(6):
        xy = rng.uniform([100, 100], [5000, 3700], (60, 2))
        R_si = Rotation.random(random_state=rng)
        u_i = R_si.inv().apply(TRUTH.directions_from_pixels(xy))
        seen = xy + rng.normal(size=(60, 2)) * np.hypot(sigma_px, common_px)[:, None]
        found = fit_attitude_and_lens(TRUTH, R_si, seen, cov, u_i).field
        honest = fit_attitude_and_lens(TRUTH, R_si, seen, cov + common_px**2 * np.eye(2), u_i).field
        turn = Rotation.from_matrix(middle_axes(found.R_si, found.camera) @ middle_axes(R_si, TRUTH).T)
        in_s = R_si.apply(turn.as_rotvec())
        ratios.append(np.trace(found.cov_s) / np.trace(honest.cov_s))
        stated.append(in_s @ np.linalg.solve(found.cov_s, in_s))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.3)  # 120 residuals: the variance is known to 13 %
    assert np.mean(stated) / 3.0 < 2.2  # chi-square of 18 degrees of freedom, 99.9 %


def test_a_nominal_camera_looks_through_the_middle_of_its_image_and_is_less_sure_of_a_wide_one():
    for width, height, fov_deg in ((1001, 800, 10.0), (640, 480, 60.0)):
        camera = nominal_camera((width, height), np.radians(fov_deg))
        assert camera.principal_px == (0.5 * (width - 1), 0.5 * (height - 1))
        edge = camera.directions_from_pixels([[-0.5, 0.5 * (height - 1)], [width - 0.5, 0.5 * (height - 1)]])
        # the distortion-free model in double precision
        assert np.degrees(np.arccos(edge[0] @ edge[1])) == pytest.approx(fov_deg, abs=1e-9)
        field = _nominal_field(camera, 0.03, np.radians(fov_deg), StarSettings())
        share = {10.0: 0.3 + 0.25, 60.0: 1.0}[fov_deg]  # of the largest error, from 28 degrees on
        assert field.shape_error == pytest.approx(share * StarSettings().uncalibrated_error)
        assert field.scale_error == pytest.approx(0.05)


@pytest.mark.parametrize("given_deg", [None, 11.0, 43.0])
def test_fields_that_are_tried_cover_every_field_once(given_deg):
    settings = StarSettings(fov_tolerance=0.3)
    fields = _fields_to_try(None if given_deg is None else np.radians(given_deg), settings)
    low, high = (5.0, 60.0) if given_deg is None else (0.7 * given_deg, 1.3 * given_deg)
    nominal, error = np.array(fields).T
    smallest, largest = np.degrees(nominal / (1.0 + error)), np.degrees(nominal * (1.0 + error))
    assert high < largest[0] < 1.01 * high and smallest[-1] <= low  # both ends with some rounding
    assert np.allclose(largest[1:-1], smallest[:-2], rtol=1e-12)  # one begins where the one before ends
    assert len(fields) == 1 or smallest[-2] > low  # none is tried in vain
    # A field of 2 phi is wider than its tangents say by phi²/3: half of that, and 0.1 at most, is covered.
    assert np.all(error <= 0.1) and np.all(error[largest < 20.0] == 0.1)
