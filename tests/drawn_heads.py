"""Attitudes that star cameras (heads) solve themselves, with errors as real ones: white, AR(1), constant,
periodic.

Drawn for the strips of a campaign (`simulator.campaign`), whose motion is known at any instant. The AR(1)
process is drawn step by step from its own recursion.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.sightings import (
    HeadAttitudes,
    StripSightings,
    exposure_without_stars,
    solved_attitudes,
)
from boresight.records.record import record
from boresight.simulator.campaign import DrawnStripMotion, StripTruth

Array = NDArray[np.float64]


@record
class HeadPlan:
    """One head: how it is mounted, what is stated of its errors, and what is wrong beyond that."""

    name: str
    R_ch: Rotation  # its true installation matrix, frame h to frame c
    noise: AttitudeNoise  # axes of h
    step_s: float = 0.1
    shift_s: float = 0.0  # of its instants
    margin_s: float = 0.4  # before and after a strip
    waves: Array | None = None  # coefficients of its periodic error, of unit variance; None: drawn
    wrong_rad: float = 0.0  # 1-sigma per axis of a rotation of each strip that is not stated


def with_heads(
    strips: Sequence[StripSightings],
    truth: StripTruth,
    heads: Sequence[HeadPlan],
    alignment: Sequence[Rotation],
    duration_s: float,
    rng: np.random.Generator,
) -> list[StripSightings]:
    """The strips with attitudes of heads instead of stars; `alignment` are the R_sh assumed for the heads
    after the first, which is the reference head.
    """
    drawn = zip(*(_attitudes(truth.motion, head, duration_s, rng) for head in heads))
    return [_strip(*one, heads, alignment) for one in zip(strips, truth.motion, drawn)]


def _strip(
    strip: StripSightings,
    motion: DrawnStripMotion,
    drawn: Sequence[tuple[Array, Rotation]],
    heads: Sequence[HeadPlan],
    alignment: Sequence[Rotation],
) -> StripSightings:
    t_s, R_hi = drawn[0]
    exposures = tuple(
        exposure_without_stars(f"{strip.strip_id}/{k:04d}", float(t)) for k, t in enumerate(t_s)
    )
    others = tuple(
        HeadAttitudes(
            head=head.name,
            t_s=t,
            R_hi=R,
            covariance_h=np.tile(head.noise.white_covariance_s, (len(t), 1, 1)),
            noise=head.noise,
            R_oi=motion.R_oi(t),
            R_sh=R_sh,
        )
        for head, (t, R), R_sh in zip(heads[1:], drawn[1:], alignment)
    )
    return replace(
        strip,
        exposures=exposures,
        R_oi_exposures=motion.R_oi(t_s),
        attitudes=solved_attitudes(R_hi, np.tile(heads[0].noise.white_covariance_s, (len(t_s), 1, 1))),
        noise=heads[0].noise,
        others=others,
    )


def _attitudes(
    motions: Sequence[DrawnStripMotion], head: HeadPlan, duration_s: float, rng: np.random.Generator
) -> list[tuple[Array, Rotation]]:
    """Instants (K,) and measured attitudes (K,) of each strip, GCRS to the head."""
    begin, end, noise = -head.margin_s, duration_s + head.margin_s, head.noise
    since: Array = np.arange(begin, end + 1e-9, head.step_s, dtype=np.float64) + head.shift_s
    times = [motion.begin_s + since for motion in motions]
    constant = noise.constant_rad * rng.standard_normal((len(motions), 3))
    for axis in np.flatnonzero(noise.constant_time_s):
        sigma, time_s = noise.constant_rad[axis : axis + 1], noise.constant_time_s[axis : axis + 1]
        begins = np.array([motion.begin_s for motion in motions])
        constant[:, axis] = correlated_noise(sigma, time_s, begins, rng)[:, 0]
    waves = head.waves if noise.periodic_rad.any() else np.zeros(0)
    if waves is None:
        waves = rng.standard_normal(6 * noise.harmonics)
    slow = correlated_noise(noise.correlated_rad, noise.correlation_time_s, np.concatenate(times), rng)
    found = []
    for n, (motion, t_s) in enumerate(zip(motions, times)):
        error = noise.white_rad * rng.standard_normal((len(t_s), 3)) + constant[n]
        error += noise.waves_s(t_s) @ waves
        error += slow[n * len(since) : (n + 1) * len(since)] + head.wrong_rad * rng.standard_normal(3)
        found.append((t_s, Rotation.from_rotvec(error) * head.R_ch.inv() * motion.R_ci(t_s)))
    return found


def correlated_noise(sigma: Array, time_s: Array, t_s: Array, rng: np.random.Generator) -> Array:
    """AR(1) noise (K, A) of standard deviations (A,) and correlation times (A,), at increasing instants."""
    values = rng.standard_normal((len(t_s), len(time_s)))
    keep = np.exp(-np.diff(t_s)[:, None] / time_s)
    for k, kept in enumerate(keep, start=1):
        values[k] = kept * values[k - 1] + np.sqrt(1.0 - kept**2) * values[k]
    return values * sigma
