"""What the stages hand to one another: directions as a camera measured them, and as they are known to be.

A covariance of a direction is (3, 3), rad², in the axes of the camera that measured it, and has no part along
the direction itself (paper, A3): `covariance @ u = 0`. The QUEST model of the paper's (A14) is
`isotropic_covariance(u, sigma)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = [
    "GroundSightings",
    "StarSightings",
    "StripSightings",
    "information_of_directions",
    "isotropic_covariance",
]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StarSightings:
    """Identified stars of one exposure. Row n of every array speaks of the same star."""

    exposure_id: str
    t_s: float  # middle of the exposure, TAI seconds since the dump's epoch
    hip: NDArray[np.int64]  # (N,) Hipparcos numbers
    xy_px: Array  # (N, 2) centroids as measured, distortion not removed
    u_s: Array  # (N, 3) measured unit vectors, star-camera frame, distortion removed
    u_i: Array  # (N, 3) apparent catalogue directions as seen from the moving satellite, GCRS
    cov_s: Array  # (N, 3, 3) covariance of u_s, rad²

    def __post_init__(self) -> None:
        n = len(self.hip)
        _check_shapes(self, hip=(n,), xy_px=(n, 2), u_s=(n, 3), u_i=(n, 3), cov_s=(n, 3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class GroundSightings:
    """Ground calibration targets placed in one strip. Row n of every array speaks of the same sighting.

    The covariance holds what is independent from sighting to sighting: its placing in the
    image. Errors that are common to a strip (position, clock) or belong to the target are described by
    the last four fields and are the estimator's business.
    """

    target_id: NDArray[np.str_]  # (N,)
    ccd: NDArray[np.int64]  # (N,) which CCD of the camera, from 0
    xy_px: Array  # (N, 2) (sample, line) as measured in that CCD's raw image
    t_s: Array  # (N,) instant of the row, TAI seconds since the dump's epoch
    u_c: Array  # (N, 3) measured look vector, remote-sensing-camera frame
    u_i: Array  # (N, 3) apparent direction of the target from the moving satellite, GCRS
    cov_c: Array  # (N, 3, 3) covariance of u_c, rad²
    range_m: Array  # (N,) distance from satellite to target
    v_rel_i: Array  # (N, 3) velocity of the satellite relative to the ground at the target, GCRS axes, m/s
    cov_target_i: Array  # (N, 3, 3) covariance of the target's own coordinates, GCRS axes, m²

    def __post_init__(self) -> None:
        n = len(self.target_id)
        _check_shapes(
            self,
            target_id=(n,),
            ccd=(n,),
            xy_px=(n, 2),
            t_s=(n,),
            u_c=(n, 3),
            u_i=(n, 3),
            cov_c=(n, 3, 3),
            range_m=(n,),
            v_rel_i=(n, 3),
            cov_target_i=(n, 3, 3),
        )


@dataclass(frozen=True, slots=True, eq=False)
class StripSightings:
    """One strip: its targets, the star exposures around it, and the nominal motion between their instants.

    `R_oi` is the rotation from GCRS to the satellite's orbital frame (or any other smooth nominal attitude).
    What is left when it is taken out of the measured attitude varies slowly, and only that is interpolated.
    """

    strip_id: str
    exposures: tuple[StarSightings, ...]  # K exposures in order of time
    ground: GroundSightings  # J sightings
    R_oi_exposures: Rotation  # (K,)
    R_oi_targets: Rotation  # (J,)

    def __post_init__(self) -> None:
        times = [exposure.t_s for exposure in self.exposures]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError(f"strip {self.strip_id}: exposures must be in strictly increasing order of time")
        for name, got, expected in (
            ("R_oi_exposures", len(self.R_oi_exposures), len(self.exposures)),
            ("R_oi_targets", len(self.R_oi_targets), len(self.ground.target_id)),
        ):
            if got != expected:
                raise ValueError(f"strip {self.strip_id}: {name} must hold {expected} rotations, got {got}")


def isotropic_covariance(u: Array, sigma_rad: Array | float) -> Array:
    """sigma² (I - u uᵀ), the QUEST model (paper, A14). `u` (N, 3), `sigma_rad` (N,) or a number."""
    variance = np.broadcast_to(np.asarray(sigma_rad, dtype=float) ** 2, (len(u),))
    return variance[:, None, None] * (np.eye(3) - u[:, :, None] * u[:, None, :])


def information_of_directions(u: Array, covariance: Array) -> Array:
    """Pseudo-inverse of covariances that vanish along `u`: (N, 3, 3), rad⁻², also zero along `u`.

    The direction along u is lent a variance of ordinary size for the inversion, and it is taken back after.
    """
    along = u[:, :, None] * u[:, None, :]
    size = 0.5 * np.trace(covariance, axis1=1, axis2=2)[:, None, None]
    return np.linalg.inv(covariance + size * along) - along / size


def _check_shapes(record: Any, **shapes: tuple[int, ...]) -> None:
    for name, expected in shapes.items():
        if (got := np.shape(getattr(record, name))) != expected:
            raise ValueError(f"{type(record).__name__}.{name} must have shape {expected}, got {got}")
