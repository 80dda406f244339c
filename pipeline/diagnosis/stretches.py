"""Attitudes of one star camera as motion of a satellite and errors of the rows: how likely are these?

Over a stretch of rows without a gap the attitude is a constant rotation, a rate and an acceleration, all of
them free, and a Gaussian process of free size: either smooth over two steps or more, or with a rate that is a
random walk, as where a manoeuvre begins. What changes faster than the rows follow one another is error. About
each axis of the errors the rows' turns y have the covariance

    s² N + a² S,

N as stated, S the shape of the motion, its size a chosen by likelihood. The likelihood is that of what the
free terms leave. With s = 1 the errors are as stated; larger factors s, in one proportion from axis to axis
or another, tell what is wrong: all errors larger, errors of the instants (along the rate), scatter.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.slow_motion import motion_modes
from boresight.geometry.attitude import ConstantRate
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.gyro import GyroNoise, GyroRecord, without_gap
from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = ["FACTORS", "Stretch", "stretches"]

FEWEST_ROWS, MOST_ROWS = 5, 64  # of a stretch; longer ones are cut, since the work grows with the cube
SMOOTH_STEPS = (2.0, 3.0, 5.0, 9.0)  # over which a motion is smooth
SIZES = np.exp(np.linspace(-3.0, 10.0, 27))  # a, in units of the stated error
FACTORS = np.exp(np.linspace(0.0, 10.0, 41))  # s of the errors, from as stated to four decades more
WILD = np.array([1e3, 1e6])  # 1-sigma of a row that says nothing, in stated errors: near, or any attitude


@record(kw_only=True)
class Stretch:
    """Rows of a record without a gap, about the three axes of their errors."""

    rows: Ints = array("K", "rows of the record")
    turns: Floats = array("K, 3", "attitudes less a rotation at constant rate, rad")
    variance: Floats = array("3, S, M", "of the modes, about each axis, by each shape of the motion")
    modes: Floats = array("3, S, M, K", "that are independent, of unit variance by the stated errors")
    rate: Floats = array("3", "by which attitudes of a later instant are turned, rad/s")
    t_s: Floats = array("K", "instants, TAI seconds since the epoch")
    own: Floats = array("3", "1-sigma of the error of a row by itself, rad")
    by_gyro: bool = scalar("whether the turns are attitudes less those that a gyro sums up", default=False)

    @property
    def sizes(self) -> Floats:
        """Sizes (A,) of the motion, in stated errors: all, or zero alone where a gyro tells it."""
        return np.zeros(1) if self.by_gyro else SIZES

    def log_likelihoods(self, factors: Floats = FACTORS) -> Floats:
        """(3, F) about each axis with errors larger by each of the factors, the motion as fits best."""
        return np.array([fit.max(axis=(1, 2)) for fit in self._fits(self.sizes, factors)])

    def _fits(self, sizes: Floats, factors: Floats = FACTORS) -> Iterator[Floats]:
        """Of each axis the logarithm of the likelihood (F, A, S) by factors, sizes (A,) and shapes."""
        for variance, modes, y in zip(self.variance, self.modes, self.turns.T):
            of_mode = factors[:, None, None, None] ** 2 + sizes[:, None, None] ** 2 * variance
            yield -0.5 * (np.log(of_mode) + (modes @ y) ** 2 / of_mode).sum(axis=3)

    def smooth_fit(self) -> tuple[float, float]:
        """Logarithm of the likelihood with a motion as fits best, and without any; errors about each axis are
        as stated or larger.
        """
        fits = list(self._fits(np.concatenate([[0.0], SIZES])))
        return sum(float(fit.max()) for fit in fits), sum(float(fit[:, 0].max()) for fit in fits)

    def gains_without(self) -> Floats:
        """(K,) by how much the attitudes are likelier, as a logarithm, if one row says nothing."""
        gains = np.zeros(len(self.t_s))
        for variance, modes, y, own in zip(self.variance, self.modes, self.turns.T, self.own):
            of_mode = 1.0 + self.sizes[:, None, None] ** 2 * variance  # (A, S, M)
            z = modes @ y
            fit = -0.5 * (np.log(of_mode) + z**2 / of_mode).sum(axis=2)
            by_row = np.einsum("smk,sm,asm->ask", modes, z, 1.0 / of_mode)
            weight = np.einsum("smk,asm->ask", modes**2, 1.0 / of_mode)
            wild = (WILD[:, None, None, None] * own) ** 2
            gained = 0.5 * (by_row**2 / (1.0 / wild + weight) - np.log1p(wild * weight)).max(axis=0)
            gains += (fit[:, :, None] + gained).max(axis=(0, 1)) - fit.max()
        return gains

    def instants(self, spread_s: float) -> tuple[Floats, Floats]:
        """Information (K, K), 1/s², on by how much each row's instant is stated too early, and that times the
        estimate (K,), 1/s; the motion is that of errors of the instants of 1-sigma `spread_s`.
        """
        at, z = np.zeros(len(self.t_s)), np.zeros((len(self.t_s),) * 2)
        of_axes = zip(self.variance, self.modes, self.turns.T, self.own, self.rate)
        for variance, modes, y, own, rate in of_axes:
            factor = 1.0 + (spread_s * rate / own) ** 2
            of_mode = factor + self.sizes[:, None, None] ** 2 * variance
            fit = -0.5 * (np.log(of_mode) + (modes @ y) ** 2 / of_mode).sum(axis=2)
            size, shape = np.unravel_index(np.argmax(fit), fit.shape)
            weighted = modes[shape].T / (of_mode[size, shape] - factor + 1.0)
            at += rate * (weighted @ (modes[shape] @ y))
            z += rate**2 * (weighted @ modes[shape])
        return z, at


def stretches(
    t_s: Floats,
    R_si: Rotation,
    covariance_s: Floats,
    noise: AttitudeNoise | None,
    rows: Ints,
    gyro: GyroRecord | None,
    known: dict[Any, tuple[Floats, ...]],
) -> Iterator[Stretch]:
    """Stretches of some rows of a record (N,) with errors of covariance (N, 3, 3), rad², each by itself, and
    what the noise of the head has in common from row to row; where a gyro covers them, against that. `known`
    are modes of the same head and gyro, by instants and covariances; those of other ones are added.
    """
    parts = (rows[part] for part in without_gap(t_s[rows]))
    cut = (here for part in parts for here in np.array_split(part, max(-(-len(part) // MOST_ROWS), 1)))
    for here in (here for here in cut if len(here) >= FEWEST_ROWS):
        t, R, own = t_s[here], R_si[here], covariance_s[here]
        motion = ConstantRate.fitted(t, R)
        turned, middle = gyro and gyro.turned(t), len(t) // 2
        D = R * (turned * turned[middle].inv() * R[middle] if turned else motion.R_oi(t)).inv()
        key = t.tobytes(), own.tobytes(), bool(turned)
        if key not in known:
            known[key] = _modes(t, own, noise, gyro.noise if gyro and turned else None)
        axes, sigma, variance, modes = known[key]
        yield Stretch(
            rows=here,
            turns=(D * D[middle].inv()).as_rotvec() @ axes,
            variance=variance,
            modes=modes,
            rate=-motion.omega_o @ axes,
            t_s=t,
            own=sigma,
            by_gyro=bool(turned),
        )


def _modes(t: Floats, own: Floats, noise: AttitudeNoise | None, gyro: GyroNoise | None) -> tuple[Floats, ...]:
    """What does not depend on attitudes, at instants (K,) with errors of covariances (K, 3, 3) and of a head
    and a gyro: the axes of the errors (3, 3), and `own`, `variance` and `modes` of the stretch.
    """
    each, (by_itself, axes) = np.arange(len(t)), np.linalg.eigh(own.mean(axis=0))
    full = noise.coloured_covariance_s(t) if noise else np.zeros((len(t), 3, len(t), 3))
    full[each, :, each, :] += own
    if gyro:
        full += gyro.covariance(t)[:, None, :, None] * np.eye(3)[:, None, :]
    steps = (t - t.mean()) / float(np.median(np.diff(t)))
    stated = np.einsum("ax,kalx->xkl", axes, full @ axes)
    shapes = np.multiply.outer(by_itself, _shapes(steps))
    return axes, np.sqrt(by_itself), *motion_modes(stated, shapes, np.vander(steps, 3))


def _shapes(t: Floats) -> Floats:
    """Covariances (S, K, K) of motions of unit size at instants (K,) in steps from row to row."""
    lag, ahead = np.abs(t[:, None] - t), np.minimum(t[:, None], t) - t[0]
    smooth = (np.exp(-0.5 * (lag / steps) ** 2) for steps in SMOOTH_STEPS)
    return np.array([*smooth, ahead**2 * (ahead / 3.0 + lag / 2.0)])
