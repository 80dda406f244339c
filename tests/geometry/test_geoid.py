"""The geoid against NGA's published test points, and grids of the user's own."""

import numpy as np
import pytest
import rasterio
from rasters import write_raster

from boresight.geometry.geoid import Geoid, egm96

# INPUT.DAT and OUTINTPT.DAT of NGA's EGM96 interpolation program F477 (readme.txt of the WGS 84 EGM96 15'
# geoid): latitude, longitude (deg), geoid height (m).
NGA_TEST_POINTS = np.array(
    [
        [38.6281550, 269.7791550, -31.628],
        [-14.6212170, 305.0211140, -2.969],
        [46.8743190, 102.4487290, -43.575],
        [-23.6174460, 133.8747120, 15.871],
        [38.6254730, 359.9995000, 50.066],
        [-0.4667440, 0.0023000, 17.329],
    ]
)


def test_egm96_gives_the_published_test_points():
    # 0.01 m: the grid is in whole centimetres, and NGA's program interpolates a coarser one (15') by splines.
    lat, lon, expected = NGA_TEST_POINTS.T
    got = egm96().undulation_m(np.radians(lat), np.radians(lon))
    np.testing.assert_allclose(got, expected, rtol=0, atol=0.01)


def test_egm96_does_not_care_for_the_turn_of_longitude_and_holds_at_the_poles():
    lat, lon = np.radians([10.0, -33.0]), np.radians([179.97, -179.99])
    here = egm96().undulation_m(lat, lon)
    np.testing.assert_allclose(egm96().undulation_m(lat, lon + 2 * np.pi), here, rtol=0, atol=1e-9)
    np.testing.assert_allclose(egm96().undulation_m(lat, lon - 4 * np.pi), here, rtol=0, atol=1e-9)
    # NIMA TR8350.2: 13.61 m at the north pole, -29.53 m at the south pole, from every side
    around = np.linspace(-np.pi, np.pi, 9)
    np.testing.assert_allclose(egm96().undulation_m(np.pi / 2, around), 13.61, rtol=0, atol=0.006)
    np.testing.assert_allclose(egm96().undulation_m(-np.pi / 2, around), -29.53, rtol=0, atol=0.006)


def test_a_smooth_field_is_interpolated_to_the_third_order():
    # f = cos(3 lat) sin(5 lon) on a north-up grid of 1 deg: cubic convolution misses h^3 f''' / 20 or so.
    step = np.radians(1.0)
    lat, lon = np.radians(90.0 - np.arange(181.0)), np.radians(np.arange(360.0))
    grid = (np.cos(3 * lat)[:, None] * np.sin(5 * lon)).astype(np.float32)
    geoid = Geoid(grid, lat[0], lon[0], -step, step)
    rng = np.random.default_rng(5)
    at, to = rng.uniform(-1.5, 1.5, 1000), rng.uniform(-10.0, 10.0, 1000)
    np.testing.assert_allclose(geoid.undulation_m(at, to), np.cos(3 * at) * np.sin(5 * to), rtol=0, atol=1e-4)


def test_a_place_outside_a_regional_grid_is_an_error():
    step = np.radians(0.1)
    geoid = Geoid(np.zeros((11, 11), np.float32), np.radians(45.0), np.radians(10.0), step, step)
    assert geoid.undulation_m(np.radians(45.5), np.radians(370.5)) == 0.0
    for lat, lon in ((44.9, 10.5), (45.5, 11.2), (45.5, 9.9)):
        with pytest.raises(ValueError, match=f"latitude {lat}.*outside the geoid grid"):
            geoid.undulation_m(np.radians(lat), np.radians(lon))


@pytest.mark.parametrize("step_deg", [-0.2, 0.2])
def test_a_millionth_of_a_step_beyond_the_first_and_last_parallel_belongs_to_the_grid(step_deg):
    # 6 rows of 11 values; on the outermost parallels the undulation is that of their row, whichever is north
    grid = np.arange(66, dtype=np.float32).reshape(6, 11)
    lat, lon, step = np.radians(45.0), np.radians(10.0), np.radians(step_deg)
    geoid = Geoid(grid, lat, lon, step, np.radians(0.1))
    at = lon + np.radians(0.3)
    # 1e-4 m: the parallel is 11 m from the next, and single precision holds 66 m to 1e-5 m
    assert geoid.undulation_m(lat - 0.9e-6 * step, at) == pytest.approx(3.0, abs=1e-4)
    assert geoid.undulation_m(lat + (5.0 + 0.9e-6) * step, at) == pytest.approx(58.0, abs=1e-4)
    for row in (-1.1e-6, 5.0 + 1.1e-6):
        with pytest.raises(ValueError, match="outside the geoid grid"):
            geoid.undulation_m(lat + row * step, at)


def test_a_grid_with_holes_is_refused():
    grid = np.zeros((3, 3), np.float32)
    grid[1, 1] = np.nan
    with pytest.raises(ValueError, match="missing values"):
        Geoid(grid, 0.0, 0.0, 0.1, 0.1)


@pytest.mark.parametrize("driver", ["GTiff", "GTX"])
def test_a_grid_of_the_users_own_is_read_as_rasterio_gives_it(driver, tmp_path):
    # A piece of EGM96 written as a file and read back: the same undulations between its points. float32: 1e-5
    # m.
    step = 1.0 / 12.0
    lat, lon = 50.0 - step * np.arange(60), 14.0 + step * np.arange(70)
    piece = egm96().undulation_m(*np.meshgrid(np.radians(lat), np.radians(lon), indexing="ij"))
    path = tmp_path / f"geoid.{driver.lower()}"
    transform = rasterio.Affine(step, 0.0, lon[0] - 0.5 * step, 0.0, -step, lat[0] + 0.5 * step)
    write_raster(path, piece.astype(np.float32), driver=driver, crs="EPSG:4326", transform=transform)
    with rasterio.open(path) as file:
        geoid = Geoid.from_raster(file.read(1), file.transform)
    rng = np.random.default_rng(6)
    at, to = np.radians(rng.uniform(lat[-3], lat[2], 200)), np.radians(rng.uniform(lon[2], lon[-3], 200))
    np.testing.assert_allclose(geoid.undulation_m(at, to), egm96().undulation_m(at, to), rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="rows along parallels"):
        Geoid.from_raster(piece, (0.0, step, 14.0, -step, 0.0, 50.0))


@pytest.mark.parametrize("whole_earth", [True, False])
def test_crossings_of_parallels_and_meridians_have_the_bits_of_scattered_places(whole_earth: bool) -> None:
    geoid = egm96()
    lat = np.radians(np.r_[-90.0, np.linspace(-33.3, 41.7, 50), 90.0])
    lon = np.radians(np.linspace(-200.0, 500.0, 60))
    if not whole_earth:
        part = np.float32(0.01) * geoid.undulations[1300:1400, 2000:2200]
        geoid = Geoid(part, *np.radians([18.3, -13.3, 1 / 12, 1 / 12]))
        lat, lon = np.radians(np.linspace(18.31, 26.5, 70)), np.radians(np.linspace(-13.2, 3.2, 80))
    expected = geoid.undulation_m(lat[:, None], lon[None, :])
    np.testing.assert_array_equal(geoid.undulation_on_grid_m(lat, lon), expected)
    with pytest.raises(ValueError, match="outside the geoid grid"):
        geoid.undulation_on_grid_m(np.append(lat, np.radians(90.5)), lon)
