"""What a calibration gives: the installation matrix with its covariance, or the turns that cannot be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.information import InformationPairs

__all__ = [
    "InstallationEstimate",
    "Iteration",
    "NoiseScale",
    "NotObservable",
    "Rejected",
    "TargetResiduals",
]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rejected:
    """One thing left out. `normalised` is its squared residual over its variance (NaN where it has none)."""

    strip_id: str
    exposure_id: str  # empty for targets and strips
    kind: str  # "star", "target", "exposure" or "strip"
    name: str  # Hipparcos number, target id, exposure id, strip id
    reason: str
    normalised: float


@dataclass(frozen=True, slots=True, eq=False)
class Iteration:
    """One step towards M = I."""

    theta_step: Array  # (3,) rad
    sigma: Array  # (3,) rad, predicted from the information at this step
    chi2: float
    targets: float  # sum of the targets' weights


@dataclass(frozen=True, slots=True, eq=False)
class TargetResiduals:
    """Every target of every strip, in the order given. Residuals after all unknowns were taken out."""

    strip_id: NDArray[np.str_]  # (J,)
    target_id: NDArray[np.str_]  # (J,)
    ccd: NDArray[np.int64]  # (J,)
    sample: Array  # (J,) px
    residual_c: Array  # (J, 2) rad along x and y of frame c
    normalised: Array  # (J,) squared residual over its own variance, 2 degrees of freedom
    kept: NDArray[np.bool_]  # (J,)


@dataclass(frozen=True, slots=True)
class NoiseScale:
    """What the residuals say of the sigmas that came with the sightings: factors, each with its own
    1-sigma.
    """

    stars: float
    stars_sigma: float
    targets: float
    targets_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class InstallationEstimate:
    """The installation matrix. Covariances are of a small turn about the axes of frame c, rad²."""

    R_cs: Rotation
    R_cs0: Rotation
    theta: Array  # (3,) rad: R_cs = exp[[theta]] R_cs0, the whole deviation
    cov_theta: Array  # (3, 3)
    chi2: float  # of the targets' residuals
    dof: int
    chi2_stars: float
    dof_stars: int
    n_strips: int
    n_exposures: int
    n_stars: int
    n_targets: int  # sightings kept
    iterations: tuple[Iteration, ...]
    converged_matrix: bool  # the last M was the unit matrix to the tolerance
    converged_covariance: bool  # the last step was a small part of the predicted sigma on every axis
    rejected: tuple[Rejected, ...]
    pairs: InformationPairs  # one a strip, about the matrix of the last iteration
    prior_shared: Array  # (n - 3, n - 3) information of the pairs' shared unknowns before any strip
    targets_taken_apart: int  # targets in several strips whose coordinates were taken as drawn anew in each
    targets: TargetResiduals
    noise: NoiseScale

    @property
    def converged(self) -> bool:
        return self.converged_matrix and self.converged_covariance

    @property
    def sigma_theta(self) -> Array:
        """(3,) rad."""
        return np.sqrt(np.diag(self.cov_theta))


@dataclass(frozen=True, slots=True, eq=False)
class NotObservable:
    """The data do not fix all three turns. No number is given along the directions that they leave open."""

    reason: str
    directions_c: Array  # (m, 3) unit vectors: the turns about them are not observable
    observable_c: Array  # (3 - m, 3) unit vectors that are
    theta_along: Array  # (3 - m,) rad, the deviation's part along each observable direction, from R_cs0
    sigma_along: Array  # (3 - m,) rad
    rejected: tuple[Rejected, ...]
