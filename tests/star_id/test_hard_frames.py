"""The renderer of bad frames keeps the light of its stars, and its bounds are those of its noise."""

import numpy as np
import pytest
from hard_frames import (
    Blur,
    Sensor,
    Stars,
    add_stars,
    bound_after_jpeg_px,
    cramer_rao_px,
    psf_table,
    render,
    rounded_information,
)

SIZE = (96, 80)
PLACE = np.array([[48.3, 39.8]])


@pytest.mark.parametrize(
    "blur", [Blur(), Blur(trail_px=(9.0, -4.0)), Blur(ring_px=3.0), Blur(coma_px=6.0)], ids=str
)
def test_a_star_has_its_electrons_whatever_the_blur(blur):
    light = np.zeros(SIZE[::-1])
    add_stars(light, Stars(PLACE, np.array([1e4])), blur)
    assert light.sum() == pytest.approx(1e4, rel=2e-3)  # wings beyond the table of 49 px
    y, x = np.indices(light.shape)
    middle = [(light * axis).sum() / light.sum() for axis in (x, y)]
    assert middle == pytest.approx(PLACE[0], abs=0.05)  # px: eight points of the table a pixel


def test_the_variance_of_the_sky_is_that_of_its_pixels():
    image, variance = render(Stars(), (300, 300), Blur(), Sensor(), np.random.default_rng(1))
    drawn = (Sensor().e_per_dn * image.astype(float)).var()
    assert drawn == pytest.approx(variance.mean(), rel=0.03)  # 90 000 pixels: 0.5 %, six of them


def test_the_bound_is_that_of_a_star_alone_and_larger_where_pixels_are_uneven():
    table, flux = psf_table(Blur()), np.array([500.0])
    variance, share = np.full(SIZE[::-1], 400.0), np.ones(SIZE[::-1])
    bound, snr = cramer_rao_px(PLACE, flux, variance, share, table)[0]
    # A Gaussian of the same width on a bright sky: sigma sqrt(2) / SNR; wings and pixels make it larger.
    gaussian = np.sqrt(2.0) * 2.5 / 2.355 / snr
    assert gaussian < bound < 1.3 * gaussian
    assert cramer_rao_px(PLACE, flux, variance, share, table, 0.1, 100.0)[0, 0] > bound


def test_rounding_to_fine_steps_loses_no_information_and_to_coarse_ones_does():
    mean, sigma = np.array([0.3, 1.7]), np.array([1.0, 2.0])
    assert rounded_information(mean, sigma, np.array([0.5, 1.0])) == pytest.approx(
        sigma**-2.0, rel=0.03
    )  # step² / 12
    assert (rounded_information(mean, sigma, np.array([8.0, 16.0])) < 0.5 * sigma**-2.0).all()


def test_a_coarser_compression_has_a_larger_bound_and_a_fine_one_about_that_before():
    table, flux = psf_table(Blur()), np.array([3000.0])
    variance, share = np.full(SIZE[::-1], 140.0), np.ones(SIZE[::-1])
    before = cramer_rao_px(PLACE, flux, variance, share, table)[0, 0]
    fine, coarse = (
        bound_after_jpeg_px(PLACE, flux, variance, Sensor(bits=8, bias_dn=16.0, jpeg=quality), table)[0]
        for quality in (95, 40)
    )
    assert fine < coarse and fine == pytest.approx(before, rel=0.25)  # its background is known
