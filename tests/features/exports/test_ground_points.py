"""Ground control points read back as the formats' own descriptions say."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from orbiting_camera import LINES, NOTES, strip

from boresight.features.exports.ground_control_points import (
    GroundPoints,
    points_asp,
    points_envi,
    points_geojson,
    points_qgis,
)
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.geoid import egm96
from boresight.geometry.pushbroom import outline_deg
from boresight.geometry.terrain import ConstantHeight

POINTS = GroundPoints(
    strip_id="S01",
    ccd=2,
    image="strips/S01-2.tif",
    target_id=("T1", "T2", "T3"),
    lat_deg=np.array([36.1, 46.874319, 80.5]),
    lon_deg=np.array([103.2, 102.448729, 179.999]),
    height_m=np.array([1500.25, 3800.0, -20.5]),
    xy_px=np.array([[0.0, 0.0], [100.25, 2000.5], [511.0, 7.125]]),
    sigma_px=np.full((3, 2), 0.05),
    residual_px=np.array([[0.3, -0.4], [0.0, 0.0], [np.nan, np.nan]]),
    sigma_m=np.array([[1.0, 2.0, 3.0]] * 3),
    used=np.array([True, True, False]),
)


def test_geojson_says_longitude_first_and_keeps_every_digit():
    # RFC 7946: position = longitude, latitude, height above WGS84
    content = json.loads(points_geojson([POINTS], NOTES))
    assert content["type"] == "FeatureCollection"
    for n, feature in enumerate(content["features"]):
        assert feature["geometry"] == {
            "type": "Point",
            "coordinates": [POINTS.lon_deg[n], POINTS.lat_deg[n], POINTS.height_m[n]],
        }
        properties = feature["properties"]
        assert (properties["sample"], properties["line"]) == tuple(POINTS.xy_px[n])
        stated = tuple(properties[key] for key in ("target", "strip", "ccd"))
        assert stated == (POINTS.target_id[n], "S01", 2)
        assert properties["used"] is bool(POINTS.used[n])


def test_envi_counts_from_the_corner_of_pixel_one_and_wants_heights_above_the_geoid():
    text = points_envi(POINTS, NOTES, egm96())
    rows = [line.split() for line in text.splitlines() if not line.startswith(";")]
    assert "projection info = {Geographic Lat/Lon, WGS-84, units=Degrees}" in text
    assert len(rows) == 2  # the rejected one is not among them
    lon, lat, height, x, y = (float(value) for value in rows[1])
    assert (lon, lat, x, y) == (102.448729, 46.874319, 101.75, 2002.0)
    # NGA's test output for its EGM96 program here: -43.575 m; the shipped 5' grid is within 0.5 m.
    assert 3800.0 - height == pytest.approx(-43.575, abs=0.5)


def test_qgis_counts_rows_downwards_with_a_minus():
    lines = points_qgis(POINTS, NOTES).splitlines()
    assert lines[0].startswith("#CRS: GEOGCRS[")
    rows = list(csv.DictReader(io.StringIO("\n".join(lines[1:]))))
    assert [row["enable"] for row in rows] == ["1", "1", "0"]
    assert (float(rows[1]["sourceX"]), float(rows[1]["sourceY"])) == (100.75, -2001.0)
    assert [float(rows[0][key]) for key in ("dX", "dY", "residual")] == [0.3, 0.4, 0.5]
    assert (float(rows[1]["mapX"]), float(rows[1]["mapY"])) == (102.448729, 46.874319)


def test_qgis_crs_is_one_that_proj_understands():
    pyproj = pytest.importorskip("pyproj")
    crs = pyproj.CRS.from_wkt(points_qgis(POINTS, NOTES).splitlines()[0][6:])
    assert crs.equals(pyproj.CRS.from_epsg(4326)) and "dump: d1" in crs.remarks


def test_asp_has_sigmas_north_first_and_leaves_out_the_rejected_one():
    """Ames Stereo Pipeline, bundle_adjust: id lat lon height 3 sigma_m image x y 2 sigma_px."""
    rows = [line.split() for line in points_asp(POINTS, NOTES).splitlines() if not line.startswith("#")]
    assert len(rows) == 2 and all(len(row) == 12 for row in rows)
    numbers = [float(value) for value in rows[1][:7] + rows[1][8:]]
    assert numbers == [1, 46.874319, 102.448729, 3800.0, 2, 1, 3, 100.25, 2000.5, 0.05, 0.05]
    assert rows[1][7] == "strips/S01-2.tif"


def test_arrays_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="sigma_px"):
        replace(POINTS, sigma_px=np.ones((2, 2)))


def test_the_outline_of_a_strip_is_that_of_the_ground_points_of_its_outer_samples():
    surface, model = ConstantHeight(120.0), strip()
    lon, lat = outline_deg(model, {0: LINES, 1: LINES}, surface).T
    corners = [
        np.degrees(
            geodetic_from_ecef(model.ground_points(ccd, sample, [0.0, LINES - 1.0], surface), WGS84)[:2]
        )
        for ccd, sample in ((0, 0.0), (1, 2047.0))
    ]
    found = {(round(a, 7), round(b, 7)) for a, b in zip(lat, lon)}
    for lats, lons in corners:
        assert {(round(a, 7), round(b, 7)) for a, b in zip(lats, lons)} <= found
