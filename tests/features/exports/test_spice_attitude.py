"""CK, SCLK, FK and IK, loaded by NAIF's own toolkit; leap seconds for it are those of ERFA."""

import numpy as np
import pytest
import spiceypy
from leap_seconds import leap_second_kernel
from scipy.spatial.transform import Rotation

from boresight.features.exports import spice_export as made
from boresight.features.exports.spice_export import SpiceFrames, frame_kernel
from boresight.geometry.epoch import Epoch, ephemeris_time
from boresight.geometry.line_camera import LookAngleCamera, LookTable

EPOCH = Epoch.from_utc("2020-08-16T12:02:20")
R_CS = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
CAMERA = LookAngleCamera(
    (
        LookTable(2552, np.arange(2552.0), np.full(2552, 0.012), -0.18 + 1.3e-5 * np.arange(2552)),
        LookTable(2552, np.arange(2552.0), np.full(2552, -0.012), -0.15 + 1.3e-5 * np.arange(2552)),
    )
)
FRAMES = SpiceFrames()
NOTE = "\n".join(["attitudes of a strip", *(f"remark {n:04d} " + "x" * 70 for n in range(40))])


def attitude(t_s):
    """A satellite that turns by four degrees a minute, through half a turn of its quaternion's sign."""
    return Rotation.from_rotvec(np.outer(2.9 + 1.1e-3 * np.asarray(t_s), [0.48, -0.6, 0.64])) * R_CS


@pytest.fixture(scope="module")
def ticks_and_instants(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kernels")
    ticks, t_s = made.on_ticks(EPOCH, np.linspace(-3.0, 22.0, 801))
    texts = {
        "a.tls": leap_second_kernel(),
        "a.tsc": made.clock_kernel(EPOCH, FRAMES, "a clock"),
        "a.tf": frame_kernel(R_CS, "frames", FRAMES),
        "a.ti": made.instrument_kernel(CAMERA, FRAMES, "fields of view"),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / "a.bc").write_bytes(made.attitude_kernel(ticks, attitude(t_s), FRAMES, "strip S01", NOTE))
    for name in (*texts, "a.bc"):
        spiceypy.furnsh(str(folder / name))
    yield ticks, t_s
    spiceypy.kclear()


def test_attitudes_are_reproduced_to_1e_12(ticks_and_instants):
    ticks, t_s = ticks_and_instants
    assert len(t_s) > 750 and t_s[0] >= -3.0 and t_s[-1] <= 22.0
    zero = made.clock_zero(EPOCH)
    for n in range(0, len(ticks), 7):
        et = zero + ticks[n] * made.TICK_S
        camera = spiceypy.pxform("J2000", FRAMES.remote_camera_name, et)
        assert np.abs(camera - (R_CS * attitude(t_s[n : n + 1]))[0].as_matrix()).max() < 1e-12


def test_utc_leads_to_the_attitude_of_that_instant(ticks_and_instants):
    # 0.06 us by which doubles of ephemeris time are rounded turn a satellite of 1.1e-3 rad/s by 7e-11 rad
    for t in (0.0, 3.3, 20.123456):
        (utc,) = EPOCH.utc_from_seconds([t])
        et = spiceypy.str2et(utc.rstrip("Z"))
        assert ephemeris_time(EPOCH, np.array([t]))[0] == pytest.approx(et, abs=2e-7)
        star = spiceypy.pxform("J2000", FRAMES.star_camera_name, et)
        assert np.abs(star - attitude([t])[0].as_matrix()).max() < 3e-10


def test_spice_knows_both_frames_by_name_and_id(ticks_and_instants):
    assert spiceypy.namfrm("BORESIGHT_REMOTE_CAMERA") == -999002
    assert spiceypy.frmnam(-999001) == "BORESIGHT_STAR_CAMERA"


@pytest.mark.parametrize("name", ["lower", "WITH SPACE", "X" * 33, ""])
def test_names_that_spice_cannot_take_are_refused(name):
    with pytest.raises(ValueError, match="frame name"):
        SpiceFrames(remote_camera_name=name)


def test_there_is_no_attitude_outside_the_strip(ticks_and_instants):
    with pytest.raises(spiceypy.exceptions.SpiceyError):
        spiceypy.pxform("J2000", FRAMES.star_camera_name, ephemeris_time(EPOCH, np.array([30.0]))[0])


def test_the_comment_area_is_read(ticks_and_instants, tmp_path):
    ticks, t_s = ticks_and_instants
    path = tmp_path / "b.bc"
    path.write_bytes(made.attitude_kernel(ticks, attitude(t_s), FRAMES, "S01", NOTE))
    handle = spiceypy.dafopr(str(path))
    n, lines, done = spiceypy.dafec(handle, 60, 200)
    *_, free = spiceypy.dafrfr(handle)
    spiceypy.dafbfs(handle)
    assert spiceypy.daffna() and free == spiceypy.dafus(spiceypy.dafgs(), 2, 6)[1][-1] + 1  # after the data
    spiceypy.dafcls(handle)
    assert done and n == 41 and list(lines)[:41] == NOTE.splitlines()


def test_fields_of_view_are_the_cameras(ticks_and_instants):
    for ccd in (0, 1):
        number = spiceypy.bodn2c(f"{FRAMES.remote_camera_name}_CCD{ccd}")
        shape, frame, boresight, n, corners = spiceypy.getfov(number, 10)
        assert (shape, frame, n) == ("POLYGON", FRAMES.remote_camera_name, 4)
        assert number == FRAMES.remote_camera_id - 1 - ccd
        ends = CAMERA.directions_from_pixels(ccd, np.array([-0.5, 2551.5]))
        assert boresight == pytest.approx(corners.mean(axis=0), abs=1e-15)
        assert corners[[3, 2], 0] - corners[:2, 0] == pytest.approx(CAMERA.pixel_rad, rel=1e-9)
        corners = corners / np.linalg.norm(corners, axis=1, keepdims=True)
        middle = [corners[0] + corners[3], corners[1] + corners[2]]
        for got, expected in zip(middle, ends):
            assert np.abs(got / np.linalg.norm(got) - expected).max() < 1e-10
    _, _, _, _, corners = spiceypy.getfov(FRAMES.remote_camera_id, 10)
    tangents = corners[:, :2] / corners[:, 2:]
    assert tangents.min(axis=0) == pytest.approx([-0.012, -0.18], abs=2e-5)
    assert tangents.max(axis=0) == pytest.approx([0.012, -0.15 + 2552 * 1.3e-5], abs=2e-5)


def test_a_single_attitude_is_refused():
    with pytest.raises(ValueError, match="two or more"):
        made.attitude_kernel(np.zeros(1), attitude([0.0]), FRAMES, "x", "")
