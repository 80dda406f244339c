"""The conventional way, as the paper describes Wang's (section 3.3.2): the yardstick, not a recommendation.

Strip by strip, the targets alone give the remote-sensing camera's attitude as a polynomial in time (third
order) on top of the nominal motion; the star camera's attitudes at its exposures then give an installation
matrix each, their mean the strip's, and the rotation nearest to all strips' the result. Attitude and
installation are solved apart, every strip with the same weight, so the weak directions of one strip stay in
the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.attitudes import cross_matrices, fit_attitudes
from boresight.geometry.sightings import StarSightings, StripSightings

__all__ = ["WangEstimate", "attitudes_of", "polynomial_residuals", "wang_calibrate"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class WangEstimate:
    """`R_cs` over all strips, each strip's own, and the strips that had too little to fit, with the
    reason.
    """

    R_cs: Rotation
    R_cs_strips: Rotation  # (S,)
    strip_ids: tuple[str, ...]  # (S,)
    left_out: tuple[tuple[str, str], ...]  # strip, reason


def wang_calibrate(strips: Sequence[StripSightings], R_cs0: Rotation, order: int = 3) -> WangEstimate:
    """The installation matrix by Wang's way. Raises `ValueError` when no strip can be fitted."""
    found, ids, left_out = [], [], []
    for strip in strips:
        enough = 3 * (order + 1) // 2 + 1
        if len(strip.ground.t_s) < enough or len(strip.exposures) < 2:
            reason = (
                f"{len(strip.ground.t_s)} targets and {len(strip.exposures)} exposures, {enough} and 2 needed"
            )
            left_out.append((strip.strip_id, reason))
            continue
        found.append(_strip_matrix(strip, R_cs0, order))
        ids.append(strip.strip_id)
    if not found:
        raise ValueError(f"none of {len(strips)} strips has enough targets and exposures for order {order}")
    R_cs_strips = Rotation.concatenate(found)
    return WangEstimate(R_cs_strips.mean(), R_cs_strips, tuple(ids), tuple(left_out))


def attitudes_of(exposures: Sequence[StarSightings]) -> tuple[Rotation, Array]:
    """R_si of every exposure from its stars, and the covariance (K, 3, 3) of a small turn about the axes
    of s.
    """
    start = np.concatenate([[0], np.cumsum([len(exposure.hip) for exposure in exposures])]).astype(np.int64)
    fit = fit_attitudes(
        np.concatenate([exposure.u_s for exposure in exposures]),
        np.concatenate([exposure.u_i for exposure in exposures]),
        np.concatenate([exposure.cov_s for exposure in exposures]),
        start,
    )
    if not fit.usable.all():
        raise ValueError(f"{int((~fit.usable).sum())} of {len(exposures)} exposures have no attitude")
    return Rotation.from_matrix(fit.R_si), fit.covariance_s


def polynomial_residuals(t_s: Array, angles: Array, order: int) -> Array:
    """What a polynomial of this order leaves of angles (N, 3) against time: the paper's Fig. 8."""
    powers = _powers(t_s, float(t_s[0]), float(t_s[-1]), order)
    return np.asarray(angles - powers @ np.linalg.lstsq(powers, angles, rcond=None)[0], dtype=np.float64)


def _strip_matrix(strip: StripSightings, R_cs0: Rotation, order: int) -> Rotation:
    R_si, _ = attitudes_of(strip.exposures)
    times = np.array([exposure.t_s for exposure in strip.exposures])
    first, last = times[0], times[-1]
    R_co = (R_cs0 * R_si * strip.R_oi_exposures.inv())[len(times) // 2]
    powers = _powers(strip.ground.t_s, first, last, order)  # (J, order + 1)
    nominal = (R_co * strip.R_oi_targets).apply(strip.ground.u_i)
    coefficients = np.zeros((order + 1, 3))
    for _ in range(5):
        w = Rotation.from_rotvec(powers @ coefficients).apply(nominal)
        turn = -cross_matrices(w)[
            :, :2
        ]  # x and y of u_c - w by a right-handed turn: two collinearity equations
        A = (turn[:, :, None, :] * powers[:, None, :, None]).reshape(2 * len(w), -1)
        step = np.linalg.lstsq(A, (strip.ground.u_c - w)[:, :2].ravel(), rcond=None)[0]
        coefficients += step.reshape(order + 1, 3)
    turned = Rotation.from_rotvec(_powers(times, first, last, order) @ coefficients)
    return (turned * R_co * strip.R_oi_exposures * R_si.inv()).mean()


def _powers(t: Array, first: float, last: float, order: int) -> Array:
    scaled = (2.0 * t - first - last) / max(last - first, 1e-9)
    return np.asarray(scaled[:, None] ** np.arange(order + 1), dtype=np.float64)
