"""A polynomial in the place of a map projection: right to its tolerance, or not there at all."""

import numpy as np
import pytest
from pyproj import Transformer

from boresight.geometry.terrain import TerrainGrid, fit_local_map


def projection(crs, pixel_m=30.0):
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    return lambda lat, lon: tuple(
        np.asarray(a) / pixel_m for a in to_map.transform(np.degrees(lon), np.degrees(lat))
    )


@pytest.mark.parametrize(
    ("crs", "lat", "lon"), [("EPSG:32632", 48.0, 9.5), ("EPSG:3035", 62.0, 25.0), ("EPSG:32733", -33.0, 17.0)]
)
@pytest.mark.parametrize("width_deg", [0.1, 1.0, 4.0])
def test_the_polynomial_is_the_projection(crs, lat, lon, width_deg):
    true = projection(crs)
    region = [tuple(np.radians([a - width_deg / 2, a + width_deg / 2])) for a in (lat, lon)]
    quick = fit_local_map(true, *region, 1e-7)
    rng = np.random.default_rng(1)
    u, v = rng.uniform(*region[0], 5000), rng.uniform(*region[1], 5000)
    assert quick.covers(u, v).all()
    assert np.abs(np.array(quick.at(u, v)) - np.array(true(u, v))).max() < 1e-7  # pixels of 30 m: 3 um
    assert not quick.covers(u + 10.0, v).any() and not quick.covers(np.array([np.nan]), v[:1]).any()


def test_there_is_none_where_no_polynomial_will_do():
    kink = lambda u, v: (np.abs(u), v)  # noqa: E731
    assert fit_local_map(kink, (-1.0, 1.0), (-1.0, 1.0), 1e-7) is None
    assert fit_local_map(kink, (1.0, 1.0), (-1.0, 1.0), 1e-7) is None
    assert fit_local_map(lambda u, v: (u * np.nan, v), (0.0, 1.0), (0.0, 1.0), 1e-7) is None


def test_a_map_of_third_degree_is_found_with_all_of_its_coefficients():
    # every power up to a total of three has a coefficient of its own; 1e-10: rounding of sums near 300
    given = np.arange(1.0, 33.0).reshape(2, 4, 4)
    given[:, np.add.outer(np.arange(4), np.arange(4)) > 3] = 0.0

    def cubic(u, v):
        x, y = (u - 0.3) / 0.2, (v + 1.1) / 0.05
        return tuple(np.polynomial.polynomial.polyval2d(x, y, each) for each in given)

    found = fit_local_map(cubic, (0.1, 0.5), (-1.15, -1.05), 1e-9)
    assert found.coefficients.shape == given.shape
    np.testing.assert_allclose(found.coefficients, given, rtol=0, atol=1e-10)


def test_a_deviation_between_the_nodes_of_the_fit_is_found():
    # a fiftieth of the region wide, halfway from its middle to two of its edges, where no degree has a node
    def bumpy(u, v, height):
        bump = np.exp(-(((u - 0.5) / 0.01) ** 2) - ((v + 0.5) / 0.01) ** 2)
        return u + 0.3 * v**2 + height * bump, v

    region = (-1.0, 1.0), (-1.0, 1.0)
    assert fit_local_map(lambda u, v: bumpy(u, v, 0.0), *region, 1e-7) is not None
    assert fit_local_map(lambda u, v: bumpy(u, v, 1e-3), *region, 1e-7) is None


def test_a_terrain_answers_alike_inside_and_outside_the_region_of_its_polynomial():
    grid = TerrainGrid.from_raster(
        np.random.default_rng(2).uniform(0.0, 500.0, (300, 400)),
        (30.0, 0, 480e3, 0, -30.0, 5.5e6),
        "EPSG:32633",
        None,
    )
    assert grid.local_map is not None
    lat, lon = np.radians(np.linspace(49.55, 49.65, 500)), np.radians(np.linspace(14.75, 14.85, 500))
    inside = grid.pixels_from_geodetic(lat, lon)
    with_one_outside = grid.pixels_from_geodetic(np.append(lat, 0.5), np.append(lon, 0.2))  # all by PROJ
    assert np.abs(np.array(inside) - np.array(with_one_outside)[:, :-1]).max() < 1e-7
    assert np.isnan(grid.height_m(np.array([0.5]), np.array([0.2]))).all()
