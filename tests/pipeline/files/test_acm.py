"""Attitudes from a CCSDS ACM: by the standard's matrix, and as this program's own export writes them."""

import re
from pathlib import Path

import numpy as np
import pytest
import spiceypy
from scipy.spatial.transform import Rotation

from boresight.features.exports.ccsds_aem import AemHeader, comprehensive_message
from boresight.geometry.earth_rotation import rotation_to_gcrs
from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.attitude_files import AttitudeRows, read_attitudes

EPOCH = Epoch.from_utc("2025-03-20T02:31:00Z")
# Of length 1 to its digits, no component near another.
Q = np.array([[0.1, 0.5, -0.7, 0.5], [0.5, 0.1, 0.5, -0.7], [-0.7, 0.5, 0.1, 0.5]])
MESSAGE = """CCSDS_ACM_VERS = 2.0
CREATION_DATE = 2025-03-21T00:00:00
ORIGINATOR = HAND

META_START
COMMENT two tenths of a second
OBJECT_NAME = SAT
TIME_SYSTEM = UTC
EPOCH_TZERO = 2025-03-20T02:31:00.5
META_STOP

AD_START
AD_METHOD = EKF
AD_STOP

ATT_START
REF_FRAME_A = ICRF
REF_FRAME_B = STR1
NUMBER_STATES = 7
ATT_TYPE = QUATERNION
RATE_TYPE = ANGVEL
0.0 0.1 0.5 -0.7 0.5 0 0 0.06
0.1 0.5 0.1 0.5 -0.7 0 0 0.06
0.2 -0.7 0.5 0.1 0.5 0 0 0.06
ATT_STOP
"""
COVARIANCE = """
COV_START
COV_REF_FRAME = STR1
COV_TYPE = ANGLE
0.0 1e-8 2e-8 3e-6
0.1 1e-8 2e-8 4e-6
0.2 1e-8 2e-8 5e-6
COV_STOP
"""


def matrix_a_to_b(q1: float, q2: float, q3: float, qc: float) -> np.ndarray:
    """CCSDS 504.0-B, annex on conventions: takes components in frame A to components in frame B."""
    return np.array(
        [
            [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)],
            [2 * (q1 * q2 - q3 * qc), -(q1**2) + q2**2 - q3**2 + qc**2, 2 * (q2 * q3 + q1 * qc)],
            [2 * (q1 * q3 + q2 * qc), 2 * (q2 * q3 - q1 * qc), -(q1**2) - q2**2 + q3**2 + qc**2],
        ]
    )


def read(folder: Path, text: str) -> AttitudeRows:
    (folder / "str1.acm").write_text(text)
    return read_attitudes(folder / "str1.acm", "str1.acm", EPOCH, None, None)


def test_attitudes_have_the_standards_sense_and_times(tmp_path: Path) -> None:
    rows = read(tmp_path, MESSAGE)
    assert rows.t_s == pytest.approx([0.5, 0.6, 0.7], abs=1e-9) and rows.covariance_s is None
    for n, q in enumerate(Q):
        assert rows.R_si[n].as_matrix() == pytest.approx(matrix_a_to_b(*q), abs=1e-12)


@pytest.mark.parametrize("name", ["EME2000", "J2000"])
def test_mean_axes_of_2000_have_their_frame_bias(name: str, tmp_path: Path) -> None:
    rows = read(tmp_path, MESSAGE.replace("ICRF", name))
    bias = rotation_to_gcrs("EME2000").as_matrix()  # EME2000 to GCRS
    assert rows.R_si[0].as_matrix() @ bias == pytest.approx(matrix_a_to_b(*Q[0]), abs=1e-12)


def test_head_as_frame_a_gives_the_inverse(tmp_path: Path) -> None:
    swapped = MESSAGE.replace("FRAME_A = ICRF", "FRAME_A = STR1").replace("FRAME_B = STR1", "FRAME_B = ICRF")
    rows = read(tmp_path, swapped)
    assert rows.R_si[0].as_matrix() == pytest.approx(matrix_a_to_b(*Q[0]).T, abs=1e-12)


def test_several_blocks_of_one_head_follow_one_another(tmp_path: Path) -> None:
    block = MESSAGE[MESSAGE.index("ATT_START") :]
    later = "".join(f"{0.3 + 0.1 * n:.1f}{line[3:]}\n" for n, line in enumerate(block.splitlines()[6:9]))
    second = "\n".join([*block.splitlines()[:6], later + "ATT_STOP\n"])
    rows = read(tmp_path, MESSAGE + second)
    assert rows.t_s == pytest.approx(0.5 + 0.1 * np.arange(6), abs=1e-9)
    says = "REF_FRAME_A and REF_FRAME_B: found STR1; STR2, expected one head"
    with pytest.raises(RawDataError, match=says):
        read(tmp_path, MESSAGE + second.replace("STR1", "STR2"))


def test_the_exported_message_is_read_with_its_variances(tmp_path: Path) -> None:
    turns = np.linspace(2.9, 3.4, 7)  # half a turn and more
    R_ci = Rotation.from_rotvec(np.outer(turns, [0.48, -0.6, 0.64]))
    utc = [f"2025-03-20T02:31:0{n}.250000000" for n in range(7)]
    header = AemHeader(creation_utc="2025-03-21T00:00:00", object_name="SAT", instrument="CAMERA_1")
    variance = np.outer(np.arange(1.0, 8.0), [1e-12, 4e-12, 9e-10])
    rows = read(tmp_path, comprehensive_message(header, ["strip S01"], utc, R_ci, variance))
    assert rows.t_s == pytest.approx(0.25 + np.arange(7.0), abs=1e-9)
    assert (rows.R_si * R_ci.inv()).magnitude().max() < 1e-13  # 15 decimals are written
    assert rows.covariance_s is not None
    assert np.diagonal(rows.covariance_s, axis1=1, axis2=2) == pytest.approx(variance, rel=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("= 2.0", "= 3.0", "CCSDS_ACM_VERS: found 3.0, expected 2.0"),
        ("ATT_TYPE = QUATERNION", "ATT_TYPE = RODRIGUES",
            "line 20, ATT_TYPE: found RODRIGUES, expected QUATERNION, EULER_ANGLES, DCM"),
        ("REF_FRAME_A = ICRF\n", "", "line 16, REF_FRAME_A: found nothing"),
        ("REF_FRAME_A = ICRF", "REF_FRAME_A = LVLH", "found LVLH and STR1, expected one of GCRF, ICRF"),
        ("EPOCH_TZERO = 2025-03-20T02:31:00.5\n", "", "EPOCH_TZERO: found nothing"),
        ("EPOCH_TZERO = 2025-03-20", "EPOCH_TZERO = 2025-13-20", "EPOCH_TZERO: found "),
        ("TIME_SYSTEM = UTC", "TIME_SYSTEM = MET", "TIME_SYSTEM: found MET"),
        ("0.1 0.5 0.1 0.5 -0.7 0 0 0.06", "0.1 0.5 0.1 0.5",
            "line 23: found 0.1 0.5 0.1 0.5, expected a time"),
        ("0.1 0.5 0.1 0.5 -0.7", "0.1 0.5 0.1 0.5 x", "line 23, QC: found x"),
        ("0.1 0.5 0.1 0.5 -0.7", "0.1 0.5 0.1 0.5 0.9", "attitude 2: found .*of length"),
        ("0.2 -0.7", "0.05 -0.7", "COV_START: found 3 covariances, expected one at each of 3 attitudes"),
        ("ATT_STOP\n\nCOV", "\nCOV", "line 26: found COV_START, expected ATT_STOP before it"),
        ("COV_STOP\n", "", r"end of the file: found COV_START of line \d+, not closed"),
        ("COV_TYPE = ANGLE", "COV_TYPE = QUATERNION",
            "COV_TYPE: found QUATERNION in STR1, expected ANGLE .*white"),
        ("COV_REF_FRAME = STR1", "COV_REF_FRAME = ICRF", "found ANGLE in ICRF, expected ANGLE in STR1"),
        ("0.2 1e-8 2e-8 5e-6\n", "", "COV_START: found 2 covariances, expected one at each of 3 attitudes"),
        ("0.2 1e-8 2e-8 5e-6", "0.2 1e-8 2e-8 -5e-6", "expected positive variances"),
        ("RATE_TYPE = ANGVEL\n", "RATE_TYPE = ANGVEL\nSENSOR_START\n", "line 22: found SENSOR_START"),
    ],
)  # fmt: skip
def test_what_is_not_read_is_named(old: str, new: str, complaint: str, tmp_path: Path) -> None:
    whole = MESSAGE + COVARIANCE
    assert old in whole
    with pytest.raises(RawDataError, match=r"str1\.acm: .*" + complaint):
        read(tmp_path, whole.replace(old, new, 1))


def test_times_that_go_back_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RawDataError, match=r"attitude 3, time: found -0\.05"):
        read(tmp_path, MESSAGE.replace("0.2 -0.7", "0.05 -0.7"))


def test_keys_of_a_csv_file_and_xml_are_refused_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "a.acm").write_text(MESSAGE)
    with pytest.raises(RawDataError, match="no such key: a message states its own"):
        read_attitudes(tmp_path / "a.acm", "a.acm", EPOCH, "GCRF", "head to inertial")
    for text, complaint in (
        ('<acm id="CCSDS_ACM_VERS" version="2.0"><body/></acm>', "body/segment: found 0 elements"),
        ("<apm version='2.0'/>", "root element: found apm, expected aem or acm"),
    ):
        (tmp_path / "a.xml").write_text(text)
        with pytest.raises(RawDataError, match=complaint):
            read_attitudes(tmp_path / "a.xml", "a.xml", EPOCH, None, None)


def in_xml(message: str) -> str:
    """A message of keyword = value form in that of XML, block by block (CCSDS 505.0-B)."""
    out = ['<?xml version="1.0"?><acm id="CCSDS_ACM_VERS" version="2.0"><header/><body><segment>']
    row = ""
    for line in message.splitlines()[3:]:
        name, _, edge = line.rpartition("_")
        tag = {"META": "metadata"}.get(name, name.lower())
        if edge == "START":
            row = f"{tag}Line"
            out.append(f"<{tag}>")
        elif edge == "STOP":
            out.append(f"</{tag}>" + ("<data>" if name == "META" else ""))
        elif line.startswith("COMMENT "):
            out.append(f"<COMMENT>{line[8:]}</COMMENT>")
        elif " = " in line:
            key, value = line.split(" = ")
            out.append(f"<{key}>{value}</{key}>")
        elif line:
            out.append(f"<{row}>{line}</{row}>")
    return "\n".join([*out, "</data></segment></body></acm>"])


def dated(day: str) -> str:
    """The message with a date on each of its rows, after 2025-03-20T02:31:00.5."""
    return re.sub(r"\n0\.(\d) ", lambda row: f"\n{day}T02:31:00.{5 + int(row[1])} ", MESSAGE)


# As in figures G-7 and G-9 of CCSDS 504.0-B-2.
SENSORS = "".join(f"SENSOR_START\nSENSOR_NUMBER = {n}\nSENSOR_USED = AST\nSENSOR_STOP\n" for n in (1, 2))
OF_YEAR = MESSAGE.replace("2025-03-20T", "2025-079T").replace("00.5\n", "00.5Z\n")
SAME = {
    "dates": dated("2025-03-20"),
    "days of the year": dated("2025-079"),
    "day of the year of the first": OF_YEAR,
    "TAI": MESSAGE.replace("= UTC", "= TAI").replace("02:31:00.5", "02:31:37.5"),  # 37 s ahead in 2025
    "TAI, day of the year": OF_YEAR.replace("= UTC", "= TAI").replace("02:31:00.5", "02:31:37.5"),
    "GPS, day of the year": OF_YEAR.replace("= UTC", "= GPS").replace("02:31:00.5", "02:31:18.5"),  # 18 s
    "sensors": "\n" + MESSAGE.replace("AD_STOP\n", f"{SENSORS}AD_STOP\n"),
    "XML": in_xml(MESSAGE + COVARIANCE),
}


@pytest.mark.parametrize("form", SAME)
def test_what_says_the_same_is_read_the_same(form: str, tmp_path: Path) -> None:
    plain = read(tmp_path, MESSAGE + COVARIANCE * ("XML" in form))
    found = read(tmp_path, SAME[form])
    assert SAME[form] != MESSAGE and np.allclose(found.t_s, plain.t_s, rtol=0, atol=1e-9)  # s
    assert np.array_equal(found.R_si.as_quat(), plain.R_si.as_quat())
    assert np.array_equal(found.covariance_s, plain.covariance_s)


def test_variances_are_those_of_the_head(tmp_path: Path) -> None:
    rows = read(tmp_path, MESSAGE + COVARIANCE)
    assert rows.covariance_s is not None
    expected = np.diag(np.radians(np.sqrt([1e-8, 2e-8, 4e-6])) ** 2)
    assert rows.covariance_s[1] == pytest.approx(expected, rel=1e-12)


def test_day_that_a_year_has_not_is_named_by_its_line(tmp_path: Path) -> None:
    says = r"line 22, time: found 2025-379T02:31:00\.5, expected a day of that year"
    with pytest.raises(RawDataError, match=says):
        read(tmp_path, dated("2025-379"))


def test_wrong_number_of_xml_is_named_by_its_line(tmp_path: Path) -> None:
    broken = in_xml(MESSAGE).replace("0.1 0.5 0.1 0.5 -0.7", "0.1 0.5 0.1 x -0.7")
    with pytest.raises(RawDataError, match=r"str1\.acm: att 1, attLine 2, Q3: found x"):
        read(tmp_path, broken)


@pytest.mark.parametrize("sequence", ["ZXY", "312", "ZXZ", "123", "xyx"])
def test_angles_and_matrices_are_those_of_naif(sequence: str, tmp_path: Path) -> None:
    # NAIF's eul2m multiplies the rotations of the axes, the last on the left: from A to B.
    angles = np.array([[40.0, -65.0, 110.0], [41.0, -64.0, 112.0], [-100.0, 20.0, 7.0]])
    axes = ["XYZ".index(axis) + 1 for axis in sequence.upper().translate(str.maketrans("123", "XYZ"))]
    to_b = [spiceypy.eul2m(*np.radians(row)[::-1].tolist(), *axes[::-1]) for row in angles]
    head = MESSAGE.split("RATE_TYPE = ANGVEL\n")[0]
    lines = [f"0.{n} " + " ".join(map(repr, row.tolist())) for n, row in enumerate(angles)]
    kind = head.replace("QUATERNION", f"EULER_ANGLES\nEULER_ROT_SEQ = {sequence}")
    by_angles = read(tmp_path, "\n".join([kind, *lines, "ATT_STOP\n"]))
    columns = [" ".join(repr(float(v)) for v in matrix.T.ravel()) for matrix in to_b]
    lines = [f"0.{n} {row}" for n, row in enumerate(columns)]
    by_matrix = read(tmp_path, "\n".join([head.replace("QUATERNION", "DCM"), *lines, "ATT_STOP\n"]))
    for rows in (by_angles, by_matrix):
        assert np.abs(rows.R_si.as_matrix() - np.array(to_b)).max() < 1e-14  # rounding of 1
    mirrored = columns[1].split()
    lines[1] = "0.1 " + " ".join([*mirrored[3:6], *mirrored[:3], *mirrored[6:]])
    with pytest.raises(RawDataError, match=r"attitude 2: found .* expected a rotation"):
        read(tmp_path, "\n".join([head.replace("QUATERNION", "DCM"), *lines, "ATT_STOP\n"]))


@pytest.mark.parametrize("sequence", ["nothing", "ZZX", "31", "ZXQ"])
def test_a_sequence_of_angles_that_is_none_is_named(sequence: str, tmp_path: Path) -> None:
    text = MESSAGE.replace("ATT_TYPE = QUATERNION", f"ATT_TYPE = EULER_ANGLES\nEULER_ROT_SEQ = {sequence}")
    with pytest.raises(RawDataError, match=rf"line 21, EULER_ROT_SEQ: found {sequence}, expected three axes"):
        read(tmp_path, text)
