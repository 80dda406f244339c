"""Series of rotations as formats of attitudes take them: steps of time, and quaternions."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import Attitude
from boresight.geometry.record import Floats

__all__ = ["continuous_quaternions", "step_between_attitudes"]

STEPS_S = tuple(2.0**-n for n in range(5, 11))  # s; whole ticks of the clock of SPICE kernels
# Error of a step, of that of the step before, above which it is a jump that no step follows: it falls to a
# quarter where the attitude is smooth, to a half where its rate jumps.
JUMP = 0.7


def step_between_attitudes(attitude: Attitude, first_s: float, last_s: float, limit_rad: float) -> float:
    """The longest of `STEPS_S` between attitudes that, interpolated along great circles, miss `attitude` by
    at most `limit_rad` between two instants; where it jumps, the longest that misses by nothing else.
    """
    chosen, before = STEPS_S[0], np.inf
    for step in STEPS_S:
        t_s = np.linspace(first_s, last_s, int(np.ceil((last_s - first_s) / step)) + 1)
        R = attitude.R_si(t_s)
        half = Rotation.from_rotvec(0.5 * (R[1:] * R[:-1].inv()).as_rotvec()) * R[:-1]
        missed = float((attitude.R_si(0.5 * (t_s[1:] + t_s[:-1])) * half.inv()).magnitude().max())
        if missed > JUMP * before:
            break
        chosen, before = step, missed
        if missed <= limit_rad:
            break
    return chosen


def continuous_quaternions(rotations: Rotation) -> Floats:
    """Quaternions (N, 4), scalar last, of rotations (N,), each with the sign nearer to the one before it, so
    that neighbours can be interpolated.
    """
    q = rotations.as_quat()
    turned = np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0
    return np.asarray(q * np.cumprod(np.concatenate([[1.0], np.where(turned, -1.0, 1.0)]))[:, None])
