"""Geo-positioning errors of a calibrated camera pair at check points, along and across the track.

Frames: i inertial, c remote-sensing camera, s star camera. Metres, radians. The attitude at a row's instant
is smoothed from the star exposures: its deviation from the nominal motion is a Gaussian process in time.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.paper.wang import attitudes_of
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats, array, record

__all__ = ["GroundErrors", "check_point_errors", "ground_errors", "smoothed_attitude"]


# Squared-exponential prior of the attitude's deviation from the nominal motion: its standard deviation for
# each axis, where waves are 3 to 12 arcsec, and its correlation length (set by hand).
MOTION_RAD, MOTION_S = 10.0 * ARCSEC, 1.0


@record
class GroundErrors:
    """Errors at J check points."""

    along_m: Floats = array("J", "along the track, positive ahead, m")
    across_m: Floats = array("J", "across the track, positive to the right seen from above, m")

    @property
    def rms_m(self) -> tuple[float, float]:
        """Root mean square along and across the track, m."""
        return float(np.sqrt(np.mean(self.along_m**2))), float(np.sqrt(np.mean(self.across_m**2)))


def smoothed_attitude(strip: StripSightings) -> Rotation:
    """R_si (J,) at the targets' instants, smoothed from all exposures of the strip."""
    R_si, covariance = attitudes_of(strip)
    times = strip.times_s
    D = R_si * strip.R_oi_exposures.inv()
    middle = D.mean()
    angles = (D * middle.inv()).as_rotvec()  # (K, 3)
    K = len(times)
    noise = np.zeros((K, 3, K, 3))
    noise[np.arange(K), :, np.arange(K)] = covariance
    constant = 1e4 * MOTION_RAD**2  # the mounting to the nominal frame is free
    prior_tt = _kernel(times, times) + constant
    prior_jt = _kernel(strip.ground.t_s, times) + constant
    whole = np.kron(prior_tt, np.eye(3)) + noise.reshape(3 * K, 3 * K)
    smooth = (np.kron(prior_jt, np.eye(3)) @ np.linalg.solve(whole, angles.ravel())).reshape(-1, 3)
    return Rotation.from_rotvec(smooth) * middle * strip.R_oi_targets


def ground_errors(look_i: Floats, to_ground_i: Floats, up_i: Floats, velocity_i: Floats) -> GroundErrors:
    """Errors at check points, `to_ground_i` (J, 3) from the satellite, of rays along `look_i`, intersected
    with the horizontal plane of each point.

    `up_i` (J, 3) is the local vertical, `velocity_i` (J, 3) gives the direction of the track. m, frame i.
    """
    reach = np.einsum("ja,ja->j", to_ground_i, up_i) / np.einsum("ja,ja->j", look_i, up_i)
    off = reach[:, None] * look_i - to_ground_i
    along = velocity_i - np.einsum("ja,ja->j", velocity_i, up_i)[:, None] * up_i
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, up_i)
    return GroundErrors(np.einsum("ja,ja->j", off, along), np.einsum("ja,ja->j", off, across))


def check_point_errors(strip: StripSightings, look_i: Floats) -> GroundErrors:
    """Errors at the targets of a strip, as check points, of look vectors `look_i` (J, 3), frame i."""
    ground = strip.ground
    up_i = -strip.R_oi_targets.inv().apply([0.0, 0.0, 1.0])
    return ground_errors(look_i, ground.range_m[:, None] * ground.u_i, up_i, ground.v_rel_i)


def _kernel(a: Floats, b: Floats) -> Floats:
    return np.asarray(MOTION_RAD**2 * np.exp(-0.5 * ((a[:, None] - b[None, :]) / MOTION_S) ** 2))
