"""A corrected DIMAP product, read as the operator's software reads it, has the calibrated places."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from command_line import ran as run
from handmade_dimap import as_version_2, dimap_text
from scipy.spatial.transform import Rotation

from boresight.features.exports.dimap_product import corrected_dimap
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dimap_metadata import operator_model

TURN = Rotation.from_rotvec(np.array([2.5, -1.7, 6.0]) * ARCSEC)  # 12 m, 8 m, and 0.3 m at the edges
REAL = Path(__file__).parents[3] / ".." / "shared" / "data" / "pleiades"
REAL = REAL / "PHRDIMAP_P1BP--2018122638935449CP.XML"
needs_real_data = pytest.mark.skipif(not REAL.exists(), reason=f"the real product is not there: {REAL}")
HEADER = "id,strip,ccd,sample,line,sigma_sample_px,sigma_line_px,lat_deg,lon_deg,height_m,height_kind,"
HEADER += "sigma_east_m,sigma_north_m,sigma_up_m\n"


def turned(path: Path) -> Pushbroom:
    """The operator's model with another mounting."""
    return operator_model(path).pushbroom.with_installation(TURN)


def pixels() -> tuple[np.ndarray, np.ndarray]:
    sample, line = np.meshgrid(np.linspace(0.0, 19_999.0, 7), np.linspace(100.0, 8_900.0, 6))
    return sample.ravel(), line.ravel()


def grounds(model: Pushbroom) -> np.ndarray:
    """Places (N, 3), ITRF, m, of the pixels, 50 m above the ellipsoid."""
    return model.ground_points(0, *pixels(), ConstantHeight(50.0))


@pytest.mark.parametrize("form", ["V1", "V2", "V2, list"])
def test_corrected_product_has_the_places_of_the_corrected_camera(tmp_path, form):
    text = dimap_text() if form == "V1" else as_version_2(dimap_text(), listed="list" in form)
    path = tmp_path / "product.xml"
    path.write_text(text)
    raw = corrected_dimap(path, TURN, {"mission": "A--B", "note": "<&>"})
    (tmp_path / "corrected.xml").write_bytes(raw)
    expected, found = grounds(turned(path)), grounds(operator_model(tmp_path / "corrected.xml").pushbroom)
    before = grounds(operator_model(path).pushbroom)
    assert np.linalg.norm(expected - before, axis=1).min() > 5.0  # m
    assert np.linalg.norm(found - expected, axis=1).max() < 1e-5  # m; quaternions lose no digit
    assert b"mission: A- -B" in raw


def satellite_attitudes() -> str:
    """Quaternions of a real product beside those of its model: Earth-fixed ones and the satellite's own."""
    own = "<Quaternion><TAI_TIME>2018-12-26T10:49:32.4</TAI_TIME>"
    own += "<Q_VALUES>0.6 0.0 0.8 0.0</Q_VALUES></Quaternion>"
    same = "<WGS84_Attitudes><Q_VALUES>0.7071 0.0 -0.7071 0.0</Q_VALUES></WGS84_Attitudes>"
    return (
        "<Data_Strip><Satellite_Attitudes><Corrected_Attitudes><WGS84_Attitudes_List>"
        f"{same}</WGS84_Attitudes_List></Corrected_Attitudes><Accurate_Attitudes><Quaternion_List>{own}"
        "</Quaternion_List></Accurate_Attitudes></Satellite_Attitudes></Data_Strip>"
    )


@pytest.mark.parametrize("version", [1, 2])
def test_only_the_quaternions_of_the_model_are_corrected(tmp_path, version):
    text = dimap_text() if version == 1 else as_version_2(dimap_text(), listed=True)
    path = tmp_path / "product.xml"
    path.write_text(text.replace("<Geometric_Data>", satellite_attitudes() + "<Geometric_Data>"))
    (tmp_path / "corrected.xml").write_bytes(corrected_dimap(path, TURN, {}))
    root = ET.parse(tmp_path / "corrected.xml").getroot()
    assert root.findtext(".//Accurate_Attitudes//Q_VALUES") == "0.6 0.0 0.8 0.0"
    q0, x, y, z = map(float, root.findtext(".//WGS84_Attitudes/Q_VALUES").split())
    turn = Rotation.from_quat([0.0, -0.7071, 0.0, 0.7071]) * TURN.inv()  # camera to ITRS
    assert (Rotation.from_quat([x, y, z, q0]) * turn.inv()).magnitude() < 1e-12  # rad
    off = grounds(operator_model(tmp_path / "corrected.xml").pushbroom) - grounds(turned(path))
    assert np.linalg.norm(off, axis=1).max() < 1e-5  # m


@needs_real_data
def test_a_real_product_is_corrected(tmp_path):
    (tmp_path / "corrected.xml").write_bytes(corrected_dimap(REAL, TURN, {"mission": "M"}))
    sample, line = np.array([0.0, 39_999.0]), np.array([0.0, 38_247.0])
    model = turned(REAL)
    expected = model.ground_points(0, sample, line, ConstantHeight(50.0))
    found = operator_model(tmp_path / "corrected.xml").pushbroom
    off = found.ground_points(0, sample, line, ConstantHeight(50.0)) - expected
    assert np.linalg.norm(off, axis=1).max() < 1e-5  # m


def test_calibrated_product_is_exported_and_another_one_is_refused(tmp_path):
    product = tmp_path / "product.xml"
    product.write_text(dimap_text())
    expected = grounds(turned(product))
    lat, lon, height = geodetic_from_ecef(expected, WGS84)
    rows = zip(*(column.tolist() for column in (*pixels(), np.degrees(lat), np.degrees(lon), height)))
    points = "".join(
        f"p{n},PAN,0,{x!r},{y!r},0.1,0.1,{a!r},{o!r},{h!r},ellipsoidal,1,1,1\n"
        for n, (x, y, a, o, h) in enumerate(rows)
    )
    (tmp_path / "points.csv").write_text(HEADER + points)

    run("import", "dimap", product, tmp_path / "dump", "--points", tmp_path / "points.csv")
    run("calibrate", tmp_path / "dump", "--out", tmp_path / "result")
    asked = ("export", tmp_path / "result", "--format", "dimap", "--out", tmp_path / "new")
    run(*asked, "--product", product)
    found = grounds(operator_model(tmp_path / "new" / "product.xml").pushbroom)
    # noiseless points: what is left is the pull of the priors on the other unknowns
    assert np.linalg.norm(found - expected, axis=1).max() < 0.05  # m, of 12
    other = tmp_path / "other.xml"
    earlier = "18-12-26T10:48:55.4490000Z", "18-12-26T10:48:55.4480000Z"
    for changed, options in (
        (("<NROWS>9000<", "<NROWS>9001<"), ()),
        (("<NROWS>9000<", "<NROWS>9001<"), ("--product", other)),
        (earlier, ("--product", other)),
    ):
        other.write_text(dimap_text().replace(*changed))
        run(*asked, *options, status=1)


def test_file_without_quaternions_is_refused(tmp_path):
    (tmp_path / "empty.xml").write_text("<Dimap_Document/>")
    with pytest.raises(RawDataError, match="attitudes"):
        corrected_dimap(tmp_path / "empty.xml", TURN, {})
