"""A real sensor: the operator's own location grid of a Pleiades strip; and damaged files."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from edits import replaced
from handmade_dimap import as_version_2, dimap_text

from boresight.geometry.constants import WGS84
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dimap_metadata import read_dimap

REAL = Path(__file__).parents[3] / ".." / "shared" / "data" / "pleiades"
DIMAP = REAL / "PHRDIMAP_P1BP--2018122638935449CP.XML"
GRID = REAL / "GRID_P1BP--2018122638935449CP.tif"
OFF = LightEffects(light_time=False, aberration=False, refraction=False)  # the operator left them out

needs_real_data = pytest.mark.skipif(
    not (DIMAP.exists() and GRID.exists()),
    reason=f"the real Pleiades metadata and location grid are not there: {REAL}",
)


def read(path, effects=OFF):
    return read_dimap(path, bundled_earth_orientation(), effects)


@pytest.fixture(scope="module")
def strip():
    return read(DIMAP)


@pytest.fixture(scope="module")
def operator_grid():
    """Samples and lines of 65 x 65 nodes, altitudes (9,), places of the nodes at each altitude (9, N, 3)."""
    with rasterio.open(GRID) as raster:
        bands, tags, t = raster.read(), raster.tags(), raster.transform
    column, row = (axis.ravel() for axis in np.meshgrid(np.arange(65), np.arange(65)))
    # the grid's origin (0.5, 0.5) is the centre of the first pixel, which is (0, 0) here
    sample, line = t.a * column + t.c - 0.5, t.e * row + t.f - 0.5
    altitudes = np.array([float(tags[f"ALTITUDE_B{2 * k}"]) for k in range(9)])
    places = [
        ecef_from_geodetic(np.radians(bands[2 * k + 1].ravel()), np.radians(bands[2 * k].ravel()), h, WGS84)
        for k, h in enumerate(altitudes)
    ]
    return sample, line, altitudes, np.array(places)


@needs_real_data
def test_pixels_of_a_real_strip_lie_where_its_operator_puts_them(strip, operator_grid):
    # 1 mm rms is what the metadata's own rounding (positions to 1 mm) allows; measured: 0.2 mm.
    sample, line, altitudes, places = operator_grid
    for altitude, operator in zip(altitudes, places):
        ours = strip.pushbroom.ground_points(0, sample, line, ConstantHeight(altitude))
        assert np.sqrt(((ours - operator) ** 2).sum(axis=1).mean()) < 1e-3  # m


@needs_real_data
def test_places_of_the_operator_are_found_in_the_pixels_he_gives_them(strip, operator_grid):
    # 1 mm at 0.7 m per pixel is 0.0015 px.
    sample, line, _, places = operator_grid
    for k in (0, 4, 8):
        inside = slice(65 * 3, -65 * 3)
        found = strip.pushbroom.pixels_from_ground(0, places[k][inside])
        assert np.abs(found[0] - sample[inside]).max() < 2e-3
        assert np.abs(found[1] - line[inside]).max() < 2e-3


@needs_real_data
def test_light_effects_move_the_real_strip_by_what_physics_says(strip, operator_grid):
    # Aberration: v/c times 695 km of range = 17.7 m; light time: 0.46 km/s cos(31 deg) times 2.3 ms.
    sample, line, altitudes, places = operator_grid
    for effects, low, high in (
        (LightEffects(light_time=False, aberration=True, refraction=False), 17.0, 18.5),
        (LightEffects(light_time=True, aberration=False, refraction=False), 0.85, 1.0),
    ):
        seen = read(DIMAP, effects)
        moved = seen.pushbroom.ground_points(0, sample, line, ConstantHeight(altitudes[0])) - places[0]
        size = np.linalg.norm(moved, axis=1)
        assert low < size.min() and size.max() < high


@needs_real_data
@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("<OFFSET>38936.90625</OFFSET>", "", "OFFSET"),
        ("<OFFSET>38936.90625</OFFSET>", "<OFFSET>nan</OFFSET>", "OFFSET"),
        ("0.0735<", "-1<", "SENSOR_LINE_PERIOD"),
        ("2018-12-26T10:48:55.4490000Z", "yesterday", "START"),
        ("10:47:23.000000Z</UTC_TIME>", "10:46:23.000000Z</UTC_TIME>", "UTC_TIME"),
        ('<LOCATION_VALUES unit="m">5447304.949 ', '<LOCATION_VALUES unit="m">', "LOCATION_VALUES"),
        ("<NCOLS>40000<", "<NCOLS>-5<", "NCOLS"),
        ("<PHR_Dimap_Document>", "<!DOCTYPE d [<!ENTITY a 'b'>]><PHR_Dimap_Document>", "XML"),
        ("</PHR_Dimap_Document>", "", "XML"),
    ],
)
def test_damaged_metadata_is_refused_by_file_and_field(tmp_path, old, new, field):
    damaged = shutil.copy(DIMAP, tmp_path / "damaged.xml")
    replaced(damaged, old, new)
    with pytest.raises(RawDataError, match=rf"^damaged\.xml: [^:]*{field}"):
        read(damaged)


ENTITIES = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><x>&b;</x>'
SPOT_5 = "<Scene_Source><MISSION>SPOT</MISSION><MISSION_INDEX>5</MISSION_INDEX></Scene_Source>"
RPC = "<METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE><METADATA_SUBPROFILE>RPC</METADATA_SUBPROFILE>"
DAMAGED = {
    "entities": (ENTITIES, "without DTD"),
    "SPOT 5": (f"<Dimap_Document>{SPOT_5}</Dimap_Document>", "Dimap_Document SPOT 5"),
    "RPC": (
        f"<Dimap_Document><Metadata_Identification>{RPC}</Metadata_Identification></Dimap_Document>",
        "found Dimap_Document PHR_SENSOR RPC without Geometric_Data/Refined",
    ),
    "states of another time than the attitudes": (
        dimap_text().replace("10:48:55.4490000Z", "10:58:55.4490000Z"),
        "no interval in common, expected a strip that a satellite can",
    ),
    "lists of another period": (
        as_version_2(dimap_text()).replace("<LINE_PERIOD>0.0735<", "<LINE_PERIOD>0.1<"),
        "^a.xml: [^:]*LINE_PERIOD",
    ),
    "another model": (as_version_2(dimap_text()).replace("Refined_Model>", "Other>"), "^a.xml: root element"),
    "no such polynomial": (as_version_2(dimap_text()).replace("XLOS_0>", "XLOS_9>"), "^a.xml: [^:]*XLOS_0"),
    "no offset": (as_version_2(dimap_text()).replace("<OFFSET>38935.0</OFFSET>", ""), "^a.xml: [^:]*OFFSET"),
    "quaternions that are none": (
        as_version_2(dimap_text(), listed=True).replace("<Q0>0.", "<Q0>0.9", 1),
        "length",
    ),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_what_is_no_sound_product_is_refused_by_what_it_is(damage, tmp_path):
    text, says = DAMAGED[damage]
    assert text not in (dimap_text(), as_version_2(dimap_text()), as_version_2(dimap_text(), listed=True))
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(RawDataError, match=says):
        read(tmp_path / "a.xml")


VERSIONS_2 = [{}, {"first_col": 20_001}, {"listed": True, "microseconds": True}]
SAMPLE, LINE = np.array([0.0, 7_000.3, 19_999.0]), np.array([0.0, 4_200.7, 8_999.0])


def places(path, sample=SAMPLE, line=LINE):
    found = read(path).pushbroom
    return found.ground_points(0, sample, line, ConstantHeight(120.0))


@pytest.mark.parametrize("options", VERSIONS_2, ids=["polynomials", "other column", "list, microseconds"])
def test_product_in_version_2_has_the_places_of_version_1(tmp_path, options):
    (tmp_path / "v1.xml").write_text(dimap_text())
    (tmp_path / "v2.xml").write_text(as_version_2(dimap_text(), **options))
    expected = places(tmp_path / "v1.xml")
    # millimetres of the positions, and degree 7 in place of all points
    assert np.isfinite(expected).all()
    assert np.linalg.norm(places(tmp_path / "v2.xml") - expected, axis=1).max() < 2e-3  # m


@pytest.mark.parametrize("inertial", [True, False])
@pytest.mark.parametrize("states", [9, 2])
def test_velocities_are_relative_to_whichever_axes_the_positions_show(tmp_path, inertial, states):
    text = dimap_text()
    if states == 2:  # those around the image
        kept = re.findall(r"<Point>.*?</Point>", text)[3:5]
        text = re.sub(r"<Point_List>.*</Point_List>", f"<Point_List>{''.join(kept)}</Point_List>", text)
    if not inertial:
        omega = 7.292115e-5
        text = re.sub(r"(<VELOCITY_VALUES>\S+ )\S+", r"\g<1>0.0", text)
        assert f"{omega * 7_064_000.0:.6f}" not in text
    (tmp_path / "dimap.xml").write_text(text)
    orbit = read(tmp_path / "dimap.xml").pushbroom.orbit
    assert len(orbit.t_s) == states
    assert np.abs(orbit.velocities_m_s[:, 1]).max() < 1e-3  # m/s: the handmade orbit stays on a meridian


def test_sample_0_looks_to_the_side_of_minus_psi_x(tmp_path):
    # psi_x of column 0 is -0.01, so that u_y is +0.01; the handmade quaternion rotates about y, the orbit
    # stays on meridian 0: the line of sight leaves it eastwards by 0.01 of the distance to the ground, less
    # 1.3e-4 by which the quaternion's polynomials have turned about z until then.
    (tmp_path / "dimap.xml").write_text(dimap_text())
    strip = read(tmp_path / "dimap.xml")
    first, last = strip.pushbroom.ground_points(0, [0.0, 19_999.0], [0.0, 0.0], ConstantHeight(0.0))
    satellite = strip.pushbroom.orbit.positions_e(strip.pushbroom.instants(np.zeros(1)))[0]
    assert first[1] == pytest.approx(0.01 * np.linalg.norm(first - satellite), rel=0.02)
    assert last[1] == pytest.approx(-0.009999 * np.linalg.norm(last - satellite), rel=0.02)


def test_last_column_may_be_one_beyond_the_image_but_not_two(tmp_path):
    for last, good in ((20_001, True), (20_002, False), (19_999, False)):
        text = dimap_text().replace("<LAST_COL>20000<", f"<LAST_COL>{last}<")
        (tmp_path / "dimap.xml").write_text(text)
        if good:
            assert read(tmp_path / "dimap.xml").width_px == 20_000
            continue
        with pytest.raises(RawDataError, match="columns, or one more"):
            read(tmp_path / "dimap.xml")


def test_product_whose_corners_lie_elsewhere_is_refused(tmp_path, monkeypatch):
    (tmp_path / "dimap.xml").write_text(dimap_text())
    model = read(tmp_path / "dimap.xml").pushbroom
    column, row = np.array([1.0, 20_000.0]), np.array([1.0, 9_000.0])
    lat, lon, _ = geodetic_from_ecef(
        model.ground_points(0, column - 1.0, row - 1.0, ConstantHeight(800.0)), WGS84
    )

    def framed(east_deg):
        vertices = "".join(
            f"<Vertex><LON>{x + east_deg!r}</LON><LAT>{y!r}</LAT><COL>{c:g}</COL><ROW>{r:g}</ROW></Vertex>"
            for x, y, c, r in zip(np.degrees(lon).tolist(), np.degrees(lat).tolist(), column, row)
        )
        frame = f"<Product_Frame><Dataset_Frame>{vertices}</Dataset_Frame></Product_Frame>"
        path = tmp_path / "framed.xml"
        path.write_text(dimap_text().replace("<Geometric_Data>", f"{frame}<Geometric_Data>"))
        return read(path)

    assert framed(0.0).width_px == 20_000  # the height of 800 m is not stated
    with pytest.raises(RawDataError, match=r"COL 1, ROW 1.* m from the line of sight of its pixel"):
        framed(0.05)
    monkeypatch.setattr("boresight.pipeline.files.dimap_metadata._CORNER_M", 0.2)  # a third of a pixel
    assert framed(0.0).width_px == 20_000


def dense(text, first_s, count):
    """A product of V2 with states and quaternions every 4.363 ms from `first_s` after START on."""
    path = Path(text)
    model = read(path).pushbroom
    t_s = model.rows.t_first_row_s + first_s + 4.363e-3 * np.arange(count)
    utc = model.orbit.epoch.utc_from_seconds(t_s)
    states = zip(model.orbit.positions_e(t_s), model.orbit.velocities_e(t_s), utc)
    points = "".join(
        f"<Point><LOCATION_XYZ>{x:.4f} {y:.4f} {z:.4f}</LOCATION_XYZ><VELOCITY_XYZ>{u:.3f} {v:.3f} {w:.3f}"
        f"</VELOCITY_XYZ><TIME>{time}</TIME></Point>"
        for (x, y, z), (u, v, w), time in states
    )
    t_s = np.concatenate([[t_s[0] - 4.363e-3], t_s, [t_s[-1] + 4.363e-3]])
    R_es = (model.attitude.R_si(t_s) * model.earth.rotations_ie(t_s)).inv()
    quaternions = "".join(
        f"<Quaternion><Q_STATUS>NOMINAL</Q_STATUS><Q0>{w!r}</Q0><Q1>{x!r}</Q1><Q2>{y!r}</Q2><Q3>{z!r}</Q3>"
        f"<TIME>{time}</TIME></Quaternion>"
        for (x, y, z, w), time in zip(R_es.as_quat().tolist(), model.orbit.epoch.utc_from_seconds(t_s))
    )
    head, rest = path.read_text().split("<Ephemeris>")
    end = rest.split("</Attitudes>")[1]
    return (
        f"{head}<Ephemeris><Point_List>{points}</Point_List></Ephemeris><Attitudes><Quaternion_List>"
        f"{quaternions}</Quaternion_List></Attitudes>{end}"
    )


def test_states_that_begin_after_the_image_and_end_before_it_by_less_than_a_step_are_extended(tmp_path):
    # Pleiades Neo 3 over Marseille (Airbus' sample): START 10:29:11.950343, the first state 2.841 ms later,
    # the first quaternion 1.5 ms before START. The image here takes 661.4 ms: 151 steps of 4.363 ms less 0.2.
    (tmp_path / "v2.xml").write_text(as_version_2(dimap_text(), listed=True, microseconds=True))
    ends = np.array([0.0, 19_999.0]), np.array([0.0, 8_999.0])
    expected = places(tmp_path / "v2.xml", *ends)
    (tmp_path / "neo.xml").write_text(dense(tmp_path / "v2.xml", 2.841e-3, 151))
    # 0.1 mm of the positions, four times as much beyond their end
    assert np.linalg.norm(places(tmp_path / "neo.xml", *ends) - expected, axis=1).max() < 1e-3  # m


@pytest.mark.parametrize(("first_s", "count"), [(0.02, 200), (-0.02, 100)])
def test_states_that_miss_lines_are_refused_with_the_lines(tmp_path, first_s, count):
    (tmp_path / "v2.xml").write_text(as_version_2(dimap_text(), listed=True, microseconds=True))
    (tmp_path / "neo.xml").write_text(dense(tmp_path / "v2.xml", first_s, count))
    with pytest.raises(
        RawDataError, match=r"orbit and attitudes of lines .* expected of all lines, 0 to 8999"
    ):
        read(tmp_path / "neo.xml")


@pytest.mark.parametrize("encoding", ["ISO-8859-1", "iso-8859-15", "UTF-16"])
def test_encoding_is_the_one_that_the_first_line_states(tmp_path, encoding):
    text = dimap_text()
    body = text[text.index("?>") + 2 :] if text.startswith("<?xml") else text
    body = body.replace("<PHR_Dimap_Document>", "<PHR_Dimap_Document><PRODUCER>d\u00e9p\u00f4t</PRODUCER>", 1)
    assert "d\u00e9p" in body
    (tmp_path / "a.xml").write_text(text)
    (tmp_path / "b.xml").write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>{body}'.encode(encoding))
    assert np.array_equal(places(tmp_path / "a.xml"), places(tmp_path / "b.xml"))
    (tmp_path / "b.xml").write_bytes(b'<?xml version="1.0" encoding="none-such"?><a/>')
    with pytest.raises(RawDataError, match="XML: found unknown encoding: none-such"):
        places(tmp_path / "b.xml")


@needs_real_data
@pytest.mark.parametrize("options", VERSIONS_2, ids=["polynomials", "other column", "list, microseconds"])
def test_real_strip_in_version_2_lies_where_its_operator_puts_it(tmp_path, operator_grid, options):
    (tmp_path / "v2.xml").write_text(as_version_2(DIMAP.read_text(), **options))
    sample, line, _, _ = operator_grid
    strip = read(tmp_path / "v2.xml")
    off = strip.pushbroom.ground_points(0, sample, line, ConstantHeight(0.0))
    same = read(DIMAP).pushbroom
    expected = same.ground_points(0, sample, line, ConstantHeight(0.0))
    assert np.linalg.norm(off - expected, axis=1).max() < 2e-3  # m
