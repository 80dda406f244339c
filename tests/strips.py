"""Strips of a four-CCD camera on a satellite at 530 km, for the tests of this folder."""

import numpy as np
from four_ccds import four_ccds
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import GM_EARTH
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock

EPOCH = Epoch.from_utc("2024-03-05T10:20:30Z")
EARTH = EarthRotation.over(EPOCH, -40.0, 60.0, bundled_earth_orientation())
# All axes far from one another: a wrong order or sign shows.
R_CS = Rotation.from_euler("xyz", [150.0, -25.0, 70.0], degrees=True)
PERIOD_S = 6.6e-5
LINES = 26_000


def states(t_s):
    """A circular orbit at 530 km, inclined by 97 deg, over 36 deg of latitude at t = 0."""
    radius, tilt = 6_908e3, 1.7
    rate = np.sqrt(GM_EARTH / radius**3)
    angle = rate * np.asarray(t_s) + 0.7
    c, s = np.cos(angle), np.sin(angle)
    p = radius * np.stack([c, s * np.cos(tilt), s * np.sin(tilt)], axis=-1)
    return p, radius * rate * np.stack([-s, c * np.cos(tilt), c * np.sin(tilt)], axis=-1)


def orbit():
    t_s = np.arange(-30.0, 50.0)
    p, v = states(t_s)
    return Orbit(epoch=EPOCH, t_s=t_s, positions_m=p, velocities_m_s=v, frame="GCRF", degree=7, earth=EARTH)


def camera(tdi_stages=1, time_of_row="middle"):
    """Four CCDs of 6144 px, 10 m focal length, overlapping by 100 px, staggered by 800 px, turned and
    distorted.
    """
    samples = np.array([0.0, 1500.0, 3067.0, 4600.0, 6143.0])
    offsets = np.array([18e-6, 6e-6, 0.0, -5e-6, -17e-6])
    tables = [
        {"distortion_samples": samples, "distortion_offsets_m": offsets * (1 - k / 2)} for k in range(4)
    ]
    return LineCamera(10.0, four_ccds(tables), tdi_stages, time_of_row)


def attitude(path, roll_deg=0.0, pitch_deg=0.0, wave_rad=6e-5, yaw_deg=0.0):
    """Exposures at 5 Hz of an attitude that points at the Earth and oscillates by 12", as in Fig. 4."""
    t_s = np.arange(-0.4, 2.6, 0.2)
    periods = np.array([3.1, 4.7, 5.0])
    wave = wave_rad * np.sin(2.0 * np.pi * t_s[:, None] / periods + [0.0, 1.0, 2.0])
    turn = Rotation.from_euler("xyz", [roll_deg, pitch_deg, yaw_deg], degrees=True)
    R_co = turn * Rotation.from_rotvec(wave)
    return AttitudeTrack(t_s, R_CS.inv() * R_co * path.R_oi(t_s), path)


def pushbroom(camera, rows, path, attitude, R_cs, effects=None):
    effects = LightEffects() if effects is None else effects
    parts = {"camera": camera, "rows": rows, "orbit": path, "earth": path.earth, "attitude": attitude}
    return Pushbroom(**parts, R_cs=R_cs, effects=effects)


def strip(roll_deg=0.0, pitch_deg=0.0, effects=None, yaw_deg=0.0, **of_camera):
    path = orbit()
    track = attitude(path, roll_deg, pitch_deg, yaw_deg=yaw_deg)
    return pushbroom(camera(**of_camera), RowClock(0.013, PERIOD_S), path, track, R_CS, effects)
