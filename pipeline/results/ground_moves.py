"""What each error of a calibration moves on the ground, to first order:

    rotation delta:  r (I - u nᵀ / uᵀn) (delta x u)      satellite moved by d:  (I - u nᵀ / uᵀn) d
    ground higher by h:  h (u / uᵀn - n)
    Earth rotated by a:  -(I - u nᵀ / uᵀn) (a x p),   p from the Earth's centre; of an orbit that is stated in
                         ITRF from the satellite, which rotates too

with the line of sight u, its length r and the vertical n; a rotation of the camera by delta rotates u too.

A located dump shares errors with the calibration: the matrix, and predicted Earth orientation. A prediction
that was wrong when the matrix was made has turned the matrix. Where the same prediction serves to locate,
ground and matrix have moved together and the error cancels but for the change of geometry; where the dates
differ, or one of them is measured by now, it does not. Both follow from the joint covariance.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.predicted_earth import correlation_of_predictions
from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import geodetic_from_ecef, unit_vectors
from boresight.geometry.orbit import Orbit
from boresight.pipeline.results.reading import SavedResult
from boresight.records.record import Floats, array, record

__all__ = ["GroundMoves", "common_covariance", "ground_moves"]


@record
class GroundMoves:
    """Ground points of N lines of sight, by their errors: along the track, and across it to the right."""

    by_rotation: Floats = array("N, 2, 3", "by a rotation about the axes of c, m/rad")
    by_position: Floats = array("N, 2, 3", "by the satellite's position, axes of ITRS")
    by_clock: Floats = array("N, 2", "by the instants of the rows, m/s")
    by_height: Floats = array("N, 2", "by the height of the ground")
    by_earth: Floats = array("N, 2, 3", "by 1-sigma rotations of the Earth's prediction, axes of ITRS")


def ground_moves(orbit: Orbit, R_ci: Rotation, t_s: Floats, p_e: Floats) -> GroundMoves:
    """The moves of ground points (N, 3), ITRS, seen at instants (N,) with attitudes (N,), GCRS to frame c."""
    motion_e = orbit.velocities_e(t_s)
    lat, lon, _ = geodetic_from_ecef(p_e)
    up = unit_vectors(lon, lat)
    along = motion_e - up * np.einsum("na,na->n", motion_e, up)[:, None]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    to_track = np.stack([along, np.cross(along, up)], axis=1)  # (N, 2, 3)
    sight = p_e - orbit.positions_e(t_s)
    distance = np.linalg.norm(sight, axis=1)
    u = sight / distance[:, None]
    fall = u / np.einsum("na,na->n", u, up)[:, None]
    by_position = to_track @ (np.eye(3) - fall[:, :, None] * up[:, None, :])
    lever = sight if orbit.frame == "ITRF" else p_e
    R_ec = np.swapaxes(orbit.earth.matrices_ie(t_s), 1, 2) @ np.swapaxes(R_ci.as_matrix(), 1, 2)
    return GroundMoves(
        distance[:, None, None] * by_position @ -cross_matrices(u) @ R_ec,
        by_position,
        np.einsum("nia,na->ni", by_position, motion_e),
        np.einsum("nia,na->ni", to_track, fall - up),
        by_position @ cross_matrices(lever) * orbit.earth.sigma_e_rad,
    )


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
