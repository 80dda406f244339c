"""Whether attitudes agree with the orbit: a camera that takes strips sees the Earth and turns with the orbit.

The usual mistakes of an attitude file leave rotations that are as smooth as the right ones: the scalar of the
quaternions in the wrong place, the inverse rotation, axes that rotate with the Earth or the orbit. Read as
stated, the camera's axis then misses the Earth, or turns against the orbital frame; read as the mistake says,
it sees the Earth and turns with the orbit. Angles in radians.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import WGS84
from boresight.geometry.orbit import Orbit
from boresight.geometry.record import Bools, Floats, record, scalar

__all__ = ["AttitudeFault", "AttitudeFinding", "find_attitude_fault", "off_nadir"]

STEADY_RAD_S = 1e-4  # against the orbital frame: a tenth of the orbital rate; yaw steering stays below
UNSTEADY_RAD_S = 3e-4  # an attitude that turns faster may be a manoeuvre: another reading must be steady
BASELINE_S = (1.5, 10.0)  # between instants that are compared: noise of the attitudes averages out


class AttitudeFault(Enum):
    """The likely mistake."""

    SCALAR_ORDER = "the scalar of the quaternions is read in the wrong place"
    INVERTED = "the quaternions are of the inverse rotation"
    EARTH_FIXED = "the quaternions relate to Earth-fixed axes (ITRF)"
    ORBITAL = "the quaternions relate to the orbital frame, not to an inertial one"
    UNRELATED = "no usual mistake explains it (installation matrix? times? another satellite?)"


@record
class AttitudeFinding:
    """Attitudes that contradict the orbit."""

    fault: AttitudeFault = scalar("the likely mistake")
    off_nadir_rad: float = scalar("median angle between the camera's axis and nadir, as stated")
    corrected_rad: float = scalar("the same if the mistake is corrected; NaN for UNRELATED")
    rate_rad_s: float = scalar("rotation against the orbital frame, as stated")

    def __str__(self) -> str:
        stated, corrected = np.degrees(self.off_nadir_rad), np.degrees(self.corrected_rad)
        text = f"the camera's axis is {stated:.1f} deg off nadir and turns by "
        text += f"{np.degrees(self.rate_rad_s):.4f} deg/s against the orbit: {self.fault.value}"
        if self.fault is AttitudeFault.UNRELATED:
            return text
        return f"{text}; corrected, it is {corrected:.1f} deg off nadir and turns with the orbit"


def find_attitude_fault(t_s: Floats, R_si: Rotation, R_cs: Rotation, orbit: Orbit) -> AttitudeFinding | None:
    """The mistake that attitudes during strips show, or None.

    `R_si` (K,) are GCRS to star camera, as the file is understood, at instants `t_s` (K,) within strips, TAI
    seconds since the orbit's epoch, in order; `R_cs` is the installation matrix as measured before launch:
    milliradians do not matter. `orbit` covers the instants.
    """
    later = np.searchsorted(t_s, t_s + BASELINE_S[0])
    first = np.flatnonzero(later < len(t_s))
    first = first[t_s[later[first]] - t_s[first] <= BASELINE_S[1]]
    if not len(first):
        return None
    last = later[first]
    R_oi = orbit.R_oi(t_s)

    def reading(R: Rotation) -> tuple[bool, float, float]:
        """Whether the Earth is seen, the angle to nadir, the rate against the orbital frame."""
        axis = (R_cs * R).inv().apply([0.0, 0.0, 1.0])
        on_earth, off = off_nadir(axis, t_s, orbit)
        R_so = R * R_oi.inv()
        rate = (R_so[last] * R_so[first].inv()).magnitude() / (t_s[last] - t_s[first])
        return float(np.mean(on_earth)) > 0.5, float(np.median(off)), float(np.median(rate))

    seen, off, rate = reading(R_si)
    if seen and rate <= UNSTEADY_RAD_S:
        return None
    for fault, R in _readings(R_si, Rotation.from_matrix(orbit.earth.matrices_ie(t_s)), R_oi):
        other_seen, other_off, other_rate = reading(R)
        if other_seen and other_rate <= STEADY_RAD_S:
            return AttitudeFinding(fault, off, other_off, rate)
    return None if seen else AttitudeFinding(AttitudeFault.UNRELATED, off, float("nan"), rate)


def off_nadir(axis_i: Floats, t_s: Floats, orbit: Orbit) -> tuple[Bools, Floats]:
    """Whether directions (K, 3), GCRS, from the satellite meet the Earth, and their angles to nadir, rad."""
    p_i = orbit.positions_i(t_s)
    radius = np.linalg.norm(p_i, axis=1)
    off = np.arccos(np.clip(-np.einsum("ki,ki->k", axis_i, p_i) / radius, -1.0, 1.0))
    return off < np.arcsin(np.minimum(WGS84.semi_major_m / radius, 1.0)), off


def _readings(R_si: Rotation, R_ie: Rotation, R_oi: Rotation) -> list[tuple[AttitudeFault, Rotation]]:
    """Attitudes as they are if each mistake was made."""
    swapped = [
        (AttitudeFault.SCALAR_ORDER, back(Rotation.from_quat(np.roll(sense.as_quat(), shift, axis=1))))
        for sense, back in ((R_si, lambda R: R), (R_si.inv(), Rotation.inv))
        for shift in (1, -1)
    ]
    return [
        (AttitudeFault.INVERTED, R_si.inv()),
        (AttitudeFault.EARTH_FIXED, R_si * R_ie.inv()),
        (AttitudeFault.ORBITAL, R_si * R_oi),
        *swapped,
    ]
