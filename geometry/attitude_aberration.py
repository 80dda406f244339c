"""The aberration that a star camera has left in its attitudes, taken out.

A head that compares measured directions with catalogue directions in which an aberration is missing reports
the attitude R_rep that takes the incomplete direction b of its line of sight to that line in the head's own
axes, which need not be their z. The complete apparent direction there is a, so the attitude in the sense of
this package is R_rep times the smallest rotation that takes a to b. Stars at an angle ρ from the line of
sight agree with that to ρ²/4 of the effect.
"""

from __future__ import annotations

from typing import Literal

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import SPEED_OF_LIGHT
from boresight.geometry.epoch import Epoch
from boresight.geometry.record import Floats

__all__ = ["AberrationRemoved", "with_all_aberration"]

AberrationRemoved = Literal["none", "annual", "annual and orbital"]
_AU_PER_DAY = erfa.DAU / erfa.DAYSEC  # m/s


def with_all_aberration(
    R_si: Rotation,
    removed: AberrationRemoved,
    epoch: Epoch,
    t_s: Floats,
    v_i: Floats,
    *,
    line_of_sight_s: Floats,
) -> Rotation:
    """Attitudes (N,) as if the head had used apparent directions with annual and orbital aberration.

    `R_si` (N,), GCRS to star camera, is what the head reports at instants `t_s` (N,), TAI seconds since
    `epoch`, having allowed for the aberration `removed`; `v_i` (N, 3) is the geocentric velocity of the
    satellite, GCRS, m/s, and `line_of_sight_s` (3,) the unit vector along the middle of the head's field of
    view, axes of its attitudes.
    """
    if removed == "annual and orbital":
        return R_si
    velocity = v_i
    if removed == "none":
        earth = erfa.epv00(*epoch.tt_jd(t_s))[1]["v"] * _AU_PER_DAY
        velocity = v_i + earth
    beta = velocity / SPEED_OF_LIGHT
    b = R_si.inv().apply(line_of_sight_s)
    inverse_gamma = np.sqrt(1.0 - np.einsum("ni,ni->n", beta, beta))
    a = erfa.ab(b, beta, np.ones(len(b)), inverse_gamma)
    normal = np.cross(a, b)
    sine = np.linalg.norm(normal, axis=1, keepdims=True)
    angle = np.arcsin(np.minimum(sine, 1.0))
    rotvec = np.divide(normal * angle, sine, out=np.zeros_like(normal), where=sine > 0.0)
    return R_si * Rotation.from_rotvec(rotvec)
