"""Attitudes of a star camera from CSV and from CCSDS messages, with every convention that may differ."""

import datetime
import gzip
from pathlib import Path

import erfa
import numpy as np
import pytest
import spiceypy
from outside import ROOT
from scipy.spatial.transform import Rotation

from boresight.features.exports.ccsds_aem import AemHeader, attitude_message
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.attitude_files import AttitudeRows, read_attitudes

EPOCH = Epoch.from_utc("2024-11-20T03:40:00")
TIMES = ("2024-11-20T03:40:10.0", "2024-11-20T03:40:10.1", "2024-11-20T03:40:10.2")
R_SI = Rotation.from_euler(
    "xyz", [[40.0, -65.0, 110.0], [40.1, -65.1, 110.2], [40.2, -65.2, 110.4]], degrees=True
)
ARCSEC = np.pi / 648_000.0


def csv_text(q: np.ndarray, extra: str = "", cells: tuple[str, ...] = ("", "", "")) -> str:
    rows = [f"utc,qx,qy,qz,qw{extra}"]
    rows += [f"{t},{','.join(map(repr, row.tolist()))}{more}" for t, row, more in zip(TIMES, q, cells)]
    return "\n".join(rows) + "\n"


def read(
    tmp_path, text: str, frame: str | None = "GCRF", rotation: str | None = "head to inertial"
) -> AttitudeRows:
    path = tmp_path / "attitudes"
    path.write_text(text)
    return read_attitudes(path, "attitudes", EPOCH, frame, rotation)


def error_rad(found: AttitudeRows, expected: Rotation = R_SI) -> float:
    return float((found.R_si * expected.inv()).magnitude().max())


def test_csv_is_read_in_both_senses_of_the_rotation(tmp_path: Path) -> None:
    there = read(tmp_path, csv_text(R_SI.inv().as_quat()))
    back = read(tmp_path, csv_text(R_SI.as_quat()), rotation="inertial to head")
    assert max(error_rad(there), error_rad(back)) < 1e-14  # rad: rounding of a quaternion
    assert np.allclose(there.t_s, [10.0, 10.1, 10.2], atol=1e-12)  # s


@pytest.mark.parametrize("sense", ["head to inertial", "inertial to head"])
def test_earth_fixed_attitudes_are_turned_with_the_earth(tmp_path: Path, sense: str) -> None:
    """Against ERFA's own matrix from celestial to terrestrial axes, with the values of the same table."""
    table = bundled_earth_orientation()
    mjd = EPOCH.mjd_tai(np.array([10.0, 10.1, 10.2])) - 37.0 / 86400.0
    ut1_utc, xp, yp = (
        np.interp(mjd, table.mjd_utc, column) for column in (table.ut1_utc_s, table.xp_rad, table.yp_rad)
    )
    R_ei = Rotation.from_matrix(
        erfa.c2t06a(erfa.DJM0, mjd + 69.184 / 86400.0, erfa.DJM0, mjd + ut1_utc / 86400.0, xp, yp)
    )
    R_se = R_SI * R_ei.inv()
    found = read(
        tmp_path, csv_text((R_se if sense == "inertial to head" else R_se.inv()).as_quat()), "ITRF", sense
    )
    assert found.is_earth_fixed and error_rad(found, R_se) < 1e-14
    turned = found.to_gcrs(EPOCH, table, "attitudes")
    # 0.3 mas: celestial pole offsets, which c2t06a leaves out; interpolation of the table between two days
    assert not turned.is_earth_fixed and error_rad(turned) < 1e-3 * ARCSEC


def test_eme2000_differs_from_gcrf_by_the_frame_bias(tmp_path: Path) -> None:
    # A vector of the mean equator of J2000 by ERFA's bias matrix: the head sees it where R_si says.
    bias = erfa.bp00(erfa.DJ00, 0.0)[0]
    v_i = np.array([0.3, -0.5, 0.81])
    v_s = R_SI.apply(v_i)
    to_head = [row @ bias.T for row in R_SI.as_matrix()]  # EME2000 to head: R_si times (GCRS from EME2000)
    text = csv_text(Rotation.from_matrix(np.array(to_head)).as_quat())
    found = read(tmp_path, text, "EME2000", "inertial to head")
    assert np.abs(found.R_si.apply(v_i) - v_s).max() < 1e-14
    assert 0.01 < error_rad(read(tmp_path, text, "ICRF", "inertial to head")) / ARCSEC < 0.03  # 23 mas


def test_rows_marked_invalid_are_counted_and_their_cells_not_read(tmp_path: Path) -> None:
    q = R_SI.inv().as_quat()
    text = csv_text(q, ",valid,temperature_c", (",1,20.5", ",0,x", ",1,21")).replace(
        repr(float(q[1, 0])), "nan"
    )
    found = read(tmp_path, text)
    assert found.n_invalid == 1 and len(found.t_s) == 2
    assert found.temperature_c is not None and found.temperature_c.tolist() == [20.5, 21.0]


def test_covariances_are_about_the_axes_of_the_head_in_arc_seconds(tmp_path: Path) -> None:
    q = R_SI.inv().as_quat()
    sigma = read(tmp_path, csv_text(q, ",sigma_x_arcsec,sigma_y_arcsec,sigma_z_arcsec", (",1,2,10",) * 3))
    assert sigma.covariance_s is not None
    np.testing.assert_allclose(sigma.covariance_s[1] / ARCSEC**2, np.diag([1.0, 4.0, 100.0]), rtol=1e-12)
    names = "".join(f",cov_{pair}_arcsec2" for pair in ("xx", "xy", "xz", "yy", "yz", "zz"))
    full = read(tmp_path, csv_text(q, names, (",4,1,-2,9,3,100",) * 3))
    assert full.covariance_s is not None
    expected = np.array([[4.0, 1.0, -2.0], [1.0, 9.0, 3.0], [-2.0, 3.0, 100.0]])
    np.testing.assert_allclose(full.covariance_s[2] / ARCSEC**2, expected, rtol=1e-12)


META = {"OBJECT_NAME": "SAT", "TIME_SYSTEM": "UTC", "ATTITUDE_TYPE": "QUATERNION"}


def kvn(meta: dict[str, str], rows: list[str], version: str) -> str:
    lines = [
        f"CCSDS_AEM_VERS = {version}",
        "CREATION_DATE = 2024-11-21T00:00:00",
        "ORIGINATOR = ELSEWHERE",
        "",
    ]
    lines += ["META_START", "COMMENT by hand", *(f"{k} = {v}" for k, v in (META | meta).items()), "META_STOP"]
    return "\n".join([*lines, "", "DATA_START", *rows, "DATA_STOP", ""])


# The standard's matrix of a quaternion, first row [q1² - q2² - q3² + qc², 2 (q1 q2 + q3 qc), ...], takes
# components in A to components in B: written out here, not taken from the program.
def standard_quaternion(matrix_ba: np.ndarray) -> np.ndarray:
    m = matrix_ba
    qc = 0.5 * np.sqrt(1.0 + np.trace(m))
    q = np.array([m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]]) / (4.0 * qc)
    return np.array([*q, qc])


def test_euler_angles_are_those_of_naif_in_keyword_value_and_both_forms_of_xml(tmp_path: Path) -> None:
    # NAIF's eul2m multiplies the rotations of the axes, the last on the left: from A to B.
    angles = np.array([[40.0, -65.0, 110.0], [41.0, -64.0, 112.0], [-100.0, 20.0, 7.0]])
    to_b = np.array([spiceypy.eul2m(*np.radians(row)[::-1].tolist(), 2, 1, 3) for row in angles])
    frames = {"REF_FRAME_A": "GCRF", "REF_FRAME_B": "ST_1", "EULER_ROT_SEQ": "312"}
    meta = {"TIME_SYSTEM": "UTC", "ATTITUDE_TYPE": "EULER_ANGLE"} | frames
    rows = [f"{t} {a:.1f} {b:.1f} {c:.1f} 1 2 3" for t, (a, b, c) in zip(TIMES, angles)]
    rates = {"ATTITUDE_TYPE": "EULER_ANGLE/RATE", "ATTITUDE_DIR": "A2B"}
    of_kvn = read(tmp_path, kvn(frames | rates, rows, "1.0"), None, None)
    turned = {"REF_FRAME_A": "ST_1", "REF_FRAME_B": "GCRF"}
    inverse = read(tmp_path, kvn(frames | rates | turned, rows, "1.0"), None, None)
    assert error_rad(inverse, of_kvn.R_si.inv()) < 1e-14
    head = "".join(f"<{key}>{value}</{key}>" for key, value in meta.items())
    first = [
        "<eulerAngleRate><EPOCH>{t}</EPOCH><rotationAngles>"
        '<rotation1 angle="Z_ANGLE">{a}</rotation1><rotation2 angle="X_ANGLE">{b}</rotation2>'
        '<rotation3 angle="Y_ANGLE">{c}</rotation3></rotationAngles>'
        '<rotationRates><rotation1 rate="Z_RATE">7</rotation1></rotationRates></eulerAngleRate>',
        "<eulerAngle><EPOCH>{t}</EPOCH><ANGLE_1>{a}</ANGLE_1><ANGLE_2>{b}</ANGLE_2><ANGLE_3>{c}</ANGLE_3>"
        "</eulerAngle>",
    ]
    for form, version in zip(first, ("1.0", "2.0")):
        states = "".join(
            f"<attitudeState>{form.format(t=t, a=a, b=b, c=c)}</attitudeState>"
            for t, (a, b, c) in zip(TIMES, angles)
        )
        xml = (
            f'<aem id="CCSDS_AEM_VERS" version="{version}"><body><segment><metadata>{head}</metadata>'
            f"<data>{states}</data></segment></body></aem>"
        )
        of_xml = read(tmp_path, xml, None, None)
        for found in (of_kvn, of_xml):
            assert np.abs(found.R_si.as_matrix() - to_b).max() < 1e-14  # rounding of 1
        if version == "1.0":
            says = "state 1, rotation2: found Y_ANGLE, expected X_ANGLE, as EU"
            with pytest.raises(RawDataError, match=says):
                read(tmp_path, xml.replace("X_ANGLE", "Y_ANGLE", 1), None, None)


CASES = [
    ("1.0", {"REF_FRAME_A": "ICRF", "REF_FRAME_B": "ST_1", "ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "LAST"},
        False),
    ("1.0", {"REF_FRAME_A": "GCRF", "REF_FRAME_B": "ST_1", "ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "FIRST"},
        False),
    ("1.0", {"REF_FRAME_A": "ICRF", "REF_FRAME_B": "ST_1", "ATTITUDE_DIR": "B2A", "QUATERNION_TYPE": "LAST"},
        True),
    ("1.0", {"REF_FRAME_A": "ST_1", "REF_FRAME_B": "ICRF", "ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "LAST"},
        True),
    ("2.0", {"REF_FRAME_A": "GCRF", "REF_FRAME_B": "ST_1"}, False),
]  # fmt: skip


@pytest.mark.parametrize(("version", "meta", "inverse"), CASES)
@pytest.mark.parametrize("form", ["kvn", "xml"])
def test_messages_of_every_form_give_the_attitude(form, version, meta, inverse, tmp_path):
    turned = Rotation.from_euler("xyz", [10.0, 20.0, 30.0], degrees=True) * R_SI  # trace above -1
    matrices = turned.inv().as_matrix() if inverse else turned.as_matrix()
    q = [standard_quaternion(matrix) for matrix in matrices]
    if form == "kvn":
        first = meta.get("QUATERNION_TYPE") == "FIRST"
        cells = [[one[3], *one[:3]] if first else one for one in q]
        rows = [f"{t} {' '.join(f'{v:.16f}' for v in c)}" for t, c in zip(TIMES, cells)]
        text = kvn(meta, rows, version)
    else:
        states = "".join(
            "<attitudeState><quaternionState><EPOCH>{}</EPOCH><quaternion><Q1>{:.16f}</Q1><Q2>{:.16f}</Q2>"
            "<Q3>{:.16f}</Q3><QC>{:.16f}</QC></quaternion></quaternionState></attitudeState>".format(t, *one)
            for t, one in zip(TIMES, q)
        )
        head = "".join(f"<{k}>{v}</{k}>" for k, v in (META | meta).items())
        text = (
            f'<?xml version="1.0"?><aem id="CCSDS_AEM_VERS" version="{version}"><header/><body><segment>'
            f"<metadata>{head}</metadata><data>{states}</data></segment></body></aem>"
        )
    found = read(tmp_path, text, None, None)
    assert error_rad(found, turned) < 1e-14  # rad
    assert np.allclose(found.t_s, [10.0, 10.1, 10.2], atol=1e-9)  # s: the time library's two-part dates


@pytest.mark.parametrize(("segments", "where"), [(1, "state 2, Q3"), (2, "segment 2, state 2, Q3")])
def test_wrong_number_in_xml_is_told_with_its_state_and_of_several_segments_with_its_own(
    segments: int, where: str, tmp_path: Path
) -> None:
    state = (
        "<attitudeState><quaternionState><EPOCH>{}</EPOCH><quaternion><Q1>0.6</Q1><Q2>0</Q2><Q3>{}</Q3>"
        "<QC>0.8</QC></quaternion></quaternionState></attitudeState>"
    )
    head = "".join(f"<{k}>{v}</{k}>" for k, v in (META | OK).items())
    parts = []
    for n in range(segments):
        wrong = "O" if n == segments - 1 else "0"
        states = state.format(f"2024-11-20T03:4{n}:00Z", "0") + state.format(f"2024-11-20T03:4{n}:01Z", wrong)
        parts.append(f"<segment><metadata>{head}</metadata><data>{states}</data></segment>")
    text = f'<aem id="CCSDS_AEM_VERS" version="1.0"><header/><body>{"".join(parts)}</body></aem>'
    with pytest.raises(RawDataError, match=f"^attitudes: {where}: found O"):
        read(tmp_path, text, None, None)


@pytest.mark.parametrize("scale", ["UTC", "TAI"])
def test_times_of_a_message_may_be_days_of_the_year(scale: str, tmp_path: Path) -> None:
    meta = OK | {"TIME_SYSTEM": scale}
    days = [datetime.datetime.fromisoformat(t.rstrip("Z")).strftime("%Y-%jT%H:%M:%S.%f") + "Z" for t in TIMES]
    kinds = [kvn(meta, [f"{t} {Q}" for t in times], "1.0") for times in (TIMES, days)]
    dates, of_year = (read(tmp_path, text, None, None).t_s for text in kinds)
    assert np.array_equal(of_year, dates)
    with pytest.raises(RawDataError, match=r"line \d+, time: found 20.*, expected a day of that year"):
        read(tmp_path, kinds[1].replace(days[0][:8], f"{days[0][:5]}367"), None, None)


def test_keywords_of_version_1_may_only_say_what_version_2_says(tmp_path: Path) -> None:
    rows = [f"{t} 0.1 0.5 -0.7 0.5" for t in TIMES]
    plain = read(tmp_path, kvn(OK, rows, "2.0"), None, None).R_si
    same = kvn(OK | {"ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "LAST"}, rows, "2.0")
    assert np.array_equal(read(tmp_path, same, None, None).R_si.as_quat(), plain.as_quat())
    for key, value, only in (("ATTITUDE_DIR", "B2A", "A2B"), ("QUATERNION_TYPE", "FIRST", "LAST")):
        read(tmp_path, kvn(OK | {key: value}, rows, "1.0"), None, None)
        says = rf"line \d+, {key}: found {value}, expected {only}, as in version 2.0, which has no {key}"
        with pytest.raises(RawDataError, match=says):
            read(tmp_path, kvn(OK | {key: value}, rows, "2.0"), None, None)
    with pytest.raises(RawDataError, match=r"line 1, CCSDS_AEM_VERS: found 3.0, expected 1.0, 2.0"):
        read(tmp_path, kvn(OK, rows, "3.0"), None, None)


def test_message_in_gps_time_is_18_seconds_earlier(tmp_path: Path) -> None:
    meta = {"REF_FRAME_A": "GCRF", "REF_FRAME_B": "ST_1", "TIME_SYSTEM": "GPS"}
    rows = [f"{t} 0 0 0 1" for t in TIMES]
    assert np.allclose(read(tmp_path, kvn(meta, rows, "2.0"), None, None).t_s, [-8.0, -7.9, -7.8], atol=1e-9)


@pytest.mark.parametrize(("scale", "later_s"), [("UTC", 0.0), ("TAI", -37.0), ("GPS", -18.0)])
def test_times_of_a_table_are_in_the_scale_that_its_column_names(scale, later_s, tmp_path):
    # 2024: TAI - UTC = 37 s, GPS - UTC = 18 s (Bulletin C of the IERS)
    path = tmp_path / "attitudes.csv"
    path.write_text(csv_text(R_SI.as_quat()).replace("utc,", f"{scale.lower()},"))
    found = read_attitudes(path, "attitudes.csv", EPOCH, "GCRF", "inertial to head", scale)
    assert np.allclose(found.t_s, np.array([10.0, 10.1, 10.2]) + later_s, atol=1e-9)  # s
    other = "GPS" if scale == "TAI" else "TAI"
    with pytest.raises(RawDataError, match=f"column {other.lower()}: found no such column"):
        read_attitudes(path, "attitudes.csv", EPOCH, "GCRF", "inertial to head", other)


Q = "0 0 0 1"
OK = {"REF_FRAME_A": "GCRF", "REF_FRAME_B": "ST_1"}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (kvn(OK | {"REF_FRAME_A": "TEME"}, [f"{t} {Q}" for t in TIMES], "2.0"),
            r"META_START of line \d+, REF_FRAME_A and REF_FRAME_B: found TEME and ST_1"),
        (kvn(OK | {"TIME_SYSTEM": "TDR"}, [f"{t} {Q}" for t in TIMES], "2.0"),
            r"line \d+, TIME_SYSTEM: found TDR, expected UTC, TAI, TT, TDB or GPS"),
        (kvn(OK, [f"{t} {Q}" for t in TIMES], "2.0").replace("REF_FRAME_A = GCRF\n", ""),
            r"META_START of line \d+, REF_FRAME_A: found nothing"),
        ("\nCCSDS_APM_VERS = 2.0\nX\n", "line 2: found CCSDS_APM_VERS = 2.0, expected CCSDS_AEM_VERS or"),
        *(
            (
                kvn(OK | {"ATTITUDE_TYPE": kind}, [f"{TIMES[0]} 1 2 3"], "2.0"),
                rf"line \d+, ATTITUDE_TYPE: found {kind}, expected QUATERNION",
            )
            for kind in ("SPIN", "SPIN/NUTATION", "EULER ANGLE/RATE")
        ),
        (
            "<aem version='2.0'><body><segment><metadata>"
            "<REF_FRAME_A>GCRF</REF_FRAME_A><REF_FRAME_B>ST</REF_FRAME_B>"
            "<TIME_SYSTEM>UTC</TIME_SYSTEM><ATTITUDE_TYPE>SPIN</ATTITUDE_TYPE></metadata><data><attitudeState>"
            "<spin><EPOCH>x</EPOCH><SPIN_ALPHA>1</SPIN_ALPHA></spin></attitudeState></data></segment></body></aem>",
            "ATTITUDE_TYPE: found SPIN, expected QUATERNION",
        ),
        (kvn(OK, [f"{TIMES[0]} {Q}", f"{TIMES[0]} {Q}"], "2.0"), "attitude 2, time: found 0.000000 s after"),
        (kvn(OK, [f"{TIMES[0]} {Q}"], "2.0"), "rows: found 1 valid rows"),
        (kvn(OK, [f"{t} 0 0 1_0 1" for t in TIMES], "2.0"), "line 15, Q3: found 1_0"),
        (kvn(OK, [f"{t} 0 0 1 1" for t in TIMES], "2.0"), "attitude 1: found .* of length 1.41421"),
        (kvn(OK, [f"{t} {Q}" for t in TIMES], "2.0").replace("DATA_STOP", ""), "end of the file"),
        (kvn(OK, [f"{t} {Q}" for t in TIMES], "2.0").replace("DATA_START\n", ""),
            "DATA_STOP, expected DATA_START"),
        (kvn(OK | {"QUATERNION_TYPE": "MIDDLE"}, [f"{t} {Q}" for t in TIMES], "1.0"),
            r"line \d+, QUATERNION_TYPE: found MIDDLE, expected FIRST or LAST"),
        *(
            (
                "COMMENT two segments\n" + kvn(OK, [f"{TIMES[0]} {Q}"], "2.0")
                + kvn(OK | {key: name}, [f"{TIMES[1]} {Q}"], "2.0").partition("\n\n")[2],
                f"REF_FRAME_A and REF_FRAME_B: found {both}, expected one head, in all",
            )
            for key, name, both in (
                ("REF_FRAME_B", "ST_2", "ST_1; ST_2"), ("REF_FRAME_A", "ITRF2014", "ITRF and ST_1; ST_1")
            )
        ),
        ("<aem version='2.0'><body>", "XML"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><aem>&b;</aem>", "XML"),
        ("<oem/>", "root element: found oem"),
    ],
)  # fmt: skip
def test_message_that_is_not_sound_is_refused(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(RawDataError, match=complaint):
        read(tmp_path, text, None, None)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("utc,qx,qy,qz\n", "column qw: found no such column"),
        ("utc,qx,qy,qz,qw,sigma_x_arcsec\n" + f"{TIMES[0]},0,0,0,1,2\n", "header: found sigma_x_arcsec only"),
        ("utc,qx,qy,qz,qw,valid\n" + f"{TIMES[0]},0,0,0,1,yes\n", "line 2, valid: found yes"),
        ("utc,qx,qy,qz,qw\n" + f"{TIMES[0]},0,0,0,nan\n", "line 2, qw: found nan"),
        ("utc,qx,qy,qz,qw\n2024-13-01T00:00:00,0,0,0,1\n", "utc: found"),
        (csv_text(R_SI.as_quat(), ",sigma_x_arcsec,sigma_y_arcsec,sigma_z_arcsec", (",1,0,1",) * 3),
            "sigma: found"),
    ],
)  # fmt: skip
def test_table_that_is_not_sound_is_refused(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(RawDataError, match=complaint):
        read(tmp_path, text)


WRITTEN = Rotation.from_euler("xyz", [[40.0 + 0.1 * k, -65.0, 110.0] for k in range(5)], degrees=True)


@pytest.mark.parametrize("name", ["ccsds_ndm_1.0.aem", "ccsds_ndm_1.0.xml", "ccsds_ndm_2.0.xml"])
def test_messages_written_by_ccsds_ndm_are_read_as_they_are_and_packed(name: str, tmp_path: Path) -> None:
    path, packed = ROOT / "fixtures" / "attitudes" / name, tmp_path / f"{name}.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    for found in (read_attitudes(one, one.name, EPOCH, None, None) for one in (path, packed)):
        assert error_rad(found, WRITTEN) < 1e-14  # rad
        assert np.allclose(found.t_s, 10.25 + np.arange(5), atol=1e-9)  # s


def test_our_own_messages_come_back(tmp_path: Path) -> None:
    header = AemHeader(creation_utc="2024-11-21T00:00:00", object_name="SAT")
    text = attitude_message(header, ["round trip"], TIMES, R_SI)
    assert error_rad(read(tmp_path, text, None, None)) < 1e-14  # rad: 15 decimals
