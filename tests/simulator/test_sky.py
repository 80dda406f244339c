"""Raw star images: light is kept, noise is what it says, stars stand where they were put."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from boresight.simulator.scenario import SkySettings
from boresight.simulator.sky import expose, hot_pixels, star_charge

DARK = SkySettings(
    background_dn=0.0,
    background_gradient_dn=(0.0, 0.0),
    background_bow_dn=0.0,
    read_noise_dn=0.0,
    hot_pixels=0,
    cosmic_rays=0.0,
    bits=16,
    e_per_dn=0.5,
)
NO_HOT = np.zeros((0, 3))


def still(xy):
    return np.asarray(xy, dtype=float)[:, None, :]


def test_five_magnitudes_are_a_hundredfold_of_charge():
    electrons = star_charge(np.array([2.0, 7.0]), np.array([0.0, np.nan]), 0.1, SkySettings())
    assert electrons[0] == pytest.approx(100.0 * electrons[1])


def test_all_the_light_of_a_star_is_in_the_image():
    rng = np.random.default_rng(1)
    image = expose(still([[40.3, 33.8]]), np.array([4000.0]), (80, 64), DARK, NO_HOT, rng)
    # 4000 electrons with photon noise: 63 electrons, 126 DN; five standard errors.
    assert image.sum() == pytest.approx(8000.0, abs=5 * 126)


def test_stars_stand_where_they_were_put():
    rng = np.random.default_rng(2)
    xy = np.column_stack([rng.uniform(20, 480, 100), rng.uniform(20, 380, 100)])
    errors = []
    for place in xy:
        image = expose(still([place]), np.array([1e4]), (500, 400), DARK, NO_HOT, rng).astype(float)
        rows, columns = np.indices(image.shape)
        errors.append([(image * columns).sum() / image.sum(), (image * rows).sum() / image.sum()] - place)
    # A centre of mass of 1e4 photons scatters by 1.28 px / 100 (PSF with its pixel); their mean by a tenth.
    assert np.abs(np.mean(errors, axis=0)).max() < 5 * 1.28e-3
    assert np.std(errors) == pytest.approx(1.28e-2, rel=0.25)  # 200 numbers: 5 %, five standard errors


def test_psf_is_integrated_over_pixels():
    noiseless = replace(DARK, e_per_dn=1e3)  # photon noise of 6e7 e is 1e-4 of the peak
    rng = np.random.default_rng(3)
    image = expose(still([[15.0, 15.0]]), np.array([6e7]), (31, 31), noiseless, NO_HOT, rng)
    columns = np.arange(31.0)
    variance = (image * (columns - 15.0) ** 2).sum() / image.sum()
    assert variance == pytest.approx(1.25**2 + 1.0 / 12.0, rel=0.01)  # Sheppard: a pixel adds 1/12


def test_a_smeared_star_is_longer_along_its_path_alone():
    noiseless = replace(DARK, e_per_dn=1e3)
    path = np.array([15.0, 15.0]) + np.linspace(-1.5, 1.5, 25)[:, None] * [1.0, 0.0]
    image = expose(path[None], np.array([6e7]), (31, 31), noiseless, NO_HOT, np.random.default_rng(3))
    rows, columns = np.indices(image.shape)
    along = (image * (columns - 15.0) ** 2).sum() / image.sum()
    across = (image * (rows - 15.0) ** 2).sum() / image.sum()
    assert along - across == pytest.approx(path[:, 0].var(), rel=0.02)


def test_background_noise_is_read_and_photon_noise():
    sky = replace(
        SkySettings(), background_gradient_dn=(0.0, 0.0), background_bow_dn=0.0, cosmic_rays=0.0, hot_pixels=0
    )
    image = expose(np.zeros((0, 1, 2)), np.zeros(0), (600, 500), sky, NO_HOT, np.random.default_rng(4))
    # and rounding to integers
    expected = sky.read_noise_dn**2 + sky.background_dn / sky.e_per_dn + 1.0 / 12.0
    # 3e5 pixels: the variance is known to 0.26 %, the mean to 0.004 DN; five standard errors.
    assert image.astype(float).var() == pytest.approx(expected, rel=0.013)
    assert image.mean() == pytest.approx(sky.background_dn, abs=0.02)


def test_background_has_its_gradient():
    sky = replace(SkySettings(), cosmic_rays=0.0, background_bow_dn=0.0)
    image = expose(np.zeros((0, 1, 2)), np.zeros(0), (600, 500), sky, NO_HOT, np.random.default_rng(5))
    across = image[:, -50:].mean() - image[:, :50].mean()
    assert across == pytest.approx(4.0 * 550 / 600, abs=0.1)  # DN; 25 000 px on either side: 0.02 DN


def test_hot_pixels_stay_in_their_places():
    sky = SkySettings(hot_pixels=30, cosmic_rays=0.0)
    hot = hot_pixels(300, 200, sky, np.random.default_rng(6))
    for seed in (7, 8):
        image = expose(np.zeros((0, 1, 2)), np.zeros(0), (300, 200), sky, hot, np.random.default_rng(seed))
        excess = image[hot[:, 1].astype(int), hot[:, 0].astype(int)] - np.median(image)
        assert np.all(excess > 20.0 - 6 * 2.2 - 5.0)  # faintest hot pixel less six noises and the gradient


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_bright_stars_saturate_at_the_last_grey_value(bits, dtype):
    sky = replace(SkySettings(), bits=bits)
    image = expose(still([[30.0, 30.0]]), np.array([1e10]), (60, 60), sky, NO_HOT, np.random.default_rng(9))
    assert image.dtype == dtype
    assert image.max() == 2**bits - 1


def test_blooming_runs_along_the_column_and_keeps_the_charge():
    even = {"background_gradient_dn": (0.0, 0.0), "background_bow_dn": 0.0, "cosmic_rays": 0.0}
    sky = replace(SkySettings(), bloom=True, background_shot_noise=False, **even)
    args = (still([[30.0, 80.0]]), np.array([3e6]), (60, 160), sky, NO_HOT, np.random.default_rng(10))
    image = expose(*args).astype(float)
    assert (image[:, 30] >= 240).sum() > (image[80] >= 240).sum() + 10
    # Nothing is lost: 3e6 e are 75 000 DN; all pixels' noise is 200 DN, those at the limit lose 1 DN each.
    assert (image - sky.background_dn).sum() == pytest.approx(75_000.0, abs=1300.0)


def test_the_same_stream_of_chance_gives_the_same_image():
    sky = SkySettings()
    images = [
        expose(still([[30.0, 30.0]]), np.array([1e5]), (64, 64), sky, NO_HOT, np.random.default_rng(11))
        for _ in range(2)
    ]
    assert np.array_equal(*images)


def test_a_star_near_or_beyond_an_edge_leaves_the_light_that_falls_on_the_detector():
    noiseless = replace(DARK, e_per_dn=1e3)  # photon noise of 6e7 e is 1e-4 of a star
    edges = ((1.5, 20.0), (-2.0, 20.0), (39.0, 20.0), (41.5, 20.0), (20.0, 1.0), (20.0, 30.5), (-1.0, -1.0))
    for x, y in edges:
        rng = np.random.default_rng(3)
        image = expose(still([[x, y]]), np.array([6e7]), (40, 30), noiseless, NO_HOT, rng).astype(float)
        inside = [ndtr((n - 0.5 - at) / 1.25) - ndtr((-0.5 - at) / 1.25) for n, at in ((40, x), (30, y))]
        # PSF of 1.25 px; DN are rounded: half of one in a few hundred pixels
        assert image.sum() == pytest.approx(6e4 * inside[0] * inside[1], abs=0.01 * 6e4)
