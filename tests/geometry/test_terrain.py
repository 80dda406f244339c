"""Rays over terrain: against planes known in closed form, a plain search, holes, edges, steep angles and
speed.
"""

import time

import numpy as np
import pytest
from pyproj import Transformer

from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import (
    ecef_from_geodetic,
    geodetic_from_ecef,
    local_axes_e,
    ray_ellipsoid_intersection,
)
from boresight.geometry.geoid import Geoid, egm96
from boresight.geometry.terrain import ConstantHeight, TerrainGrid, intersect
from boresight.geometry.terrain_rays import _bilinear_and_slopes, bilinear, bounds_of_heights

UTM33 = "EPSG:32633"
CELL_DEG = 1.0 / 3600.0  # 31 m


def fractal(n, relief_m, seed=3):
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.rfftfreq(n), np.fft.fftfreq(n)[:, None])
    frequency[0, 0] = 1.0
    heights = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((n, n))) * frequency**-2.1, s=(n, n))
    heights -= heights.min()
    return heights * (relief_m / heights.max())


def degrees_grid(heights):
    return TerrainGrid.from_raster(heights, (CELL_DEG, 0.0, 14.0, 0.0, -CELL_DEG, 50.0), "EPSG:4326", None)


def utm_grid(heights):
    return TerrainGrid.from_raster(heights, (30.0, 0.0, 480e3, 0.0, -30.0, 5.5e6), UTM33, None)


def polar_grid(heights, **more):
    """The pole in its middle: longitude turns by half a circle along a short path."""
    half = 15.0 * len(heights)
    return TerrainGrid.from_raster(heights, (30.0, 0.0, -half, 0.0, -30.0, half), "EPSG:3413", None, **more)


def rays_at(lat_rad, lon_rad, height_m, zenith_rad, azimuth_rad, distance_m=600e3):
    """Rays that come down through places, at zenith distances, from an azimuth."""
    p_e = ecef_from_geodetic(lat_rad, lon_rad, height_m, WGS84)
    sine, cosine = np.sin(zenith_rad), np.cos(zenith_rad)
    level = sine * np.sin(azimuth_rad), sine * np.cos(azimuth_rad)
    local = np.stack(np.broadcast_arrays(*level, -cosine), axis=-1)
    direction = np.einsum("nij,nj->ni", local_axes_e(lat_rad, lon_rad), np.broadcast_to(local, p_e.shape))
    return p_e - distance_m * direction, direction


def rays_over(grid, n, zenith_deg, seed, margin=10.0):
    """Rays through random places of a grid at mid height; zenith distance given, azimuth random."""
    rng = np.random.default_rng(seed)
    rows, columns = grid.heights_m.shape
    column, row = rng.uniform(margin, columns - margin, n), rng.uniform(margin, rows - margin, n)
    a, _, c, _, e, f = grid.transform
    x, y = a * (column + 0.5) + c, e * (row + 0.5) + f
    if grid.crs != "EPSG:4326":
        x, y = Transformer.from_crs(grid.crs, "EPSG:4326", always_xy=True).transform(x, y)
    azimuth = rng.uniform(0.0, 2 * np.pi, n)
    middle = 0.5 * sum(grid.height_range_m())
    return rays_at(np.radians(y), np.radians(x), middle, np.radians(zenith_deg), azimuth)


class Plain:
    """The same ground without its grid: `intersect` then searches it in even steps."""

    def __init__(self, grid):
        self.height_m, self.height_range_m = grid.height_m, grid.height_range_m


@pytest.mark.parametrize("make", [degrees_grid, utm_grid, polar_grid])
@pytest.mark.parametrize("zenith_deg", [0.0, 2.0, 30.0, 60.0, 80.0])
def test_found_points_lie_on_the_ground_and_on_the_ray(make, zenith_deg):
    # 1e-6 m in height is promised; off the ray only by the rounding of a 600 km range.
    grid = make(fractal(300, 1500.0))
    origin, direction = rays_over(grid, 3000, zenith_deg, seed=1, margin=-5.0 if zenith_deg > 70 else 60.0)
    met = intersect(origin, direction, grid)
    found = np.isfinite(met[:, 0])
    assert found.mean() > (0.3 if zenith_deg > 70 else 0.95 if zenith_deg < 45 else 0.5)
    lat, lon, height = geodetic_from_ecef(met[found], WGS84)
    assert np.abs(height - grid.height_m(lat, lon)).max() < 1e-6
    assert np.linalg.norm(np.cross(met - origin, direction)[found], axis=1).max() < 1e-7


@pytest.mark.parametrize("zenith_deg", [1.0, 30.0, 65.0])
def test_the_first_crossing_is_the_one_that_a_plain_search_finds(zenith_deg, monkeypatch):
    # A search in 4000 steps (0.4 m of height): the same point, but for rays that graze a crest (at 65 deg, 1
    # %).
    monkeypatch.setattr("boresight.geometry.terrain._STEPS", 4000)
    grid = degrees_grid(fractal(200, 1500.0, seed=4))
    origin, direction = rays_over(grid, 400, zenith_deg, seed=2, margin=50.0)
    fast, plain = intersect(origin, direction, grid), intersect(origin, direction, Plain(grid))
    both = np.isfinite(fast[:, 0]) & np.isfinite(plain[:, 0])
    assert both.mean() > 0.7
    same = np.linalg.norm(fast - plain, axis=1)[both] < 1e-4
    assert same.mean() > (0.99 if zenith_deg > 60 else 0.9999)
    assert np.mean(np.isfinite(fast[:, 0]) == np.isfinite(plain[:, 0])) > 0.97


def test_a_wall_hides_what_is_behind_it():
    # Flat ground at 100 m with a wall of 400 m along a column; rays at 60 deg from the west meet the wall's
    # near side.
    heights = np.full((200, 200), 100.0)
    heights[:, 100] = 500.0
    grid = degrees_grid(heights)
    lat = np.full(50, np.radians(50.0 - 100 * CELL_DEG))
    column = np.linspace(101.0, 115.0, 50)
    lon = np.radians(14.0 + (column + 0.5) * CELL_DEG)
    rays = rays_at(lat, lon, 100.0, np.radians(60.0), 0.5 * np.pi)
    met_lon = geodetic_from_ecef(intersect(*rays, grid), WGS84)[1]
    met_column, _ = grid.pixels_from_geodetic(lat, met_lon)
    # the wall's shadow: 400 m * tan(60) = 693 m = 35 pixels of 19.9 m
    assert np.all((met_column > 98.9) & (met_column < 100.0))
    beyond = rays_at(lat[:1], lon[:1] + np.radians(40 * CELL_DEG), 100.0, np.radians(60.0), 0.5 * np.pi)
    height = geodetic_from_ecef(intersect(*beyond, grid), WGS84)[2]
    np.testing.assert_allclose(height, 100.0, rtol=0, atol=1e-5)


def test_holes_and_edges_give_nan_and_only_they():
    heights = np.full((100, 100), 50.0)
    heights[0, 0] = 51.0  # not flat
    heights[40:50, 60:70] = np.nan
    grid = degrees_grid(heights)
    column, row = np.meshgrid(np.arange(-3.0, 103.0, 0.5), np.arange(-3.0, 103.0, 0.5))
    lon = np.radians(14.0 + (column.ravel() + 0.5) * CELL_DEG)
    lat = np.radians(50.0 - (row.ravel() + 0.5) * CELL_DEG)
    met = intersect(*rays_at(lat, lon, 50.0, 0.0, 0.0), grid)
    inside = (column >= 0) & (column <= 99) & (row >= 0) & (row <= 99)
    hole = (column > 59) & (column < 70) & (row > 39) & (row < 50)
    rim = (column >= 59) & (column <= 70) & (row >= 39) & (row <= 50)
    # rounding decides on the edge itself
    near_edge = (np.abs(column - 49.5) > 49.0) | (np.abs(row - 49.5) > 49.0)
    found = np.isfinite(met[:, 0]).reshape(column.shape)
    assert not found[hole].any() and not found[~inside].any()
    assert found[inside & ~rim & ~near_edge].all()


def test_ground_behind_a_hole_is_not_guessed():
    # A ray that comes down over a hole and would meet ground just behind it under the hole's rim: not known.
    heights = np.full((100, 100), 500.0)
    heights[:, 50:] = 100.0
    heights[:, 49] = np.nan
    grid = degrees_grid(heights)
    lat = np.array([np.radians(50.0 - 50 * CELL_DEG)])
    lon = np.radians([14.0 + 50.6 * CELL_DEG])
    low = intersect(*rays_at(lat, lon, 100.0, np.radians(70.0), 0.5 * np.pi), grid)
    assert np.isnan(low).all() or geodetic_from_ecef(low, WGS84)[2][0] > 499.0
    far = intersect(*rays_at(lat, lon + np.radians(30 * CELL_DEG), 100.0, 0.3, 0.5 * np.pi), grid)
    np.testing.assert_allclose(geodetic_from_ecef(far, WGS84)[2], 100.0, rtol=0, atol=1e-5)


def test_an_inclined_plane_is_met_where_algebra_says():
    # Ground that rises linearly with longitude; the ray comes straight down, so the height is that of its
    # place.
    heights = np.tile(np.arange(200.0) * 3.0, (200, 1))
    grid = degrees_grid(heights)
    rng = np.random.default_rng(6)
    column = rng.uniform(5.0, 190.0, 500)
    lat = np.radians(50.0 - rng.uniform(5.0, 190.0, 500) * CELL_DEG)
    lon = np.radians(14.0 + (column + 0.5) * CELL_DEG)
    met = intersect(*rays_at(lat, lon, 0.0, 0.0, 0.0), grid)
    expected = ecef_from_geodetic(lat, lon, 3.0 * column, WGS84)
    # float32 heights are exact here; 1e-7 deg of place
    np.testing.assert_allclose(met, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("crs", ["EPSG:4326", UTM33])
def test_paths_in_pixels_are_those_of_their_points(crs):
    # A turned raster; 1e-6 px is 0.03 mm in a pixel of 30 m; the path of 1 km, between its points, is good to
    # L^3 / R^3.
    degrees = crs == "EPSG:4326"
    step = CELL_DEG if degrees else 30.0
    west, north = (14.0, 50.0) if degrees else (480e3, 5.5e6)
    transform = (step, 0.2 * step, west, 0.3 * step, -step, north)
    grid = TerrainGrid.from_raster(np.zeros((100, 100)), transform, crs, None)
    rng = np.random.default_rng(6)
    x, y = west + step * rng.uniform(20.0, 80.0, 200), north - step * rng.uniform(20.0, 80.0, 200)
    if not degrees:
        x, y = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(x, y)
    coefficients = np.zeros((4, 3, 200))
    coefficients[0] = np.radians(y), np.radians(x), np.full(200, 100.0)
    coefficients[1] = rng.uniform(-8e-5, 8e-5, (3, 200))
    coefficients[2] = rng.uniform(-8e-9, 8e-9, (3, 200))
    powers = np.vander(np.linspace(-1.0, 1.0, 4), increasing=True)
    pixels = grid.pixels_along_tracks(np.einsum("sk,kin->sin", powers, coefficients))
    for s in (-1.0, -0.3, 0.6, 1.0):
        (lat, lon, height), found = (
            np.einsum("k,kin->in", s ** np.arange(len(c)), c) for c in (coefficients, pixels)
        )
        expected = np.array([*grid.pixels_from_geodetic(lat, lon), height])
        assert np.abs(found - expected).max() < 1e-6


@pytest.mark.parametrize(
    "transform",
    [
        (30.0, 0.0, 471_200.0, 0.0, -30.0, 5_310_400.0),
        (21.0, 17.0, 655_800.0, 15.0, -26.0, 5_150_300.0),  # a raster that is turned on its map
    ],
)
@pytest.mark.parametrize("count", [1, 400])
def test_pixels_of_a_raster_in_a_projection_are_those_of_the_places_that_proj_gives_them(transform, count):
    shape = 900, 2300  # wide, so that rows and columns cannot stand for one another
    grid = TerrainGrid.from_raster(np.zeros(shape), transform, UTM33, None)
    inside = np.random.default_rng(8).uniform(0.0, 1.0, (count, 2))
    corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    pixels = np.concatenate([inside, corners]) * [shape[1], shape[0]] - 0.5
    a, b, c, d, e, f = transform
    x, y = (pixels + 0.5).T.tolist()
    to_degrees = Transformer.from_crs(UTM33, "EPSG:4326", always_xy=True)
    places = [to_degrees.transform(a * u + b * v + c, d * u + e * v + f) for u, v in zip(x, y)]
    lon, lat = np.radians(places).T
    assert grid.local_map is not None and grid.local_map.covers(lat, lon).all()
    found = np.column_stack(grid.pixels_from_geodetic(lat, lon))
    assert np.abs(found - pixels).max() < 1e-6  # px of 30 m: PROJ's inverse is good to 1e-9 m
    assert np.isnan(grid.height_m(lat + 0.5, lon)).all()


def test_flat_grids_and_constant_heights_are_met_alike():
    flat = degrees_grid(np.full((50, 50), 123.0))
    origin, direction = rays_over(flat, 200, 20.0, seed=8)
    expected = ray_ellipsoid_intersection(origin, direction, 123.0, WGS84)
    np.testing.assert_allclose(intersect(origin, direction, flat), expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(intersect(origin, direction, ConstantHeight(123.0)), expected, rtol=0, atol=0)
    past = rays_at(np.radians([51.0]), np.radians([14.0]), 0.0, 0.0, 0.0)
    assert np.isnan(intersect(*past, flat)).all()


def test_a_ray_that_misses_the_earth_gives_nan():
    grid = degrees_grid(fractal(64, 300.0))
    origin = np.array([[7000e3, 0.0, 0.0], [7000e3, 0.0, 0.0]])
    direction = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    assert np.isnan(intersect(origin, direction, grid)).all()


def test_heights_above_sea_level_are_raised_by_the_geoid():
    heights = np.full((20, 20), 100.0)
    for transform, crs in (
        ((0.01, 0.0, 14.0, 0.0, -0.01, 50.0), "EPSG:4326"),
        ((1000.0, 0.0, 480e3, 0.0, -1000.0, 5.5e6), UTM33),
    ):
        grid = TerrainGrid.from_raster(heights, transform, crs, egm96())
        x, y = transform[0] * 7.5 + transform[2], transform[4] * 11.5 + transform[5]
        lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(x, y)
        expected = 100.0 + egm96().undulation_m(np.radians(lat), np.radians(lon))
        # 1e-5 m: heights are kept as float32
        assert grid.heights_m[11, 7] == pytest.approx(float(expected), abs=1e-5)


def test_a_geoid_that_does_not_reach_is_an_error_not_a_zero():
    small = Geoid(np.zeros((3, 3), np.float32), 0.0, 0.0, 0.01, 0.01)
    with pytest.raises(ValueError, match="outside the geoid grid"):
        TerrainGrid.from_raster(np.zeros((5, 5)), (0.01, 0, 14.0, 0, -0.01, 50.0), "EPSG:4326", small)


def test_a_grid_may_be_turned_or_written_in_another_turn_of_longitude():
    heights = fractal(60, 100.0)
    straight = degrees_grid(heights)
    transform = (0.0, CELL_DEG, 374.0, -CELL_DEG, 0.0, 50.0)
    turned = TerrainGrid.from_raster(heights.T, transform, "EPSG:4326", None)
    rng = np.random.default_rng(9)
    lat, lon = (
        np.radians(50.0 - rng.uniform(5, 55, 50) * CELL_DEG),
        np.radians(14.0 + rng.uniform(5, 55, 50) * CELL_DEG),
    )
    np.testing.assert_allclose(turned.height_m(lat, lon), straight.height_m(lat, lon), rtol=0, atol=1e-5)


def test_bilinear_reaches_to_the_last_pixel_and_no_farther():
    heights = np.array([[0.0, 1.0], [2.0, 5.0]], np.float32)
    at = np.array([[0, 0], [1, 1], [0.5, 0.5], [1, 0.25], [1.0001, 0.5], [-0.0001, 0.0], [np.nan, 0.0]])
    got = bilinear(heights, at[:, 0], at[:, 1])
    np.testing.assert_array_equal(got[:4], [0.0, 5.0, 2.0, 2.0])
    assert np.isnan(got[4:]).all()


@pytest.mark.parametrize(
    ("heights", "message"),
    [
        (np.full((3, 3), np.nan), "no height at all"),
        (np.zeros(5), "at least 2 x 2"),
        (np.zeros((1, 9)), "at least 2 x 2"),
    ],
)
def test_rasters_that_are_no_terrain_are_refused(heights, message):
    with pytest.raises(ValueError, match=message):
        degrees_grid(heights)


def test_a_hundred_thousand_rays_are_quick():
    # The budget of a million pixels is one second for the whole way; here rays at 25 deg over 300 m of
    # relief, 0.07 s measured for 100 000 on one core.
    grid = degrees_grid(fractal(512, 300.0, seed=12))
    column, row = np.meshgrid(np.linspace(100.0, 400.0, 400), np.linspace(100.0, 400.0, 250))
    lon = np.radians(14.0 + column.ravel() * CELL_DEG)
    lat = np.radians(50.0 - row.ravel() * CELL_DEG)
    rays = rays_at(lat, lon, 150.0, np.radians(25.0), 1.0)
    took = []
    for _ in range(3):
        start = time.process_time()
        met = intersect(*rays, grid)
        took.append(time.process_time() - start)
    assert np.isfinite(met).all()
    assert min(took) < 0.3


def test_a_hole_that_begins_with_a_block_of_rows_leaves_the_rise_before_it_unknown():
    heights = np.zeros((600, 64), dtype=np.float32)
    heights[512:, 20] = np.nan  # blocks have 512 rows; the last cells of the first one end in the hole
    bounds = bounds_of_heights(heights)
    assert not any(np.isnan(level).any() for level in bounds.rise_m)
    beside_the_last_tile = bounds.rise_m[0][2 + 503 // 8]
    assert beside_the_last_tile[2 + 20 // 8] > 1e8  # m: unknown


@pytest.mark.parametrize("shape", [(1025, 700), (513, 9), (2, 2)])
def test_bounds_of_tiles_are_those_of_the_heights_in_and_around_them(shape):
    rng = np.random.default_rng(10)
    heights = rng.normal(0.0, 100.0, shape).astype(np.float32)
    heights[rng.random(shape) < 0.01] = np.nan
    bounds = bounds_of_heights(heights)
    assert (bounds.lowest_m, bounds.highest_m) == (np.nanmin(heights), np.nanmax(heights))
    for size, low, high, rise in zip(bounds.sizes, bounds.low_m, bounds.high_m, bounds.rise_m):
        rows, columns = (-(-length // size) for length in shape)
        assert low.shape == high.shape == rise.shape == (rows + 4, columns + 4)
        for row, column in zip(rng.integers(0, rows, 20), rng.integers(0, columns, 20)):
            near = heights[max(0, (row - 1) * size) : (row + 2) * size]
            near = near[:, max(0, (column - 1) * size) : (column + 2) * size]
            if np.isfinite(near).any():
                assert low[row + 2, column + 2] == np.nanmin(near)
                assert high[row + 2, column + 2] == np.nanmax(near)
            steps = [
                np.nanmax(np.abs(np.diff(near, axis=k)), initial=0.0) for k in (0, 1) if near.shape[k] > 1
            ]
            assert rise[row + 2, column + 2] >= max(steps, default=0.0)


def test_slopes_are_those_of_the_bilinear_height_up_to_the_last_row_and_column():
    heights = fractal(30, 400.0)[:25].astype(np.float32)
    rng = np.random.default_rng(2)
    column, row = rng.uniform(0, 29, 300), rng.uniform(0, 24, 300)
    column[:40], row[20:60] = 29.0, 24.0  # on the last column, on the last row, on both
    height, by_column, by_row = _bilinear_and_slopes(heights, column, row)
    c, r = np.minimum(column.astype(int), 28), np.minimum(row.astype(int), 23)
    u, v, z = column - c, row - r, heights.astype(float)
    a, b, d, e = z[r, c], z[r, c + 1], z[r + 1, c], z[r + 1, c + 1]
    # float32 heights of some hundreds of metres
    assert height == pytest.approx((1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * e), abs=1e-3)
    assert by_column == pytest.approx((1 - v) * (b - a) + v * (e - d), abs=1e-3)
    assert by_row == pytest.approx((1 - u) * (d - a) + u * (e - b), abs=1e-3)


@pytest.mark.parametrize("west_deg", [-180.0, 0.0, 180.0])
def test_a_raster_around_the_whole_earth_has_a_height_at_every_longitude(west_deg):
    heights = np.repeat(np.arange(360.0, dtype=np.float32)[None], 20, axis=0)
    around = TerrainGrid.from_raster(heights, (1.0, 0.0, west_deg, 0.0, -1.0, 10.0), "EPSG:4326", None)
    lon = np.arange(-179.5, 180.0, 7.0)
    for turns in (-360.0, 0.0, 360.0):  # however it is written
        found = around.height_m(np.full(len(lon), 0.01), np.radians(lon + turns))
        assert found == pytest.approx((lon - west_deg) % 360.0 - 0.5, abs=1e-3)
