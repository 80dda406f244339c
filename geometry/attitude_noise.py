"""Errors of a star camera's attitudes as they are: white + correlated + constant + periodic, each axis alone.

Of attitudes at instants t_k, a small right-handed rotation about each axis of the head has the covariance

    w² δ_kl + a² exp(-|t_k - t_l| / τ) + c² + p² / H Σ cos(2π h (t_k - t_l) / P), h = 1 ... H,

white noise from row to row, a first-order autoregressive process AR(1) (seconds: stars that cross pixels, the
filter of the head), a constant over the record or strip (errors that pass over many minutes), which may
be correlated with that of other passes over a time T, and an error that comes back with a period P (of the
orbit: what the Sun warms), a Fourier series of H terms. A process that outlasts a pass is split: what of it
is the same at both ends of the pass is one more constant. Angles in radians, times in seconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.records.record import Floats, array, check_numbers, record, scalar

__all__ = ["NO_NOISE", "AttitudeNoise", "LastingError"]


FASTER = 0.26  # is what is left of a split process: the mean over the pass keeps its variance within 1 %
NO_EFFECT = 1e-6  # of the variance of a process: less is no constant of its own


@record(by_value=True)
class LastingError:
    """An error of a head about one of its axes that is constant over a pass and goes on after it."""

    head: str = scalar("name of the head")
    name: str = scalar("which of its errors, and about which axis: the same in all passes")
    time_s: float = scalar("time over which it is correlated; 0: independent from pass to pass")
    first_s: float = scalar("begin of the pass; the instant for which the error holds, where it is one")
    last_s: float = scalar("end of the pass, or the same instant")


@record(kw_only=True)
class AttitudeNoise:
    """Errors of one head about its own axes n; `R_sn` takes these to the frame s of the attitudes.

    Raises `ValueError` for a negative standard deviation or a correlation time that is not positive.
    """

    white_rad: Floats = array("3", "1-sigma, independent from row to row")
    correlated_rad: Floats = array("3", "1-sigma of the AR(1) process")
    correlation_time_s: Floats = array("3", "in which its correlation falls to 1/e")
    constant_rad: Floats = array("3", "1-sigma, constant over a pass: strips of one time")
    constant_time_s: Floats = array(
        "3",
        "in which its correlation from pass to pass falls to 1/e; 0: independent",
        default_factory=lambda: np.zeros(3),
    )
    periodic_rad: Floats = array(
        "3", "1-sigma of what comes back with a period", default_factory=lambda: np.zeros(3)
    )
    period_s: float = scalar("this period", default=1.0)
    harmonics: int = scalar("terms of its Fourier series, of equal size", default=1)
    R_sn: Rotation = scalar("axes of the head to frame s", default=Rotation.identity())

    def __post_init__(self) -> None:
        check_numbers(self)
        for name in ("white_rad", "correlated_rad", "constant_rad", "periodic_rad"):
            if not np.all(getattr(self, name) >= 0.0):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not np.all(self.correlation_time_s > 0.0):
            raise ValueError(f"correlation_time_s must be positive, got {self.correlation_time_s}")

    @property
    def white_covariance_s(self) -> Floats:
        """(3, 3) covariance of the white part of one attitude, rad², frame s."""
        R = self.R_sn.as_matrix()
        return np.asarray((R * self.white_rad**2) @ R.T)

    @property
    def lasting_covariance_s(self) -> Floats:
        """(3, 3) covariance of what is constant over a pass or comes back with a period, rad², frame s."""
        R = self.R_sn.as_matrix()
        return np.asarray((R * (self.constant_rad**2 + self.periodic_rad**2)) @ R.T)

    def waves_s(self, t_s: Floats) -> Floats:
        """(J, 3, 6 H) rotations about the axes of s, rad, at instants (J,), by the coefficients of the
        Fourier series, of unit variance: of each term those of cosine and sine about the head's axes.
        """
        if not self.periodic_rad.any():
            return np.zeros((len(t_s), 3, 0))
        phase = 2.0 * np.pi / self.period_s * np.outer(t_s, np.arange(1, self.harmonics + 1))
        waves = np.stack([np.cos(phase), np.sin(phase)], axis=2) / np.sqrt(self.harmonics)
        about = self.R_sn.as_matrix() * self.periodic_rad
        return np.asarray(np.einsum("jhp,sa->jshpa", waves, about).reshape(len(t_s), 3, -1))

    def within(
        self, first_s: float, last_s: float, head: str
    ) -> tuple[AttitudeNoise, Floats, tuple[LastingError, ...]]:
        """The noise of one pass without what is constant in it, and these constants, but for the periodic
        error: rotations (3, m) about the axes of s, 1-sigma each, rad, and what they are.
        """
        span, tau = last_s - first_s, self.correlation_time_s
        kept = np.exp(-span / tau)
        kept[kept < NO_EFFECT] = 0.0
        rest = replace(
            self,
            correlated_rad=self.correlated_rad * np.sqrt(1.0 - kept),
            correlation_time_s=np.where(kept < 1.0, tau * (1.0 - kept) * (1.0 - FASTER * np.sqrt(kept)), tau),
            constant_rad=np.zeros(3),
            periodic_rad=np.zeros(3),
        )
        middle, R = 0.5 * (first_s + last_s), self.R_sn.as_matrix()
        columns, errors = [], []
        for name, sizes, times, begin, end in (
            ("constant", self.constant_rad, self.constant_time_s, middle, middle),
            ("correlated", self.correlated_rad * np.sqrt(kept), tau, first_s, last_s),
        ):
            for a in np.flatnonzero(sizes > 0.0).tolist():
                columns.append(R[:, a] * sizes[a])
                errors.append(LastingError(head, f"{name}/{'xyz'[a]}", float(times[a]), begin, end))
        return rest, np.array(columns).reshape(-1, 3).T, tuple(errors)

    def coloured_covariance_s(self, t_s: Floats) -> Floats:
        """(K, 3, K, 3) covariance, rad², frame s, of all but the white part at instants (K,)."""
        apart = np.abs(t_s[:, None] - t_s[None, :])
        decay = np.exp(-apart[:, :, None] / self.correlation_time_s)
        of_axes = self.correlated_rad**2 * decay + self.constant_rad**2  # (K, K, 3)
        R, waves = self.R_sn.as_matrix(), self.waves_s(t_s)
        of_pairs = np.swapaxes(np.tensordot(of_axes, R[:, None] * R, axes=(2, 2)), 1, 2)
        return np.asarray(np.tensordot(waves, waves, axes=(2, 2)) + of_pairs, dtype=np.float64)


# Attitudes without any noise: white, correlated or constant.
NO_NOISE = AttitudeNoise(
    white_rad=np.zeros(3), correlated_rad=np.zeros(3), correlation_time_s=np.ones(3), constant_rad=np.zeros(3)
)
