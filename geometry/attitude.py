"""Attitude against time, from the star camera's exposures, interpolated relative to the nominal motion.

An Earth-pointing satellite rotates by four degrees a minute, one that scans the sky as fast as the ground by
fifty. The attitude relative to that nominal motion is slow and small; only this is interpolated, by Lagrange
polynomials through four exposures. The result is linear in corrections of the exposures' attitudes, so an
estimator can use the same weights. The way of the operator of Sentinel-2, an expansion to second order about
the nearest attitude, is offered too.
Rotations R_si take GCRS to the star camera, or any other frame s. TAI seconds since the epoch, radians.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.spatial.transform import Rotation

from boresight.geometry.earth_rotation import EarthRotation
from boresight.records.record import Bools, Floats, Ints, array, check_numbers, record, scalar

__all__ = [
    "Attitude",
    "AttitudeTrack",
    "ConstantRate",
    "EarthFixedAttitude",
    "Interpolation",
    "InterpolationNodes",
    "NominalMotion",
    "interpolation_weights",
    "linear_weights",
]

Interpolation = Literal["lagrange", "taylor"]  # names of the ways between attitudes; see `AttitudeTrack`
_TAYLOR_POINTS = 8  # attitudes around an instant that the operator's interpolation of Sentinel-2 takes
_NEAR = 0.1  # of the mean step: exposures nearer to one another give no slope


class Attitude(Protocol):
    """Attitude as a function of time."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant at which it is known, TAI seconds since the epoch."""

    def R_si(self, t_s: ArrayLike) -> Rotation:
        """The rotation from GCRS to frame s at each instant (N,)."""


class NominalMotion(Protocol):
    """Any smooth reference attitude: `geometry.orbit.Orbit` over ground, `ConstantRate` in a scan of the
    sky."""

    def R_oi(self, t_s: ArrayLike) -> Rotation:
        """The rotation from GCRS to the reference frame at each instant (N,)."""


@record
class ConstantRate:
    """A rotation at constant rate about an axis fixed in the rotating frame o, and so in GCRS too:
    `R_oi(t) = exp(-[omega_o] (t - t_s)) R_oi(t_s)`.
    """

    t_s: float = scalar("instant of the reference attitude, TAI seconds since the epoch")
    R_oi_reference: Rotation = scalar("GCRS to frame o at that instant")
    omega_o: Floats = array("3", "angular velocity of frame o relative to GCRS, axes of o, rad/s")

    @classmethod
    def fitted(cls, t_s: ArrayLike, R_oi: Rotation) -> ConstantRate:
        """The motion nearest to attitudes (K,) at instants (K,), by least squares; `ValueError` for one."""
        t = np.asarray(t_s, dtype=float)
        if len(t) < 2 or np.ptp(t) == 0.0:
            raise ValueError(f"a rate needs attitudes at two instants or more, got {len(t)}")
        middle, turns = R_oi[len(t) // 2], -(R_oi * R_oi[len(t) // 2].inv()).as_rotvec()
        omega, at_mean = np.linalg.lstsq(np.vander(t - t.mean(), 2), turns, rcond=None)[0]
        return cls(float(t.mean()), Rotation.from_rotvec(-at_mean) * middle, omega)

    def R_oi(self, t_s: ArrayLike) -> Rotation:
        """GCRS to frame o at instants (N,)."""
        t = np.atleast_1d(np.asarray(t_s, dtype=float))
        return Rotation.from_rotvec(-self.omega_o * (t - self.t_s)[:, None]) * self.R_oi_reference


def interpolation_weights(
    t_nodes: ArrayLike, t: ArrayLike, interpolation: Interpolation = "lagrange", points: int = 4
) -> Floats:
    """Weights (J, K) by which values at nodes (K,) give values at instants (J,); each row sums to 1.

    "lagrange": polynomials through the `points` nodes around each instant (all nodes if fewer), at the ends
    through the outermost ones. Raises `ValueError` for an instant more than half a step outside the nodes.
    "taylor" is that of the reference software of Sentinel-2: value, rate and acceleration, at the nearest
    node k, of the polynomial of degree 7 through the nodes k - 4 ... k + 3, expanded to second order. The
    result jumps halfway between nodes. With fewer than 8 nodes it is "lagrange" of `points`.
    """
    nodes, instants = np.asarray(t_nodes, dtype=float), np.asarray(t, dtype=float)
    start, local = _stencil_weights(nodes, instants, interpolation, points)
    weights = np.zeros((len(instants), len(nodes)))
    np.put_along_axis(weights, start[:, None] + np.arange(local.shape[1]), local, axis=1)
    return weights


def linear_weights(t_nodes: Floats, t: Floats, inside: Bools | None = None) -> sparse.csr_array:
    """Sparse weights (J, K) by which values at nodes (K,) give values at instants (J,), linearly between two
    nodes, beyond the ends those of the nearest; rows of zeros for instants that are not `inside`. Without
    nodes there are no columns.
    """
    if not len(t_nodes):
        return sparse.csr_array((len(t), 0))
    k = np.clip(np.searchsorted(t_nodes, t, side="right") - 1, 0, max(len(t_nodes) - 2, 0))
    after = np.minimum(k + 1, len(t_nodes) - 1)
    share = np.clip((t - t_nodes[k]) / np.maximum(t_nodes[after] - t_nodes[k], 1e-9), 0.0, 1.0)
    values = np.stack([1.0 - share, share], axis=1) * (1.0 if inside is None else inside[:, None])
    rows, columns = np.repeat(np.arange(len(t)), 2), np.stack([k, after], axis=1).ravel()
    return sparse.csr_array((values.ravel(), (rows, columns)), shape=(len(t), len(t_nodes)))


@record
class InterpolationNodes:
    """N nodes of an interpolation from K exposures: those nearer together than a tenth of the mean step are
    one node, their mean.

    A polynomial through two attitudes a millisecond apart has their noise as its slope. The covariance of
    such a node is that of one exposure: vibration, the places of stars on the pixels, or the very same image
    make errors in so short a time that are the same.
    """

    t_s: Floats = array("N", "instants, TAI seconds since the epoch")
    R_si: Rotation = array("N", "attitudes, GCRS to frame s")
    R_oi: Rotation = array("N", "nominal attitudes, GCRS to frame o")
    share: Floats = array("N, K", "of each exposure in each node; rows sum to 1")

    @classmethod
    def of_exposures(cls, t_s: Floats, R_si: Rotation, R_oi: Rotation) -> InterpolationNodes:
        """The nodes of exposures (K,) in order of time."""
        step = np.diff(t_s)
        near = step < _NEAR * step.mean() if len(step) else np.zeros(0, dtype=bool)
        if not near.any():
            return cls(t_s, R_si, R_oi, np.eye(len(t_s)))
        group = np.concatenate([[0], np.cumsum(~near)])
        share = (group == np.arange(group[-1] + 1)[:, None]) / np.bincount(group)[:, None]
        first = np.flatnonzero(np.concatenate([[True], ~near]))

        def mean(R: Rotation) -> Rotation:
            return Rotation.from_rotvec(share @ (R * R[first][group].inv()).as_rotvec()) * R[first]

        nominal = mean(R_oi)
        return cls(share @ t_s, mean(R_si * R_oi.inv()) * nominal, nominal, share)

    def covariance(self, of_exposures: Floats) -> Floats:
        """Covariances (N, 3, 3) of the nodes' attitudes from those of the exposures (K, 3, 3)."""
        return np.asarray(np.tensordot(self.share, of_exposures, axes=1))


@record
class AttitudeTrack:
    """Attitudes at K exposures, interpolated between them; those of nearly the same instant are one node
    (`InterpolationNodes`).

    Raises `ValueError` for fewer than two exposures or instants that do not increase.
    """

    t_s: Floats = array("K", "instants of the exposures, increasing, TAI seconds since the epoch")
    R_si_nodes: Rotation = array("K", "GCRS to frame s at the exposures")
    nominal: NominalMotion = scalar("reference attitude; the difference from it is interpolated")
    cov_s: Floats | None = array(
        "K, 3, 3", "covariance of a small rotation of each attitude about the axes of s, rad²", default=None
    )
    points: int = scalar("exposures that one polynomial passes through", default=4)
    interpolation: Interpolation = scalar(
        "lagrange, or taylor: to second order about the nearest exposure (`interpolation_weights`)",
        default="lagrange",
    )
    is_smoothed: bool = scalar("whether errors of neighbouring attitudes are alike", default=False)
    smoothed_errors: Callable[[Floats], Floats] | None = scalar(
        "of smoothed attitudes: rotation (N, 3, A) about the axes of s at instants (N,), by independent "
        "errors of unit variance, rad",
        default=None,
    )
    shares: Mapping[str, Floats] = scalar(
        "(3, 3) by which a rotation of each head, by its name, rotates these, axes of s; none: of one head",
        default_factory=dict,
    )
    _share: Floats = field(init=False, repr=False)  # (N, K) of the exposures in the nodes
    _R_so_middle: Rotation = field(init=False, repr=False)
    _rotvec_s: Floats = field(
        init=False, repr=False
    )  # (K, 3) D_k relative to the middle one, rotation vectors

    def __post_init__(self) -> None:
        k = len(self.t_s)
        if k < 2 or np.any(np.diff(self.t_s) <= 0.0):
            raise ValueError(f"AttitudeTrack needs two or more instants in increasing order, got {k}")
        nodes = InterpolationNodes.of_exposures(self.t_s, self.R_si_nodes, self.nominal.R_oi(self.t_s))
        R_so = nodes.R_si * nodes.R_oi.inv()
        middle = R_so[len(R_so) // 2]
        named = {
            "t_s": nodes.t_s,
            "R_si_nodes": nodes.R_si,
            "cov_s": None if self.cov_s is None else nodes.covariance(self.cov_s),
            "_share": nodes.share,
            "_R_so_middle": middle,
            "_rotvec_s": (R_so * middle.inv()).as_rotvec(),
        }
        for name, value in named.items():
            object.__setattr__(self, name, value)

    @property
    def span_s(self) -> tuple[float, float]:
        """From half a step before the first exposure to half a step after the last."""
        t = self.t_s
        return float(t[0] - 0.5 * (t[1] - t[0])), float(t[-1] + 0.5 * (t[-1] - t[-2]))

    @property
    def breaks_s(self) -> Floats:
        """Instants (B,) where the interpolation is not smooth: exposures, or halfway between them."""
        return self.t_s if self.interpolation == "lagrange" else 0.5 * (self.t_s[1:] + self.t_s[:-1])

    def R_si(self, t_s: ArrayLike) -> Rotation:
        """GCRS to frame s at instants (N,); `ValueError` more than half a step outside the exposures."""
        return self.R_so(t_s) * self.nominal.R_oi(t_s)

    def R_so(self, t_s: ArrayLike) -> Rotation:
        """The frame of the nominal motion to frame s, as `R_si`."""
        t = np.asarray(t_s, dtype=float)
        start, weights = _stencil_weights(self.t_s, t, self.interpolation, self.points)
        rotvec = np.zeros((len(t), 3))
        for m in range(weights.shape[1]):
            rotvec += weights[:, m, None] * self._rotvec_s[start + m]
        return Rotation.from_rotvec(rotvec) * self._R_so_middle

    def errors_s(self, t_s: ArrayLike, covariance_s: Floats | None = None) -> Floats:
        """Rotation (N, 3, 3 K) about the axes of s, at instants (N,), by each of 3 K independent errors, 1
        sigma, of the K exposures that the track was made from, of covariance (K, 3, K, 3), rad²; of smoothed
        attitudes by their own.
        """
        t = np.asarray(t_s, dtype=float)
        if self.smoothed_errors is not None:
            return self.smoothed_errors(t)
        assert covariance_s is not None
        weights = interpolation_weights(self.t_s, t, self.interpolation, self.points) @ self._share
        K = len(covariance_s)
        values, vectors = np.linalg.eigh(covariance_s.reshape(3 * K, 3 * K))
        root = (vectors * np.sqrt(np.maximum(values, 0.0))).reshape(K, 3, 3 * K)
        return np.asarray(np.tensordot(weights, root, axes=1))

    def covariance_s(self, t_s: ArrayLike) -> Floats:
        """Covariance (N, 3, 3), rad^2, of a small rotation of `R_si(t_s)` about the axes of s.

        The exposures' errors, propagated through the weights, plus the interpolation error; of smoothed
        attitudes, their own.
        """
        t = np.asarray(t_s, dtype=float)
        if self.is_smoothed:
            assert self.cov_s is not None
            return np.asarray((linear_weights(self.t_s, t) @ self.cov_s.reshape(-1, 9)).reshape(-1, 3, 3))
        covariance = self.interpolation_sigma_rad(t)[:, :, None] ** 2 * np.eye(3)
        if self.cov_s is not None:
            weights = interpolation_weights(self.t_s, t, self.interpolation, self.points)
            covariance += np.einsum("jk,kab->jab", weights**2, self.cov_s)
        return covariance

    def interpolation_sigma_rad(self, t_s: ArrayLike) -> Floats:
        """1-sigma (N, 3), about the axes of s, of the interpolation error between the exposures, rad.

        The remainder of Lagrange's formula, `f'''' (t - t_1)...(t - t_4) / 4!` for four points, with the
        derivative estimated from divided differences of one order more than the polynomial's, less the
        contribution of the exposures' errors. Motion faster than the exposures (vibration) is not included.
        NaN with too few exposures.
        """
        t = np.asarray(t_s, dtype=float)
        points = min(self.points, len(self.t_s))
        if len(self.t_s) <= points:
            return np.full((len(t), 3), np.nan)
        coefficients = _divided_difference_weights(self.t_s, points)
        differences = coefficients @ self._rotvec_s
        size2 = (differences**2).mean(axis=0)
        if self.cov_s is not None:
            variance = np.einsum("kaa->ka", self.cov_s)
            size2 = np.maximum(size2 - (coefficients**2 @ variance).mean(axis=0), 0.0)
        start = _stencil_start(self.t_s, t, points)
        product = np.ones(len(t))
        for m in range(points):
            product *= t - self.t_s[start + m]
        return np.abs(product)[:, None] * np.sqrt(size2)


@record
class EarthFixedAttitude:
    """Attitude as polynomials in time: a quaternion that takes frame s to ITRS axes, as operators publish it.

    `q(t) = sum_n coefficients[:, n] ((t - t_offset_s) / scale_s)^n`, scalar last, then normalised.
    """

    coefficients: Floats = array("4, D + 1", "of the quaternion's components, lowest power first")
    t_offset_s: float = scalar("origin of the polynomials, TAI seconds since the epoch")
    scale_s: float = scalar("unit of time of the polynomials, s")
    earth: EarthRotation = scalar("rotation between ITRS and GCRS")
    span_s: tuple[float, float] = array("2", "first and last instant, TAI seconds since the epoch")

    def __post_init__(self) -> None:
        check_numbers(self, any_value=("t_offset_s",))

    def R_si(self, t_s: ArrayLike) -> Rotation:
        """The rotation from GCRS to frame s at instants (N,)."""
        t = np.asarray(t_s, dtype=float)
        x = (t - self.t_offset_s) / self.scale_s
        quaternion = np.polynomial.polynomial.polyval(x, self.coefficients.T).T
        return (self.earth.rotations_ie(t) * Rotation.from_quat(quaternion)).inv()


def _inside(nodes: Floats, t: Floats) -> None:
    """Raise `ValueError` unless all instants lie within the nodes, or half a step outside."""
    if len(nodes) < 2 or np.any(np.diff(nodes) <= 0.0):
        raise ValueError(f"two or more nodes in increasing order are needed, got {len(nodes)}")
    low = nodes[0] - 0.5 * (nodes[1] - nodes[0])
    high = nodes[-1] + 0.5 * (nodes[-1] - nodes[-2])
    outside = ~((t >= low) & (t <= high))
    if np.any(outside):
        raise ValueError(
            f"{outside.sum()} of {len(t)} instants lie outside the exposures by more than half a step: "
            f"{t[outside][0]:.6f} s, exposures {nodes[0]:.6f} ... {nodes[-1]:.6f} s"
        )


def _stencil_start(nodes: Floats, t: Floats, points: int) -> Ints:
    _inside(nodes, t)
    interval = np.clip(np.searchsorted(nodes, t, side="right") - 1, 0, len(nodes) - 2)
    return np.clip(interval - (points // 2 - 1), 0, len(nodes) - points)


def _stencil_weights(
    nodes: Floats, t: Floats, interpolation: Interpolation, points: int
) -> tuple[Ints, Floats]:
    """First node (J,) of each stencil and the weights (J, points) of its nodes."""
    if interpolation == "taylor" and len(nodes) >= _TAYLOR_POINTS:
        return _taylor_weights(nodes, t)
    if points < 2:
        raise ValueError(f"interpolation needs two points or more, got {points}")
    points = min(points, len(nodes))
    start = _stencil_start(nodes, t, points)
    local = nodes[start[:, None] + np.arange(points)]
    weights = np.ones((len(t), points))
    for j in range(points):
        for m in range(points):
            if m != j:
                weights[:, j] *= (t - local[:, m]) / (local[:, j] - local[:, m])
    return start, weights


def _taylor_weights(nodes: Floats, t: Floats) -> tuple[Ints, Floats]:
    """`_stencil_weights` of the expansion about the nearest node."""
    points = _TAYLOR_POINTS
    _inside(nodes, t)
    nearest = np.searchsorted(0.5 * (nodes[1:] + nodes[:-1]), t)
    start = np.clip(nearest - points // 2, 0, len(nodes) - points)
    away = nodes[start[:, None] + np.arange(points)] - nodes[nearest][:, None]
    scale = np.abs(away).max(axis=1)[:, None]
    powers = (away / scale)[:, :, None] ** np.arange(points)  # values = powers @ coefficients
    x = (t - nodes[nearest])[:, None] / scale
    to_second_order = np.concatenate([np.ones_like(x), x, x * x, np.zeros((len(t), points - 3))], axis=1)
    return start, np.linalg.solve(np.swapaxes(powers, 1, 2), to_second_order[:, :, None])[:, :, 0]


def _divided_difference_weights(nodes: Floats, order: int) -> Floats:
    """Matrix (K - order, K) that takes values at the nodes to their divided differences of this order."""
    matrix = np.eye(len(nodes))
    for step in range(1, order + 1):
        matrix = np.diff(matrix, axis=0) / (nodes[step:] - nodes[:-step])[:, None]
    return matrix
