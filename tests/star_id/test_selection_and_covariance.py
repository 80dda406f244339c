"""Which stars enter a fit and which error is stated, against independent calculations."""

from dataclasses import replace

import erfa
import numpy as np
import pytest
from frames import PAPER_CAMERA, Sensor, listed_stars, render, stars_in_view
from frames import SMALL_CAMERA as CAMERA
from scipy.spatial.transform import Rotation

from boresight.features.sky_images.score import cramer_rao_px
from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import StarSightings
from boresight.star_id.camera_fit import IdentifiedStars, fit_camera
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.finding.background import Background
from boresight.star_id.finding.centroid import Counts, fit_stars
from boresight.star_id.finding.psf import Psf
from boresight.star_id.given_camera import fit_known_camera
from boresight.star_id.identification.triangle_index import build_index, equivalent_fov, triangle_shapes
from boresight.star_id.observer import Observer, proper_motion_covariance
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import has_reliable_position, select_for_calibration, sight_stars, smear_of_rate

SETTINGS = StarSettings(gain_e_per_dn=40.0)
EPOCH, P_I, STILL = Epoch.from_utc("2026-03-01T00:00:00Z"), np.array([6.9e6, 0.0, 0.0]), np.zeros(3)
ALCOR, MIZAR = 65477, 65378  # 11.8 arc-minutes apart, V 4.0 and 2.2


@pytest.fixture(scope="module")
def index():
    fov = equivalent_fov(CAMERA.width_px, CAMERA.height_px, CAMERA.focal_m / CAMERA.pixel_m)
    places = hipparcos_stars(8.0).places
    return build_index(places, places.epoch_jyear, fov)


@pytest.mark.filterwarnings("ignore:.*distance overridden")
def test_directions_of_the_index_include_proper_motion():
    places = hipparcos_stars(4.0).places
    index = build_index(places, 2060.0, 0.3)
    stars, day = index.stars, 365.25 * (2060.0 - 2000.0) + 2451545.0
    no = np.zeros(len(stars.hip))
    then = 365.25 * (stars.epoch_jyear - 2000.0) + 2451545.0
    motion = (stars.pm_ra_rad_yr, stars.pm_dec_rad_yr)
    ra, dec, *_ = erfa.pmsafe(stars.ra_rad, stars.dec_rad, *motion, no, no, then, 0.0, day, 0.0)
    # ERFA is the authority; Arcturus moves 156 arc-seconds, 7.6e-4 rad. Without a parallax ERFA puts stars at
    # 10 Mpc, so that motion along the line of sight does not matter.
    assert np.abs(index.u_i - erfa.s2c(ra, dec)).max() < 1e-9
    assert np.abs(index.u_i - build_index(places, places.epoch_jyear, 0.3).u_i).max() > 5e-4


@pytest.fixture(scope="module")
def six_years_apart():
    places = hipparcos_stars(6.5).places
    return tuple(build_index(places, year, 0.3) for year in (2020.0, 2026.0))


@pytest.mark.parametrize("ra_deg", [0.0, 115.0, 230.0])
@pytest.mark.parametrize("dec_deg", [-70.0, 35.0])
def test_an_unknown_epoch_is_an_error_along_each_stars_motion(six_years_apart, ra_deg, dec_deg):
    """Against the places of the same stars six years later, small angles from the middle of the image."""
    now, later = six_years_apart
    (middle,) = erfa.s2c(np.radians([ra_deg]), np.radians(dec_deg))
    R_si = Rotation.align_vectors([[0.0, 0.0, 1.0]], middle[None])[0]
    narrow = replace(CAMERA, p1=0.0, p2=0.0, q1=0.0, q2=0.0)
    rows = np.flatnonzero(R_si.apply(now.u_i)[:, 2] > np.cos(0.05))
    before, after = (narrow.pixels_from_directions(R_si.apply(one.u_i[rows])) for one in (now, later))
    moved = after - before
    stated = proper_motion_covariance(now, rows, narrow, R_si, 6.0)
    assert len(rows) > 2
    expected = moved[:, :, None] * moved[:, None, :]
    assert np.abs(stated - expected).max() < 0.01 * np.abs(expected).max()  # px^2; 0.05 rad off the axis


def fields(n, error_px, rng):
    """Centroids, covariances and directions of n stars in the paper's camera, and its attitude."""
    xy = rng.uniform([100, 100], [5000, 3700], (n, 2))
    R_si = Rotation.random(random_state=rng)
    u_i = R_si.inv().apply(PAPER_CAMERA.directions_from_pixels(xy))
    return xy + error_px * rng.normal(size=(n, 2)), np.tile(0.05**2 * np.eye(2), (n, 1, 1)), u_i, R_si


def test_an_outlier_has_no_part_in_the_attitude_of_an_image():
    rng = np.random.default_rng(1)
    xy, cov, u_i, R_si = fields(40, 0.05, rng)
    without = fit_known_camera(PAPER_CAMERA, xy[1:], cov[1:], u_i[1:], R_si)
    xy[0] += [0.9, -0.4]  # 20 sigma, yet within the radius of a match
    found = fit_known_camera(PAPER_CAMERA, xy, cov, u_i, R_si)
    # rounding; kept, it moves the attitude by 3e-7 rad
    assert (found.R_si * without.R_si.inv()).magnitude() < 1e-12
    assert np.allclose(found.cov_s, without.cov_s, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize("error_px", [0.05, 0.2])
def test_errors_larger_than_stated_enlarge_the_covariance(error_px):
    rng = np.random.default_rng(2)
    xy, cov, u_i, R_si = fields(300, error_px, rng)
    known = fit_known_camera(PAPER_CAMERA, xy, cov, u_i, R_si)
    stars = IdentifiedStars(xy, cov, u_i, np.zeros(300, dtype=np.int64), np.zeros(1))
    plain = replace(PAPER_CAMERA, focal_m=1.0001 * PAPER_CAMERA.focal_m)
    fit = fit_camera(stars, plain, Rotation.concatenate([R_si]), ("focal_m", "q1"))
    honest = fit_camera(
        replace(stars, cov_px=cov * (error_px / 0.05) ** 2),
        plain,
        Rotation.concatenate([R_si]),
        ("focal_m", "q1"),
    )
    J = PAPER_CAMERA.pixel_jacobian(xy)
    u_s = R_si.apply(u_i)
    A = np.stack([np.cross(axis, u_s) for axis in np.eye(3)], axis=2)
    W = np.linalg.pinv(J @ cov @ J.transpose(0, 2, 1), rcond=1e-9)
    bound = np.linalg.inv((A.transpose(0, 2, 1) @ W @ A).sum(axis=0))
    # 600 coordinates: chi2 is known to 6 % (1 sigma)
    assert np.trace(known.cov_s) / np.trace(bound) == pytest.approx((error_px / 0.05) ** 2, rel=0.2)
    assert fit.variance_factor == pytest.approx((error_px / 0.05) ** 2, rel=0.2)
    assert np.allclose(fit.covariance, honest.covariance, rtol=0.2, atol=0.0)


def test_the_smear_of_a_rate_is_the_motion_of_a_star_near_the_axis():
    rate_s, exposure_s = np.array([2e-3, -7e-3, 3e-3]), 0.1  # rad/s, s
    axis = np.array([[0.0, 0.0, 1.0]])
    before, after = (
        CAMERA.pixels_from_directions(Rotation.from_rotvec(-sign * 0.5 * exposure_s * rate_s).apply(axis))[0]
        for sign in (-1.0, 1.0)
    )  # the camera turns by its rate, directions of stars in its axes by the opposite
    smear = np.array(smear_of_rate(CAMERA, rate_s, exposure_s))
    assert np.abs(smear).min() > 0.5  # px
    assert np.abs(smear - (after - before)).max() < 1e-3  # px: distortion over 3 px


def test_a_star_that_a_neighbour_displaces_is_not_reliable(index):
    rows = np.array([np.flatnonzero(index.stars.hip == ALCOR)[0]])
    arcsec_per_px = np.degrees(CAMERA.pixel_m / CAMERA.focal_m) * 3600.0
    ratio, d = 10.0 ** (0.4 * (index.stars.v_mag[rows[0]] - 2.23)), 708.5 / arcsec_per_px
    for sigma_px in (1.0, 2.7):
        # of two Gaussians d apart the fit of one is displaced by F2/F1 d exp(-d^2 / 4 s^2)
        shift = ratio * d * np.exp(-(d**2) / (4.0 * sigma_px**2))
        reliable = has_reliable_position(index, rows, CAMERA, sigma_px, SETTINGS)
        assert reliable[0] == (shift < SETTINGS.max_photocentre_shift_px)
        assert (sigma_px > 2.0) == (shift > 0.05)


def sky_image(R_si, rng, sensor, extra=None):
    """Rendered image of the catalogue, no star brighter than V 4, with an extra one (x, y, flux)."""
    places = hipparcos_stars(8.0).places
    rows, xy = stars_in_view(CAMERA, R_si, places)
    flux = sensor.flux_at_v7_dn * 10 ** (-0.4 * (np.maximum(places.v_mag[rows], 4.0) - 7.0))
    if extra is not None:
        xy, flux = np.vstack([xy, extra[:2]]), np.append(flux, extra[2])
    return render(xy, flux, CAMERA.width_px, CAMERA.height_px, sensor, rng), xy, places.hip[rows]


def sighted(index, image):
    found = sight_stars("1", image, CAMERA, index, Observer(EPOCH, 0.0, P_I, STILL), SETTINGS)
    assert isinstance(found, StarSightings), found
    return found


def test_a_blended_star_is_not_sighted(index):
    R_si, sensor = Rotation.random(random_state=np.random.default_rng(3)), Sensor(bits=16)
    alone, xy, hip = sky_image(R_si, np.random.default_rng(4), sensor)
    first = sighted(index, alone)
    star = first.hip[10]
    x, y = xy[np.flatnonzero(hip == star)[0]]
    for distance_px in (2.2, 5.0):  # seen as one, and as two
        image, _, _ = sky_image(R_si, np.random.default_rng(4), sensor, (x + distance_px, y, 300.0))
        assert star not in sighted(index, image).hip


def test_blended_stars_of_a_list_are_not_selected(index):
    places, rng = hipparcos_stars(8.0).places, np.random.default_rng(5)
    R_si = Rotation.random(random_state=rng)
    stars = listed_stars(CAMERA, R_si, places, rng)
    rows, xy = stars_in_view(CAMERA, R_si, places)
    nearest = np.linalg.norm(xy[None] - stars.xy_px[:, None], axis=2).argmin(axis=1)
    where = {hip: k for k, hip in enumerate(index.stars.hip.tolist())}
    named = np.array([where[hip] for hip in places.hip[rows[nearest]].tolist()])
    blended = np.arange(len(named)) % 3 == 0
    every, some = (
        select_for_calibration(
            replace(stars.centroids, blended=flags), np.arange(len(named)), named, CAMERA, index, SETTINGS
        )
        for flags in (np.zeros(len(named), dtype=bool), blended)
    )
    assert every.sum() > 20 and (some == every & ~blended).all() and (every & blended).any()


def test_the_covariance_is_larger_along_the_smear():
    rng, size, smear = np.random.default_rng(6), 600, (6.0, 0.0)
    x, y = np.meshgrid(np.arange(30, size - 30, 40), np.arange(30, size - 30, 40))
    xy = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.5, 0.5, (x.size, 2))
    image = render(xy, np.full(len(xy), 900.0), size, size, Sensor(smear_px=smear, bits=16), rng)
    pixels = np.rint(xy).astype(np.int64)
    sky = Background(np.full((3, 3), 20.0), np.full((3, 3), 2.0), size, size)
    psf = Psf(1.25, 1.25, smear, size, size)
    fits = fit_stars(image, pixels, xy - pixels, sky, psf, Counts(gain_e_per_dn=40.0, saturation_dn=np.inf))
    error, variance = fits.xy_px - xy, np.einsum("nii->ni", fits.cov_px)
    assert (variance[:, 0] > 1.5 * variance[:, 1]).all()  # 1.25 px and hypot(1.25, 6 / sqrt(12)) px wide
    # 196 stars: 10 % (1 sigma) on each axis
    assert (error**2 / variance).mean(axis=0) == pytest.approx(1.0, abs=0.4)


def test_directions_are_less_sure_along_the_smear(index):
    R_si = Rotation.random(random_state=np.random.default_rng(7))
    image, _, _ = sky_image(R_si, np.random.default_rng(8), Sensor(smear_px=(6.0, 0.0), bits=16))
    cov_s = sighted(index, image).cov_s
    assert (cov_s[:, 0, 0] > 1.4 * cov_s[:, 1, 1]).mean() > 0.9  # columns are opposite to x of s


def test_a_star_unlike_the_psf_has_a_larger_covariance():
    rng, size = np.random.default_rng(9), 200
    sky = Background(np.full((3, 3), 20.0), np.full((3, 3), 2.0), size, size)
    pixels, psf = np.array([[100, 100]]), Psf(1.25, 1.25, (0.0, 0.0), size, size)
    xy = np.array([[100.2, 99.9]])
    fits, counts = [], Counts(gain_e_per_dn=40.0, saturation_dn=np.inf)
    for halo in (0.0, 0.1):  # of the light in a halo twice as wide
        core = render(xy, np.array([(1 - halo) * 2e4]), size, size, Sensor(bits=16), rng).astype(float)
        wide = render(xy, np.array([halo * 2e4]), size, size, Sensor(2.5, 0.0, 1e9, 0.0, bits=16), rng)
        fits.append(fit_stars(core + wide, pixels, np.zeros((1, 2)), sky, psf, counts))
    gaussian, unlike = fits
    misfit = float(unlike.chi2[0] / unlike.dof[0])
    assert misfit > 5.0 and gaussian.chi2[0] < 1.5 * gaussian.dof[0]
    # the fitted flux, and with it the photon noise, differs by a tenth
    assert np.trace(unlike.cov_px[0]) / np.trace(gaussian.cov_px[0]) == pytest.approx(misfit, rel=0.3)


def test_a_lookup_gives_all_triangles_that_agree_and_no_other():
    """Looser tolerances or ignored handedness give no wrong identification, since `likelihood` decides, but
    cost time and, with a calibrated camera of whose triangles only the 16 largest are tried,
    identifications."""
    index = build_index(hipparcos_stars(4.5).places, 1991.25, 0.35)
    table, rng = index.tables[0], np.random.default_rng(10)
    some = rng.choice(len(table.vertices), 25, replace=False)
    u = index.u_i[table.vertices[some]].reshape(-1, 3)
    u = u + 3e-4 * rng.normal(size=u.shape)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    mirrored = u[:, [1, 0, 2]]
    for directions, least in ((u, 20), (mirrored, 0)):
        _, shapes = triangle_shapes(directions, np.arange(len(u)).reshape(-1, 3))
        tolerance = rng.uniform(2e-3, 2e-2, len(shapes))
        query, row = table.lookup(shapes, tolerance, 0.01)
        off = np.abs(table.ratios[None] - shapes[:, None, :2]).max(axis=2)
        longer = np.abs(table.longest[None] - shapes[:, None, 2]) / np.abs(shapes[:, None, 2])
        agree = (off < tolerance[:, None]) & (longer < tolerance[:, None] + 0.01)
        assert set(zip(query.tolist(), row.tolist())) == set(map(tuple, np.argwhere(agree).tolist()))
        assert agree[np.arange(len(some)), some].sum() >= least or least == 0
        sign = np.sign(np.linalg.det(index.u_i[table.vertices[row]]))
        assert (sign == np.sign(shapes[query, 2])).all()  # the same handedness, from the stars themselves


QUIET = Background(np.full((3, 3), 20.0), np.full((3, 3), 2.0), 200, 200)


@pytest.mark.parametrize("flux_dn", [1e5, 3e5])
def test_a_star_whose_core_is_saturated_is_measured_on_its_wings(flux_dn):
    """A circle of 7 and 8 px is saturated; part of the information is beyond the window of other stars."""
    rng, psf = np.random.default_rng(11), Psf(1.25, 1.25, (0.0, 0.0), 200, 200)
    xy = np.array([[100.3, 99.8]])
    image = render(xy, np.array([flux_dn]), 200, 200, Sensor(), rng)
    pixels, start = np.array([[100, 100]]), np.zeros((1, 2))
    fit = fit_stars(image, pixels, start, QUIET, psf, Counts(gain_e_per_dn=40.0, saturation_dn=235.0))
    bound = cramer_rao_px(xy, np.array([flux_dn]), np.full(1, 2.02), psf, 40.0, full_dn=215.0)
    error = fit.xy_px[0] - xy[0]
    assert fit.saturated[0] and fit.converged[0]
    assert error @ np.linalg.solve(fit.cov_px[0], error) < 18.4  # 1e-4 of two degrees of freedom
    # 2 %: the bound takes the weights of the true star; the window of other stars loses 5 to 8 %
    assert np.sqrt(0.5 * np.trace(fit.cov_px[0])) == pytest.approx(bound[0], rel=0.02)


def test_charge_at_the_ends_of_a_bloom_is_not_the_star():
    rng, psf = np.random.default_rng(12), Psf(1.25, 1.25, (0.0, 0.0), 200, 200)
    xy = np.array([[100.3, 99.8]])
    image = render(xy, np.array([2e4]), 200, 200, Sensor(), rng)
    image[93:107, 100] = 255  # charge that ran over along its column
    fits = []
    for left in (30, 190):  # DN in the pixels where the charge ends
        image[[92, 107], 100] = left
        arguments = image, np.array([[100, 100]]), np.zeros((1, 2)), QUIET, psf
        fits.append(fit_stars(*arguments, Counts(gain_e_per_dn=40.0, saturation_dn=235.0)))
    assert fits[0].saturated[0] and fits[0].converged[0]
    assert np.array_equal(fits[0].xy_px, fits[1].xy_px)


def test_coma_and_width_are_about_the_middle_between_the_outermost_pixels() -> None:
    psf = Psf(1.0, 1.6, (0.0, 0.0), 300, 200, coma_px=2.0)
    corners = np.array([[-0.5, -0.5], [299.5, -0.5], [-0.5, 199.5], [299.5, 199.5]])
    np.testing.assert_allclose(psf.sigma_at(corners), 1.6, rtol=1e-12)
    halfway, middle = [[74.5, 49.5]], [[149.5, 99.5]]  # the width grows with the square of the distance
    assert psf.sigma_at(np.array([*middle, *halfway])) == pytest.approx([1.0, 1.15], abs=1e-12)
    fans = psf.coma_at(corners)
    assert fans is not None
    outwards = np.array([[-3.0, -2.0], [3.0, -2.0], [-3.0, 2.0], [3.0, 2.0]]) / np.sqrt(13.0)
    np.testing.assert_allclose(fans, 2.0 * outwards, rtol=1e-12)


def test_the_width_of_the_psf_grows_with_the_square_of_the_distance_from_the_middle():
    psf = Psf(1.0, 1.5, (0.0, 0.0), 201, 101)
    middle, corner, halfway = [100.0, 50.0], [-0.5, -0.5], [49.75, 24.75]
    assert psf.sigma_at(np.array([middle, corner, halfway])) == pytest.approx([1.0, 1.5, 1.125], abs=1e-12)
