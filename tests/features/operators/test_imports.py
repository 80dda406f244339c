"""Dumps made of operators' files give the same places as the operators' models, through the dump's reader."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from command_line import invoked, ran
from handmade_dimap import dimap_text
from handmade_sentinel2 import DATASTRIP, write_sentinel2
from scipy.spatial.transform import Rotation

from boresight.features.operators.dimap_grid import dimap_grid_differences
from boresight.features.operators.sentinel2_grid import operator_orbit, operator_pushbroom
from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.files.dimap_metadata import operator_model
from boresight.pipeline.files.dump import Dump, open_dump

POINTS = "id,strip,ccd,sample,line,sigma_sample_px,sigma_line_px,lat_deg,lon_deg,height_m,height_kind,"
POINTS += "sigma_east_m,sigma_north_m,sigma_up_m\n"
POINTS += "a,{strip},{ccd},3,100,0.1,0.1,10.0,20.0,50.0,ellipsoidal,1,1,1\n"


def model_of(dump: Dump, head: int = 0) -> Pushbroom:
    """The rigorous model that a dump's own files state."""
    source, strip = dump.heads[head].source, dump.strips[0]
    return Pushbroom(
        camera=dump.line_camera,
        rows=strip.clock,
        orbit=dump.orbit,
        earth=dump.orbit.earth,
        attitude=AttitudeTrack(
            source.rows.t_s, source.rows.R_si, dump.orbit, interpolation=dump.heads[head].interpolation
        ),
        R_cs=dump.heads[head].R_cs0,
        effects=dump.light,
    )


@pytest.fixture(scope="module")
def sentinel2(tmp_path_factory):
    """Datastrip, points and the dump of its corrected attitudes."""
    root = tmp_path_factory.mktemp("s2")
    datastrip = write_sentinel2(root)
    (root / "points.csv").write_text(POINTS.format(strip="B04", ccd=1))
    options = ("--gipp", root, "--band", "B04", "--points", root / "points.csv")
    said = ran("import", "sentinel2", datastrip, root / "corrected", *options, "--attitudes", "corrected")
    assert "2 CCDs, 1 points" in said.output
    ran("import", "sentinel2", datastrip, root / "raw", *options)
    return root


def test_places_of_an_imported_datastrip_are_the_operators(sentinel2):
    strip = read_sentinel2(sentinel2 / DATASTRIP, sentinel2, "B04")
    orbit = operator_orbit(strip, strip.earth_orientation)
    dump = open_dump(sentinel2 / "corrected")
    ours = model_of(dump)
    sample, line = np.array([0.0, 7.5, 23.0]), np.array([0.0, 1000.2, 4607.0])
    for ccd in (0, 1):
        theirs = operator_pushbroom(replace(strip, refining=None), ccd, orbit)
        expected = theirs.ground_points(ccd, sample, line, ConstantHeight(100.0))
        found = ours.ground_points(ccd, sample, line, ConstantHeight(100.0))
        assert np.isfinite(expected).all()
        # the orbit's nanosecond (7 um) and the OEM's micrometre; 1e-9 of a line in the offset of the CCD
        assert np.linalg.norm(found - expected, axis=1).max() < 1e-4  # m


@pytest.mark.parametrize(("east_m", "status"), [(0.0, 0), (1.0, 4)])
def test_check_against_a_grid_has_a_verdict_and_an_exit_status(sentinel2, tmp_path, east_m, status):
    strip = read_sentinel2(sentinel2 / DATASTRIP, sentinel2, "B04")
    orbit = operator_orbit(strip, strip.earth_orientation)
    rows = ["granule,detector,band,line,sample,lon,lat,alt\n"]
    for ccd in (0, 1):
        model = operator_pushbroom(strip, ccd, orbit)
        place = model.ground_points(ccd, [6.0], [1200.0], ConstantHeight(100.0))
        lat, lon, height = (float(v[0]) for v in geodetic_from_ecef(place, WGS84))
        lon += ccd * east_m / (6.378e6 * np.cos(lat))
        place = f"{float(np.degrees(lon))!r},{float(np.degrees(lat))!r},{height!r}"
        rows.append(f"G,{ccd + 1},B04,1201,6,{place}\n")
    (tmp_path / "grid.csv").write_text("".join(rows))
    asked = ("sentinel2", sentinel2 / DATASTRIP, "--gipp", sentinel2, "--band", "B04")
    told = ran(*asked, "--grid", tmp_path / "grid.csv", status=status)
    assert ("agrees with" in told.output) == (status == 0)
    assert ("line 3 of the grid: detector 2" in told.output) == (status == 4)


def test_places_of_a_dimap_are_compared_with_each_node_of_a_location_grid(tmp_path):
    (tmp_path / "DIM.XML").write_text(dimap_text())
    strip = operator_model(tmp_path / "DIM.XML")
    row, column = (axis.ravel() for axis in np.indices((3, 5)))
    bands, moved_m = [], {0.0: np.zeros(15), 800.0: 3.0 * (np.arange(15) == 7)}
    for altitude, off in moved_m.items():
        ground = ConstantHeight(altitude)
        places = strip.pushbroom.ground_points(0, 4e3 * column, 3e3 * row, ground)
        lat, lon, _ = geodetic_from_ecef(places, WGS84)
        bands += [np.degrees(lon), np.degrees(lat + off / 6.37e6)]
    nodes = np.reshape(bands, (4, 3, 5))
    placed = rasterio.Affine(4e3, 0.0, 0.5, 0.0, 3e3, 0.5)  # (0.5, 0.5): the centre of the first pixel
    form = {"driver": "GTiff", "count": 4, "height": 3, "width": 5, "dtype": "float64", "transform": placed}
    with rasterio.open(tmp_path / "GRID.tif", "w", **form) as grid:
        grid.write(nodes)
        grid.update_tags(ALTITUDE_B0="0", ALTITUDE_B2="800")
    found = np.array(dimap_grid_differences(strip, tmp_path / "GRID.tif"))
    expected = [[0.0, 0.0, 0.0], [800.0, 3.0 / np.sqrt(15.0), 3.0]]
    assert found == pytest.approx(np.array(expected), abs=0.03)  # m: 1 % of a meridian's radius


def test_rows_of_an_imported_strip_are_counted_from_the_earliest(sentinel2):
    # detector 02 begins 4 s after detector 01; the dump's times have nanoseconds
    dump = open_dump(sentinel2 / "corrected")
    strip = dump.strips[0]
    assert strip.first_row == pytest.approx({0: 0.0, 1: 4.0 / 1.5658e-3}, abs=2e-6)
    assert strip.lines == 4608 + int(np.ceil(4.0 / 1.5658e-3))
    assert strip.ccd_lines == {0: 4608, 1: 4608}
    assert dump.points[0].xy_px[0].tolist() == [3.0, 100.0]  # a line of its own detector


def test_trackers_are_heads_with_the_operators_mounting(sentinel2):
    raw, corrected = open_dump(sentinel2 / "raw"), open_dump(sentinel2 / "corrected")
    assert [head.name for head in raw.heads] == ["STR1", "STR2"]
    assert corrected.heads[0].interpolation == "taylor" and raw.heads[0].interpolation == "lagrange"
    R_ps = Rotation.from_quat([0.0, -0.8, 0.0, 0.6])
    assert (raw.heads[1].R_cs0 * (corrected.heads[0].R_cs0 * R_ps).inv()).magnitude() < 1e-12
    for head in (0, 1):  # noiseless attitudes of one body: the same place by either
        found = model_of(raw, head).ground_points(0, [5.0], [800.0], ConstantHeight(0.0))
        expected = model_of(corrected).ground_points(0, [5.0], [800.0], ConstantHeight(0.0))
        assert np.linalg.norm(found - expected) < 1e-3  # m; two interpolations of a smooth motion


def test_places_of_an_imported_pleiades_strip_are_the_operators(tmp_path):
    product = tmp_path / "dimap.xml"
    product.write_text(dimap_text().replace("48:55.449", "48:55.949"))
    strip = operator_model(product)
    (tmp_path / "points.csv").write_text(POINTS.format(strip="PAN", ccd=0))
    ran("import", "dimap", product, tmp_path / "dump", "--points", tmp_path / "points.csv")
    dump = open_dump(tmp_path / "dump")
    sample = np.array([0.0, 0.4 * strip.width_px, strip.width_px - 1.0])
    line = np.array([0.0, 0.3 * strip.height_px, strip.height_px - 1.0])
    expected = strip.pushbroom.ground_points(0, sample, line, ConstantHeight(0.0))
    found = model_of(dump).ground_points(0, sample, line, ConstantHeight(0.0))
    assert np.isfinite(expected).all()
    assert np.linalg.norm(found - expected, axis=1).max() < 1e-3  # m: nanoseconds, micrometres
    t_s, rows = dump.heads[0].source.rows.t_s, dump.strips[0].clock
    assert np.diff(t_s) == pytest.approx(0.1, abs=2e-9)  # s: nanoseconds of two times
    spare_s = rows.t_first_row_s - t_s[0], t_s[-1] - rows.t_first_row_s - 9000 * rows.row_period_s
    assert min(spare_s) > 0.499 and max(spare_s) < 0.601  # half a second, and on to a multiple of the step


def test_wrong_usage_is_told(sentinel2, tmp_path):
    asked = ("import", "sentinel2", sentinel2 / DATASTRIP)
    options = ("--gipp", sentinel2, "--band", "B04")
    choices = "'raw', 'corrected', 'refined'"
    for extra, said in (((), "not an empty folder"), (("--attitudes", "best"), choices)):
        assert said in ran(*asked, sentinel2 / "raw", *options, *extra, status=2).output
    refused = invoked(*asked, tmp_path / "new", "--gipp", tmp_path, "--band", "B04")
    assert refused.exit_code == 1 and "none of kind VIEDIR" in str(refused.exception)
