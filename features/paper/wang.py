"""Wang's calibration as the paper describes it (section 3.3.2), for comparison.

For each strip the targets alone give the attitude of the remote-sensing camera as a polynomial in time (third
order) added to the nominal motion. The star camera's attitude at each exposure then gives an installation
matrix; their mean is the strip's, and the mean over strips the result. Attitude and installation are solved
separately and all strips weigh the same, so the poorly determined directions of a strip remain in the result.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_estimate import cross_matrices, with_attitudes
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats, array, record, scalar

__all__ = ["WangEstimate", "attitudes_of", "polynomial_residuals", "wang_calibrate"]


@record
class WangEstimate:
    """Installation matrix by Wang's method."""

    R_cs: Rotation = scalar("mean over the strips, s to c")
    R_cs_strips: Rotation = array("S", "matrix of each strip")
    rejected: tuple[tuple[str, str], ...] = scalar(
        "(strip, reason) of strips with too few targets or exposures"
    )


def wang_calibrate(strips: Sequence[StripSightings], R_cs0: Rotation, order: int = 3) -> WangEstimate:
    """The installation matrix by Wang's method with polynomials of `order`.

    Raises `ValueError` when no strip has enough targets and exposures.
    """
    found, rejected = [], []
    for strip in strips:
        enough = 3 * (order + 1) // 2 + 1
        if len(strip.ground.t_s) < enough or len(strip.exposures) < 2:
            reason = (
                f"{len(strip.ground.t_s)} targets and {len(strip.exposures)} exposures, {enough} and 2 needed"
            )
            rejected.append((strip.strip_id, reason))
            continue
        found.append(_strip_matrix(strip, R_cs0, order))
    if not found:
        raise ValueError(f"none of {len(strips)} strips has enough targets and exposures for order {order}")
    R_cs_strips = Rotation.concatenate(found)
    return WangEstimate(R_cs_strips.mean(), R_cs_strips, tuple(rejected))


def attitudes_of(strip: StripSightings) -> tuple[Rotation, Floats]:
    """R_si of every exposure of a strip, and covariances (K, 3, 3), rad², of a small rotation about the axes
    of s. Raises `ValueError` where an exposure has no attitude.
    """
    fit = with_attitudes([strip])[0].attitudes
    if fit is None or not fit.usable.all():
        n = int(fit.usable.sum()) if fit is not None else 0
        raise ValueError(f"strip {strip.strip_id}: {n} of {len(strip.exposures)} exposures have an attitude")
    return Rotation.from_matrix(fit.R_si), fit.covariance_s


def polynomial_residuals(t_s: Floats, angles: Floats, order: int) -> Floats:
    """Residuals (N, 3) of angles (N, 3) from a least-squares polynomial in time: the paper's Fig. 8."""
    powers = _powers(t_s, float(t_s[0]), float(t_s[-1]), order)
    return np.asarray(angles - powers @ np.linalg.lstsq(powers, angles, rcond=None)[0], dtype=np.float64)


def _strip_matrix(strip: StripSightings, R_cs0: Rotation, order: int) -> Rotation:
    R_si, _ = attitudes_of(strip)
    times = strip.times_s
    first, last = times[0], times[-1]
    R_co = (R_cs0 * R_si * strip.R_oi_exposures.inv())[len(times) // 2]
    powers = _powers(strip.ground.t_s, first, last, order)  # (J, order + 1)
    nominal = (R_co * strip.R_oi_targets).apply(strip.ground.u_i)
    coefficients = np.zeros((order + 1, 3))
    for _ in range(5):
        w = Rotation.from_rotvec(powers @ coefficients).apply(nominal)
        jacobian = -cross_matrices(w)[:, :2]  # of x and y of u_c - w: two collinearity equations
        A = (jacobian[:, :, None, :] * powers[:, None, :, None]).reshape(2 * len(w), -1)
        step = np.linalg.lstsq(A, (strip.ground.u_c - w)[:, :2].ravel(), rcond=None)[0]
        coefficients += step.reshape(order + 1, 3)
    fitted = Rotation.from_rotvec(_powers(times, first, last, order) @ coefficients)
    return (fitted * R_co * strip.R_oi_exposures * R_si.inv()).mean()


def _powers(t: Floats, first: float, last: float, order: int) -> Floats:
    scaled = (2.0 * t - first - last) / max(last - first, 1e-9)
    return np.asarray(scaled[:, None] ** np.arange(order + 1), dtype=np.float64)
