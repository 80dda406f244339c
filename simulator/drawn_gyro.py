"""Rows of a gyro between the exposures of drawn strips, with its errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.gyro import GyroNoise, GyroRows, summed_up
from boresight.geometry.sightings import StripSightings
from boresight.simulator.campaign import StripTruth

__all__ = ["with_gyro"]

Array = NDArray[np.float64]


def with_gyro(
    strips: Sequence[StripSightings],
    truth: StripTruth,
    R_cs: Rotation,
    noise: GyroNoise,
    t_s: Array,
    rng: np.random.Generator,
) -> list[StripSightings]:
    """The strips with a gyro of the axes of s at instants (K,) since the begin of each strip."""
    found = []
    for strip, motion in zip(strips, truth.motion):
        at, step = motion.begin_s + t_s, np.diff(t_s, prepend=t_s[0])[:, None]
        bias = noise.bias_rad_s * rng.standard_normal(3) + noise.bias_walk_rad_s * np.cumsum(
            np.sqrt(step) * rng.standard_normal((len(at), 3)), axis=0
        )
        errors = step * bias + noise.random_walk_rad * np.sqrt(step) * rng.standard_normal((len(at), 3))
        errors += np.diff(noise.white_rad * rng.standard_normal((len(at) + 1, 3)), axis=0)
        R_si = R_cs.inv() * motion.R_ci(at)
        turns = np.zeros((len(at), 3))
        turns[1:] = -(R_si[1:] * R_si[:-1].inv()).as_rotvec()
        rows = GyroRows(t_s=at, R_sz=summed_up(turns + errors), R_oi=motion.R_oi(at), noise=noise)
        found.append(replace(strip, gyro=rows))
    return found
