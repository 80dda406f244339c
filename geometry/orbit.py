"""Position and velocity of the satellite, interpolated between the nodes of an ephemeris.

Interpolation is done in the frame of the ephemeris (GCRF = GCRS, or the Earth-fixed ITRF), by Lagrange
polynomials through positions or Hermite polynomials through positions and velocities, of the degree that the
ephemeris states. Interpolation across a data gap raises `OrbitGapError`. Metres, seconds, TAI seconds since
the epoch. The orbital frame o has z to the Earth's centre, y against the orbit's normal, x completing them,
approximately along the velocity.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import TYPE_CHECKING, Literal

import erfa
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from boresight.records.record import Floats, Ints, array, check_numbers, record, scalar

if TYPE_CHECKING:
    from boresight.geometry.earth_rotation import EarthRotation
    from boresight.geometry.epoch import Epoch

__all__ = ["Orbit", "OrbitGapError", "argument_of_latitude", "beta_angle", "orbital_frame"]

OrbitFrame = Literal["GCRF", "ITRF"]
OrbitMethod = Literal["lagrange", "hermite"]

_CLOCK_SLACK_S = 1e-6  # instants this far outside the nodes are rounding, not extrapolation
_GAP_FACTOR = 1.5  # a step this much longer than the usual one is a gap


class OrbitGapError(ValueError):
    """An instant lies outside the ephemeris, in a gap of it, or among too few nodes between gaps."""


@record(kw_only=True)
class Orbit:
    """An ephemeris with its interpolation.

    A Lagrange polynomial needs degree + 1 nodes, a Hermite polynomial (degree + 1) / 2, rounded up. Without
    velocities only Lagrange is possible, and the velocity is the polynomial's derivative. Raises `ValueError`
    for instants that do not increase, too few nodes, an unknown frame or method. Nothing is interpolated over
    the begin of a part, whose first instant may be the last of the part before it.
    """

    epoch: Epoch = scalar("origin of t_s")
    t_s: Floats = array("K", "instants of the nodes, increasing, TAI seconds since the epoch")
    positions_m: Floats = array("K, 3", "in `frame`, m")
    velocities_m_s: Floats | None = array("K, 3", "rate of change of the coordinates in `frame`, m/s")
    frame: OrbitFrame = scalar("frame of the nodes: GCRF (= GCRS) or ITRF")
    degree: int = scalar("degree of the interpolating polynomial")
    earth: EarthRotation = scalar("rotation between ITRS and GCRS")
    method: OrbitMethod = scalar(
        "lagrange (positions) or hermite (positions and velocities)", default="lagrange"
    )
    max_step_s: float | None = scalar("longer steps are gaps; None: 1.5 times the median step", default=None)
    begins: tuple[int, ...] = scalar("first nodes of parts beside the first one", default=())
    _segment: Ints = field(init=False, repr=False)  # (K,) number of the gap-free segment
    _scale: Floats = field(init=False, repr=False)  # (windows, nodes_needed), of Lagrange's polynomials
    _slope_at_node: Floats = field(
        init=False, repr=False
    )  # (windows, nodes_needed), their derivative at their own node

    def __post_init__(self) -> None:
        k = len(self.t_s)
        check_numbers(self)
        if self.frame not in ("GCRF", "ITRF"):
            raise ValueError(f"Orbit.frame must be GCRF or ITRF, got {self.frame!r}")
        if self.method not in ("lagrange", "hermite"):
            raise ValueError(f"Orbit.method must be lagrange or hermite, got {self.method!r}")
        if self.method == "hermite" and self.velocities_m_s is None:
            raise ValueError("Hermite interpolation needs velocities")
        if k < self.nodes_needed:
            raise ValueError(
                f"{self.method}, degree {self.degree}: {self.nodes_needed} nodes needed, got {k}"
            )
        steps = np.diff(self.t_s)
        begins = np.zeros(k - 1, dtype=bool)
        begins[[n - 1 for n in self.begins]] = True
        if np.any((steps < 0.0) | ((steps == 0.0) & ~begins)):
            raise ValueError("Orbit.t_s must increase")
        limit = _GAP_FACTOR * float(np.median(steps)) if self.max_step_s is None else self.max_step_s
        object.__setattr__(self, "_segment", np.concatenate([[0], np.cumsum((steps > limit) | begins)]))
        scale, slope_at_node = _window_scales(np.asarray(self.t_s, dtype=float), self.nodes_needed)
        object.__setattr__(self, "_scale", scale)
        object.__setattr__(self, "_slope_at_node", slope_at_node)

    @property
    def nodes_needed(self) -> int:
        """Number of nodes of one polynomial."""
        return self.degree + 1 if self.method == "lagrange" else (self.degree + 2) // 2

    @property
    def span_s(self) -> tuple[float, float]:
        """Instants of the first and the last node; there may be gaps between them."""
        return float(self.t_s[0]), float(self.t_s[-1])

    def around(self, t_first_s: float, t_last_s: float) -> Orbit:
        """The part that interpolation between two instants depends on, with two nodes to spare."""
        spare = self.nodes_needed + 2
        first = max(int(np.searchsorted(self.t_s, t_first_s)) - spare, 0)
        last = min(int(np.searchsorted(self.t_s, t_last_s)) + spare, len(self.t_s))
        usual_step = float(np.median(np.diff(self.t_s)))
        return replace(
            self,
            t_s=self.t_s[first:last],
            positions_m=self.positions_m[first:last],
            velocities_m_s=None if self.velocities_m_s is None else self.velocities_m_s[first:last],
            max_step_s=self.max_step_s if self.max_step_s is not None else _GAP_FACTOR * usual_step,
            begins=tuple(n - first for n in self.begins if first < n < last),
        )

    def positions_i(self, t_s: ArrayLike) -> Floats:
        """Positions (N, 3) in GCRS, m, at instants (N,). `OrbitGapError` where not covered."""
        return self._states_in("GCRF", t_s)[0]

    def states_i(self, t_s: ArrayLike) -> tuple[Floats, Floats]:
        """Positions, m, and velocities relative to the inertial axes, m/s, in GCRS, each (N, 3)."""
        return self._states_in("GCRF", t_s)

    def positions_e(self, t_s: ArrayLike) -> Floats:
        """Positions (N, 3) in ITRS, m."""
        return self._states_in("ITRF", t_s)[0]

    def velocities_e(self, t_s: ArrayLike) -> Floats:
        """Velocities (N, 3) relative to the rotating Earth, in ITRS axes, m/s."""
        return self._states_in("ITRF", t_s)[1]

    def R_oi(self, t_s: ArrayLike) -> Rotation:
        """The rotation from GCRS to the orbital frame at each instant."""
        return orbital_frame(*self.states_i(t_s))

    def _states_in(self, frame: OrbitFrame, t_s: ArrayLike) -> tuple[Floats, Floats]:
        """Positions and rates of change of the coordinates (N, 3) in a frame."""
        t = np.asarray(t_s, dtype=float)
        if t.ndim != 1:
            raise ValueError(f"instants must have shape (N,), got {t.shape}")
        position, velocity = self._state(t)
        if frame == self.frame:
            return position, velocity
        R_ie, omega = self.earth.matrices_ie(t), self.earth.omega_e
        if frame == "GCRF":
            inertial = velocity + np.cross(omega, position)
            return np.einsum("nij,nj->ni", R_ie, position), np.einsum("nij,nj->ni", R_ie, inertial)
        p_e, inertial = np.einsum("nji,nj->ni", R_ie, position), np.einsum("nji,nj->ni", R_ie, velocity)
        return p_e, inertial - np.cross(omega, p_e)

    def _state(self, t: Floats) -> tuple[Floats, Floats]:
        """Interpolated positions and velocities (N, 3) in the frame of the nodes."""
        begin = self._stencils(t)
        nodes = begin[:, None] + np.arange(self.nodes_needed)
        away = t[:, None] - self.t_s[nodes]
        scale = self._scale[begin]
        basis = _lagrange_basis(away, scale)
        p = self.positions_m[nodes]
        if self.method == "hermite":
            assert self.velocities_m_s is not None
            v, slope = self.velocities_m_s[nodes], _lagrange_slopes(away, scale)
            return _hermite(away, p, v, basis, slope, self._slope_at_node[begin])
        position = np.einsum("nk,nkj->nj", basis, p)
        if self.velocities_m_s is None:
            return position, np.einsum("nk,nkj->nj", _lagrange_slopes(away, scale), p)
        return position, np.einsum("nk,nkj->nj", basis, self.velocities_m_s[nodes])

    def _stencils(self, t: Floats) -> Ints:
        """First (N,) of the nodes around each instant, all in one gap-free segment."""
        if len(t) == 0:
            return np.zeros(0, dtype=np.int64)
        first, last = self.t_s[0], self.t_s[-1]
        outside = ~((t >= first - _CLOCK_SLACK_S) & (t <= last + _CLOCK_SLACK_S))
        if np.any(outside):
            raise OrbitGapError(
                f"{outside.sum()} of {len(t)} instants lie outside the ephemeris: "
                f"{t[outside][0]:.6f} s is not within {first:.6f} ... {last:.6f} s"
            )
        left = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.t_s) - 2)
        at_node = t <= self.t_s[left] + _CLOCK_SLACK_S
        at_next = t >= self.t_s[left + 1] - _CLOCK_SLACK_S
        in_gap = (self._segment[left] != self._segment[left + 1]) & ~at_node & ~at_next
        if np.any(in_gap):
            a = left[in_gap][0]
            raise OrbitGapError(
                f"{in_gap.sum()} of {len(t)} instants fall in a gap of the ephemeris, "
                f"{self.t_s[a]:.3f} ... {self.t_s[a + 1]:.3f} s"
            )
        segment = self._segment[np.where(at_next & ~at_node, left + 1, left)]
        start = np.searchsorted(self._segment, segment, side="left")
        stop = np.searchsorted(self._segment, segment, side="right")
        k = self.nodes_needed
        if np.any(stop - start < k):
            raise OrbitGapError(
                f"{self.method} of degree {self.degree} needs {k} nodes without a gap; "
                f"only {int((stop - start).min())} are around {t[stop - start < k][0]:.3f} s"
            )
        if k % 2:  # an odd stencil is centred on the nearest node
            nearer_right = t - self.t_s[left] > self.t_s[left + 1] - t
            begin = left + nearer_right - k // 2
        else:
            begin = left - (k // 2 - 1)
        return np.asarray(np.clip(begin, start, stop - k), dtype=np.int64)


def orbital_frame(p_i: ArrayLike, v_i: ArrayLike) -> Rotation:
    """R_oi (N,), GCRS to the orbital frame, from positions and velocities (N, 3), GCRS; see the module."""
    p, v = np.atleast_2d(p_i).astype(float), np.atleast_2d(v_i).astype(float)
    z = -p / np.linalg.norm(p, axis=1, keepdims=True)
    y = -np.cross(p, v)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=1))


def argument_of_latitude(p_i: ArrayLike, v_i: ArrayLike) -> Floats:
    """Angle (N,), 0 to 2 pi, in the orbital plane from the ascending node on the equator of GCRS.

    Positions and velocities (N, 3) in GCRS. For an equatorial orbit the angle is from the x axis.
    """
    p, v = np.asarray(p_i, dtype=float), np.asarray(v_i, dtype=float)
    normal = np.cross(p, v)
    node = np.stack([-normal[..., 1], normal[..., 0], np.zeros(normal.shape[:-1])], axis=-1)
    flat = np.linalg.norm(node, axis=-1) < 1e-12 * np.linalg.norm(normal, axis=-1)
    node[flat] = [1.0, 0.0, 0.0]
    ahead = np.cross(normal, node) / np.linalg.norm(normal, axis=-1, keepdims=True)
    angle = np.arctan2((p * ahead).sum(axis=-1), (p * node).sum(axis=-1))
    return np.asarray(angle % (2.0 * np.pi))


def beta_angle(p_i: ArrayLike, v_i: ArrayLike, epoch: Epoch, t_s: Floats) -> Floats:
    """Angle (N,), rad, of the Sun above the orbital plane, positive on the side of the angular momentum.

    Positions and velocities (N, 3) in GCRS at instants t_s (N,) after `epoch`; the Sun is ERFA's (`epv00`).
    """
    normal = np.cross(np.asarray(p_i, dtype=float), np.asarray(v_i, dtype=float))
    sun = -np.asarray(erfa.epv00(*epoch.tt_jd(t_s))[0]["p"])
    lengths = np.linalg.norm(normal, axis=-1) * np.linalg.norm(sun, axis=-1)
    return np.asarray(np.arcsin((normal * sun).sum(axis=-1) / lengths))


def _lagrange_basis(away: Floats, scale: Floats) -> Floats:
    """Lagrange's polynomials (N, K): products of the other nodes' distances `away`, times `scale`, (N, K)."""
    basis = scale.copy()
    left: Floats = np.ones(len(away))
    right: Floats = left
    for j in range(away.shape[1]):
        basis[:, j] *= left
        basis[:, -1 - j] *= right
        left, right = left * away[:, j], right * away[:, -1 - j]
    return basis


def _lagrange_slopes(away: Floats, scale: Floats) -> Floats:
    """Derivatives of `_lagrange_basis`, (N, K), by the product rule."""
    n, k = away.shape
    slopes = np.zeros((n, k))
    for j in range(k):
        value: Floats = np.ones(n)
        slope: Floats = np.zeros(n)
        for m in range(k):
            if m != j:
                value, slope = value * away[:, m], slope * away[:, m] + value
        slopes[:, j] = slope * scale[:, j]
    return slopes


def _window_scales(t_nodes: Floats, k: int) -> tuple[Floats, Floats]:
    """Of each node's distances to the others in a window of k: 1 / product and sum of 1 / distance."""
    windows = np.lib.stride_tricks.sliding_window_view(t_nodes, k)
    difference = windows[:, :, None] - windows[:, None, :]
    difference[:, np.arange(k), np.arange(k)] = 1.0
    with np.errstate(divide="ignore", invalid="ignore"):  # over the begin of a part: not used
        return 1.0 / difference.prod(axis=2), (1.0 / difference).sum(axis=2) - 1.0


def _hermite(
    away: Floats, p: Floats, v: Floats, basis: Floats, slope: Floats, slope_at_node: Floats
) -> tuple[Floats, Floats]:
    """Hermite's polynomial through positions and velocities (N, K, 3), and its derivative."""
    square, square_slope = basis**2, 2.0 * basis * slope
    factor = 1.0 - 2.0 * slope_at_node * away
    a, b = factor * square, away * square
    da = -2.0 * slope_at_node * square + factor * square_slope
    db = square + away * square_slope
    position = np.einsum("nk,nkj->nj", a, p) + np.einsum("nk,nkj->nj", b, v)
    return position, np.einsum("nk,nkj->nj", da, p) + np.einsum("nk,nkj->nj", db, v)
