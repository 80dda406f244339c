"""A surveyed target: its coordinates and its chip share one error, its height is orthometric."""

from types import SimpleNamespace

import numpy as np
import pytest
from pyproj import Transformer

from boresight.simulator.ground_targets import _surveyed

EAST, NORTH, HEIGHT_M, UNDULATION_M, SIGMA_M = 500_300.0, 5_300_200.0, 412.0, 47.0, 3.0


def test_survey_error_moves_coordinates_and_chip_alike_and_heights_are_above_the_geoid() -> None:
    scene = SimpleNamespace(
        epsg=32633, surface=SimpleNamespace(height_m=lambda lat, lon: np.full(len(lat), HEIGHT_M))
    )
    geoid = SimpleNamespace(undulation_m=lambda lat, lon: np.full(len(lat), UNDULATION_M))
    settings, image = SimpleNamespace(sigma_m=SIGMA_M), np.zeros((20, 20), dtype=np.uint8)
    rng = np.random.default_rng(4)
    target, chip, _ = _surveyed("t", scene, EAST, NORTH, image, 1.5, settings, geoid, rng)
    error = np.random.default_rng(4).standard_normal(3) * SIGMA_M  # metres: several, so that none is missed
    assert np.abs(error).min() > 0.5
    back = Transformer.from_crs(4326, 32633, always_xy=True)
    east, north = back.transform(target.lon_deg, target.lat_deg)
    assert (east - EAST, north - NORTH) == pytest.approx(tuple(error[:2]), abs=1e-6)  # m, PROJ's round trip
    middle = chip.affine[2] + 10 * 1.5, chip.affine[5] - 10 * 1.5
    assert middle == pytest.approx((east, north), abs=1e-6)
    # h = H + N: what is reported is above the geoid, the surface above the ellipsoid.
    assert target.height_m == pytest.approx(HEIGHT_M - UNDULATION_M + error[2], abs=1e-9)
