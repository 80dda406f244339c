"""Series of rotations as formats of attitudes take them: instants, and quaternions."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack
from boresight.records.record import Floats

__all__ = ["continuous_quaternions", "instants_to_interpolate"]

LONGEST_S = 2.0**-3  # between attitudes
SHORTEST_S = 2.0**-18  # 3.8 µs: between the attitudes before and after a jump


def instants_to_interpolate(track: AttitudeTrack, first_s: float, last_s: float, limit_rad: float) -> Floats:
    """Instants (N,) from first_s to last_s between which attitudes that are interpolated along great circles
    miss `track` by at most `limit_rad`: steps are halved where they miss by more, and a jump of the track's
    own interpolation has an attitude on either side.
    """
    inside = (track.breaks_s > first_s + 2.0 * SHORTEST_S) & (track.breaks_s < last_s - 2.0 * SHORTEST_S)
    breaks = track.breaks_s[inside]
    before, low, high = (breaks + n * SHORTEST_S for n in (-1.5, -0.5, 0.5))
    step = track.R_si(high) * track.R_si(low).inv()
    jumps = (step * track.R_si(before) * track.R_si(low).inv()).magnitude() > limit_rad
    regular = np.linspace(first_s, last_s, int(np.ceil((last_s - first_s) / LONGEST_S)) + 1)
    t_s = np.unique(np.concatenate([regular, breaks[~jumps], low[jumps], high[jumps]]))
    while True:
        middle, R = 0.5 * (t_s[1:] + t_s[:-1]), track.R_si(t_s)
        half = Rotation.from_rotvec(0.5 * (R[1:] * R[:-1].inv()).as_rotvec()) * R[:-1]
        missed = (track.R_si(middle) * half.inv()).magnitude() > limit_rad
        if not np.any(wide := missed & (np.diff(t_s) > SHORTEST_S)):
            return t_s
        t_s = np.sort(np.concatenate([t_s, middle[wide]]))


def continuous_quaternions(rotations: Rotation) -> Floats:
    """Quaternions (N, 4), scalar last, of rotations (N,), each with the sign nearer to the one before it, so
    that neighbours can be interpolated.
    """
    q = rotations.as_quat()
    turned = np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0
    return np.asarray(q * np.cumprod(np.concatenate([[1.0], np.where(turned, -1.0, 1.0)]))[:, None])
