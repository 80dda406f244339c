"""The ground: seamless, the same from wherever it is asked for, changed only where another date says so."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from pyproj import Proj

from boresight.simulator.ground import BlurredGround, GroundImage, ImageGround, ProceduralGround
from boresight.simulator.lattice_noise import fractal, smooth_noise, white, white_at
from boresight.simulator.relief import relief_grid
from boresight.simulator.scenario import CloudSettings, GroundSettings, OtherDateSettings, TerrainSettings

SETTINGS = GroundSettings()
COLUMN, ROW = 200_000, -7_900_000  # somewhere in a UTM zone, texels of 0.5 m


def ground(date=0, key=5, **changes):
    return ProceduralGround(replace(SETTINGS, **changes), 0.5, key, date)


def test_white_noise_belongs_to_its_place():
    whole = white(-70, 1000, 400, 300, key=3)
    assert np.array_equal(white(-7, 1100, 140, 30, key=3), whole[100:130, 63:203])
    assert not np.array_equal(whole, white(-70, 1000, 400, 300, key=4))


def all_of_a_window(key):
    i, j = np.meshgrid(np.arange(1000), np.arange(1000))
    return white_at(i, j, key)


@pytest.mark.parametrize("noise", [white(0, 0, 1000, 1000, key=1), all_of_a_window(key=1)])
def test_white_noise_is_uniform_and_without_memory(noise):
    noise = noise.astype(float)
    assert abs(noise.mean()) < 5 * 0.577e-3  # a million numbers of sigma 0.577
    assert noise.var() == pytest.approx(1.0 / 3.0, rel=0.005)
    for shifted in (noise[1:], noise[:, 1:]):
        neighbour = noise[: shifted.shape[0], : shifted.shape[1]]
        assert abs((shifted * neighbour).mean()) < 5 / 3e3  # covariance of a million pairs


def test_no_texture_of_a_chip_comes_twice():
    """A chip of 128 px covers 256 texels. The texture of none is found again in the 3 km around it."""
    noise = white(0, 0, 4096, 4096, key=2)
    chip = noise[1300:1556, 2100:2356]
    found = cv2.matchTemplate(noise, chip, cv2.TM_CCOEFF_NORMED)
    found[1290:1311, 2090:2111] = 0.0
    # Chance: 15 million places of sigma 1 / 256; a square of the chip that comes again, a sixteenth.
    assert found.max() < 2.0 / 16.0


def test_fractal_noise_has_no_seams():
    whole = np.concatenate(list(fractal(-50, 301, 400, 300, 9, 6, 0.8)))
    part = np.concatenate(list(fractal(70, 351, 101, 99, 9, 6, 0.8)))
    assert np.array_equal(part, whole[50:149, 120:221])


def test_smooth_noise_is_smooth():
    x = np.linspace(0.0, 10.0, 10_001)
    noise = smooth_noise(x, np.full_like(x, 0.3), key=2)
    assert np.abs(np.diff(noise)).max() < 1e-3 * 4.0  # slope of the fade is at most 15 / 8 of a step of 2


def test_windows_of_the_ground_fit_together():
    blurred = BlurredGround(ground(), 1.2)
    whole = blurred.window(COLUMN - 300, ROW + 200, 1400, 1300)
    part = BlurredGround(ground(), 1.2).window(COLUMN + 500, ROW + 900, 200, 150)
    assert np.array_equal(part, whole[700:850, 800:1000])


def test_tiles_meet_without_an_edge():
    """Four tiles about a corner show what one piece of land without that corner shows."""
    column, row = (COLUMN // 1024 + 1) * 1024, (ROW // 1024 + 1) * 1024
    window = (column - 400, row - 400, 800, 800)
    tiles = BlurredGround(ground(), 1.2).window(*window)
    patch = ground().patch(column - 410, row - 410, 820, 820)
    whole = cv2.GaussianBlur(patch, (13, 13), np.sqrt(1.2**2 - 1.0 / 6.0))[10:-10, 10:-10]
    difference = np.abs(tiles - whole)
    assert (difference > 0.005).mean() < 2e-3  # edges of polygons that the rim of a tile cuts off elsewhere
    assert (difference[:, 390:410] > 0.005).mean() < 2e-3
    assert (difference[390:410] > 0.005).mean() < 2e-3


def test_patches_of_one_place_differ_by_less_than_their_rims():
    """Polygons cut off at another rim may be drawn a little differently along their edges, not elsewhere."""
    one, two = ground().patch(COLUMN, ROW, 600, 500), ground().patch(COLUMN + 37, ROW + 11, 500, 450)
    difference = np.abs(one[11:461, 37:537] - two)
    assert (difference > 0.02).mean() < 2e-3


def test_reflectance_and_contrast_are_those_of_land():
    patch = ground().patch(COLUMN, ROW, 2000, 2000)
    assert patch.dtype == np.float32
    assert 0.0 < patch.min() and patch.max() < 1.0
    assert 0.1 < patch.mean() < 0.35
    assert 0.05 < patch.std() < 0.2


def test_another_date_without_changes_shows_the_same_ground():
    assert np.array_equal(ground(0).patch(COLUMN, ROW, 300, 300), ground(1).patch(COLUMN, ROW, 300, 300))


@pytest.mark.parametrize(
    "other",
    [
        OtherDateSettings(gamma=1.4),
        OtherDateSettings(ramp=0.3),
        OtherDateSettings(changed_fields=0.5),
        OtherDateSettings(occlusion=0.3),
    ],
)
def test_another_date_changes_what_it_says(other):
    before = ground(0, other_date=other).patch(COLUMN, ROW, 900, 900)
    after = ground(1, other_date=other).patch(COLUMN, ROW, 900, 900)
    assert np.array_equal(before, ground(0).patch(COLUMN, ROW, 900, 900))
    changed = (np.abs(after - before) > 0.02).mean()
    assert changed > 0.02
    if other.changed_fields or other.occlusion:
        assert changed < 0.7


def test_clouds_cover_the_fraction_asked_for():
    cloudy = ground(1, cloud=CloudSettings(cover=0.3, size_km=0.15))
    clear = ground(0)
    window = (COLUMN, ROW, 2000, 2000)  # 1 km, some 11 clouds
    covered = (cloudy.patch(*window) - clear.patch(*window) > 0.3).mean()
    assert 0.12 < covered < 0.48  # clouds gather: one window of some tens of them


def test_a_user_s_image_lies_where_its_affine_says():
    rng = np.random.default_rng(1)
    image = rng.uniform(0.0, 100.0, (300, 400)).astype(np.float32)
    east, north, pixel = 500_000.0, 4_000_000.0, 1.0
    source = GroundImage(image, (pixel, 0.0, east, 0.0, -pixel, north), "EPSG:32648")
    ortho = ImageGround(source, 1.0, 32648)
    patch = ortho.patch(500_010, -4_000_000 + 20, 100, 80)
    low, high = np.quantile(image, [0.0, 0.999])
    expected = 0.9 * np.clip((image[20:100, 10:110] - low) / (high - low), 0.0, 1.0)
    assert np.abs(patch - expected).max() < 0.01  # OpenCV reads between pixels in steps of 1/32


def test_a_user_s_image_is_mirrored_beyond_its_borders():
    image = np.arange(200.0 * 100.0).reshape(100, 200)
    source = GroundImage(image, (1.0, 0.0, 500_000.0, 0.0, -1.0, 4_000_000.0), "EPSG:32648")
    ortho = ImageGround(source, 1.0, 32648)
    inside = ortho.patch(500_000, -4_000_000, 50, 40)
    mirrored = ortho.patch(500_000 - 49, -4_000_000, 50, 40)
    assert np.abs(mirrored[:, ::-1] - inside).max() < 0.01
    far = ortho.patch(900_000, -4_400_000, 50, 40)
    assert np.all((far >= 0.0) & (far <= 0.9))


def test_an_image_out_of_reach_is_told_with_the_place_of_its_middle():
    # 30 rows of 70 columns, turned: rows run east, columns south
    image = np.arange(30.0 * 70.0).reshape(30, 70)
    affine = (11.0, 5000.0, 40_000.0, -3000.0, 700.0, -90_000.0)
    crs = "+proj=ortho +lat_0=-33 +lon_0=-70 +a=6371000"  # half of the Earth has no place in its plane
    ortho = ImageGround(GroundImage(image, affine, crs), 1.0, 32648)
    east, north = 40_000.0 + 35 * 11.0 + 15 * 5000.0, -90_000.0 - 35 * 3000.0 + 15 * 700.0
    lon, lat = Proj(crs)(east, north, inverse=True)
    with pytest.raises(ValueError, match=rf"middle is at {lat:.2f} deg north, {lon:.2f} deg east: set orbit"):
        ortho.patch(500_000, -4_000_000, 50, 40)


def test_relief_has_its_mean_and_size_and_is_known_in_its_boxes_alone():
    settings = TerrainSettings(mean_m=500.0, relief_m=80.0, feature_km=3.0, spacing_arcsec=6.0)
    boxes = np.array([[30.0, 100.0, 30.6, 100.6], [31.0, 100.2, 31.2, 100.4]])
    heights, (a, _, west, _, e, north) = relief_grid(boxes, settings, key=4)
    known = heights[np.isfinite(heights)]
    assert known.mean() == pytest.approx(500.0, abs=15.0)  # some 400 hills of 80 m
    assert known.std() == pytest.approx(80.0, rel=0.2)
    row, column = int((30.8 - north) / e), int((100.3 - west) / a)
    assert np.isnan(heights[row, column])  # between the boxes
    assert np.isfinite(heights[int((31.1 - north) / e), column])
