"""Where a calibrated pair of cameras puts points of the ground, and how far off along and across the track.

Frames: i inertial, c remote-sensing camera, s star camera. Metres, radians. The attitude at a row's instant
is that of the star camera's exposures around it, smoothed: what the nominal motion leaves is a Gaussian
process in time, so that exposures help one another where the motion is slower than their rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.experiments.wang import attitudes_of

__all__ = ["GroundErrors", "MotionPrior", "ground_errors", "smoothed_attitude"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MotionPrior:
    """What is believed of the attitude beside the nominal motion: size and time over which it keeps its
    value.
    """

    sigma_rad: float = 10.0 * ARCSEC  # waves of 3 to 12 arcsec (paper, Fig. 4)
    length_s: float = (
        1.0  # of a squared-exponential: shorter waves still come through, at a little more noise
    )


@dataclass(frozen=True, slots=True, eq=False)
class GroundErrors:
    """Errors at J check points, metres."""

    along_m: Array  # (J,)
    across_m: Array  # (J,)

    @property
    def rms_m(self) -> tuple[float, float]:
        """Along and across the track."""
        return float(np.sqrt(np.mean(self.along_m**2))), float(np.sqrt(np.mean(self.across_m**2)))


def smoothed_attitude(strip: StripSightings, prior: MotionPrior) -> Rotation:
    """R_si (J,) at the targets' instants from all exposures of the strip."""
    R_si, covariance = attitudes_of(strip.exposures)
    times = np.array([exposure.t_s for exposure in strip.exposures])
    D = R_si * strip.R_oi_exposures.inv()
    middle = D.mean()
    turns = (D * middle.inv()).as_rotvec()  # (K, 3)
    K = len(times)
    noise = np.zeros((K, 3, K, 3))
    noise[np.arange(K), :, np.arange(K)] = covariance
    constant = 1e4 * prior.sigma_rad**2  # the mounting to the nominal frame is free
    prior_tt = _kernel(times, times, prior) + constant
    prior_jt = _kernel(strip.ground.t_s, times, prior) + constant
    whole = np.kron(prior_tt, np.eye(3)) + noise.reshape(3 * K, 3 * K)
    smooth = (np.kron(prior_jt, np.eye(3)) @ np.linalg.solve(whole, turns.ravel())).reshape(-1, 3)
    return Rotation.from_rotvec(smooth) * middle * strip.R_oi_targets


def ground_errors(
    position_i: Array, look_i: Array, ground_i: Array, up_i: Array, velocity_i: Array
) -> GroundErrors:
    """Errors at check points (J, 3) of rays from `position_i` along `look_i`, met with the level of each
    point.

    `up_i` is the local vertical, `velocity_i` gives the direction of the track. Along is positive ahead,
    across positive to the right of the track seen from above.
    """
    level = np.einsum("ja,ja->j", ground_i - position_i, up_i)
    reach = level / np.einsum("ja,ja->j", look_i, up_i)
    off = position_i + reach[:, None] * look_i - ground_i
    along = velocity_i - np.einsum("ja,ja->j", velocity_i, up_i)[:, None] * up_i
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, up_i)
    return GroundErrors(np.einsum("ja,ja->j", off, along), np.einsum("ja,ja->j", off, across))


def _kernel(a: Array, b: Array, prior: MotionPrior) -> Array:
    return np.asarray(prior.sigma_rad**2 * np.exp(-0.5 * ((a[:, None] - b[None, :]) / prior.length_s) ** 2))
