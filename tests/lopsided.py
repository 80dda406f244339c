"""A mission in which nothing is symmetric: no term vanishes, no two axes or numbers are alike.

The date is far from an equinox, the satellite moves in no coordinate plane, heads point in bold directions
with unequal noise about each axis, and places lie south and west.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch

EPOCH = Epoch.from_utc("2025-11-03T08:41:07Z")
TIMES_S = np.array([-813.25, 12.4, 401.7, 5211.9])  # s, and not about zero
VELOCITIES_I = np.array(  # m/s, GCRS
    [
        [-2210.0, 5120.0, 5030.0],
        [1260.0, -7010.0, 2510.0],
        [5840.0, 3110.0, -3720.0],
        [-610.0, -3300.0, 6820.0],
    ]
)
ATTITUDES = Rotation.from_euler(
    "zxz",
    [[40.0, 65.0, -110.0], [-155.0, 112.0, 33.0], [78.0, 24.0, 141.0], [-63.0, 97.0, -12.0]],
    degrees=True,
)
HEADS = {  # noise about the heads' own axes, which are not those of the attitudes
    name: AttitudeNoise(
        white_rad=np.array(white) * ARCSEC,
        correlated_rad=np.array(correlated) * ARCSEC,
        correlation_time_s=np.array(times),
        constant_rad=np.array(constant) * ARCSEC,
        R_sn=Rotation.from_euler("xyz", angles, degrees=True),
    )
    for name, white, correlated, times, constant, angles in (
        ("port", (1.3, 0.7, 9.0), (2.1, 0.9, 6.0), (3.0, 8.0, 1.4), (0.8, 2.9, 4.0), (40.0, -65.0, 110.0)),
        ("zenith", (0.4, 2.2, 5.0), (0.0, 3.0, 1.0), (0.7, 2.0, 11.0), (5.0, 0.3, 1.1), (-20.0, 80.0, 35.0)),
        ("star", (6.0, 1.0, 0.5), (1.0, 0.2, 4.0), (5.0, 0.9, 2.5), (0.2, 1.7, 3.3), (155.0, 15.0, -70.0)),
    )
}
PLACES = {
    "Ushuaia": (-54.8019, -68.303, 21.5),
    "Walvis": (-22.9576, 14.5053, 7.25),
    "Sitka": (57.0531, -135.33, 4.5),
}
