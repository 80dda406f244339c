"""The attitude of one image by the fit of many: the plain form of what `star_id` computes faster."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from boresight.geometry.attitude_estimate import AttitudeSettings, fit_attitudes
from boresight.records.record import Bools, Floats

USUAL = AttitudeSettings()


@dataclass(frozen=True)
class PlainAttitude:
    """Attitude of one image of N stars."""

    R_si: Rotation
    cov_s: Floats  # (3, 3) rad²
    chi2: float
    dof: int
    kept: Bools  # (N,)


def plain_attitude(
    u_s: Floats, u_i: Floats, cov_s: Floats, settings: AttitudeSettings = USUAL
) -> PlainAttitude:
    """Attitude from measured `u_s` (N, 3), covariances (N, 3, 3), rad², and true `u_i` (N, 3)."""
    fit = fit_attitudes(u_s, u_i, cov_s, np.array([0, len(u_s)]), settings)
    assert fit.usable[0]
    R_si = Rotation.from_matrix(fit.R_si[0])
    return PlainAttitude(R_si, fit.covariance_s[0], float(fit.chi2[0]), int(fit.dof[0]), fit.kept)


def attitude_by_scatter(u_s: Floats, u_i: Floats, cov_s: Floats, false_alarm: float) -> PlainAttitude:
    """The same with stars rejected by their scatter where its median exceeds the stated covariances."""
    every = fit_attitudes(u_s, u_i, cov_s, np.array([0, len(u_s)]), AttitudeSettings(robust=False))
    factor = max(1.0, float(np.median(every.squared_mahalanobis)) / chi2(2).median())
    found = plain_attitude(u_s, u_i, factor * cov_s, AttitudeSettings(probability_false_alarm=false_alarm))
    return PlainAttitude(found.R_si, found.cov_s / factor, factor * found.chi2, found.dof, found.kept)
