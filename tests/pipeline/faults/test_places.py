"""Strips over the pole and the 180th meridian: pixels to targets to places, and terrain that lies across."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.warp
from edits import replaced
from rasters import write_raster

from boresight.features.geolocate.positions import Pixels, ground_places
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.terrain import TerrainGrid
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.files.terrain_files import TerrainFiles, surface_of
from boresight.pipeline.results.reading import SavedResult
from boresight.pipeline.results.strip_model import Calibrated, StripModel
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.strip import StripTask, pushbroom_of, strip_matches, targets_near
from boresight.simulator import mission as rendering
from boresight.simulator.mission_records import Mission

SMALL = [
    *("strips.count=1", "strips.lines=600", "line_camera.ccds=1", "line_camera.rotation_urad=[12.0]"),
    *("line_camera.samples=256", "line_camera.principal_sample=127.0"),
    "line_camera.distortion_um=[[5.0,50.0],[17.0,40.0]]",
    *("targets.per_strip=8", "targets.check_points_per_strip=8", "targets.chip_size_px=64"),
    *("star_camera.width_px=64", "star_camera.height_px=48", "star_camera.rate_hz=2.0"),
    "terrain.spacing_arcsec=30.0",
    *("errors.gps_m=0.0", "errors.clock_s=0.0", "sky.hot_pixels=0", "sky.cosmic_rays=0"),
]  # fmt: skip
PLACES = {
    "180th meridian": ["orbit.longitude_deg=180.03", "orbit.latitude_deg=-17.0"],
    # An orbit that takes the satellite to within 20 m of the pole in the middle of the strip.
    "pole": "orbit.longitude_deg=200.0 orbit.latitude_deg=89.85 orbit.inclination_deg=89.9 "
    "orbit.descending=false".split(),
}

ACROSS = np.linspace(-3.0, 3.0, 160)
POLAR_HEIGHTS = (200.0 + 80.0 * np.sin(ACROSS)[:, None] * np.cos(1.7 * ACROSS)).astype(np.float32)
POLAR_AFFINE = (500.0, 0.0, -4e4, 0.0, -500.0, 4e4)  # 80 km around the pole


class PolarGround:
    """In the place of the simulator's ground, which is a grid of degrees."""

    @staticmethod
    def from_raster(heights: object, affine: object, crs: str, geoid: object) -> TerrainGrid:
        return TerrainGrid.from_raster(POLAR_HEIGHTS, POLAR_AFFINE, "EPSG:3995", None)


@pytest.fixture(scope="module", params=PLACES)
def flown(request, tmp_path_factory) -> tuple[str, Mission, Dump]:
    scenario = named_scenario("mini", [*SMALL, *PLACES[request.param]])
    root = tmp_path_factory.mktemp("place") / "dump"
    if request.param == "pole":
        with pytest.MonkeyPatch.context() as patch:
            # Degrees are no grid at the pole: the ground is a polar one, for the strip and for the user.
            patch.setattr(rendering, "relief_grid", lambda *arguments: (np.zeros((2, 2)), (1.0,) * 6))
            patch.setattr(rendering, "TerrainGrid", PolarGround)
            mission = fly(scenario, 3)
        write_dump(mission, root, created_by="a test")
        write_grid(root / "terrain/dem.tif", POLAR_HEIGHTS, 3995, rasterio.Affine(*POLAR_AFFINE))
        replaced(root / "dump.toml", '"egm96"', '"ellipsoidal"')
    else:
        mission = fly(scenario, 3)
        write_dump(mission, root, created_by="a test")
    return request.param, mission, open_dump(root)


def task_of(mission: Mission, dump: Dump) -> StripTask:
    """The strip with attitudes as they truly were, and the matrix as measured on the ground."""
    truth, (strip,) = mission.truth, dump.strips
    # The truth tells attitudes once a millisecond of the strip; the last row lies 0.1 ms before its end.
    t_s = truth.t_attitude_s[::49] + (mission.epoch.tai_s - dump.epoch.tai_s)
    R_si = truth.R_cs.inv() * truth.R_ci[::49]
    of_dump = {"orbit": dump.orbit, "targets": dump.targets, "chips": dump.chips, "terrain": dump.terrain}
    of_dump |= {"R_cs": dump.R_cs0, "sigma_installation_rad": dump.sigma_installation_rad}
    attitude = {"t_attitude_s": t_s, "R_si": R_si}
    how = {"camera": dump.line_camera, "effects": LightEffects(), "settings": Settings().match}
    task = StripTask(strip=strip, **of_dump, **attitude, **how)
    targets, _ = targets_near(task, dump.targets, dump.chips)
    assert len(targets) == len(dump.targets)
    return task


def test_targets_are_placed_where_they_are(flown) -> None:
    place, mission, dump = flown
    lon = np.array([target.lon_deg for target in mission.targets])
    if place == "pole":
        assert max(t.lat_deg for t in mission.targets) > 89.99 and np.ptp(lon % 360.0) > 90.0
    else:
        assert lon.min() < -179.9 and lon.max() > 179.9  # on either side
    result, omitted = strip_matches(task_of(mission, dump))
    assert result is not None and not omitted and not result.refused
    true = {point.point_id: (point.sample, point.line) for point in mission.truth.targets}
    for match in result.matches:
        # Noise and survey leave less than a tenth of a pixel; the search begins 250 px away.
        assert np.hypot(*(np.array(match.xy_px) - true[match.target_id])) < 0.3  # px
    assert len(result.matches) == len(mission.targets)


def test_pixels_are_placed_on_the_ground_and_found_again(flown) -> None:
    _, mission, dump = flown
    truth = mission.truth
    task = replace(task_of(mission, dump), R_cs=truth.R_cs)
    push = pushbroom_of(task)
    track = replace(push.attitude, cov_s=np.tile(1e-12 * np.eye(3), (len(task.t_attitude_s), 1, 1)))
    matrix = {"R_cs": truth.R_cs, "theta": np.zeros(3), "cov_theta": 1e-12 * np.eye(3), "installation": {}}
    no_exposures = {"exposure_id": [], "t_exposures_s": np.zeros(0), "usable": np.zeros(0, dtype=bool)}
    no_exposures |= {"R_si": task.R_si[:0], "covariance_s": np.zeros((0, 3, 3))}
    saved = SavedResult(**matrix, **no_exposures)
    of = {"folder": dump.root, "dump": dump, "sigma_terrain_m": 0.0, "exposure_margin_s": 1.0}
    calibrated = Calibrated(result=saved, **of)
    points = truth.check_points
    ccd, at = np.zeros(len(points), dtype=np.int64), np.array([[p.sample, p.line] for p in points])
    pixels = Pixels(ccd, *at.T)
    places = ground_places(calibrated, StripModel(task.strip, push, track), pixels, surface_of(dump.terrain))
    assert np.all((places.lon_deg >= -180.0) & (places.lon_deg <= 180.0))
    p_e = ecef_from_geodetic(np.radians(places.lat_deg), np.radians(places.lon_deg), places.height_m, WGS84)
    true_e = np.array([p.p_e for p in points])
    # Heights: exact with the terrain; at the pole those of the nearest target, where the ground is the geoid.
    # Distortion that the table leaves: 0.03 px of 6.4 m. Attitudes between the given ones: below 0.1 px.
    assert np.linalg.norm(p_e - true_e, axis=1).max() < 3.0  # m
    assert np.isfinite(places.sigma_along_m).all() and places.sigma_along_m.max() < 5.0
    sample, line = push.pixels_from_ground(0, p_e)
    np.testing.assert_allclose(sample, pixels.sample, atol=1e-4)  # px
    np.testing.assert_allclose(line, pixels.line, atol=1e-4)


def test_terrain_across_the_meridian_is_one_ground_however_it_is_written(tmp_path: Path) -> None:
    """A plane, given in degrees from 179.9 on, from -180.1 on, and on a map of UTM zone 60."""
    lat, lon = np.radians([-17.02, -17.0, -16.98]), np.radians([179.98, 180.0, -179.98])
    expected = 300.0 + 1000.0 * (np.degrees(lat) + 17.0) + 500.0 * np.array([-0.02, 0.0, 0.02])
    for name, epsg in (("east", 4326), ("west", 4326), ("utm", 32760)):
        if epsg == 4326:
            west, step = (179.9 if name == "east" else -180.1), (0.001, 0.001)
            corner = (west, -16.9)
        else:
            (x,), (y,) = rasterio.warp.transform("EPSG:4326", "EPSG:32760", [180.0], [-17.0])
            step, corner = (100.0, 100.0), (x - 1e4, y + 1e4)
        columns, rows = np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5)
        x, y = corner[0] + step[0] * columns, corner[1] - step[1] * rows
        if epsg != 4326:
            x, y = rasterio.warp.transform("EPSG:32760", "EPSG:4326", x.ravel(), y.ravel())
        east = (np.reshape(x, (200, 200)) - 180.0 + 180.0) % 360.0 - 180.0
        heights = (300.0 + 1000.0 * (np.reshape(y, (200, 200)) + 17.0) + 500.0 * east).astype(np.float32)
        path = tmp_path / f"{name}.tif"
        write_grid(path, heights, epsg, rasterio.Affine(step[0], 0, corner[0], 0, -step[1], corner[1]))
        surface = surface_of(TerrainFiles((path.name,), (path,), "ellipsoidal"))
        # Heights of some hundred metres in single precision, and a bend of the map below a millimetre.
        np.testing.assert_allclose(surface.height_m(lat, lon), expected, atol=2e-3)  # m
        np.testing.assert_allclose(surface.height_m(lat, lon - 2.0 * np.pi), expected, atol=2e-3)


def test_terrain_that_was_replaced_under_the_same_name_is_read_anew(tmp_path: Path) -> None:
    path, transform = tmp_path / "dem.tif", rasterio.Affine(0.01, 0, 10.0, 0, -0.01, 50.0)
    terrain = TerrainFiles((path.name,), (path,), "ellipsoidal")
    here = np.radians([49.5]), np.radians([10.5])
    for height in (100.0, 900.0):
        write_grid(path, np.full((200, 200), height, dtype=np.float32), 4326, transform)
        assert surface_of(terrain).height_m(*here) == height
        assert surface_of(terrain) is surface_of(terrain)


def test_polar_terrain_has_a_height_at_the_pole_and_on_every_meridian(tmp_path: Path) -> None:
    heights = np.add.outer(np.arange(200.0), np.arange(200.0)).astype(np.float32)
    path = tmp_path / "polar.tif"
    write_grid(path, heights, 3995, rasterio.Affine(100.0, 0, -1e4, 0, -100.0, 1e4))
    surface = surface_of(TerrainFiles((path.name,), (path,), "egm96"))
    lon = np.radians(np.arange(-180.0, 181.0, 15.0))
    pole = surface.height_m(np.full(len(lon), 0.5 * np.pi), lon)
    # Row + column at the middle of the grid, raised by the geoid (14.9 m at the pole); one place, one height.
    np.testing.assert_allclose(pole, pole[0], atol=1e-6)
    assert pole[0] == pytest.approx(199.0 + 13.606, abs=0.1)
    near = surface.height_m(np.full(len(lon), np.radians(89.95)), lon)
    assert np.isfinite(near).all() and near[0] == pytest.approx(near[-1], abs=1e-6)


def test_terrain_in_several_files_is_that_of_one(handmade: Path) -> None:
    rows, columns = np.meshgrid(np.arange(60.0), np.arange(80.0), indexing="ij")
    whole = (800.0 + 200.0 * np.sin(rows / 9.0) + 3.0 * columns).astype(np.float32)
    cut = {"west": (0, 45), "east": (45, 80), "all": (0, 80)}
    for name, (first, last) in cut.items():
        corner = rasterio.Affine(0.001, 0, 20.0 + 0.001 * first, 0, -0.001, 10.0)
        write_grid(handmade / f"{name}.tif", whole[:, first:last], 4326, corner)
    text = (handmade / "dump.toml").read_text() + '\n[terrain]\nheight_kind = "egm96"\nsigma_m = 5\n'
    lat = np.radians(9.9995 - 0.001 * rows[3:-3, 3:-3])
    lon = np.radians(20.0012 + 0.001 * columns[3:-3, 3:-3])
    heights = {}
    for names in ('"all.tif"', '["east.tif", "west.tif"]'):
        stated = text.replace('"targets.csv"', f'"targets.csv"\nterrain = {names}')
        (handmade / "dump.toml").write_text(stated)
        heights[names] = surface_of(open_dump(handmade).terrain).height_m(lat, lon)
    one, two = heights.values()
    assert np.isfinite(one).all() and np.abs(two - one).max() < 1e-3  # m: float32 of a thousand metres
    for names in ('["all.tif", "../all.tif"]', "[]", "3"):
        stated = text.replace('"targets.csv"', f'"targets.csv"\nterrain = {names}')
        (handmade / "dump.toml").write_text(stated)
        with pytest.raises(RawDataError) as caught:
            open_dump(handmade)
        assert caught.value.file == "dump.toml" and str(caught.value.field).startswith("files.terrain")


def write_grid(path: Path, values: np.ndarray, epsg: int, transform: rasterio.Affine) -> None:
    write_raster(path, values, crs=f"EPSG:{epsg}", transform=transform)


def test_longitudes_of_places_near_the_pole_are_those_of_the_ground(flown) -> None:
    _, mission, _ = flown
    p_e = np.array([point.p_e for point in mission.truth.check_points])
    lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
    np.testing.assert_allclose(np.degrees(lat), [p.lat_deg for p in mission.truth.check_points], atol=1e-10)
    np.testing.assert_allclose(np.degrees(lon), [p.lon_deg for p in mission.truth.check_points], atol=1e-10)
