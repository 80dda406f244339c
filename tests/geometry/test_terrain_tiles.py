"""Height models in several files are the ground that one file with all heights would be."""

import numpy as np
import pytest

from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.terrain import Raster, TerrainGrid, TerrainTiles, intersect, joined

NORTH, WEST, STEP = 46.2, 7.5, 1.0 / 1200.0  # three arc-seconds
ROWS, COLUMNS = 180, 240
MOST = 10**6


def hills(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Heights with 600 m of relief, m, at rows and columns of the whole raster."""
    wave = 300.0 * np.sin(rows / 17.0) * np.cos(columns / 23.0 + 0.4) + 1.7 * columns
    return (1500.0 + wave).astype(np.float32)


def tile(first_row: int, first_column: int, rows: int, columns: int, crs: str = "EPSG:4326") -> Raster:
    row, column = np.meshgrid(
        np.arange(first_row, first_row + rows), np.arange(first_column, first_column + columns), indexing="ij"
    )
    corner = (WEST + first_column * STEP, NORTH - first_row * STEP)
    return Raster(hills(row, column), (STEP, 0.0, corner[0], 0.0, -STEP, corner[1]), crs)


def grid(raster: Raster) -> TerrainGrid:
    return TerrainGrid.from_raster(raster.heights_m, raster.transform, raster.crs, None)


def rays(seed: int, count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions towards the tiles from 600 km above, up to 25 degrees off the vertical."""
    rng = np.random.default_rng(seed)
    lat = np.radians(NORTH - STEP * rng.uniform(5, ROWS - 5, count))
    lon = np.radians(WEST + STEP * rng.uniform(5, COLUMNS - 5, count))
    aim = ecef_from_geodetic(lat, lon, np.full(count, 1400.0), WGS84)
    away = np.radians(rng.uniform(-2.0, 2.0, (2, count)))
    origin = ecef_from_geodetic(lat + away[0], lon + away[1], np.full(count, 6e5), WGS84)
    return origin, aim - origin


def same(one: Raster, other: Raster) -> bool:
    alike = (one.transform, one.crs) == (other.transform, other.crs)
    return alike and np.array_equal(one.heights_m, other.heights_m)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1, 0, 2)])
def test_tiles_side_by_side_and_overlapping_become_the_one_raster(order):
    whole = tile(0, 0, ROWS, COLUMNS)
    parts = [tile(0, 0, 90, 120), tile(0, 120, 91, 120), tile(90, 0, 90, 121), tile(90, 120, 90, 120)]
    (one,) = joined([parts[n] for n in order], MOST)
    assert np.array_equal(one.heights_m, whole.heights_m)
    assert one.transform == pytest.approx(whole.transform, rel=1e-12)


def test_first_of_overlapping_tiles_counts_and_gaps_have_no_height():
    one, two = tile(0, 0, 40, 40), tile(20, 30, 40, 40)
    raised = Raster(two.heights_m + 100.0, two.transform, two.crs)
    (both,) = joined([one, raised], MOST)
    assert both.heights_m.shape == (60, 70)
    assert np.array_equal(both.heights_m[:40, :40], one.heights_m)
    assert np.array_equal(both.heights_m[40:, 30:], raised.heights_m[20:])
    assert np.isnan(both.heights_m[45:, :30]).all() and np.isnan(both.heights_m[:20, 40:]).all()


@pytest.mark.parametrize(
    "other",
    [
        tile(0, 41, 40, 40),  # a column is missing between them
        tile(0, 40, 40, 40, "EPSG:4258"),
        Raster(np.ones((40, 40), np.float32), (STEP, 0, WEST + 40.4 * STEP, 0, -STEP, NORTH), "EPSG:4326"),
        Raster(np.ones((40, 40), np.float32), (2 * STEP, 0, WEST + 40 * STEP, 0, -STEP, NORTH), "EPSG:4326"),
        Raster(np.ones((40, 40), np.float32), (STEP, 0, WEST, 0, -1.004 * STEP, NORTH), "EPSG:4326"),
    ],
    ids=["gap", "crs", "between pixels", "other pixels", "off by a sixth of a pixel after forty"],
)
def test_rasters_that_do_not_fit_stay_apart(other):
    one = tile(0, 0, 40, 40)
    for pair in ([one, other], [other, one]):
        found = joined(pair, MOST)
        assert len(found) == 2 and same(found[0], pair[0]) and same(found[1], pair[1])


def test_tiles_that_would_be_too_large_together_stay_apart():
    beside = [tile(0, 0, 40, 40), tile(0, 40, 40, 40)]
    one, other = joined(beside, 3199)
    assert same(one, beside[0]) and same(other, beside[1])
    (both,) = joined(beside, 3200)
    assert np.array_equal(both.heights_m, tile(0, 0, 40, 80).heights_m)


def test_rays_meet_overlapping_grids_where_they_meet_the_whole():
    whole = grid(tile(0, 0, ROWS, COLUMNS))
    tiles = TerrainTiles((grid(tile(0, 0, ROWS, 130)), grid(tile(0, 110, ROWS, 130))))
    origin, direction = rays(1)
    expected, found = intersect(origin, direction, whole), intersect(origin, direction, tiles)
    assert np.isfinite(expected).all()
    # at the edges of the grids rays are sampled every 15 m of height: a crest may be missed there
    off = np.linalg.norm(found - expected, axis=1)
    assert np.isfinite(found).all() and np.quantile(off, 0.999) < 1e-3  # m
    lat, lon, _ = geodetic_from_ecef(expected, WGS84)
    # coordinates of 4000 km have single heights to 0.1 mm in float32
    assert np.abs(tiles.height_m(lat, lon) - whole.height_m(lat, lon)).max() < 1e-3


def test_finer_grid_counts_where_it_is_and_the_coarse_one_around_it():
    coarse = grid(tile(0, 0, ROWS, COLUMNS))
    inner = tile(60, 80, 60, 80)
    fine = grid(Raster(inner.heights_m + 40.0, inner.transform, inner.crs))
    tiles = TerrainTiles((fine, coarse))
    origin, direction = rays(2)
    found = intersect(origin, direction, tiles)
    lat, lon, height = geodetic_from_ecef(found, WGS84)
    above, inside = height - coarse.height_m(lat, lon), np.isfinite(fine.height_m(lat, lon))
    on_coarse, on_fine = np.abs(above) < 1e-3, np.abs(above - 40.0) < 1e-3  # m
    assert inside.sum() > 200 and on_fine[inside].mean() > 0.99 and on_coarse[~inside].mean() > 0.99
    wall = above[~on_fine & ~on_coarse]  # rays that meet the fine grid's edge from the side
    assert np.all((wall > 0.0) & (wall < 40.0))
    low, high = tiles.height_range_m()
    highest = max(fine.height_range_m()[1], coarse.height_range_m()[1])
    assert (low, high) == (coarse.height_range_m()[0], highest)


def test_turned_tiles_become_one_raster_with_every_pixel_at_its_place():
    a, b, c, d, e, f = transform = (0.9, -0.4, 4.1e5, -0.3, -1.1, 5.2e6)  # turned and sheared
    heights = hills(*np.mgrid[0:60, 0:70])
    parts = []
    for row, column, rows, columns in ((30, 20, 30, 50), (0, 0, 60, 20), (0, 20, 30, 50)):
        corner = (c + a * column + b * row, f + d * column + e * row)
        part = heights[row : row + rows, column : column + columns]
        parts.append(Raster(part, (a, b, corner[0], d, e, corner[1]), "EPSG:32632"))
    (one,) = joined(parts, MOST)
    assert np.array_equal(one.heights_m, heights)
    assert one.transform == pytest.approx(transform, rel=1e-12)


def test_a_ray_through_a_hill_of_one_grid_does_not_meet_the_lower_ground_of_the_other_behind_it():
    heights = np.full((ROWS, COLUMNS), 200.0, np.float32)
    heights[:, 60:100] = 2600.0  # a ridge; the ray comes from the west and goes down
    step = (STEP, 0.0, WEST, 0.0, -STEP, NORTH)
    east = (STEP, 0.0, WEST + 120 * STEP, 0.0, -STEP, NORTH)
    west = grid(Raster(heights[:, :130], step, "EPSG:4326"))
    tiles = TerrainTiles((west, grid(Raster(heights[:, 120:], east, "EPSG:4326"))))
    lat = np.radians(NORTH - STEP * np.array([50.0, 90.0]))
    lon = np.radians(WEST + STEP * np.array([80.0, 150.0]))
    on_ridge = ecef_from_geodetic(lat, lon[:1].repeat(2), np.full(2, 2600.0), WGS84)
    behind = ecef_from_geodetic(lat, lon[1:].repeat(2), np.full(2, 200.0), WGS84)
    origin = on_ridge + 40.0 * (on_ridge - behind)
    height = geodetic_from_ecef(intersect(origin, behind - origin, tiles), WGS84)[2]
    assert height == pytest.approx([2600.0, 2600.0], abs=1e-3)  # m: the ridge, not the ground behind
