"""A gyro over a pass: how frame s turns from row to row, and how the error of the angles grows.

About each axis the error e of angles that are summed up from row to row has a rate, the bias b:

    de = b dt + white noise of density a²,   db = white noise of density c²,   a row: e + white noise w.

As long as a satellite turns at one rate, errors of the scale and of the axes are part of the bias. Angles in
radians, times in seconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

from boresight.geometry.attitude import NominalMotion
from boresight.geometry.orbit import Orbit
from boresight.records.record import Floats, Ints, RowRecord, array, check_numbers, record, scalar

__all__ = ["GyroNoise", "GyroRecord", "GyroRows", "longest_without_gap", "summed_up", "without_gap"]

GAP = 3.0  # usual steps: over a longer one nothing is summed up


@record(kw_only=True, by_value=True)
class GyroNoise:
    """Errors of a gyro, the same about every axis. `ValueError` unless all are positive."""

    random_walk_rad: float = scalar("angle random walk a: 1-sigma after one second")
    bias_walk_rad_s: float = scalar("c: 1-sigma by which the bias changes in one second")
    bias_rad_s: float = scalar("1-sigma of the bias at the first row")
    white_rad: float = scalar("w: 1-sigma of an angle by itself, its resolution")

    def __post_init__(self) -> None:
        check_numbers(self)

    def spread(self, dt: Floats) -> Floats:
        """(N, 2, 2) covariance of e and b after `dt` (N,), both known before."""
        a2, c2 = self.random_walk_rad**2, self.bias_walk_rad_s**2
        cross = 0.5 * c2 * dt**2
        return np.stack([a2 * dt + c2 * dt**3 / 3.0, cross, cross, c2 * dt], axis=1).reshape(-1, 2, 2)

    def covariance(self, t_s: Floats) -> Floats:
        """(K, K) covariance of e at instants (K,), rad², known at the first, the bias known not at all there:
        without that, which is linear in time.
        """
        since = t_s - t_s[0]
        first, last = np.minimum.outer(since, since), np.maximum.outer(since, since)
        walk = first**2 * (3.0 * last - first) / 6.0
        own = self.white_rad**2 * np.eye(len(t_s))
        return np.asarray(self.random_walk_rad**2 * first + self.bias_walk_rad_s**2 * walk + own)


@record(kw_only=True)
class GyroRows(RowRecord):
    """What a gyro tells around a pass."""

    t_s: Floats = array("K", "instants, increasing, TAI seconds since the epoch")
    R_sz: Rotation = array("K", "frame s at a fixed instant of the record to frame s, as the gyro sums it up")
    R_oi: Rotation = array("K", "GCRS to the nominal frame at the same instants")
    noise: GyroNoise = scalar("errors of the sums")

    @property
    def step_s(self) -> float:
        """Usual time from row to row."""
        return float(np.median(np.diff(self.t_s)))

    def within(self, first_s: float, last_s: float) -> GyroRows | None:
        """The rows from one instant to another; None for fewer than two."""
        rows = slice(*np.searchsorted(self.t_s, [first_s, last_s]))
        return self.take(rows) if len(self.t_s[rows]) > 1 else None

    def path(self, t_s: Floats, turns: Floats, middle: Rotation) -> Floats:
        """Rotation (K, 3) from the attitude R_so = `middle`, about the axes of s, as the gyro sums it up from
        row to row. Turns (N, 3) of that kind at instants (N,) lie near it: they tell where it begins, and
        along them every step is taken.
        """
        near = np.stack([np.interp(self.t_s, t_s, axis) for axis in turns.T], axis=1)
        R_si = Rotation.from_rotvec(near[:-1]) * middle * self.R_oi[:-1]
        after = self.R_sz[1:] * self.R_sz[:-1].inv() * R_si * self.R_oi[1:].inv() * middle.inv()
        steps = after.as_rotvec() - near[:-1]
        return np.asarray(near[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))


@record(kw_only=True)
class GyroRecord:
    """The whole record of a gyro, about the axes of frame s."""

    t_s: Floats = array("K", "instants, increasing, TAI seconds since the dump's epoch")
    R_sz: Rotation = array("K", "frame s at a fixed instant to frame s, as in `GyroRows`")
    noise: GyroNoise = scalar("its errors")

    def around(self, t_s: Floats, nominal: NominalMotion) -> GyroRows | None:
        """The rows over attitudes at instants (K,), increasing, and half a step beyond as far as an orbit has
        states; None where they have a gap there, or do not cover the attitudes but for a step of their own.
        """
        if len(t_s) < 2:
            return None
        first, last = float(1.5 * t_s[0] - 0.5 * t_s[1]), float(1.5 * t_s[-1] - 0.5 * t_s[-2])
        if isinstance(nominal, Orbit):
            first, last = max(first, nominal.span_s[0]), min(last, nominal.span_s[1])
        rows = slice(*np.searchsorted(self.t_s, [first, last]))
        at = self.t_s[rows]
        if len(at) < 2 or len(longest_without_gap(at)) < len(at):
            return None
        step = float(np.median(np.diff(at)))
        if at[0] > t_s[0] + step or at[-1] < t_s[-1] - step:
            return None
        return GyroRows(t_s=at, R_sz=self.R_sz[rows], R_oi=nominal.R_oi(at), noise=self.noise)

    def in_axes(self, R_hs: Rotation) -> GyroRecord:
        """The record about the axes of another frame h, fixed to s."""
        return replace(self, R_sz=R_hs * self.R_sz * R_hs.inv())

    def turned(self, t_s: Floats) -> Rotation | None:
        """The rotations R_sz at instants (K,), increasing, by a spline.

        None where the rows do not cover the instants, or are fewer.
        """
        before = np.searchsorted(self.t_s, t_s[0], side="right") - 1
        rows = slice(max(int(before), 0), int(np.searchsorted(self.t_s, t_s[-1])) + 1)
        at = self.t_s[rows]
        covered = len(at) > 1 and at[0] <= t_s[0] and at[-1] >= t_s[-1]
        if not covered or len(longest_without_gap(at)) < len(at) or len(at) < len(t_s):
            return None
        return RotationSpline(at, self.R_sz[rows])(t_s)


def without_gap(t_s: Floats) -> list[Ints]:
    """Rows at increasing instants (K,), in stretches in which no step is three times the usual one."""
    step = np.diff(t_s)
    gaps = step > GAP * np.median(step) if len(step) else np.zeros(0, dtype=bool)
    return np.split(np.arange(len(t_s)), np.flatnonzero(gaps) + 1)


def longest_without_gap(t_s: Floats) -> Ints:
    """Of rows at increasing instants (K,), those of the longest stretch in which no step is three times the
    usual one.
    """
    return max(without_gap(t_s), key=len)


def summed_up(turns_s: Floats) -> Rotation:
    """R_sz (K,) from the rotations of frame s (K, 3), about its own axes, since the row before."""
    steps = Rotation.from_rotvec(-turns_s).as_matrix()
    for k in range(1, len(steps)):
        steps[k] = steps[k] @ steps[k - 1]
    return Rotation.from_matrix(steps)
