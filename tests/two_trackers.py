"""Attitudes of two star cameras as those of Sentinel-2A, with the noise that is drawn."""

import numpy as np
from drawn_heads import correlated_noise
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.pipeline.head_noise.tracks import HeadTrack

ARCSEC = np.pi / 648_000.0
STEP, ROWS = 0.1, 930  # the record of Sentinel-2A's trackers
T = STEP * np.arange(ROWS)
R_SH = Rotation.from_euler("xyz", [50.0, 20.0, -70.0], degrees=True)
WHITE = np.array([[0.6, 0.9, 6.0], [0.9, 0.7, 6.8]])
CORRELATED = np.array([[0.4, 0.7, 4.7], [0.7, 0.35, 4.9]])
TIME = np.array([[0.5, 0.8, 1.2], [1.2, 0.4, 0.9]])
NOISE = [
    AttitudeNoise(
        white_rad=w * ARCSEC, correlated_rad=a * ARCSEC, correlation_time_s=tau, constant_rad=np.zeros(3)
    )
    for w, a, tau in zip(WHITE, CORRELATED, TIME)
]


def errors(rng: np.random.Generator, head: int) -> np.ndarray:
    slow = correlated_noise(CORRELATED[head], TIME[head], T, rng)
    return ARCSEC * (WHITE[head] * rng.standard_normal((ROWS, 3)) + slow)


def tracks(
    rng: np.random.Generator, late_s: float = 0.0, slew_rad_s2: float = 0.0
) -> tuple[HeadTrack, HeadTrack]:
    """Two heads on a satellite that follows its orbit, or slews about a lopsided axis."""

    def motion(t: np.ndarray) -> Rotation:
        angle = np.outer(0.5 * slew_rad_s2 * t**2, [0.6, -0.5, 0.62])
        return Rotation.from_rotvec(angle) * Rotation.from_rotvec(np.outer(t, [0.0, 1.1e-3, 0.0]))

    nominal = Rotation.from_rotvec(np.outer(T, [0.0, 1.1e-3, 0.0]))
    a = Rotation.from_rotvec(errors(rng, 0)) * motion(T)
    b = Rotation.from_rotvec(errors(rng, 1)) * R_SH.inv() * motion(T - late_s)
    return HeadTrack(name="A", t_s=T, R_hi=a, R_oi=nominal), HeadTrack(name="B", t_s=T, R_hi=b, R_oi=nominal)
