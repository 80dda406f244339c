"""Strips: what stands on the ground appears where the rigorous model says, with the stated blur and noise."""

import numpy as np
import pytest
from pyproj import Transformer
from strips import pushbroom

from boresight.geometry.attitude import interpolation_weights
from boresight.geometry.constants import WGS84
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.line_camera import gaussian_sigma_px
from boresight.geometry.pushbroom import RowClock
from boresight.geometry.terrain import ConstantHeight, TerrainGrid
from boresight.simulator.cameras import (
    calibrated_line_camera,
    distorted_line_camera,
    installation_of_scenario,
)
from boresight.simulator.ground import BlurredGround, ProceduralGround
from boresight.simulator.motion import flown_orbit, true_attitude
from boresight.simulator.scan import (
    LineNodes,
    TrueScene,
    all_panels,
    needed_sample_step,
    panels_near,
    read_ground,
    scan,
)
from boresight.simulator.scenario import GroundSettings, scenario_from_dict

LINES, EPSG = 900, 32648
SCENARIO = scenario_from_dict(
    {
        "based_on": "mini",
        "attitude": {"roll_deg": 9.0, "pitch_deg": -3.0},
        "installation": {"zenith_distance_deg": 50.0, "azimuth_deg": 200.0, "turn_deg": 20.0},
        "errors": {"vibration_arcsec": 0.1},
        "ground": {
            "texels_per_pixel": 3.0,
            "pixel_gain_sigma": 0.0,
            "bits": 16,
            "dn_full_scale": 50000.0,
            "e_per_dn": 1e9,
            "read_noise_dn": 0.0,
        },
    }
)
TEXEL_M = SCENARIO.ground_pixel_m / SCENARIO.ground.texels_per_pixel


class Spots:
    """Dark ground with bright Gaussian spots, as sharp as texels allow, at given map places."""

    texel_m = TEXEL_M

    def __init__(self, east, north, sigma_texel=1.0):
        self._column, self._row = east / TEXEL_M - 0.5, -north / TEXEL_M - 0.5
        self._sigma = sigma_texel

    def patch(self, column, row, width, height):
        x, y = column + np.arange(width), row + np.arange(height)
        out = np.zeros((height, width), np.float32)
        for c, r in zip(self._column, self._row):
            if -20 < c - column < width + 20 and -20 < r - row < height + 20:
                across = np.exp(-0.5 * ((x - c) / self._sigma) ** 2)
                out += np.exp(-0.5 * ((y - r) / self._sigma) ** 2)[:, None] * across
        return out * np.float32(0.9)


class Flat:
    """Ground of one reflectance."""

    texel_m = TEXEL_M

    def __init__(self, reflectance):
        self._reflectance = reflectance

    def patch(self, column, row, width, height):
        return np.full((height, width), self._reflectance, np.float32)


@pytest.fixture(scope="module")
def model(tables):
    table, _ = tables
    earth = EarthRotation.over(Epoch.from_utc(SCENARIO.epoch_utc), -20.0, 20.0, table)
    orbit = flown_orbit(SCENARIO.orbit, -10.0, 12.0, earth)
    R_cs = installation_of_scenario(SCENARIO.installation)
    rng = np.random.default_rng(4)
    attitude = true_attitude(SCENARIO.attitude, SCENARIO.errors, R_cs, orbit, earth, rng)
    camera = distorted_line_camera(calibrated_line_camera(SCENARIO.line_camera), SCENARIO.errors, rng)
    rows = RowClock(2.0, SCENARIO.strips.row_period_s)
    return pushbroom(camera, rows, orbit, attitude.during(1.0, 5.0), R_cs)


@pytest.fixture(scope="module")
def surface(model, tables):
    """Hills under the strip: 12 m over a kilometre, with a sharp edge at every cell."""
    rng = np.random.default_rng(9)
    heights = 300.0 + 12.0 * rng.standard_normal((80, 80))
    middle = model.ground_points(1, np.array([500.0]), np.array([LINES / 2.0]), ConstantHeight(300.0))
    lat, lon, _ = geodetic_from_ecef(middle, WGS84)
    step = 0.01
    corner = np.degrees(lon[0]) - 40 * step, np.degrees(lat[0]) + 40 * step
    return TerrainGrid.from_raster(
        heights, (step, 0.0, corner[0], 0.0, -step, corner[1]), "EPSG:4326", tables[1]
    )


def rendered(model, surface, ground, ccd, sigma_texel=2.2, wanted=None):
    step = needed_sample_step(model, surface, LINES)
    blurred = BlurredGround(ground, sigma_texel)
    scene = TrueScene(model.tabulated(-10.0, LINES + 10.0), surface, EPSG, blurred, step)
    gain = np.ones(SCENARIO.line_camera.samples, np.float32)
    wanted = all_panels(LINES, len(gain)) if wanted is None else wanted
    rng = np.random.default_rng(3)
    return np.concatenate(list(scan(scene, ccd, LINES, SCENARIO.ground, gain, rng, 128, wanted)))


@pytest.mark.parametrize("ccd", [0, 3])
def test_points_appear_where_the_rigorous_model_says(model, surface, ccd):
    rng = np.random.default_rng(20 + ccd)
    sample, line = np.meshgrid(np.linspace(20, 490, 8), np.linspace(20, LINES - 20, 12))
    sample, line = (x.ravel() + rng.uniform(-4, 4, x.size) for x in (sample, line))
    p_e = model.ground_points(ccd, sample, line, surface)
    to_map = Transformer.from_crs(4978, EPSG, always_xy=True)
    east, north, _ = to_map.transform(*p_e.T)
    image = rendered(model, surface, Spots(east, north), ccd).astype(float)
    told_sample, told_line = model.pixels_from_ground(ccd, p_e)
    misses = []
    for s, r in zip(told_sample, told_line):
        x, y = round(s), round(r)
        part = image[y - 7 : y + 8, x - 7 : x + 8]
        rows, columns = np.indices(part.shape) - 7.0
        misses.append([(part * columns).sum() / part.sum() + x - s, (part * rows).sum() / part.sum() + y - r])
    misses = np.array(misses)
    assert len(misses) == 96
    # A spot is 0.8 px wide (1 sigma): sampling moves its centre by 1e-3 px, vibration across it by 0.01 px.
    assert np.abs(misses).max() < 0.02
    assert np.abs(misses.mean(axis=0)).max() < 0.002


def test_places_between_the_nodes_are_those_of_the_rigorous_model(model, surface):
    step = needed_sample_step(model, surface, LINES)
    scene = TrueScene(model, surface, EPSG, BlurredGround(Flat(0.4), 1.0), step)
    nodes = np.append(np.arange(0.0, 511.0, step), 511.0)
    samples, lines = np.arange(0.0, 512.0, 3.0), np.arange(100.0, 160.0)
    told = LineNodes.over(scene, 3, 90, 128, nodes).at(100, 60)
    true = scene.texels(3, samples, lines)
    for told_nodes, direct in zip(told, true):
        between = told_nodes @ interpolation_weights(nodes, samples).T
        miss_px = np.abs(between - direct) / SCENARIO.ground.texels_per_pixel
        assert miss_px.max() < 0.01  # px; the edges' share is held to 0.005 px on 999 of 1000 edges


def test_a_texture_is_blurred_to_the_stated_transfer_function(model, surface):
    """Stripes at half the Nyquist frequency of the texels come out as strong as the Gaussian says."""

    class Stripes:
        texel_m = TEXEL_M

        def patch(self, column, row, width, height):
            x = column + np.arange(width)
            wave = 0.5 + 0.4 * np.sin(2.0 * np.pi * x / 10.0)
            return np.broadcast_to(wave, (height, width)).astype(np.float32).copy()

    sigma = 1.8
    ground = BlurredGround(Stripes(), sigma)
    column = 1000.0 + np.arange(4000.0)[None, :] * 0.37
    seen = read_ground(ground, column, np.full_like(column, 50.3), np.random.default_rng(1))[0]
    phase = 2.0 * np.pi * column[0] / 10.0
    amplitude = 2.0 * np.hypot((seen * np.sin(phase)).mean(), (seen * np.cos(phase)).mean())
    expected = 0.4 * np.exp(-0.5 * (sigma * 2.0 * np.pi / 10.0) ** 2)
    assert amplitude == pytest.approx(expected, rel=0.02)  # higher terms of the linear interpolation


def plain(ground, column, row, sigma_texel):
    """Reflectance at texel coordinates: every texel around, weighted by the optics' Gaussian."""
    reach = int(np.ceil(5.0 * sigma_texel)) + 1
    left, top = int(column.min()) - reach - 1, int(row.min()) - reach - 1
    size = int(column.max()) + reach + 2 - left, int(row.max()) + reach + 2 - top
    texels = ground.patch(left, top, *size).astype(float)
    i, j = np.rint(column).astype(int), np.rint(row).astype(int)
    total, weights = np.zeros(column.shape), np.zeros(column.shape)
    for dj in range(-reach, reach + 1):
        for di in range(-reach, reach + 1):
            weight = np.exp(-0.5 * ((i + di - column) ** 2 + (j + dj - row) ** 2) / sigma_texel**2)
            total += weight * texels[j + dj - top, i + di - left]
            weights += weight
    return total / weights


@pytest.mark.parametrize("line", [40, 700])
def test_a_strip_is_what_the_plain_sum_over_texels_gives(model, surface, line):
    texels_per_pixel = GroundSettings().texels_per_pixel
    sigma_texel = gaussian_sigma_px(SCENARIO.ground.mtf_nyquist) * texels_per_pixel
    ground = ProceduralGround(SCENARIO.ground, SCENARIO.ground_pixel_m / texels_per_pixel, 5, 1)
    near = panels_near(np.array([[128.0, line + 60.0]]), 60.0, LINES, SCENARIO.line_camera.samples)
    image = rendered(model, surface, ground, 2, sigma_texel, near) / 50000.0 * 255.0
    lines, samples = np.arange(line, line + 120.0), np.arange(70.0, 190.0)
    scene = TrueScene(model, surface, EPSG, BlurredGround(ground, sigma_texel), 16)
    expected = 255.0 * plain(ground, *scene.texels(2, samples, lines), sigma_texel)
    difference = image[line : line + 120, 70:190] - expected
    assert expected.std() > 10.0  # DN of 8 bits: the land has contrast
    # The camera's own noise has 0.8 DN and more: linear interpolation between texels adds a fifth to its
    # variance here, where pixels of 8 m show much contrast; a fiftieth where they have 0.7 m.
    assert difference.std() < 0.35
    slopes = np.stack([slope.ravel() for slope in np.gradient(expected)])
    shift_px = np.linalg.solve(slopes @ slopes.T, slopes @ difference.ravel())
    assert np.abs(shift_px).max() < 0.005  # px: of a chip, whose matching is good to 0.01 px and more


def test_reading_the_ground_is_free_of_opencv_s_lattice():
    """OpenCV places samples on 1/32 texel; on average over many pixels the true place must come out."""

    class Ramp:
        texel_m = TEXEL_M

        def patch(self, column, row, width, height):
            x = column + np.arange(width, dtype=np.float32)
            return np.broadcast_to(x * np.float32(1e-3), (height, width)).copy()

    ground = BlurredGround(Ramp(), 0.0)
    for fraction in (0.01, 0.26, 0.49):  # of 1/32
        column = np.full((200, 200), 100.0 + fraction / 32.0)
        seen = read_ground(ground, column, np.full((200, 200), 20.5), np.random.default_rng(2))
        # 40 000 pixels, each uniform over 1/32 texel: 4.5e-5 texel; 16 bits: 1.5e-5 / 1e-3 texel, truncated.
        assert seen.mean() * 1e3 == pytest.approx(100.0 + fraction / 32.0, abs=0.012)


def test_noise_of_a_strip_is_read_and_photon_noise(model, surface):
    scenario = scenario_from_dict({"based_on": "mini", "ground": {"pixel_gain_sigma": 0.0}})
    ground = scenario.ground
    scene = TrueScene(model.tabulated(-10.0, 210.0), surface, EPSG, BlurredGround(Flat(0.4), 1.0), 16)
    gain = np.ones(512, np.float32)
    blocks = scan(scene, 1, 200, ground, gain, np.random.default_rng(3), 200, all_panels(200, len(gain)))
    image = np.concatenate(list(blocks)).astype(float)
    expected = ground.read_noise_dn**2 + 0.4 * 255.0 / ground.e_per_dn + 1.0 / 12.0
    # 102 400 pixels: variance to 0.44 %, five sigma.
    assert image.var() == pytest.approx(expected, rel=0.022)
    assert image.mean() == pytest.approx(0.4 * 255.0, abs=0.05)


def test_a_look_past_the_terrain_is_an_error(model, tables):
    heights = np.zeros((4, 4))
    far = TerrainGrid.from_raster(heights, (0.1, 0.0, 0.0, 0.0, -0.1, 0.0), "EPSG:4326", tables[1])
    scene = TrueScene(model, far, EPSG, BlurredGround(Flat(0.4), 1.0), 16)
    with pytest.raises(ValueError, match="miss the terrain"):
        scene.texels(0, np.array([0.0, 511.0]), np.array([0.0, 1.0]))


def test_ccds_overlap_by_what_was_asked_for():
    settings = SCENARIO.line_camera
    camera = calibrated_line_camera(settings)
    for left, right in zip(camera.ccds, camera.ccds[1:]):
        first_of_right = right.focal_plane(np.array([0.0]))[0, 1]
        sample, _ = left.samples(np.array([[left.x_offset_m, first_of_right]]))
        assert settings.samples - sample[0] == pytest.approx(settings.overlap_px, abs=0.05)  # rotated: µrad
    first, last = camera.ccds[0], camera.ccds[-1]
    ends = [first.focal_plane(np.array([0.0]))[0, 1], last.focal_plane(np.array([511.0]))[0, 1]]
    assert sum(ends) == pytest.approx(0.0, abs=1e-5)  # m


def test_distortion_tables_meet_the_papers_printed_entries():
    camera = calibrated_line_camera(scenario_from_dict({"based_on": "paper"}).line_camera)
    ccd = camera.ccds[2]
    plain = ccd.y_first_m + np.array([56.0, 203.0, 3067.0]) * ccd.pixel_m
    offsets = plain - ccd.focal_plane(np.array([56.0, 203.0, 3067.0]))[:, 1]
    assert offsets * 1e6 == pytest.approx([1077.2, 866.3, 0.0], abs=0.05)  # um; the spline between 49 entries


def test_targets_lie_in_their_chips_middle(mission):
    for target, chip in zip(mission.targets, mission.chips):
        to_map = Transformer.from_crs(4326, chip.epsg, always_xy=True)
        east, north = to_map.transform(target.lon_deg, target.lat_deg)
        a, _, c, _, e, f = chip.affine
        column, row = (east - c) / a, (north - f) / e
        assert column == pytest.approx(chip.image.shape[1] / 2, abs=1e-3)  # px; rounding of degrees
        assert row == pytest.approx(chip.image.shape[0] / 2, abs=1e-3)


def test_panels_near_a_place_are_all_that_a_square_around_it_touches():
    near = panels_near(np.array([[600.0, 250.0], [0.0, 999.0]]), 30.0, 1000, 1100)
    assert near.shape == all_panels(1000, 1100).shape == (4, 3)
    assert np.argwhere(near).tolist() == [[0, 1], [1, 1], [3, 0]]


def test_panels_that_nobody_wants_are_zeros_and_the_others_show_the_ground(model, surface):
    wanted = panels_near(np.array([[100.0, 100.0]]), 20.0, LINES, SCENARIO.line_camera.samples)
    wanted[1:] = False
    whole, some = (
        rendered(model, surface, Flat(0.4), 1, wanted=each) for each in (np.ones_like(wanted), wanted)
    )
    np.testing.assert_array_equal(some[:256], whole[:256])
    assert whole[256:].min() > 0 and not some[256:].any()
