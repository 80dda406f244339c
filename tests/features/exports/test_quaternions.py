"""Steps of time between exported attitudes: as short as their interpolation needs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from boresight.features.exports.quaternions import STEPS_S, step_between_attitudes
from boresight.geometry.record import record, scalar

RATE = np.array([3e-4, -1.06e-3, 2e-4])  # rad/s, of an orbit


@record
class Jittery:
    """A constant rate with a sine about one axis and, every 0.1 s, a jump about another."""

    sine_rad: float = scalar("its amplitude")
    hz: float = scalar("its frequency")
    jump_rad: float = scalar("size of the jumps")
    span_s: tuple[float, float] = (0.0, 10.0)

    def R_si(self, t_s: ArrayLike) -> Rotation:
        t = np.asarray(t_s, dtype=float)
        sine = self.sine_rad * np.sin(2.0 * np.pi * self.hz * t)
        jump = self.jump_rad * (np.floor(10.0 * t) % 2)
        return Rotation.from_rotvec(np.column_stack([sine, jump, 0.0 * t])) * Rotation.from_rotvec(
            np.outer(t, RATE)
        )


@pytest.mark.parametrize(("sine_rad", "hz"), [(0.0, 1.0), (5e-6, 1.3), (5e-6, 2.0), (2e-5, 2.0)])
@pytest.mark.parametrize("pixel_rad", [1e-6, 1.27e-5])
def test_great_circles_between_the_attitudes_miss_by_less_than_the_limit(
    sine_rad: float, hz: float, pixel_rad: float
) -> None:
    attitude, limit = Jittery(sine_rad, hz, 0.0), 0.003 * pixel_rad
    step = step_between_attitudes(attitude, 0.0, 10.0, limit)
    t = np.arange(0.0, 10.0 + 0.5 * step, step)
    at = np.random.default_rng(1).uniform(0.0, 10.0, 2000)
    missed = (Slerp(t, attitude.R_si(t))(at) * attitude.R_si(at).inv()).magnitude()
    assert missed.max() < 1.05 * limit  # places of the largest error other than the middles of the steps
    # and no shorter than needed: a sine is missed by (2 pi hz step)^2 / 8 of its size
    needed = np.sqrt(8.0 * limit / max(sine_rad, 1e-30)) / (2.0 * np.pi * hz)
    assert step == STEPS_S[0] or step > 0.45 * needed


def test_jumps_that_no_step_follows_do_not_ask_for_the_shortest() -> None:
    assert step_between_attitudes(Jittery(0.0, 1.0, 1e-6), 0.0, 10.0, 1e-9) > STEPS_S[-1]
