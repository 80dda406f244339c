"""Raw star images: light is kept, noise is what it says, stars stand where they were put."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from boresight.simulator.scenario import SkySettings
from boresight.simulator.sky import expose, star_charge

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


@pytest.mark.parametrize("place", [(15.0, 15.0), (14.7, 16.3), (15.49, 14.51)])
def test_a_star_stands_where_it_was_put_integrated_over_pixels(place):
    # photon noise of 5e8 e and rounding to DN move the middle by 2e-4 px; the total is that of photons
    noiseless = replace(DARK, e_per_dn=1e4)
    image = expose(still([place]), np.array([5e8]), (31, 31), noiseless, NO_HOT, np.random.default_rng(3))
    assert image.sum() == pytest.approx(5e4, rel=1e-3)
    rows, columns = np.indices(image.shape)
    for grid, middle in ((columns, place[0]), (rows, place[1])):
        assert (image * grid).sum() / image.sum() == pytest.approx(middle, abs=2e-3)
        variance = (image * (grid - middle) ** 2).sum() / image.sum()
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


def test_a_star_near_or_beyond_an_edge_leaves_the_light_that_falls_on_the_detector():
    noiseless = replace(DARK, e_per_dn=1e3)  # photon noise of 6e7 e is 1e-4 of a star
    edges = ((1.5, 20.0), (-2.0, 20.0), (39.0, 20.0), (41.5, 20.0), (20.0, 1.0), (20.0, 30.5), (-1.0, -1.0))
    for x, y in edges:
        rng = np.random.default_rng(3)
        image = expose(still([[x, y]]), np.array([6e7]), (40, 30), noiseless, NO_HOT, rng).astype(float)
        inside = [ndtr((n - 0.5 - at) / 1.25) - ndtr((-0.5 - at) / 1.25) for n, at in ((40, x), (30, y))]
        # PSF of 1.25 px; DN are rounded: half of one in a few hundred pixels
        assert image.sum() == pytest.approx(6e4 * inside[0] * inside[1], abs=0.01 * 6e4)
