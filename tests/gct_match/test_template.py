"""A chip's pixels and the ground that they show."""

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray
from pyproj import Transformer

from boresight.gct_match.imaging.resample import sample
from boresight.gct_match.predict.template import chip_points
from boresight.gct_match.records import Chip
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic


def test_points_of_a_rotated_chip_are_those_of_its_affine_transform() -> None:
    # Authorities: the affine package for the pixel, PROJ for the map. 1e-6 px of 2 m is 2 um on the ground.
    placed = Affine.translation(500_300.0, 5_300_200.0) * Affine.rotation(25.0) * Affine.scale(2.0, -2.5)
    blank = np.zeros((60, 80))
    chip = Chip("t", blank, tuple(placed)[:6], "EPSG:32633", np.ones(blank.shape, dtype=bool))
    column, row = np.array([0.0, 12.25, 79.0]), np.array([0.0, 40.5, 3.0])
    a, b, c, d, e, f = tuple(placed)[:6]
    x, y = column + 0.5, row + 0.5  # the centre of a pixel is half a pixel from its corner
    east, north = a * x + b * y + c, d * x + e * y + f
    lon, lat = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(east, north)
    p_e = ecef_from_geodetic(np.radians(lat), np.radians(lon), np.full(3, 310.0), WGS84)
    np.testing.assert_allclose(chip_points(chip, p_e), np.column_stack([column, row]), atol=1e-6)


def test_points_on_one_line_are_sampled_without_their_first_order(invented: NDArray):
    image = invented[:60, :60].astype(np.float32)
    x = np.broadcast_to(np.arange(10.0, 40.0, dtype=np.float32), (30, 30)).copy()
    y = np.full((30, 30), 17.0, dtype=np.float32)
    # all rows see the same row of the picture, at whole pixels: Lanczos has it to rounding
    assert sample(image, x, y) == pytest.approx(np.broadcast_to(image[17, 10:40], (30, 30)), abs=1e-3)
