"""The satellite's motion."""

import numpy as np

from boresight.geometry.constants import GM_EARTH, J2_EARTH, WGS84
from boresight.simulator.motion import acceleration


def potential(p: np.ndarray) -> float:
    """GM / r (1 - J2 (a / r)² P2(z / r)) (Vallado, eq. 8-18 with the second zonal term only)."""
    r = np.linalg.norm(p)
    second = 0.5 * (3.0 * (p[2] / r) ** 2 - 1.0)
    return float(GM_EARTH / r * (1.0 - J2_EARTH * (WGS84.semi_major_m / r) ** 2 * second))


def test_acceleration_is_the_gradient_of_the_potential_of_a_flattened_earth() -> None:
    # Central differences over 100 m: error of the difference below 1e-7 of J2's part, 0.01 m/s².
    for p in np.array([[6.9e6, 0.0, 0.0], [1.2e6, -4.0e6, 5.5e6], [2e5, 1e5, -6.9e6]]):
        steps = 100.0 * np.eye(3)
        gradient = [(potential(p + s) - potential(p - s)) / 200.0 for s in steps]
        found = np.asarray(acceleration(0.0, np.concatenate([p, np.zeros(3)])))[3:]
        np.testing.assert_allclose(found, gradient, atol=1e-6)  # m/s²; J2 makes 0.013
