"""A real datastrip of Sentinel-2A against the operator's own location grids; and damaged files."""

import gzip
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from edits import replaced
from handmade_sentinel2 import SPAMOD, VIEDIR, write_sentinel2
from scipy.spatial.transform import Rotation, Slerp

from boresight.features.exports.operator_parameters import fit_correction
from boresight.features.operators.imported_mission import write_imported
from boresight.features.operators.sentinel2_grid import (
    operator_orbit,
    operator_pushbroom,
    refined_attitudes,
    refined_camera,
)
from boresight.features.operators.sentinel2_import import sentinel2_mission
from boresight.features.operators.sentinel2_product import (
    AttitudeRecord,
    GyroAngles,
    Sentinel2,
    read_sentinel2,
)
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.groundlight import apparent_ground_directions
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_cameras

REAL = Path(__file__).parents[3] / ".." / "shared" / "data" / "sentinel2"
needs_real_data = pytest.mark.skipif(
    not (REAL / "grid_B04.csv").exists(), reason=f"the real Sentinel-2 datastrip is not there: {REAL}"
)
# Bulletin A of 24 October 2019, which the operator's software used: UT1 - UTC (s), x and y of the pole (")
DAYS = np.arange(59075.0, 59081.0)
UT1_UTC = np.array([-0.27451, -0.27419, -0.27381, -0.27347, -0.27321, -0.27314])
POLE = np.array(
    [[0.2388, 0.2391, 0.2393, 0.2396, 0.2397, 0.2399], [0.3653, 0.3636, 0.3620, 0.3603, 0.3587, 0.3570]]
)


@cache
def real(band: str) -> Sentinel2:
    """A band of the real datastrip."""
    return read_sentinel2(next(REAL.glob("*MTD_L1B_DS*.xml")), REAL, band)


def operator_table() -> EarthOrientationTable:
    return EarthOrientationTable(
        mjd_utc=DAYS,
        ut1_utc_s=UT1_UTC,
        xp_rad=POLE[0] * ARCSEC,
        yp_rad=POLE[1] * ARCSEC,
        dx_rad=0.0 * DAYS,
        dy_rad=0.0 * DAYS,
        source="IERS Bulletin A, 2019-10-24",
        mjd_last_measured=float(DAYS[-1]),
    )


@needs_real_data
@pytest.mark.parametrize("interpolation, largest_m", [("taylor", 0.005), ("lagrange", 0.4)])
def test_pixels_of_a_real_datastrip_lie_where_its_operator_puts_them(interpolation, largest_m):
    # Largest difference of 174 of the 1740 points of the grid of B04; measured: 1.8 mm and 0.13 m of all.
    strip = real("B04")
    orbit = operator_orbit(strip, operator_table())
    grid = np.loadtxt(REAL / "grid_B04.csv", delimiter=",", skiprows=1, usecols=(1, 3, 4, 5, 6, 7))[::10]
    for detector in range(1, 13):
        push = operator_pushbroom(strip, detector - 1, orbit)
        push = replace(push, attitude=replace(push.attitude, interpolation=interpolation))
        for _, line, sample, lon, lat, height in grid[grid[:, 0] == detector]:
            ours = push.ground_points(detector - 1, [sample], [line - 1.0], ConstantHeight(height))
            there = ecef_from_geodetic(np.radians(lat), np.radians(lon), height, WGS84)
            assert np.linalg.norm(ours - there) < largest_m


@needs_real_data
def test_bands_of_a_real_datastrip_are_the_cameras_of_one_dump(tmp_path):
    bands = [real(band) for band in ("B04", "B02")]
    write_imported(tmp_path / "both", sentinel2_mission(bands, "test"))
    views = {view.camera: view for view in open_cameras(tmp_path / "both", sky_alone=True)}
    assert sorted(views) == ["B02", "B04"]
    for band in bands:
        view = views[band.band]
        assert {strip.strip_id for strip in view.strips} == {band.band}
        assert [head.name for head in view.heads] == ["STR1", "STR2"]
        for ccd in (0, 11):
            at = np.array([0.0, 1295.5])
            ours, theirs = (one.directions_from_pixels(ccd, at) for one in (view.line_camera, band.camera))
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


@needs_real_data
def test_the_gyros_of_a_real_datastrip_turn_as_its_trackers_do(tmp_path):
    strip = real("B04")
    write_imported(tmp_path / "raw", sentinel2_mission([strip], "test"))
    heads = open_cameras(tmp_path / "raw", sky_alone=True)[0].heads
    gyro = heads[0].gyro
    assert gyro is not None and 0.01 < gyro.noise.random_walk_rad / ARCSEC < 0.04
    for head in heads:  # the axes were found with another record, the corrected one
        t, rows, R_hs = gyro.t_s[3:-3], head.source.rows, head.R_cs0.inv() * heads[0].R_cs0
        R_hz, R_hi = gyro.in_axes(R_hs).turned(t), Slerp(rows.t_s, rows.R_si)(t)
        off = (R_hi * (R_hz * R_hz[40].inv() * R_hi[40]).inv()).as_rotvec()
        off -= np.vander(t, 2) @ np.linalg.lstsq(np.vander(t, 2), off, rcond=None)[0]  # a bias
        assert np.all(off.std(axis=0) / ARCSEC < [1.3, 1.3, 10.0])  # the noise of one row of a tracker


def test_the_axes_of_gyros_are_those_that_the_corrected_attitudes_show(files):
    strip = read_sentinel2(files / "S2A_OPER_MTD_L1B_DS_TEST.xml", files, "B04")
    assert strip.gyros is None and sentinel2_mission([strip], "test").gyro is None
    rng, t, walk = np.random.default_rng(5), 0.1 * np.arange(900), 0.02 * ARCSEC
    angle = 1e-4 * np.stack([np.sin(t / 7.0), np.cos(t / 5.0), np.sin(t / 9.0)], axis=1)
    angle += np.outer(t, [0.0, -1.04e-3, 0.0])
    R_is = [Rotation.identity()]
    for step in np.diff(angle, axis=0):
        R_is.append(R_is[-1] * Rotation.from_rotvec(step))
    four = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
    axes = Rotation.random(rng=rng).apply(four)
    at = np.delete(np.arange(5, 895, 10), [11, 12, 13, 40, 71, 72])  # rows that are missing
    step_s = np.diff(t[at], prepend=t[at[0]] - 1.0)[:, None]
    errors = np.cumsum(walk * np.sqrt(step_s) * rng.standard_normal((len(at), 4)), axis=0)
    errors += np.outer(t[at], [1e-6, -2e-6, 3e-6, 0.0])
    gyros = GyroAngles(t[at], angle[at] @ axes.T + errors)
    corrected = AttitudeRecord(t, Rotation.concatenate(R_is))
    found = sentinel2_mission([replace(strip, corrected=corrected, gyros=gyros)], "test").gyro
    off = (found.turns_g[1:] - np.diff(angle[at], axis=0)) / np.sqrt(step_s[1:])
    assert np.all(np.sqrt((off**2).mean(axis=0)) < 1.5 * walk)  # the bias of each gyro is taken out
    assert found.random_walk_rad == pytest.approx(np.sqrt(0.75) * walk, rel=0.3)  # of four axes, about three
    assert (found.R_sg * strip.R_ps["STR1"]).magnitude() < 1e-12
    wrong = GyroAngles(gyros.t_s, 1.5 * gyros.angles_rad)
    assert sentinel2_mission([replace(strip, corrected=corrected, gyros=wrong)], "test").gyro is None


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sentinel2")
    write_sentinel2(folder)
    return folder


def test_what_the_files_say_is_read(files):
    strip = read_sentinel2(files / "S2A_OPER_MTD_L1B_DS_TEST.xml", files, "B04")
    assert strip.satellite == "Sentinel-2A" and strip.lines == 4608
    assert strip.camera.n_ccds == 2 and strip.camera.n_px(1) == 24
    # the epoch is 12:02:02 UTC; line 0 of detector 01 begins 2.5 s after 12:02:00 UTC
    assert strip.t_first_row_s == pytest.approx([0.5 + 0.7829e-3, 4.5 + 0.7829e-3], abs=1e-9)
    u = strip.camera.directions_from_pixels(0, np.array([3.0]))[0]
    assert u / u[2] == pytest.approx([0.01 + 3e-8, 0.001 - 3 * 1.27e-5, 1.0], abs=1e-12)
    # P: intrinsic about y, x, z, written out as the product of elementary matrices
    x, y, z = -3e-5, -9.6e-4, 2e-5
    P = Rotation.from_rotvec([0, y, 0]) * Rotation.from_rotvec([x, 0, 0]) * Rotation.from_rotvec([0, 0, z])
    assert (strip.R_cp * P.inv()).magnitude() < 1e-15
    refining = strip.refining
    assert refining is not None and refining.t_middle_s == pytest.approx(5.5)
    there = refining.rotations(np.array([15.5])).as_rotvec()[0]
    assert there == pytest.approx([1.6e-6, 3e-6, 1e-6], abs=1e-11)  # rad; products of angles are left
    t = strip.trackers["STR2"].t_s
    assert t == pytest.approx(strip.corrected.t_s)
    back = strip.trackers["STR2"].R_is * strip.R_ps["STR2"].inv()
    assert (back * strip.corrected.R_is.inv()).magnitude().max() < 1e-14
    # the datastrip's own values are those of IERS Bulletin A for that day, 16 August 2020
    earth, ones = strip.earth_orientation, np.ones(6)
    np.testing.assert_allclose(earth.xp_rad / ARCSEC, POLE[0][2] * ones, rtol=1e-12)
    np.testing.assert_allclose(earth.yp_rad / ARCSEC, POLE[1][2] * ones, rtol=1e-12)
    np.testing.assert_allclose(earth.ut1_utc_s, UT1_UTC[2] * ones, rtol=1e-12)


def test_the_operator_s_refining_turns_and_scales_the_piloting_frame(files):
    strip = read_sentinel2(files / "S2A_OPER_MTD_L1B_DS_TEST.xml", files, "B04")
    turned = refined_attitudes(strip).R_is.inv() * strip.corrected.R_is  # about axes of the piloting frame
    Q = strip.refining.rotations(strip.corrected.t_s)
    np.testing.assert_allclose(turned.as_rotvec(), Q.as_rotvec(), rtol=0, atol=1e-15)
    sample = np.array([0.0, 7.5, 23.0])
    for ccd in (0, 1):
        looks_p = strip.R_cp.inv().apply(strip.camera.directions_from_pixels(ccd, sample))
        looks_p[:, 2] *= 1.0 - 2.5e-6  # as Rugged's FixedZHomothety
        expected = strip.R_cp.apply(looks_p / np.linalg.norm(looks_p, axis=1, keepdims=True))
        found = refined_camera(strip).directions_from_pixels(ccd, sample)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)  # rad; the factor moves 2.5e-8


def test_lines_of_a_band_of_20_m_last_twice_as_long(files, tmp_path):
    folder = shutil.copytree(files, tmp_path / "b20")
    path = folder / "S2A_OPER_MTD_L1B_DS_TEST.xml"
    assert path.read_text().count("<RESOLUTION>10<") == 1
    replaced(path, "<RESOLUTION>10<", "<RESOLUTION>20<")
    strip = read_sentinel2(path, folder, "B04")
    assert strip.row_period_s == pytest.approx(2.0 * 1.5658e-3, rel=1e-12)
    # the middle of the first line is half of its own time after its beginning
    assert strip.t_first_row_s == pytest.approx([0.5 + 1.5658e-3, 4.5 + 1.5658e-3], abs=1e-9)


@pytest.mark.parametrize(
    ("name", "old", "new", "field"),
    [
        ("S2A_OPER_MTD_L1B_DS_TEST", "<LINE_PERIOD>1.5658<", "<LINE_PERIOD>-1<", "LINE_PERIOD"),
        ("S2A_OPER_MTD_L1B_DS_TEST", "<REFERENCE_LINE>1<", "<REFERENCE_LINE>7<", "Time_Stamp"),
        ("S2A_OPER_MTD_L1B_DS_TEST", "2020-08-16T12:02:02.500Z", "noon", "SENSING_START"),
        ("S2A_OPER_MTD_L1B_DS_TEST", "<UT1_UTC>-0.27381<", "<UT1_UTC>-27<", "IERS_Bulletin"),
        ("S2A_OPER_MTD_L1B_DS_TEST", f"<GIPP_FILENAME>{VIEDIR}<", "<GIPP_FILENAME>../../etc<", "GIPP_List"),
        ("S2A_OPER_MTD_L1B_DS_TEST", 'physicalBand="B4"', 'physicalBand="B5"', "Spectral_Information"),
        ("S2A_OPER_MTD_L1B_DS_TEST", "<QUATERNION_VALUES>", "<QUATERNION_VALUES>9 ", "QUATERNION_VALUES"),
        (SPAMOD, "<SCALAR>0.8<", "<SCALAR>0.9<", "STR1_ATT_QUATERNION"),
        (SPAMOD, '<R1 axis="X" unit="mrad">-0.03<', '<R1 axis="Z" unit="mrad">-0.03<', "R1"),
        (VIEDIR, "<NB_OF_PIXELS>24<", "<NB_OF_PIXELS>25<", "TAN_PSI_X_LIST"),
        (VIEDIR, 'detector_id="02"', 'detector_id="03"', "detector_id"),
        (VIEDIR, " 0.010000200000 ", " 0.040000200000 ", "VIEWING_DIRECTIONS"),
        (VIEDIR, "<GS2_VIEWING_DIRECTIONS>", "<!DOCTYPE d [<!ENTITY a 'b'>]><GS2_VIEWING_DIRECTIONS>", "XML"),
    ],
)
def test_damaged_files_are_refused_by_file_and_field(files, tmp_path, name, old, new, field):
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    replaced(tmp_path / f"{name}.xml", old, new)
    with pytest.raises(RawDataError) as error:
        read_sentinel2(tmp_path / "S2A_OPER_MTD_L1B_DS_TEST.xml", tmp_path, "B04")
    assert field in error.value.field and error.value.file == f"{name}.xml"


def test_a_datastrip_compressed_with_gzip_is_read_as_plain(files, tmp_path):
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    plain = tmp_path / "S2A_OPER_MTD_L1B_DS_TEST.xml"
    packed = tmp_path / "packed.xml.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    one, other = (read_sentinel2(path, tmp_path, "B04") for path in (plain, packed))
    assert np.array_equal(one.positions_m, other.positions_m) and one.lines == other.lines
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(RawDataError, match=r"packed\.xml\.gz: gzip: found "):
        read_sentinel2(packed, tmp_path, "B04")


def test_angles_further_down_the_chain_are_refused(files, tmp_path):
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    below = "<FOCAL_PLANE_TO_DETECTOR_VNIR><R1>0</R1><R2>0.1</R2><R3>0</R3></FOCAL_PLANE_TO_DETECTOR_VNIR>"
    replaced(tmp_path / f"{SPAMOD}.xml", "</DATA>", f"{below}</DATA>")
    with pytest.raises(RawDataError, match="not supported"):
        read_sentinel2(tmp_path / "S2A_OPER_MTD_L1B_DS_TEST.xml", tmp_path, "B04")


@needs_real_data
def test_the_operators_refining_of_a_real_datastrip_is_found_again():
    # The operator's grids contain its refining: three angles, rates and a scale, here from 145 points each of
    # two detectors; urad, urad/s and 1e-6 as its file has them. The grids are rounded to 1 mm, 1.3 nrad.
    strip = real("B04")
    orbit = operator_orbit(strip, operator_table())
    grid = np.loadtxt(REAL / "grid_B04.csv", delimiter=",", skiprows=1, usecols=(1, 3, 4, 5, 6, 7))
    v_s, u_c, t_s = [], [], []
    for detector in (2, 11):
        rows = grid[grid[:, 0] == detector]
        push = operator_pushbroom(replace(strip, refining=None), detector - 1, orbit)
        t = push.instants(rows[:, 1] - 1.0)
        p_e = ecef_from_geodetic(np.radians(rows[:, 4]), np.radians(rows[:, 3]), rows[:, 5], WGS84)
        u_i, _ = apparent_ground_directions(p_e, t, orbit, orbit.earth, push.effects)
        v_s.append(push.attitude.R_si(t).apply(u_i))
        u_c.append(strip.camera.directions_from_pixels(detector - 1, rows[:, 2]))
        t_s.append(t)
    v_s, u_c, t_s = np.concatenate(v_s), np.concatenate(u_c), np.concatenate(t_s)
    refining = strip.refining
    found = fit_correction(v_s, u_c, t_s, strip.R_cp, refining.t_middle_s)
    assert 1e6 * found.angles_rad[0] == pytest.approx([c[0] * 1e6 for c in refining.angles], abs=0.005)
    assert 1e6 * found.angles_rad[1] == pytest.approx([c[1] * 1e6 for c in refining.angles], abs=0.005)
    assert 1e6 * found.scale == pytest.approx(1e6 * refining.homothety, abs=0.005)
