"""Detection and centroids against rendered truth: rates, bounds, honest covariances, and what is not a
star."""

from dataclasses import replace

import numpy as np
import pytest
from frames import Sensor, render
from scipy.spatial import cKDTree
from scipy.special import ndtr
from scipy.stats import chi2, poisson

from boresight.features.sky_images.score import cramer_rao_px, score_centroids
from boresight.simulator.scenario import SkySettings
from boresight.simulator.sky import expose
from boresight.star_id.finding.background import estimate_background
from boresight.star_id.finding.candidates import find_candidates
from boresight.star_id.finding.detect import detection_threshold
from boresight.star_id.finding.psf import Psf
from boresight.star_id.finding.star_list import _subtract_dark, list_stars
from boresight.star_id.finding.star_shape import _width_over_field
from boresight.star_id.finding.windows import star_windows
from boresight.star_id.settings import StarSettings

TOLD_GAIN = StarSettings(gain_e_per_dn=40.0)


def grid_of_stars(rng, flux, *, size=1500, step=25, sensor=None):
    """An image full of equal stars at random pixel phases, far from one another."""
    x, y = np.meshgrid(np.arange(20, size - 20, step), np.arange(20, size - 20, step))
    xy = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.5, 0.5, (x.size, 2))
    image = render(xy, np.full(len(xy), flux), size, size, sensor or Sensor(), rng)
    return image, xy


@pytest.mark.parametrize(("level", "noise"), [(20.0, 2.0), (20.0, 0.8), (7.3, 4.0)])
def test_sky_level_and_noise_are_found_under_stars_and_hot_pixels(level, noise):
    rng = np.random.default_rng(1)
    sensor = Sensor(background_dn=level, read_noise_dn=noise, hot_pixels=500)
    image = render(rng.uniform(0, 1024, (300, 2)), rng.uniform(50, 5000, 300), 1024, 1024, sensor, rng)
    background = estimate_background(image)
    # a block's level rests on 4096 values or fewer; stars leave a trace of 1/50 sigma. Rounding adds 1/12
    # DN^2.
    assert background.level_dn == pytest.approx(level, abs=0.12 * noise)
    assert np.median(background.noise_dn) == pytest.approx(np.sqrt(noise**2 + 1 / 12), rel=0.03)


def test_a_sky_that_slopes_displaces_no_star():
    rng = np.random.default_rng(12)
    x, y = np.meshgrid(np.arange(25.0, 980.0, 45.0), np.arange(25.0, 980.0, 45.0))
    xy = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-14.0, 14.0, (x.size, 2))
    level = render(xy, np.full(len(xy), 600.0), 1000, 1000, Sensor(), rng)
    row, column = np.indices(level.shape)
    plane = 0.2 * column - 0.1 * row + 100.0 + rng.uniform(-0.5, 0.5, level.shape)
    flat, moved = (list_stars(one, TOLD_GAIN).xy_px for one in (level, np.round(level + plane)))
    apart, of_flat = cKDTree(flat).query(moved)
    both = apart < 0.1
    assert both.sum() > 0.95 * len(xy)
    # 0.023 and -0.011 px while the sky of a window was taken as level; 480 differences of 0.006 px by
    # rounding twice and by other widths of the PSF are known to 3e-4 px
    assert np.mean(moved[both] - flat[of_flat[both]], axis=0) == pytest.approx([0.0, 0.0], abs=1e-3)


def test_false_alarms_come_at_the_rate_that_was_asked_for():
    rng = np.random.default_rng(2)
    settings = StarSettings(false_alarms_per_frame=2.0, psf_sigma_px=1.25)
    sensor = Sensor(background_dn=30.0, read_noise_dn=3.0)
    empty = np.empty((0, 2)), np.empty(0)
    count = sum(len(list_stars(render(*empty, 1024, 1024, sensor, rng), settings).xy_px) for _ in range(30))
    # 60 are expected at most: peaks between pixel centres and those that fit no star fall away
    assert poisson(60).ppf(1e-4) * 0.25 < count < poisson(60).ppf(1 - 1e-4)


def test_the_threshold_follows_the_density_of_peaks():
    v = detection_threshold(5120 * 3840, 1.25, 0.5)
    density = v * np.exp(-0.5 * v * v) / (2 * 1.25**2 * (2 * np.pi) ** 1.5)
    assert density * 5120 * 3840 == pytest.approx(0.5, rel=1e-6)


def test_stars_of_snr_8_are_found_and_hot_pixels_are_not():
    rng = np.random.default_rng(3)
    image, xy = grid_of_stars(rng, 74.0, sensor=Sensor(hot_pixels=2000))  # SNR 8.1
    stars = list_stars(image, StarSettings(max_stars=9999))
    distance = cKDTree(stars.xy_px).query(xy)[0]
    near_hot = 2000 * 50 / 1500**2  # a hot pixel within 4 px of a star may hide it
    assert (distance < 2.0).mean() > 0.985 - near_hot
    assert (cKDTree(xy).query(stars.xy_px)[0] > 3.0).sum() <= 4  # of 2000 hot pixels and of the noise


SKIES = {
    "plain": Sensor(),
    "quiet": Sensor(read_noise_dn=0.8),
    "sloping": Sensor(background_dn=40.0, gradient_dn=30.0),
    "steep": Sensor(background_dn=110.0, gradient_dn=180.0),
    "quiet and steep": Sensor(background_dn=60.0, gradient_dn=80.0, read_noise_dn=0.8),
    "bright": Sensor(background_dn=170.0, read_noise_dn=3.0),
    "wide": Sensor(sigma_px=2.0),
    "wide and sloping": Sensor(sigma_px=2.3, background_dn=40.0, gradient_dn=30.0),
    "16 bit": Sensor(bits=16, background_dn=1000.0, read_noise_dn=25.0),
    "16 bit, whose grey levels need no stretch": Sensor(bits=16, background_dn=100.0, read_noise_dn=4.0),
    "16 bit and steep": Sensor(bits=16, background_dn=4000.0, gradient_dn=6000.0, read_noise_dn=25.0),
}


@pytest.mark.parametrize("sky", [*SKIES, "floating"])
def test_the_search_misses_few_stars_of_snr_8_in_any_sky(sky):
    rng = np.random.default_rng(4)
    sensor = SKIES.get(sky, Sensor(bits=16, background_dn=1000.0, read_noise_dn=25.0))
    share = np.diff(ndtr((np.arange(-9, 11) - 0.5) / sensor.sigma_px))
    # a block of the background, a seventh of the image, counts a slope within it as noise
    noise = np.sqrt(sensor.read_noise_dn**2 + (1.0 + (sensor.gradient_dn / 7.0) ** 2) / 12.0)
    image, xy = grid_of_stars(rng, 8.0 * noise / (share**2).sum(), size=1000, sensor=sensor)
    image = image.astype(np.float32) if sky == "floating" else image
    halvings = 1 if sensor.sigma_px < 1.8 else 2
    places = find_candidates(image, estimate_background(image), halvings=halvings)
    distance = cKDTree(places + 0.5).query(xy, p=np.inf)[0]
    assert (distance < 2**halvings).mean() > 0.985  # that far `detect` looks about a place
    false = (cKDTree(xy).query(places)[0] > 6.0).sum()
    # 3.7 sigma leaves 1.1e-4 of the sums of white noise; neighbours overlap, and rounding lowers it a little
    assert false < 4e-4 * image.size / 4**halvings


@pytest.mark.parametrize(("snr", "flux"), [(8, 73.0), (15, 137.0), (40, 365.0), (150, 1370.0)])
def test_errors_are_at_the_bound_and_stated_honestly_without_being_told_the_psf(snr, flux):
    rng = np.random.default_rng(snr)
    sensor = Sensor()
    image, xy = grid_of_stars(rng, flux, size=1000, step=24, sensor=sensor)
    parts = [list_stars(image, StarSettings(gain_e_per_dn=40.0, max_stars=5000))]
    truths = [(xy, np.full(len(xy), flux))]
    psf = Psf(1.25, 1.25, (0.0, 0.0), 1000, 1000)
    score = score_centroids(parts, truths, saturation_dn=255.0, psf=psf, gain_e_per_dn=40.0)
    bins = score.found > 500
    assert bins.any()
    # 3200 coordinates a flux: 1.3 % on the rms, 2.5 % on chi2 (1 sigma)
    assert (score.over_bound[bins] < 1.05 + 0.03).all()
    assert ((score.chi2[bins] > 0.9) & (score.chi2[bins] < 1.1)).all()
    for share, left in ((0.001, 1), (0.004, 0)):  # a neighbour of 0.2 % is one too many
        beside = [(np.vstack([xy, xy + 3.0]), np.repeat([flux, share * flux], len(xy)))]
        assert score_centroids(parts, beside, saturation_dn=255.0).stars.sum() == left * score.stars.sum()


def test_stars_near_the_threshold_state_honest_errors():
    # numbers of stars as in the sky: most that are seen at SNR 6 are fainter, lifted by noise
    rng = np.random.default_rng(2)
    chi2 = []
    for _ in range(2):
        image, xy = grid_of_stars(rng, 0.0, step=24)
        snr = 5.0 * rng.uniform((5.0 / 7.0) ** 1.125, 1.0, len(xy)) ** (-1.0 / 1.125)
        image = render(xy, 9.1 * snr, 1500, 1500, Sensor(), rng)
        stars = list_stars(image, StarSettings(gain_e_per_dn=40.0, psf_sigma_px=1.25, max_stars=9999))
        distance, nearest = cKDTree(xy).query(stars.xy_px)
        seen = distance < 3.1
        error = stars.xy_px[seen] - xy[nearest[seen]]
        chi2.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(stars.cov_px[seen]), error) / 2.0)
    # 4800 stars: 1.6 % (1 sigma)
    assert 0.95 < np.concatenate(chi2).mean() < 1.05


def test_no_bias_over_pixel_phase():
    rng = np.random.default_rng(6)
    parts, truths = [], []
    for _ in range(4):
        image, xy = grid_of_stars(rng, 1400.0, size=1500, step=20)
        parts.append(list_stars(image, StarSettings(gain_e_per_dn=40.0, max_stars=10000)))
        truths.append((xy, np.full(len(xy), 1400.0)))
    score = score_centroids(parts, truths, saturation_dn=255.0)
    # 20 phases of 2000 coordinates each, standard error 0.0003 px
    assert np.nanmax(score.phase_error_px) < 0.0006
    assert np.nanmax(np.abs(score.phase_bias_px)) < 0.003


def test_smear_is_found_and_its_centroids_are_honest():
    rng = np.random.default_rng(7)
    image, xy = grid_of_stars(rng, 700.0, size=800, sensor=Sensor(smear_px=(2.4, -1.5)))
    stars = list_stars(image, TOLD_GAIN)
    direction = np.sign(stars.psf.smear_px[0])  # a smear has no sense
    assert np.array(stars.psf.smear_px) * direction == pytest.approx([2.4, -1.5], abs=0.25)
    distance, nearest = cKDTree(xy).query(stars.xy_px)
    error = (stars.xy_px - xy[nearest])[distance < 1.0]
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(stars.cov_px[distance < 1.0]), error) / 2
    assert 0.85 < chi2.mean() < 1.2


def test_a_field_dependent_width_is_found():
    rng = np.random.default_rng(8)
    size, xy = 1200, rng.uniform(30, 1170, (400, 2))
    corner = ((xy + 0.5) / size - 0.5) ** 2
    sigma = 1.0 + 0.5 * 2.0 * corner.sum(axis=1)
    quiet = Sensor(read_noise_dn=0.01, background_dn=0.0, bits=16)
    image = rng.normal(20, 2, (size, size))
    for width in np.arange(1.0, 1.55, 0.05):  # px; stars are as wide as the next of these
        alike = xy[:60][np.abs(sigma[:60] - width) <= 0.025]
        image += render(alike, np.full(len(alike), 900.0), size, size, replace(quiet, sigma_px=width), rng)
    image = image.clip(0, 255).round().astype(np.uint8)
    psf = list_stars(image, TOLD_GAIN).psf
    assert psf.sigma_px == pytest.approx(1.0, abs=0.06)
    assert psf.sigma_corner_px == pytest.approx(1.5, abs=0.15)


def test_the_width_grows_with_the_square_of_the_distance_from_the_middle_of_a_wide_image():
    # 640 x 240 px, stars above the lower third only; 1 in the corners. 1e-9 px: no noise, only rounding
    xy = np.random.default_rng(12).uniform(0.0, [639.0, 160.0], (200, 2))
    corner2 = 0.5 * (((xy[:, 0] - 319.5) / 320.0) ** 2 + ((xy[:, 1] - 119.5) / 120.0) ** 2)
    psf = Psf(sigma_px=1.0, sigma_corner_px=1.0, smear_px=(0.0, 0.0), width_px=640, height_px=240)
    widths = _width_over_field(psf, xy, 1.3 + 0.6 * corner2, np.full(200, 0.02))
    assert widths == pytest.approx((1.3, 1.9), abs=1e-9)


def test_saturated_and_blended_stars_are_flagged():
    rng = np.random.default_rng(9)
    xy = np.array([[100.2, 100.7], [300.0, 100.0], [305.0, 101.0], [200.3, 300.6]])
    image = render(xy, np.array([9000.0, 800.0, 500.0, 800.0]), 400, 400, Sensor(), rng)
    stars = list_stars(image, TOLD_GAIN)
    row = cKDTree(stars.xy_px).query(xy)[1]
    assert stars.saturated[row].tolist() == [True, False, False, False]
    assert stars.blended[row].tolist() == [False, True, True, False]
    miss = stars.xy_px[row[0]] - xy[0]  # the wings alone place a saturated star, to its stated error
    assert miss @ np.linalg.solve(stars.cov_px[row[0]], miss) < 18.4


def bright_and_full_stars(rng):
    """80 stars from 3 to 60 times as bright as would fill a pixel, among 240 that are not saturated."""
    x, y = np.meshgrid(np.arange(50, 1750, 94), np.arange(50, 1750, 94))
    xy = np.column_stack([x.ravel(), y.ravel()])[:320] + rng.uniform(-5.0, 5.0, (320, 2))
    flux = np.exp(rng.uniform(*np.log([[100.0, 1500.0]]).T, 320))
    flux[::4] = np.exp(rng.uniform(*np.log([[3500.0, 60000.0]]).T, 80))
    return render(xy, flux, 1800, 1800, Sensor(), rng), xy[::4], flux[::4]


def test_wings_of_saturated_stars_give_centroids_near_the_bound():
    image, xy, flux = bright_and_full_stars(np.random.default_rng(12))
    stars = list_stars(image, StarSettings())
    row = cKDTree(stars.xy_px).query(xy)[1]
    assert stars.saturated[row].all()
    row, good = row[~stars.blended[row]], ~stars.blended[row]
    assert len(row) >= 76
    miss = stars.xy_px[row] - xy[good]
    nees = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(stars.cov_px[row]), miss).sum()
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], 2 * len(row))
    assert low < nees < high
    noise = np.full(len(row), np.sqrt(4.0 + 1.0 / 12.0))
    bound = cramer_rao_px(xy[good], flux[good], noise, stars.psf, 40.0, full_dn=235.0)
    # half the pixels beside full ones are clipped or spoilt by chance; 160 numbers tell a ratio to 6 %
    assert np.sqrt((miss**2).sum() / (2.0 * (bound**2).sum())) < 1.3


def test_saturated_stars_whose_charge_ran_over_are_not_trusted():
    rng = np.random.default_rng(13)
    _, xy, flux = bright_and_full_stars(rng)
    sky = replace(SkySettings(), bloom=True, cosmic_rays=0, hot_pixels=0)
    others = rng.uniform(0.0, 1800.0, (200, 2))
    places, charge = np.vstack([xy, others]), 40.0 * np.append(flux, rng.uniform(100.0, 1500.0, 200))
    image = expose(places[:, None, :], charge, (1800, 1800), sky, np.empty((0, 3)), rng)
    stars = list_stars(image, StarSettings())
    distance, nearest = cKDTree(xy).query(stars.xy_px)
    seen = np.flatnonzero(stars.saturated & (distance < 5.0))
    assert len(seen) > 60
    trusted = seen[~stars.blended[seen]]
    assert len(trusted) < 0.1 * len(seen)
    miss = stars.xy_px[trusted] - xy[nearest[trusted]]
    nees = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(stars.cov_px[trusted]), miss)
    assert (nees < 18.4).all()  # 1e-4 of two degrees of freedom


def test_a_cosmic_ray_and_a_trail_are_not_stars():
    rng = np.random.default_rng(10)
    image = render(rng.uniform(20, 380, (30, 2)), np.full(30, 900.0), 400, 400, Sensor(), rng)
    image[200, 150:162] = 180
    for k in range(300):
        image[50 + k // 3, 50 + k] = 200
    stars = list_stars(image, TOLD_GAIN)
    on_trail = np.abs(stars.xy_px[:, 1] - 50 - (stars.xy_px[:, 0] - 50) / 3) < 2.0
    on_ray = (np.abs(stars.xy_px[:, 1] - 200) < 2) & (stars.xy_px[:, 0] > 147) & (stars.xy_px[:, 0] < 165)
    assert (on_trail & (stars.xy_px[:, 0] > 55) & (stars.xy_px[:, 0] < 345)).sum() <= 3
    assert on_ray.sum() <= 1


def test_a_dark_frame_removes_what_it_knows():
    rng = np.random.default_rng(11)
    pattern = np.zeros((400, 400))
    pattern[rng.integers(0, 400, 4000), rng.integers(0, 400, 4000)] = 30.0
    xy = rng.uniform(20, 380, (40, 2))
    image = render(xy, np.full(40, 700.0), 400, 400, Sensor(), rng) + pattern
    dark = np.clip(pattern + 20.0, 0, 255).astype(np.uint8)
    stars = list_stars(np.clip(image, 0, 255).astype(np.uint8), TOLD_GAIN, dark)
    assert (cKDTree(stars.xy_px).query(xy)[0] < 0.5).mean() > 0.9
    assert (cKDTree(xy).query(stars.xy_px)[0] > 2.0).sum() <= 2


@pytest.mark.parametrize("shape", [(33, 47), (101, 517)])
def test_odd_and_small_images_are_worked_through(shape):
    rng = np.random.default_rng(12)
    xy = np.array([[20.3, 16.4]])
    stars = list_stars(render(xy, np.array([900.0]), shape[1], shape[0], Sensor(), rng), TOLD_GAIN)
    assert cKDTree(stars.xy_px).query(xy)[0][0] < 0.2


def test_an_image_too_small_or_not_flat_is_refused():
    with pytest.raises(ValueError, match="must be"):
        list_stars(np.zeros((10, 400), np.uint8), StarSettings())
    with pytest.raises(ValueError, match="must be"):
        list_stars(np.zeros((100, 100, 3), np.uint8), StarSettings())


def test_the_bound_agrees_with_the_closed_form_for_fine_pixels():
    # Sky-limited Gaussian, known width: sigma_x = sqrt(2) sigma / SNR with SNR = F / (noise sqrt(4 pi
    # sigma^2)).
    psf = Psf(3.0, 3.0, (0.0, 0.0), 100, 100)
    flux, noise = 5000.0, 2.0
    bound = cramer_rao_px(np.array([[50.0, 50.0]]), np.array([flux]), np.array([noise]), psf, np.inf)[0]
    snr = flux / (noise * np.sqrt(4 * np.pi * 9.0))
    assert bound == pytest.approx(np.sqrt(2) * 3.0 / snr, rel=0.02)  # the pixel widens the PSF by 1 %


def test_a_dark_frame_is_taken_off_but_its_median_and_leaves_saturated_pixels() -> None:
    dark = np.array([[100, 104], [102, 90], [200, 103]], np.uint16)
    image = np.array([[110, 104], [4000, 95], [150, 4095]], np.uint16)
    found = _subtract_dark(image, dark, 4000.0)  # the median of the dark frame is 102.5
    np.testing.assert_array_equal(found, [[112.5, 102.5], [4000.0, 107.5], [52.5, 4000.0]])


def test_windows_of_a_slanting_sky_hold_nothing() -> None:
    row, column = np.mgrid[0:300, 0:400]
    image = (200.0 + 0.3 * column - 0.7 * row + 300.0).astype(np.float32)
    pixels = np.array([[150, 120], [222, 200]])
    found = star_windows(image, pixels, estimate_background(image), 4, 4095.0)
    # DN: the sky changes by 8 DN over a window; the level at its middle is interpolated, to some tenths
    np.testing.assert_allclose(found.data - found.data[:, [40]], 0.0, atol=0.01)
    np.testing.assert_allclose(found.data[:, 40], 0.0, atol=0.5)


def test_a_sky_is_as_noisy_with_rows_and_columns_exchanged():
    """Columns with offsets of their own, which were made even, and noise of few levels along them."""
    rng = np.random.default_rng(5)
    image = rng.normal(size=(600, 800)).round() + 0.15 * np.arange(800) + rng.uniform(size=800)
    here, there = (estimate_background(one.astype(np.float32)) for one in (image, image.T))
    assert here.noise_dn.shape == there.noise_dn.shape[::-1]
    # the same pixels in another order: rounding, and where a block of one more row begins
    assert np.median(there.noise_dn) == pytest.approx(np.median(here.noise_dn), rel=0.01)
