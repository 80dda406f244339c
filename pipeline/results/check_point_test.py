"""Whether check points are off by no more than the calibration predicts.

Along the track, and across it, the errors e of N check points have a covariance C: of the matrix, predicted
Earth orientation and the camera's distortion, which all points share; of a strip's attitudes, position, clock
and heights, which the points of the strip share; of vibration, each point's own. Their mean square is

    e . e / N = sum_i lambda_i z_i²,     lambda the eigenvalues of C / N, z independent standard normal

and the probability that it is as large as found by chance is that of the saddlepoint approximation (Lugannani
and Rice 1980; Kuonen 1999, Biometrika 86, 929).

What the matrix has taken up of the errors of a strip cancels there (`place_errors`).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from boresight.records.record import Floats, record, scalar

__all__ = ["DIRECTIONS", "RmsTest", "probability_beyond", "rms_test"]

PROBABILITY_REFUSED = 1e-3  # that a right prediction is refused, both directions together
# Names of the two directions on the ground in which errors of check points are stated: along the satellite's
# track and across it.
DIRECTIONS = ("along", "across")
AT_MEAN = 1e-4  # of a standard deviation: nearer to the mean the approximation is its limit


@record
class RmsTest:
    """Errors of check points in one direction against those predicted."""

    direction: str = scalar("along or across, the track")
    points: int = scalar("check points")
    rms_m: float = scalar("root mean square of their errors")
    predicted_m: float = scalar("root of the mean square that is expected")
    p_value: float = scalar("probability of an rms as large, if the prediction is right")
    limit: float = scalar("p-value below which the prediction is refused")
    allowed: bool = scalar("whether the errors are as predicted, or smaller")


def rms_test(direction: str, error_m: Floats, covariance: Floats) -> RmsTest:
    """The test of errors (N,), m, with the predicted covariance (N, N), m²."""
    mean_square = float(np.mean(error_m**2))
    eigenvalues = np.maximum(np.linalg.eigvalsh(covariance / len(error_m)), 0.0)
    p, limit = probability_beyond(eigenvalues, mean_square), PROBABILITY_REFUSED / len(DIRECTIONS)
    predicted = float(np.sqrt(eigenvalues.sum()))
    return RmsTest(direction, len(error_m), float(np.sqrt(mean_square)), predicted, p, limit, p >= limit)


def probability_beyond(eigenvalues: Floats, x: float) -> float:
    """Probability that sum_i lambda_i z_i² > x, z_i standard normal, eigenvalues lambda_i (N,) >= 0."""
    lam = eigenvalues[eigenvalues > 1e-12 * eigenvalues.max(initial=0.0)]
    if not len(lam) or x <= 0.0:
        return float(x <= 0.0)

    def slope(t: float) -> float:
        return float(np.sum(lam / (1.0 - 2.0 * t * lam))) - x

    most = 0.5 / float(lam.max())  # the generating function is finite below
    t = brentq(slope, -len(lam) / x, most * (1.0 - 1e-12), xtol=1e-14 * most, rtol=1e-14)
    second, third = (float(np.sum(c * (lam / (1.0 - 2.0 * t * lam)) ** n)) for c, n in ((2.0, 2), (8.0, 3)))
    if abs(t) * np.sqrt(second) < AT_MEAN:
        return 0.5 - third / second**1.5 / (6.0 * np.sqrt(2.0 * np.pi))
    w = np.sign(t) * np.sqrt(2.0 * (t * x + 0.5 * float(np.sum(np.log1p(-2.0 * t * lam)))))
    v = t * np.sqrt(second)
    return float(np.clip(ndtr(-(w + np.log(v / w) / w)), 0.0, 1.0))
