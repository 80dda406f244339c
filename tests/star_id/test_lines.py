"""Offsets of single lines that detectors show in few grey levels, near saturation, and with noise of their
own."""

import numpy as np
import pytest
from frames import Sensor, render
from scipy.spatial import cKDTree

from boresight.star_id.finding.lines import without_lines
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings

SIZE = 900
SENSOR = Sensor(bits=16, e_per_dn=4.0, background_dn=20.0, read_noise_dn=1.2)


def eight_bits(rng, columns, offset_dn, *, noise_dn=0.0, row_noise_dn=0.0, stars=150):
    """Stars of SNR 15 to 60, hot columns and row noise, in 8 bits."""
    xy = rng.uniform(25, SIZE - 26, (stars, 2))
    image = render(xy, rng.uniform(150.0, 600.0, stars), SIZE, SIZE, SENSOR, rng).astype(np.float64)
    where = rng.choice(SIZE, columns, replace=False)
    image[:, where] += offset_dn + rng.normal(0.0, noise_dn, (SIZE, columns))
    image += rng.normal(0.0, row_noise_dn, (SIZE, 1))
    return image.round().clip(0, 255).astype(np.uint8), where, xy


def counted(stars, xy):
    """Share of the stars found, and false detections."""
    found = (cKDTree(stars.xy_px).query(xy)[0] < 2.0).mean()
    return found, int((cKDTree(xy).query(stars.xy_px)[0] > 3.0).sum())


@pytest.mark.parametrize("columns", [3, 10, 20])
@pytest.mark.parametrize("offset_dn", [12.0, 233.0])  # a few sigmas; within noise of saturation
def test_hot_columns_of_8_bits_make_no_stars(columns, offset_dn):
    image, _, xy = eight_bits(np.random.default_rng(columns), columns, offset_dn, row_noise_dn=0.8)
    found, false = counted(list_stars(image, StarSettings()), xy)
    assert found >= 0.9  # blends and stars on saturated columns are lost
    assert false <= 2


def test_a_hot_column_with_noise_of_its_own_makes_no_stars():
    image, where, xy = eight_bits(np.random.default_rng(5), 10, 40.0, noise_dn=12.0)
    stars = list_stars(image, StarSettings())
    found, false = counted(stars, xy)
    assert found >= 0.9
    assert false <= 2
    clean, _ = without_lines(image, 255.0)
    assert clean[:, where].std() < 2.0 * clean.std()  # DN: the noise of the columns is 12, of the others 2.6


def test_row_noise_of_a_sky_of_few_grey_levels_is_subtracted():
    """Noise of 2.6 DN with row noise of 2 DN, in 8 bits, without any hot column."""
    image, _, _ = eight_bits(np.random.default_rng(6), 0, 0.0, row_noise_dn=2.0)
    rows = np.median(without_lines(image, 255.0)[0], axis=1)
    assert rows.std() < 0.4  # DN: 2 before; medians of 900 pixels are known to 0.11, and offsets to 0.08


def test_lines_of_a_clean_image_of_8_bits_are_left_as_they_are():
    image, _, _ = eight_bits(np.random.default_rng(7), 0, 0.0)
    assert without_lines(image, 255.0)[0] is image
