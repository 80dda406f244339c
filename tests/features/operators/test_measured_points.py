"""Image points of other programs: each origin of pixels, sign of rows and coordinate system put right."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer
from rasterio.control import GroundControlPoint

from boresight.features.operators.point_import import (
    MeasuredPoints,
    PointErrors,
    points_csv,
    read_measured_points,
)
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.ground_points import read_points

ERRORS = PointErrors(sigma_px=0.3, sigma_m=(1.0, 2.0, 3.0), height_m=None)
LAT_LON = [[32.7, -16.95], [32.71, -16.9]]
XY = [[120.25, 3000.5], [2047.0, 17.0]]  # (0, 0) is the centre of the first pixel

ASP_POINT = "1 32 -16 5 1 1 1 i.tif 1 2 1 1\n"
MOON = 'GEOGCS["Moon",DATUM["Moon",SPHEROID["Moon",1737400,0]],PRIMEM["R",0],UNIT["degree",0.01745329252]]'
UTM = CRS.from_epsg(32628).to_wkt("WKT1_GDAL")


def check(found: MeasuredPoints) -> None:
    assert np.allclose(found.xy_px, XY, atol=1e-9)
    assert np.allclose(found.lat_lon_height[:, :2], LAT_LON, atol=1e-9)  # degrees: 0.1 mm


def test_qgis_points_count_from_the_corner_with_rows_upwards(tmp_path: Path) -> None:
    utm = Transformer.from_crs("EPSG:4326", "EPSG:32628", always_xy=True)
    rows = ["#CRS: EPSG:32628", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual", "0,0,1,-1,0,0,0,0"]
    for (lat, lon), (x, y) in zip(LAT_LON, XY):
        east, north = utm.transform(lon, lat)
        rows.append(f"{float(east)!r},{float(north)!r},{x + 0.5},{-(y + 0.5)},1,0,0,0")
    path = tmp_path / "a.points"
    path.write_text("\n".join(rows) + "\n")
    with pytest.raises(RawDataError, match="--height-m"):
        read_measured_points(path, ERRORS)
    found = read_measured_points(path, PointErrors(sigma_px=0.3, sigma_m=(1.0, 2.0, 3.0), height_m=12.0))
    check(found)
    assert found.n_disabled == 1 and found.lat_lon_height[0, 2] == 12.0


def test_points_of_asp_have_their_own_errors_and_images(tmp_path: Path) -> None:
    path = tmp_path / "a.gcp"
    lines = ["# id lat lon height"]
    for n, ((lat, lon), (x, y)) in enumerate(zip(LAT_LON, XY)):
        lines.append(f"{n} {lat!r} {lon!r} 55.5 1 2 3 left.tif {x} {y} 0.5 0.25 right.tif 1 2 1 1")
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(RawDataError, match="--image"):
        read_measured_points(path, ERRORS)
    found = read_measured_points(path, ERRORS, "left.tif")
    check(found)
    assert found.sigma_px.tolist() == [[0.5, 0.25]] * 2 and found.sigma_m.tolist() == [[1.0, 2.0, 3.0]] * 2
    assert found.lat_lon_height[:, 2].tolist() == [55.5, 55.5]


def test_ground_control_points_of_a_geotiff_count_from_the_corner(tmp_path: Path) -> None:
    gcps = [
        GroundControlPoint(row=y + 0.5, col=x + 0.5, x=lon, y=lat, z=55.5)
        for (lat, lon), (x, y) in zip(LAT_LON, XY)
    ]
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", width=8, height=8, count=1, dtype="uint8") as file:
        file.gcps = (gcps, rasterio.crs.CRS.from_epsg(4326))
        file.write(np.zeros((1, 8, 8), dtype=np.uint8))
    found = read_measured_points(path, ERRORS)
    check(found)
    assert found.lat_lon_height[:, 2].tolist() == [55.5, 55.5]


def test_datum_that_asp_writes_is_no_point_and_must_be_that_of_the_earth(tmp_path: Path) -> None:
    path = tmp_path / "a.gcp"
    path.write_text(f"# WKT: {CRS.from_epsg(4326).to_wkt('WKT1_GDAL')}\n{ASP_POINT}")
    assert read_measured_points(path, ERRORS).lat_lon_height.tolist() == [[32.0, -16.0, 5.0]]


def test_what_is_written_is_read_as_measured_points(tmp_path: Path) -> None:
    path = tmp_path / "a.gcp"
    path.write_text(
        "".join(
            f"{n} {a!r} {b!r} 5 1 2 3 i.tif {x} {y} 0.5 0.25\n"
            for n, ((a, b), (x, y)) in enumerate(zip(LAT_LON, XY))
        )
    )
    out = tmp_path / "points.csv"
    out.write_text(points_csv(read_measured_points(path, ERRORS), "s1", 2, "egm96"))
    (strip,), _ = read_points(out, "points.csv", {})
    assert strip.strip_id == "s1" and strip.ccd.tolist() == [2, 2]
    assert np.allclose(strip.xy_px, XY) and np.allclose(strip.cov_px[0], np.diag([0.25, 0.0625]))


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.gcp", "1 2 3\n", "line 1: found 3 words"),
        ("a.gcp", "1 32 -16 x 1 1 1 i.tif 1 2 1 1\n", "line 1, height: found x"),
        ("a.gcp", "# nothing\n", "points: found none"),
        ("a.points", "mapX,mapY\n1,2\n", "line 2: found no sourceX, expected a column sourceX or pixelX"),
        (
            "a.points",
            "#CRS: EPSG:4326\n\nmapX,mapY,pixelX,pixelY\n1,2,3,4\n1,2,3,b\n",
            "line 5, sourceY: found b",
        ),
        ("a.points", "#CRS: LOCAL\nmapX,mapY,sourceX,sourceY\n1,2,3,4\n", "CRS: found LOCAL"),
        ("a.gcp", f"# WKT: {MOON}\n{ASP_POINT}", "line 1, # WKT: found Moon, .*, expected .* on WGS 84"),
        ("a.gcp", f"# WKT: {UTM}\n{ASP_POINT}", "line 1, # WKT: found WGS 84 / UTM.*, expected .* on WGS 84"),
        ("a.gcp", f"# WKT: GEO[\n{ASP_POINT}", "line 1, # WKT: found GEO.*that PROJ knows"),
        ("a.points", "#CRS: nonsense\nmapX,mapY,sourceX,sourceY\n1,2,3,4\n", "CRS: found nonsense"),
        ("a.tif", "not a tiff", "a GeoTIFF with ground control points"),
        ("a.xyz", "", "ending: found .xyz"),
        (
            "a.points",
            "mapX,mapY,sourceX,sourceY,enable\n-16,9,32,7,100,25,-200,75,1\n",
            "line 2: found 9 cells, expected 5, with points in numbers",
        ),
    ],
)
def test_file_of_points_that_is_not_sound_is_refused(name, text, complaint, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(RawDataError, match=complaint):
        read_measured_points(
            tmp_path / name, PointErrors(sigma_px=1.0, sigma_m=(1.0, 1.0, 1.0), height_m=0.0)
        )
