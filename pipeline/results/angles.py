"""Cross angles of stars and targets against what they should be: the paper's z_ij (21) at the final matrix,
and its predicted spread (A6), (A15).

A target's row lies between star exposures, so the star vectors of the nearest exposure are first carried to
the row's instant by the measured motion of the star camera. What is left is noise: of the star's place, of
the target's place, of the motion between the two, and what the mission states of its own errors.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude import AttitudeTrack, NominalMotion, interpolation_weights
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats, array, record, scalar

__all__ = ["MeasuredStrip", "cross_angles"]


@record(kw_only=True)
class MeasuredStrip:
    """A strip, its measured attitudes and which sightings are used. Exposures in the strip's order."""

    strip: StripSightings = scalar("sightings of the strip")
    orbit: NominalMotion = scalar("nominal motion: the orbit, or the scan of the sky")
    R_si: Rotation = array("K", "attitude at each exposure, GCRS -> star camera")
    covariance_s: Floats = array("K, 3, 3", "of each attitude, frame s, rad²")
    stars_kept: tuple[NDArray[np.bool_], ...] = array("K", "arrays (N,): the stars used of each exposure")
    targets_kept: NDArray[np.bool_] = array("J", "the targets used")


@record(kw_only=True)
class CrossAngles:
    """Cross angles of N pairs of a star and a target. Row n of every array is the same pair."""

    strip_id: NDArray[np.str_] = array("N", "strip")
    target_id: NDArray[np.str_] = array("N", "target")
    exposure_id: NDArray[np.str_] = array("N", "exposure")
    hip: NDArray[np.int64] = array("N", "catalogue number of the star")
    z: Floats = array("N", "cosine measured minus cosine known")
    sigma: Floats = array("N", "predicted 1 sigma of z")


def cross_angles(motions: list[MeasuredStrip], R_cs: Rotation, settings: CalibrationSettings) -> CrossAngles:
    """All pairs of kept targets and kept stars of the exposure nearest in time."""
    parts = [part for motion in motions for part in _of_strip(motion, R_cs, settings)]
    return CrossAngles(
        strip_id=np.array([p[0] for p in parts for _ in p[3]], dtype=str),
        target_id=np.array([p[1] for p in parts for _ in p[3]], dtype=str),
        exposure_id=np.array([p[2] for p in parts for _ in p[3]], dtype=str),
        hip=np.concatenate([np.zeros(0, dtype=np.int64), *(p[3] for p in parts)]),
        z=np.concatenate([np.zeros(0), *(p[4] for p in parts)]),
        sigma=np.concatenate([np.zeros(0), *(p[5] for p in parts)]),
    )


def _of_strip(
    motion: MeasuredStrip, R_cs: Rotation, settings: CalibrationSettings
) -> Iterator[tuple[str, str, str, NDArray[np.int64], Floats, Floats]]:
    strip, ground = motion.strip, motion.strip.ground
    times = strip.times_s
    if len(times) < 2 or not any(kept.any() for kept in motion.stars_kept):
        return
    track = AttitudeTrack(times, motion.R_si, motion.orbit)
    R_ci = R_cs * track.R_si(ground.t_s)
    own = _target_covariances(motion, R_ci.as_matrix(), settings)
    inside = (ground.t_s >= times[0]) & (ground.t_s <= times[-1])
    C, weights = R_cs.as_matrix(), interpolation_weights(times, ground.t_s)
    for j in np.flatnonzero(motion.targets_kept & inside):
        k = int(np.argmin(np.abs(times - ground.t_s[j])))
        stars, kept = strip.exposures[k], motion.stars_kept[k]
        carry = R_ci[j] * motion.R_si[k].inv()
        w_i = carry.apply(stars.u_s[kept])
        w_j = ground.u_c[j]
        z = w_i @ w_j - stars.u_i[kept] @ ground.u_i[j]  # (21)
        weights[j, k] -= 1.0
        motion_c = C @ np.einsum("k,kab->ab", weights[j] ** 2, motion.covariance_s) @ C.T
        moved = C @ stars.cov_s[kept] @ C.T
        cross = np.cross(w_i, w_j)
        variance = np.einsum("a,nab,b->n", w_j, moved, w_j)  # (A6): the star's part
        variance += np.einsum("na,ab,nb->n", w_i, own[j], w_i)  # the target's part
        variance += np.einsum("na,ab,nb->n", cross, motion_c, cross)
        names = str(strip.strip_id), str(ground.target_id[j]), stars.exposure_id
        yield (*names, stars.hip[kept], z, np.sqrt(variance))


def _target_covariances(motion: MeasuredStrip, R_ci: Floats, settings: CalibrationSettings) -> Floats:
    """Covariance (J, 3, 3) of each target's direction, frame c, rad²: image measurement and stated errors.
    `R_ci` (J, 3, 3) are the attitudes of the camera.
    """
    ground = motion.strip.ground
    w = ground.u_c
    across = np.eye(3) - w[:, :, None] * w[:, None, :]
    distance = ground.range_m[:, None, None]
    white = settings.sigma_vibration_rad**2 + settings.sigma_distortion_rad**2
    covariance = white + (settings.sigma_position_m / distance) ** 2
    covariance = covariance * across
    v = np.einsum("jab,jbc,jc->ja", across, R_ci, ground.v_rel_i) * settings.sigma_clock_s
    covariance = covariance + v[:, :, None] * v[:, None, :] / distance**2
    own = R_ci @ ground.cov_target_i @ np.swapaxes(R_ci, 1, 2)
    reach = np.where(ground.is_star[:, None, None], 1.0, distance)  # a star's is an angle already
    covariance = covariance + across @ own @ across / reach**2
    return np.asarray(covariance + ground.cov_c)
