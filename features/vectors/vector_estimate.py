"""The installation matrix from vectors of frames, by estimator, rejection and tests of `calibrate`.

A frame is the paper's: one attitude, stars and targets at one instant. It becomes a strip with one exposure
whose targets, like stars, no position of the satellite moves; errors that strips have in common are off.
Frames of one instant, or with the same stars, have one attitude, whose error counts once
(`simultaneous_strips`).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.hypotheses import vector_hypotheses
from boresight.calib.information import InformationPairs
from boresight.calib.reliability import examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Verdict, assess
from boresight.geometry.attitude_estimate import with_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import GroundSightings, StarSightings, StripSightings, VectorSets
from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Floats, record, scalar

__all__ = ["VectorCalibration", "calibrate_vector_sets", "strips_of_frames"]

# Settings for vectors of independent errors, each with a stated covariance: no error is shared.
INDEPENDENT = CalibrationSettings(
    sigma_position_m=0.0, sigma_clock_s=0.0, sigma_vibration_rad=0.0, sigma_distortion_rad=0.0
)
EVERY_S = 60.0  # from one instant to the next: no two frames of different stars are of one pass
# Cosine of the largest angle, 80°, between a star's direction and the axis z up to which an error of the
# focal length is tested: its effect grows with the tangent.
WIDEST_FIELD = np.cos(np.radians(80.0))


@record
class VectorCalibration:
    """The estimate from frames, with what its residuals say of it."""

    estimate: InstallationEstimate = scalar("matrix, covariance, residuals of targets, rejections")
    verdict: Verdict = scalar("whether the vectors contradict themselves, and what they cannot show")
    strips: tuple[StripSightings, ...] = scalar("one a frame, with the attitude that its stars give")


def calibrate_vector_sets(
    frames: VectorSets, R_cs0: Rotation, prior: Floats | None = None
) -> VectorCalibration | NotObservable:
    """The matrix from frames with independent errors, about the start `R_cs0`; `NotObservable` where they
    leave a rotation undetermined. `prior` (3, 3), rad⁻², is the information on theta that `R_cs0` has.
    """
    strips = with_attitudes(strips_of_frames(frames), INDEPENDENT.attitudes)
    known = prior is not None and InformationPairs(np.array(["R_cs0"]), prior[None], np.zeros((1, 3)), R_cs0)
    estimate = calibrate_strips(strips, R_cs0, INDEPENDENT, prior=known or None)
    if isinstance(estimate, NotObservable):
        return estimate
    reliability = examine(
        estimate,
        strips,
        INDEPENDENT,
        pixel_rad=ARCSEC,
        star_camera=_star_camera(frames.u_s),
        table_of=vector_hypotheses,
    )
    return VectorCalibration(estimate, assess(estimate, strips, reliability=reliability), tuple(strips))


def strips_of_frames(frames: VectorSets) -> list[StripSightings]:
    """Each frame with targets as a strip of one exposure, with the stars of all frames of its instant. Stars
    are numbered by their row, and targets that are no places on the ground too.
    """
    instants, digits = frames.instants, len(str(max(len(frames) - 1, 0)))
    cov_s, cov_c = frames.covariances
    ids = np.arange(len(frames.w_c)).astype(str) if frames.target_id is None else frames.target_id
    exposures = {}
    for first in dict.fromkeys(instants):
        rows = frames.stars_of([k for k, instant in enumerate(instants) if instant == first])
        exposures[first] = StarSightings(
            exposure_id=f"{first:0{digits}d}",
            t_s=EVERY_S * first,
            hip=rows,
            xy_px=np.zeros((len(rows), 2)),
            u_s=frames.u_s[rows],
            u_i=frames.v_stars[rows],
            cov_s=cov_s[rows],
        )
    strips = []
    for k, first in enumerate(instants):
        own = slice(*frames.target_start[k : k + 2].tolist())
        if not (J := own.stop - own.start):
            continue
        targets = GroundSightings.of_stars(
            target_id=ids[own],
            ccd=np.zeros(J, dtype=np.int64),
            xy_px=np.column_stack([np.arange(J), np.zeros(J)]).astype(float),
            t_s=np.full(J, EVERY_S * first),
            u_c=frames.w_c[own],
            u_i=frames.v_targets[own],
            cov_c=cov_c[own],
            cov_target_i=np.zeros((J, 3, 3)) if frames.cov_targets is None else frames.cov_targets[own],
        )
        strips.append(
            StripSightings(
                strip_id=f"{k:0{digits}d}",
                exposures=(exposures[first],),
                ground=targets,
                R_oi_exposures=Rotation.identity(1),
                R_oi_targets=Rotation.identity(J),
            )
        )
    return strips


def _star_camera(u_s: Floats) -> StarCamera | None:
    """A camera of pixels of an arc-second about the axis z, as wide as the stars: what is tested of a star
    camera's model. None where the stars do not lie about that axis.
    """
    if u_s[:, 2].min() < WIDEST_FIELD:
        return None
    corner = float(np.max(np.linalg.norm(u_s[:, :2] / u_s[:, 2:], axis=1))) / ARCSEC
    side = max(int(np.ceil(np.sqrt(2.0) * corner)), 2)
    return StarCamera(focal_m=1.0, pixel_m=ARCSEC, width_px=side, height_px=side, principal_px=(0.0, 0.0))
