"""Usual mistakes of orbit and attitude files: an ephemeris contradicts itself, or attitudes contradict it.

Over a step h the positions of an ephemeris give the mean of the velocities at its ends, with the acceleration
a of a point mass Earth in the axes of the ephemeris,

    u = (p2 - p1) / h + h (a2 - a1) / 12,

and a consistent file has v = (v1 + v2) / 2 = u. Otherwise the likely cause is that frequent mistake whose
model fits v best: zero, reversed, multiplied by a factor (units), inertial velocities in a rotating frame (v
= u + omega x p) or the opposite. Velocities that change as in axes that rotate with the Earth, in a frame
that is stated as inertial, or the opposite, tell a wrong frame; as in axes that rotate backwards, a mirrored
one.

A camera that takes strips sees the Earth and turns with the orbit. Mistakes of an attitude file leave
rotations that are as smooth as the right ones: the scalar of the quaternions in the wrong place, the inverse
rotation, axes that rotate with the Earth or the orbit. Read as stated, the camera's axis then misses the
Earth, or turns against the orbital frame; read as the mistake says, it sees the Earth and turns with the
orbit. Metres, seconds, radians.
"""

from __future__ import annotations

from enum import Enum
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import EARTH_ROTATION_RATE, GM_EARTH, WGS84
from boresight.geometry.orbit import Orbit
from boresight.records.record import Bools, Floats, record, scalar
from boresight.star_id.beyond_chance import MAD_SIGMA

__all__ = [
    "AttitudeFault",
    "AttitudeFinding",
    "OrbitFault",
    "OrbitFinding",
    "find_attitude_fault",
    "find_orbit_fault",
    "off_nadir",
]

_MEAN_OVER_S = 10.0  # noise of the positions averages out over intervals of this length
_GAP_FACTOR = 1.5  # steps longer than this times the median are gaps and not compared
_EFFECT_M_S = 2.0  # smallest error of the velocities that is reported: 0.0014 arcsec of aberration
_MISFIT_M_S = 20.0  # largest difference of velocities from those of the positions that a fault may leave
_SHORTEST_S = 20.0  # span of states whose accelerations are compared with models: 1 m/s apart by then 20 m/s
_ACCELERATION_M_S2 = 0.3  # smallest unexplained acceleration that is reported; the Earth's rotation makes 1.1
_LONGEST_S = 300.0  # over which the acceleration is nearly linear
_CLEARLY_LESS = 0.3  # of the misfit as stated, that another frame may leave
_EFFECT_SIGMAS = 3.0  # of the mean of the differences
_UNRELATED = 0.1  # of the differences: a fault that leaves more does not explain them
_SAME_UNITS = 0.1  # by which velocities may be longer than positions tell
_JUMP_M = 7.5  # smallest jump of the positions that is reported: a millisecond along the track
_LONGEST_GAP_S = 180.0  # over which positions are compared with velocities: quadrature errs by metres
_JUMP_SIGMAS = 12.0  # of the steps' scatter
_JUMP_RELATIVE = 2e-4  # of a step's length: error of the quadrature for steps of minutes
STEADY_RAD_S = 1e-4  # against the orbital frame: a tenth of the orbital rate; yaw steering stays below
UNSTEADY_RAD_S = 3e-4  # an attitude that turns faster may be a manoeuvre: another reading must be steady
BASELINE_S = (1.5, 10.0)  # between instants that are compared: noise of the attitudes averages out


class OrbitFault(Enum):
    """What is inconsistent, and the likely cause."""

    NOT_ORDERED = "the times of the states do not increase"
    ZERO = "the velocities are zero"
    REVERSED = "the velocities are reversed (sign or order of time)"
    SCALED = "the velocities are multiplied by a factor"
    INERTIAL_IN_ROTATING_FRAME = "the velocities are inertial, the frame rotates with the Earth"
    ROTATING_IN_INERTIAL_FRAME = "the velocities are relative to the rotating Earth, the frame is inertial"
    UNRELATED = "the velocities are not the rate of change of the positions (axes? another object?)"
    FRAME = "the states move as in axes that rotate with the Earth, the frame is inertial"
    INERTIAL = "the states move as in inertial axes, the frame rotates with the Earth"
    MIRRORED = "the states move as in axes that rotate against the Earth (sign of x or y?)"
    JUMP = "the positions jump"

    @property
    def is_of_frame(self) -> bool:
        """Whether the states are those of other axes than stated."""
        return self in (OrbitFault.FRAME, OrbitFault.INERTIAL, OrbitFault.MIRRORED)


@record(kw_only=True)
class OrbitFinding:
    """An inconsistency of an ephemeris."""

    fault: OrbitFault = scalar("what is inconsistent, and the likely cause")
    state: int = scalar("index of the state concerned, from 0 (jumps and order; else 0)")
    size: float = scalar(
        "m/s or m/s²: rms error of velocities or accelerations; m: jump; s: step back in time"
    )
    factor: float = scalar("velocities over rate of change of the positions")

    def __str__(self) -> str:
        at = f" at state {self.state + 1}"
        units = "" if abs(self.factor - 1.0) < _SAME_UNITS else " (units?)"
        return self.fault.value + {
            OrbitFault.NOT_ORDERED: f"{at}: {self.size:.6g} s back",
            OrbitFault.JUMP: f"{at}: {self.size:.4g} m against the velocities",
            OrbitFault.SCALED: f": {self.factor:.6g}{units}",
            OrbitFault.FRAME: f", {self.size:.2g} m/s² off",
            OrbitFault.INERTIAL: f", {self.size:.2g} m/s² off",
            OrbitFault.MIRRORED: f", {self.size:.2g} m/s² off",
        }.get(self.fault, f": they differ from the positions' rate of change by {self.size:.4g} m/s rms")


def find_orbit_fault(
    t_s: Floats, positions_m: Floats, velocities_m_s: Floats, frame: Literal["GCRF", "ITRF"]
) -> OrbitFinding | None:
    """The first inconsistency of an ephemeris, or None.

    Instants `t_s` (K,), s; states (K, 3) in the axes of `frame`, m and m/s: in ITRF the velocity is the rate
    of change of the coordinates. None also for fewer than two states without a gap between them. Errors of
    the velocities below 2 m/s, jumps of the positions below 7.5 m or within their scatter, and gaps are no
    inconsistencies.
    """
    step = np.diff(t_s)
    if np.any(step <= 0.0):
        k = int(np.argmax(step <= 0.0))
        return OrbitFinding(fault=OrbitFault.NOT_ORDERED, state=k + 1, size=-float(step[k]), factor=np.nan)
    if not len(step):
        return None
    by_positions = step[:, None] * _mean_velocities(t_s, positions_m, frame)
    by_velocities = 0.5 * step[:, None] * (velocities_m_s[1:] + velocities_m_s[:-1])
    compared = step <= _GAP_FACTOR * np.median(step)
    middle = 0.5 * (positions_m[1:] + positions_m[:-1])
    if frame == "ITRF":
        other, rotation = OrbitFault.INERTIAL_IN_ROTATING_FRAME, EARTH_ROTATION_RATE
    else:
        other, rotation = OrbitFault.ROTATING_IN_INERTIAL_FRAME, -EARTH_ROTATION_RATE
    carried = step[:, None] * np.cross([0.0, 0.0, rotation], middle)
    return (
        _velocity_fault(step, by_positions, by_velocities, (other, carried), compared)
        or _frame_fault(t_s, positions_m, velocities_m_s, frame)
        or _jump(by_positions, by_velocities, compared, compared | (step < _LONGEST_GAP_S))
    )


def _mean_velocities(t: Floats, p: Floats, frame: str) -> Floats:
    """Means (K - 1, 3) of the velocities at the ends of each step, m/s, by the positions."""
    v = np.gradient(p, t, axis=0, edge_order=2 if len(t) > 2 else 1)
    a, h = _acceleration(p, v, float(frame == "ITRF")), np.diff(t)[:, None]
    return np.asarray(np.diff(p, axis=0) / h + h / 12.0 * np.diff(a, axis=0))


def _acceleration(p: Floats, v: Floats, rate: float) -> Floats:
    """(K, 3), m/s², of states in axes that rotate at `rate` times that of the Earth about its pole."""
    omega = np.array([0.0, 0.0, rate * EARTH_ROTATION_RATE])
    gravity = -GM_EARTH * p / np.linalg.norm(p, axis=1, keepdims=True) ** 3
    return np.asarray(gravity - np.cross(omega, 2.0 * v + np.cross(omega, p)))


def _velocity_fault(
    step: Floats,
    by_positions: Floats,
    by_velocities: Floats,
    other: tuple[OrbitFault, Floats],
    compared: Bools,
) -> OrbitFinding | None:
    """Compare mean velocities over intervals of about 10 s with the hypotheses of the module."""
    block = np.cumsum(~compared) * len(step) + np.floor(np.cumsum(step) / max(_MEAN_OVER_S, step.min()))
    start = np.flatnonzero(np.diff(block[compared], prepend=-1.0))
    h, *displacements = (
        np.add.reduceat(values[compared], start, axis=0)
        for values in (step[:, None], by_positions, by_velocities, other[1])
    )
    u, v, w = (displacement / h for displacement in displacements)
    factor = float((u * v).sum() / max((u * u).sum(), 1e-30))
    models = {
        None: u,
        other[0]: u + w,
        OrbitFault.ZERO: 0.0 * u,
        OrbitFault.REVERSED: -u,
        OrbitFault.SCALED: factor * u,
    }
    rms = {name: float(np.sqrt(np.mean(np.sum((v - model) ** 2, axis=1)))) for name, model in models.items()}
    best = min(rms, key=lambda fault: rms[fault] + 0.5 * (fault is OrbitFault.SCALED))  # m/s: simpler first
    effect = np.sqrt(max(rms[None] ** 2 - rms[best] ** 2, 0.0))
    if effect > max(_EFFECT_M_S, _EFFECT_SIGMAS * rms[best] / np.sqrt(len(u))):
        unrelated = rms[best] > max(_MISFIT_M_S, _UNRELATED * rms[None])
        return OrbitFinding(
            fault=OrbitFault.UNRELATED if unrelated or best is None else best,
            state=0,
            size=rms[None],
            factor=factor,
        )
    differences = np.linalg.norm(v - u, axis=1)
    if np.median(differences) > _MISFIT_M_S:
        return OrbitFinding(fault=OrbitFault.UNRELATED, state=0, size=rms[None], factor=factor)
    return None


def _frame_fault(t: Floats, p: Floats, v: Floats, frame: str) -> OrbitFinding | None:
    """Compare how the velocities change, over the first stretch of states without gaps, with the acceleration
    in axes that do not rotate, rotate with the Earth, and rotate against it.
    """
    span = np.diff(t)
    gaps = np.flatnonzero(span > _GAP_FACTOR * np.median(span))
    n = int(gaps[0]) + 1 if len(gaps) else len(t)
    n = min(n, int(np.searchsorted(t, t[0] + _LONGEST_S)))
    if n < 3 or t[n - 1] - t[0] < _SHORTEST_S:
        return None
    t, p, v = t[:n], p[:n], v[:n]
    slope = np.polyfit(t - t.mean(), v, 1)[0]
    rates = {None: 0.0, OrbitFault.FRAME: 1.0, OrbitFault.MIRRORED: -1.0}
    if frame == "ITRF":
        rates = {None: 1.0, OrbitFault.INERTIAL: 0.0, OrbitFault.MIRRORED: -1.0}
    misfit = {
        fault: float(np.linalg.norm(slope - _acceleration(p, v, rate).mean(axis=0)))
        for fault, rate in rates.items()
    }
    best = min(misfit, key=lambda fault: misfit[fault])
    if best is None or misfit[None] < _ACCELERATION_M_S2 or misfit[best] > _CLEARLY_LESS * misfit[None]:
        return None
    return OrbitFinding(fault=best, state=0, size=misfit[None], factor=1.0)


def _jump(by_positions: Floats, by_velocities: Floats, usual: Bools, compared: Bools) -> OrbitFinding | None:
    """The largest difference of a step from its velocities beyond the scatter of the `usual` ones: times that
    jump by a step make a gap.
    """
    difference = np.where(compared, np.linalg.norm(by_positions - by_velocities, axis=1), 0.0)
    scatter = MAD_SIGMA * float(np.median(difference[usual]))
    limit = np.maximum(
        max(_JUMP_M, _JUMP_SIGMAS * scatter), _JUMP_RELATIVE * np.linalg.norm(by_positions, axis=1)
    )
    beyond = difference > np.maximum(limit, 0.5 * difference.max())
    if not beyond.any():
        return None
    k = int(np.argmax(beyond))
    return OrbitFinding(fault=OrbitFault.JUMP, state=k + 1, size=float(difference[k]), factor=1.0)


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
