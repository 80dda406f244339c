"""Errors that a located dump shares with the calibration: the matrix, and predicted Earth orientation.

A prediction that was wrong when the matrix was made has turned the matrix. Where the same prediction serves
to locate, ground and matrix have moved together and the error cancels but for the change of geometry; where
the dates differ, or one of them is measured by now, it does not. Both follow from the joint covariance.
"""

from __future__ import annotations

import numpy as np

from boresight.calib.predicted_earth import correlation_of_predictions
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.record import Floats
from boresight.pipeline.results.reading import SavedResult

__all__ = ["common_covariance"]


def common_covariance(result: SavedResult, earth: EarthRotation) -> Floats:
    """Covariance (6, 6) of theta, rad, and the rotation of the Earth in units of its 1-sigma (true less
    assumed, axes of ITRS), at a dump with this Earth rotation; zero of the latter where it is measured.
    """
    whole = np.zeros((6, 6))
    whole[:3, :3] = result.cov_theta
    if not earth.prediction:
        return whole
    here, seen = (earth.prediction,), result.earth.predictions
    whole[3:, 3:] = np.eye(3)
    if seen:
        with_seen = correlation_of_predictions(here, seen)
        gain = np.linalg.solve(correlation_of_predictions(seen, seen), with_seen.T).T
        whole[3:, 3:] += gain @ (result.earth.covariance @ gain.T - with_seen.T)
        whole[:3, 3:] = result.earth.with_theta_rad @ gain.T
        whole[3:, :3] = whole[:3, 3:].T
    return whole
