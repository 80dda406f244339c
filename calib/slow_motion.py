"""Motion of the satellite between star exposures: how far it may leave the polynomials through them.

The attitude relative to the nominal motion is a constant and a rate, different in every strip, and on top of
them a stationary Gaussian process with the covariance a² exp(-h² / (2 T²)) about every axis: the oscillation
of an attitude control loop, smooth over a time T. Faster motion is the vibration's business. With x the
motion, t_j the instant of a target and t_k those of the exposures, interpolation by weights w misses

    e_j = x(t_j) - sum_k w_jk x(t_k),     cov e = K_tt - W K_nt - K_tn Wᵀ + W K_nn Wᵀ,

nothing where exposures are dense. The mission states the size of a and T (`CalibrationSettings`). Where a
strip has three exposures or more, they show how the attitude leaves a straight line: a and T are then
averaged over their posterior given the exposures of all strips, with a log-normal prior about the stated
values. Attitudes that scatter more than stated, from one exposure to the next, are not motion: the grid has a
factor of the stated noise as well, so that their residuals stay too large and are reported. Two exposures
show no motion; then the stated values hold as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude import InterpolationNodes
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats, array, record

__all__ = [
    "AT_REST",
    "FEWEST_SHOW",
    "SlowMotion",
    "has_few_exposures",
    "missed_covariance",
    "motion_is_shown",
    "motion_modes",
    "motion_of",
    "stated_motion",
]

MANY = 8  # exposures of a strip that follow the motion; scatter of so many is to be reported, not explained
FEWEST_SHOW = 3  # exposures of a strip: two determine constant and rate
SPREAD = (1.0, 0.5, 1.0)  # 1-sigma of the logarithms of a, T and the factor of the noise
AMPLITUDES = np.exp(np.linspace(-4.0, 3.0, 29))  # in units of the stated values
TIMES = np.exp(np.linspace(-1.5, 1.5, 13))  # the same of T: from 1/4.5 to 4.5 of it
NOISES = 2.0 ** np.arange(8)  # factors of the attitudes' stated noise: 1 to 128
MOST_STRIPS = 24  # that are asked; more would not change the answer
MOST_EXPOSURES = 64  # of a strip


@record(kw_only=True)
class SlowMotion:
    """Covariance of the motion: a mixture over T."""

    time_s: Floats = array("T", "times over which the motion is smooth")
    variance: Floats = array("T", "variance about each axis with this time, weighted, rad²")

    def covariance(self, t: Floats, u: Floats) -> Floats:
        """(J, K) covariance, rad², of the motion about one axis at instants (J,) with that at (K,)."""
        lag2 = (t[:, None] - u[None, :]) ** 2
        return np.tensordot(np.exp(-0.5 * lag2[:, :, None] / self.time_s**2), self.variance, axes=1)


AT_REST = SlowMotion(time_s=np.zeros(0), variance=np.zeros(0))  # no motion between exposures


def missed_covariance(motion: SlowMotion, t: Floats, nodes: Floats, weights: Floats) -> Floats:
    """Covariance (J, J), rad², about each axis, of what interpolation with weights (J, K) between nodes (K,)
    misses at instants (J,).
    """
    both = np.concatenate([t, nodes])
    difference = np.column_stack([np.eye(len(t)), -weights])
    return np.asarray(difference @ motion.covariance(both, both) @ difference.T)


def has_few_exposures(strip: StripSightings) -> bool:
    """Whether a strip with fitted attitudes has fewer exposures than follow the motion."""
    return len(_nodes_of(strip)[0].t_s) < MANY


def motion_is_shown(strips: Sequence[StripSightings]) -> bool:
    """Whether any of strips with fitted attitudes has exposures enough to show how far it moves."""
    return any(len(_nodes_of(strip)[0].t_s) >= FEWEST_SHOW for strip in strips)


def motion_of(strips: Sequence[StripSightings], settings: CalibrationSettings) -> SlowMotion:
    """The motion that the exposures of strips with fitted attitudes show, else the stated one; none where all
    have `MANY` exposures.
    """
    if settings.sigma_motion_rad == 0.0 or not any(map(has_few_exposures, strips)):
        return AT_REST
    log_a, log_t = np.log(AMPLITUDES), np.log(TIMES)
    times_s = settings.motion_time_s * TIMES
    if not motion_is_shown(strips):
        return stated_motion(settings)
    grid = np.meshgrid(np.log(NOISES), log_a, log_t, indexing="ij")
    sizes = (SPREAD[2], SPREAD[0], SPREAD[1])
    log_posterior = np.sum([-0.5 * (part / size) ** 2 for part, size in zip(grid, sizes)], axis=0)
    chosen = np.unique(np.linspace(0, len(strips) - 1, min(len(strips), MOST_STRIPS)).astype(int))
    amplitudes = settings.sigma_motion_rad * AMPLITUDES
    for n in chosen.tolist():
        log_posterior += _log_likelihood(strips[n], amplitudes, times_s)
    weight = np.exp(log_posterior - log_posterior.max()).sum(axis=0)
    return SlowMotion(time_s=times_s, variance=amplitudes**2 @ weight / weight.sum())


def stated_motion(settings: CalibrationSettings) -> SlowMotion:
    """The motion as stated, where nothing shows it."""
    if settings.sigma_motion_rad == 0.0:
        return AT_REST
    weight = np.exp(-0.5 * (np.log(TIMES) / SPREAD[1]) ** 2)
    variance = settings.sigma_motion_rad**2 * weight / weight.sum()
    return SlowMotion(time_s=settings.motion_time_s * TIMES, variance=variance)


def motion_modes(noise: Floats, shapes: Floats, trend: Floats) -> tuple[Floats, Floats]:
    """Of turns (K,) about each axis with the covariance noise (..., K, K) plus a² times one of the shapes
    (..., S, K, K), without what the trend (K, D) takes up: variances (..., S, M) by the shape, and the
    independent modes (..., S, M, K) of unit variance by noise, M = K - D.
    """
    rest = np.linalg.qr(trend, mode="complete")[0][:, trend.shape[1] :].T
    root = np.linalg.cholesky(rest @ noise @ rest.T)
    white = np.linalg.solve(root, np.broadcast_to(rest, (*noise.shape[:-2], *rest.shape)))[..., None, :, :]
    variance, vectors = np.linalg.eigh(white @ shapes @ np.swapaxes(white, -1, -2))
    return np.maximum(variance, 0.0), np.swapaxes(vectors, -1, -2) @ white


def _nodes_of(strip: StripSightings) -> tuple[InterpolationNodes, Floats]:
    """Nodes of the strip's usable exposures, `MOST_EXPOSURES` at most, and their covariances."""
    times, R_si, R_oi, covariance_s = (part[:MOST_EXPOSURES] for part in strip.usable())
    nodes = InterpolationNodes.of_exposures(times, R_si, R_oi)
    return nodes, nodes.covariance(covariance_s)


def _log_likelihood(strip: StripSightings, amplitudes: Floats, times_s: Floats) -> Floats:
    """(F, A, T) logarithm of the likelihood of noises, amplitudes and times; constant and rate unknown."""
    nodes, own = _nodes_of(strip)
    t = nodes.t_s
    found = np.zeros((len(NOISES), len(amplitudes), len(times_s)))
    if len(t) < FEWEST_SHOW:
        return found
    D = nodes.R_si * nodes.R_oi.inv()
    turns = (D * D[len(D) // 2].inv()).as_rotvec()
    noise = strip.noise.coloured_covariance_s(t)
    noise[np.arange(len(t)), :, np.arange(len(t)), :] += own
    shapes = np.exp(-0.5 * (t[:, None] - t[None, :]) ** 2 / times_s[:, None, None] ** 2)  # (T, K, K)
    trend = np.column_stack([np.ones_like(t), t - t.mean()])
    for axis in np.linalg.eigh(own.mean(axis=0))[1].T:  # about which the stars' errors are independent
        values, modes = motion_modes(np.einsum("a,kalb,b->kl", axis, noise, axis), shapes, trend)
        y2 = (modes @ (turns @ axis)) ** 2
        moved = amplitudes[:, None, None] ** 2 * values
        variance = NOISES[:, None, None, None] ** 2 + moved
        found -= 0.5 * (np.log(variance) + y2 / variance).sum(axis=3)
    return found
