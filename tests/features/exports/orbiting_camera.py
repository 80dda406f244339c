"""A strip for the tests of exports: bold mounting, oscillating attitude, two staggered, turned, distorted
CCDs whose images begin at different rows.
"""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation
from strips import pushbroom

from boresight.features.exports.notes import Notes
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import GM_EARTH
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock

NOTES = Notes(
    created="2026-01-01T00:00:00Z",
    program="boresight",
    mission='a "mission"',
    dump="d1",
    frames="f",
    valid="v",
    verdict="consistent",
    result="0123456789abcdef, 2026-01-01T00:00:00Z",
    inputs="i",
)
EPOCH = Epoch.from_utc("2025-03-20T02:31:07Z")
R_CS = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
LINES = 3000
LATER_ROWS = 97.37  # by which the image of CCD 1 begins after that of CCD 0


@cache
def strip() -> Pushbroom:
    """530 km, 0.53 m pixels behind 10 m, 1.6 degrees off nadir, roll and pitch waves of some arc-seconds."""
    t = np.arange(0.0, 41.0)
    earth = EarthRotation.over(EPOCH, t[0], t[-1], bundled_earth_orientation())
    radius, inclination = 6_908_137.0, np.radians(97.5)
    rate = np.sqrt(GM_EARTH / radius**3)
    u = 0.6 + rate * t
    node, across = np.array([0.8, 0.6, 0.0]), np.array([-0.6, 0.8, 0.0]) * np.cos(inclination)
    across = across + np.array([0.0, 0.0, np.sin(inclination)])
    p = radius * (np.outer(np.cos(u), node) + np.outer(np.sin(u), across))
    v = radius * rate * (np.outer(-np.sin(u), node) + np.outer(np.cos(u), across))
    orbit = Orbit(epoch=EPOCH, t_s=t, positions_m=p, velocities_m_s=v, frame="GCRF", degree=7, earth=earth)
    t_star = 18.0 + 0.2 * np.arange(20)
    wave = 1e-5 * np.column_stack([np.sin(t_star), np.cos(1.7 * t_star), 0.3 * np.sin(2.1 * t_star)])
    tilt = Rotation.from_euler("xy", [0.028, 0.012])
    R_ci = Rotation.from_rotvec(wave) * tilt * orbit.R_oi(t_star)
    attitude = AttitudeTrack(t_star, R_CS.inv() * R_ci, orbit)
    rows = RowClock(19.0 + 1e-3 / 3.0, 7e-5, {0: 0.0, 1: LATER_ROWS})
    return pushbroom(camera(), rows, orbit, attitude, R_CS)


def camera() -> LineCamera:
    samples = np.linspace(0.0, 2047.0, 25)
    x = (samples - 1000.0) / 1000.0
    strong = -(2e-5 * x**3 + 3e-5 * x**5)  # 5 px at the ends, of a degree that no cubic follows
    table = {"distortion_samples": samples, "distortion_offsets_m": strong}
    places = (
        {"y_first_m": -0.03, "x_offset_m": 0.002, "rotation_rad": 1.2e-3, "principal_sample": 1000.0} | table,
        {"y_first_m": -0.0115, "x_offset_m": -0.003, "rotation_rad": -8e-4, "principal_sample": 1023.0},
    )
    return LineCamera(10.0, tuple(Ccd(n_px=2048, pixel_m=1e-5, **place) for place in places))
