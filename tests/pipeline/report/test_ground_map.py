"""Quicklooks of strips: each pixel has the grey value of the place where it lies."""

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import rasterio
from pyproj import Geod
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.gct_match.settings import MatchSettings
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, local_axes_e
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.report.budget_table import CONTEXT
from boresight.pipeline.report.ground_map import (
    BAND_LINES,
    MOST_SIDE_PX,
    NODES,
    RELIEF,
    SUN,
    MapScene,
    _joined,
    _lattice_map,
    _shaded,
    overview,
)
from boresight.pipeline.results.strip_model import open_calibrated, strip_model


@pytest.mark.parametrize(
    ("lines", "tile", "banded"), [(4000, 16, True), (4000, 512, False), (500, 16, False)]
)
def test_an_overview_of_a_slope_is_the_slope(lines: int, tile: int, banded: bool, tmp_path: Path) -> None:
    row, column = np.mgrid[:lines, :700]
    grey = 10 * row + 30 * column  # at most 60 970
    form = {"tiled": True, "blockxsize": 512, "blockysize": tile, "compress": "deflate"}
    with rasterio.open(
        tmp_path / "s.tif", "w", driver="GTiff", width=700, height=lines, count=1, dtype="uint16", **form
    ) as file:
        file.write(grey.astype(np.uint16), 1)
    strip = StripFiles(paths={0: tmp_path / "s.tif"}, names={0: "s.tif"}, shapes={0: (lines, 700)})
    found = overview(strip, 0, MatchSettings())
    (sample, line), (across, along) = found.first_px, found.pitch_px
    assert (along > across) == banded and (not banded or line == 0.5 * (BAND_LINES - 1))
    i, j = np.indices(found.means.shape)
    # means of integers are rounded once for each halving of the blocks' sides, 4 at most
    slope = 10 * (line + along * i) + 30 * (sample + across * j)
    np.testing.assert_allclose(found.means, slope, rtol=0.0, atol=0.5 * 4)


def test_residuals_in_metres_are_the_way_on_the_ground_of_the_rotated_look_direction(finished):
    """A look direction that is rotated by its residual meets the ground as far away as the table says."""
    dump, result = finished
    ground = pq.read_table(result / "evidence" / "ground.parquet").to_pandas()
    stored = pq.read_table(result / "sightings" / "targets.parquet").to_pandas()
    rows = ground[ground["state"] == "used"].merge(stored, on=["strip_id", "target_id", "ccd"])
    assert len(rows) >= 8
    model = strip_model(open_calibrated(result, dump), rows["strip_id"][0]).pushbroom
    for one in rows.itertuples():
        sample, line = np.array([one.sample_px]), np.array([one.line_px])
        axis = np.cross(one.u_c, [*one.residual_c, 0.0])
        rotated = model.with_installation(Rotation.from_rotvec(axis).inv() * model.R_cs)
        level = ConstantHeight(one.height_m)
        way_e = np.subtract(*(m.ground_points(one.ccd, sample, line, level)[0] for m in (rotated, model)))
        axes_e = local_axes_e(*np.radians([one.lat_deg, one.lon_deg]))
        east_north = (way_e @ axes_e)[:2]
        # 1 mm: residuals are decimetres, and turn the look by less than a pixel of some metres
        assert [one.residual_east_m, one.residual_north_m] == approx(east_north, abs=1e-3)
        assert one.residual_m == approx(np.hypot(*east_north), abs=1e-3)
        east, north, _ = model.orbit.velocities_e(np.array([one.t_s_x]))[0] @ axes_e
        flight = complex(east, north) / abs(complex(east, north))
        along_left = complex(*east_north) * flight.conjugate()
        # to the right is positive
        assert [one.residual_along_m, one.residual_across_m] == approx(
            [along_left.real, -along_left.imag], abs=1e-3
        )


def test_outlines_of_a_map_go_through_the_corners_of_the_corner_pixels(finished):
    dump, result = finished
    (scene,) = json.loads((result / CONTEXT).read_text())["scenes"]
    (strip,) = scene["strips"]
    calibrated = open_calibrated(result, dump)
    found, surface = strip_model(calibrated, strip["id"]), surface_of(calibrated.dump.terrain)
    for ccd, outline in enumerate(strip["outlines_m"]):
        lines, samples = found.strip.images.shape(ccd)
        corners = np.array(
            [[-0.5, -0.5], [samples - 0.5, -0.5], [samples - 0.5, lines - 0.5], [-0.5, lines - 0.5]]
        )
        places = geodetic_from_ecef(found.pushbroom.ground_points(ccd, *corners.T, surface))
        lat, lon = np.degrees(places[:2])
        # by the geodesic from the plane's origin: azimuthal equidistant
        azimuth, _, metres = Geod(ellps="WGS84").inv([scene["lon_deg"]] * 4, [scene["lat_deg"]] * 4, lon, lat)
        expected = np.array([metres * np.sin(np.radians(azimuth)), metres * np.cos(np.radians(azimuth))]).T
        drawn = np.array(outline)
        apart = np.linalg.norm(drawn[:, None] - expected, axis=2).min(axis=0)
        assert apart.max() < 0.2  # m: written to 0.1 m
        west, south, east, north = scene["box_m"]
        assert np.all((drawn > [west, south]) & (drawn < [east, north]))


class Slope:
    """Ground that rises evenly to the east and falls to the north of a place, metres a metre."""

    rise = 0.06, -0.11

    def height_m(self, lat_rad, lon_rad):
        azimuth, _, metres = Geod(ellps="WGS84").inv(
            np.full(lat_rad.shape, -71.0),
            np.full(lat_rad.shape, 44.0),
            np.degrees(lon_rad),
            np.degrees(lat_rad),
        )
        east, north = self.rise
        return metres * (east * np.sin(np.radians(azimuth)) + north * np.cos(np.radians(azimuth)))


@pytest.mark.parametrize(
    ("box_m", "shares"), [((-9e3, 1e3, 3e3, 5e3), (1 / 3, 1)), ((2e3, 1e3, 5e3, 13e3), (1, 1 / 4))]
)
def test_a_slope_is_as_light_as_it_is_turned_to_the_sun(box_m, shares):
    scene = MapScene(lat_deg=44.0, lon_deg=-71.0, strips=(), box_m=box_m)
    picture = _shaded(scene, Slope())
    assert picture.shape == tuple(round(share * MOST_SIDE_PX) for share in shares)
    up = np.array([*(-RELIEF * np.array(Slope.rise)), 1.0])
    grey = 255.0 * (0.25 + 0.75 * float(SUN @ up) / np.linalg.norm(up))
    # half a grey level of rounding, and what heights at pixels from node to node leave: 0.5 %
    inside = picture[1:-1, 1:-1]
    assert abs(float(inside.mean()) - grey) < 0.5 + 0.005 * grey and np.ptp(inside) <= 1


def test_a_picture_on_the_lattice_has_its_pixels_at_their_centres():
    rows, columns = 24, 60
    node_x, node_y = (np.linspace(-0.5, side - 0.5, NODES, dtype=np.float32) for side in (columns, rows))
    x, y = (
        cv2.remap(plane, *_lattice_map(rows, columns), cv2.INTER_LINEAR)
        for plane in np.meshgrid(node_x, node_y)
    )
    # OpenCV interpolates at 1/32 of a lattice step, of 2 px.
    np.testing.assert_allclose(x, np.broadcast_to(np.arange(columns), x.shape), atol=2.0 / 32.0)
    np.testing.assert_allclose(y, np.broadcast_to(np.arange(rows)[:, None], y.shape), atol=2.0 / 32.0)


def test_a_quicklook_of_two_ccds_is_grey_from_its_first_to_its_last_hundredth():
    left, right = (np.full((3, 200), np.nan, dtype=np.float32) for _ in range(2))
    left[0], left[1, :51] = 2000.0 + np.arange(200), 7.0  # 7: beneath the other CCD
    right[1] = 2200.0 + np.arange(200)
    seen = np.arange(400).reshape(2, 200)  # above the darkest grey value of 2000
    # percentiles 1 and 99 of 0 ... 399
    expected = np.clip(255.0 * (seen - 3.99) / (395.01 - 3.99), 0.0, 255.0)
    found = _joined([left, right])
    np.testing.assert_allclose(found[:2], expected, atol=0.51)  # rounded
    np.testing.assert_array_equal(found[2], 0)


def test_a_quicklook_shows_each_place_as_its_strip_does(finished):
    """Grey values of the page's picture of a strip against the raw image where the model sees each place."""
    dump, result = finished
    (scene,) = json.loads((result / CONTEXT).read_text())["scenes"]
    (kept,) = [
        one for one in pq.read_table(result / "evidence" / "map.parquet").to_pylist() if one["strip_id"]
    ]
    picture = cv2.imdecode(np.frombuffer(kept["jpeg"], np.uint8), cv2.IMREAD_GRAYSCALE)
    (west, south, east, north), (rows, columns) = kept["box_m"], picture.shape
    calibrated = open_calibrated(result, dump)
    found, surface = strip_model(calibrated, kept["strip_id"]), surface_of(calibrated.dump.terrain)
    i, j = (index.ravel() for index in np.mgrid[5 : rows - 5 : 9, 5 : columns - 5 : 9])
    east_m, north_m = west + (east - west) * (j + 0.5) / columns, north - (north - south) * (i + 0.5) / rows
    lon, lat, _ = Geod(ellps="WGS84").fwd(
        *(np.full(len(i), scene[name]) for name in ("lon_deg", "lat_deg")),
        np.degrees(np.arctan2(east_m, north_m)),
        np.hypot(east_m, north_m),
    )
    lat, lon = np.radians([lat, lon])
    ground_e = ecef_from_geodetic(lat, lon, surface.height_m(lat, lon))
    none = np.ones(len(i), dtype=bool)
    for ccd in found.strip.images.ccds:
        lines, samples = found.strip.images.shape(ccd)
        sample, line = found.pushbroom.pixels_from_ground(ccd, ground_e)
        inside = (sample > 3) & (sample < samples - 4) & (line > 3) & (line < lines - 4)
        raw = cv2.blur(found.strip.images.read(ccd, 0, lines, 0, samples).astype(np.float32), (5, 5))
        grey = raw[np.rint(line[inside]).astype(int), np.rint(sample[inside]).astype(int)]
        # of blocks and JPEG against means of 5 by 5 pixels; a picture a block aside has less than 0.9
        assert np.corrcoef(grey, picture[i[inside], j[inside]])[0, 1] > 0.95
        none &= (sample < -9) | (sample > samples + 8) | (line < -9) | (line > lines + 8)
    assert none.sum() > 200 and picture[i[none], j[none]].max() < 40  # black, as JPEG has it beside an edge
