"""Campaigns of strips with every error of the paper's Table 1, and whether what is stated of errors holds."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import StripSightings
from boresight.records.record import record
from boresight.simulator.campaign import (
    CameraPair,
    DistortionCurve,
    DrawnStripMotion,
    StripPlan,
    StripTruth,
    draw_targets,
)

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


def draw_other_camera(
    strips: Sequence[StripSightings],
    truth: StripTruth,
    plan: StripPlan,
    cameras: CameraPair,
    name: str,
    rng: np.random.Generator,
) -> list[StripSightings]:
    """What another camera of the satellite sees while `strips` are taken: the same exposures, attitudes and
    position, a row clock and a distortion of its own. Matrix and field are those of `cameras`.
    """
    curve, drawn = DistortionCurve.draw(plan, cameras, rng), []
    turn = cameras.R_cs * truth.R_cs.inv()
    for strip, nadir, error_m in zip(strips, truth.motion, truth.position_m):
        motion = _Turned(nadir.begin_s, nadir.radius_m, nadir.rate, nadir.R_ie, nadir.waves, turn)
        strip_id = f"{strip.strip_id}-{name}"
        t = nadir.begin_s + plan.duration_s * np.sort(rng.uniform(*plan.along, plan.targets))
        rows = t, nadir.R_oi(t), motion.R_ci(t)
        ground, *_ = draw_targets(strip_id, rows, plan, cameras, motion, (curve, None), rng, error_m)
        drawn.append(replace(strip, strip_id=strip_id, ground=ground, R_oi_targets=rows[1], camera=name))
    return drawn


@record
class _Turned(DrawnStripMotion):
    """The motion of a camera whose axes are rotated against those that oscillate."""

    turn: Rotation

    def R_ci(self, t: NDArray) -> Rotation:
        return self.turn * DrawnStripMotion.R_ci(self, t)
