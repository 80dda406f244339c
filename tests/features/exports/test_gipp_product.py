"""GIPP files of Sentinel-2 with a corrected matrix, read back by the importer's reader and by a chain of its
own from the format's description; nothing else in them changes.
"""

import difflib
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from handmade_sentinel2 import SPAMOD, VIEDIR, write_sentinel2
from scipy.spatial.transform import Rotation

from boresight.features.exports.gipp_product import corrected_gipp
from boresight.features.operators.sentinel2_import import sentinel2_mission
from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.errors import RawDataError

REAL = Path(__file__).parents[4] / "shared" / "data" / "sentinel2"
# Bold and lopsided, so that a sign or an order that is wrong shows.
CORRECTION = Rotation.from_rotvec(np.array([40.0, -65.0, 110.0]) * ARCSEC)
# rad: 5 mm on the ground seen from Sentinel-2's 786 km
FIVE_MM = 5e-3 / 786e3


def piloting_directions(spamod: str, viedir: str, detector: int) -> np.ndarray:
    """Lines of sight of a detector in the piloting frame, by elementary rotations: v = P^-1 u, P rotates
    about y, then the new x, then the new z, by R2, R1, R3 mrad, and u is [tan_psi_y, -tan_psi_x, 1].
    """
    angles = re.search(r"<PILOTING_TO_MSI_FRAME>(.*?)</PILOTING_TO_MSI_FRAME>", spamod, re.DOTALL)
    a, b, c = (1e-3 * float(re.search(rf"<R{k} [^>]*>([^<]+)", angles[1])[1]) for k in (1, 2, 3))
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    P = about_y @ about_x @ about_z
    one = list(ElementTree.fromstring(viedir.encode()).iter("VIEWING_DIRECTIONS"))[detector]
    tan_x, tan_y = (np.array(one.find(f"TAN_PSI_{axis}_LIST").text.split(), dtype=float) for axis in "XY")
    u = np.column_stack([tan_y, -tan_x, np.ones(len(tan_x))])
    v = u @ P  # rows: P^-1 u
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def head_of(datastrip: Path, gipp: Path, attitudes: str = "corrected", n: int = 0):
    """The head of corrected attitudes, whose matrix is that of the SPAMOD file, or a star tracker."""
    return sentinel2_mission([read_sentinel2(datastrip, gipp, "B04")], "t", attitudes=attitudes).heads[n]


def looks(table) -> np.ndarray:
    """Lines of sight of a detector in the camera's frame."""
    u_c = np.column_stack([table.tan_x, table.tan_y, np.ones(table.n_px)])
    return u_c / np.linalg.norm(u_c, axis=1, keepdims=True)


def changed(before: str, after: str) -> list[str]:
    """Lines that are new."""
    lines = difflib.ndiff(before.splitlines(), after.splitlines())
    return [line[2:].strip() for line in lines if line.startswith("+ ")]


@pytest.mark.parametrize(("attitudes", "n"), [("corrected", 0), ("raw", 0), ("raw", 1)])
def test_a_corrected_spamod_gives_the_result_s_matrix_and_differs_in_its_angles_only(tmp_path, attitudes, n):
    datastrip = write_sentinel2(tmp_path)
    before = head_of(datastrip, tmp_path, attitudes, n)
    path = tmp_path / f"{SPAMOD}.xml"
    text = path.read_text()
    made = corrected_gipp(path, CORRECTION, before.R_cs0, before.name)
    path.write_text(made)
    after = head_of(datastrip, tmp_path, attitudes, n)
    # rad: rounding of angles in mrad
    assert (after.R_cs0 * (CORRECTION * before.R_cs0).inv()).magnitude() < 1e-14
    blocks = [re.sub(r"<(R[123]) [^>]*>[^<]*", r"<\1>", one) for one in (text, made)]
    assert blocks[0] == blocks[1] and made != text


def test_a_corrected_viedir_looks_where_a_corrected_spamod_looks(tmp_path):
    datastrip = write_sentinel2(tmp_path)
    before = head_of(datastrip, tmp_path)
    spamod, viedir = (tmp_path / f"{name}.xml" for name in (SPAMOD, VIEDIR))
    by_angles = corrected_gipp(spamod, CORRECTION, before.R_cs0, before.name)
    by_looks = corrected_gipp(viedir, CORRECTION, before.R_cs0, before.name)
    for detector in (0, 1):
        one = piloting_directions(by_angles, viedir.read_text(), detector)
        other = piloting_directions(spamod.read_text(), by_looks, detector)
        plain = piloting_directions(spamod.read_text(), viedir.read_text(), detector)
        assert np.abs(one - other).max() < 1e-13  # rad: 15 digits
        assert np.abs(one - plain).max() > 60 * ARCSEC


def test_dates_of_applicability_change_only_where_they_are_given(tmp_path):
    path = tmp_path / "looks.xml"
    head = "<APPLICABILITY_DATE>2015-07-03T00:00:00.0Z</APPLICABILITY_DATE>\n"
    head += "<APPLICABILITY_END_DATE>2100</APPLICABILITY_END_DATE>\n"
    lists = '<VIEWING_DIRECTIONS detector_id="01"><TAN_PSI_X_LIST>0.1 0.2</TAN_PSI_X_LIST>'
    path.write_text(f"{head}{lists}<TAN_PSI_Y_LIST>0 0.01</TAN_PSI_Y_LIST></VIEWING_DIRECTIONS>")
    same = corrected_gipp(path, Rotation.identity(), Rotation.identity(), "")
    dated = corrected_gipp(path, Rotation.identity(), Rotation.identity(), "", ("2026-03-01T00:00:00.0Z", ""))
    assert same.startswith(head)
    assert changed(same, dated) == ["<APPLICABILITY_DATE>2026-03-01T00:00:00.0Z</APPLICABILITY_DATE>"]


def test_a_spamod_of_another_matrix_is_refused(tmp_path):
    datastrip = write_sentinel2(tmp_path)
    head = head_of(datastrip, tmp_path)
    other = Rotation.from_rotvec([1e-5, 0.0, 0.0]) * head.R_cs0
    with pytest.raises(RawDataError, match=r"1e-05 rad from the dump's matrix"):
        corrected_gipp(tmp_path / f"{SPAMOD}.xml", CORRECTION, other, head.name)
    tracker, path = head_of(datastrip, tmp_path, "raw", 1), tmp_path / "other.xml"
    path.write_text((tmp_path / f"{SPAMOD}.xml").read_text().replace("-0.8 0.0</VECTOR>", "-0.8</VECTOR>"))
    with pytest.raises(RawDataError, match="STR2_ATT_QUATERNION: found 3 numbers, expected 4"):
        corrected_gipp(path, CORRECTION, tracker.R_cs0, tracker.name)
    with pytest.raises(RawDataError, match="a SPAMOD or VIEDIR file"):
        corrected_gipp(datastrip, CORRECTION, head.R_cs0, head.name)


@pytest.mark.skipif(not REAL.is_dir(), reason=f"NO SENTINEL-2 FILES in {REAL}: not tried with real ones")
def test_real_gipp_files_take_a_correction_to_5_mm(tmp_path):
    band = "B02"
    (datastrip,) = REAL.glob("*_MTD_L1B_DS_*.xml")
    (spamod,), (viedir,) = REAL.glob("*_SPAMOD_*.xml"), REAL.glob(f"*_VIEDIR_*_{band}.xml")
    strip = read_sentinel2(datastrip, REAL, band)
    head = sentinel2_mission([strip], "test", attitudes="raw").heads[0]  # its matrix holds the tracker's, too
    made = corrected_gipp(spamod, CORRECTION, head.R_cs0, head.name)
    assert len(changed(spamod.read_text(), made)) == 3
    directions = corrected_gipp(viedir, CORRECTION, head.R_cs0, head.name)
    for detector in (0, 11):
        expected = (CORRECTION * strip.R_cp).inv().apply(looks(strip.camera.ccds[detector]))
        for files in ((made, viedir.read_text()), (spamod.read_text(), directions)):
            assert np.abs(piloting_directions(*files, detector) - expected).max() < FIVE_MM
    # and by our reader, from a folder in which only one of the files is a corrected one
    for name, text in ((spamod.name, made), (viedir.name, directions)):
        gipp = tmp_path / name
        gipp.mkdir()
        for path in REAL.glob("*_GIP_*.xml"):
            (gipp / path.name).symlink_to(path.resolve())
        (gipp / name).unlink()
        (gipp / name).write_text(text)
        again = read_sentinel2(datastrip, gipp, band)
        for detector in (0, 11):
            ours, theirs = (one.R_cp.inv().apply(looks(one.camera.ccds[detector])) for one in (again, strip))
            turned = strip.R_cp.inv() * CORRECTION.inv() * strip.R_cp
            assert np.abs(ours - turned.apply(theirs)).max() < FIVE_MM
