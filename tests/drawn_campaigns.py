"""Campaigns of strips with every error of the paper's Table 1, and whether what is stated of errors holds."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.simulator.campaign import CameraPair, StripPlan

__all__ = ["BOLD", "CAMERAS", "R_CS0", "TABLE_1", "assert_chi_square", "nees_of_estimate", "squared"]

BOLD = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
CAMERAS = CameraPair(BOLD)
R_CS0 = deviation_from_theta(np.array([0.003, 0.002, 0.001])).inv() * BOLD  # the paper's (28)
TABLE_1 = StripPlan(
    sigma_position_m=2.0, sigma_clock_s=1e-4, sigma_vibration_rad=0.1 * ARCSEC, sigma_distortion_rad=3e-7
)


def squared(error: NDArray, covariance: NDArray) -> float:
    """An error squared in units of its stated covariance (NEES): chi-square where that is honest."""
    return float(error @ np.linalg.solve(covariance, error))


def nees_of_estimate(estimate: InstallationEstimate, R_cs: Rotation = BOLD) -> float:
    """The squared error of a matrix whose true one is known."""
    return squared(theta_between(estimate.R_cs, R_cs), estimate.cov_theta)


def assert_chi_square(squares: ArrayLike, dof: float) -> None:
    """The sum of squares, each of `dof` degrees of freedom, lies in the middle 99.9 % of its distribution."""
    found = np.atleast_1d(squares)
    low, high = chi2(df=dof * len(found)).ppf([0.0005, 0.9995])
    assert low < found.sum() < high, (low, found.sum(), high)
