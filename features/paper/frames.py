"""The information form, all frames at once: vectors of many frames to their pairs (F, F theta), no SVD of B.

A frame is the paper's: one attitude, stars and targets at one instant. With the attitude eliminated, the
information on theta is the parallel sum of what both cameras know of the attitude (docs/notes/estimation.md):

    F = F_s - F_s (F_s + F_c)⁻¹ F_s,    F_s = R_cs sum (I - u uᵀ)/σ² R_csᵀ,    F_c = sum (I - w wᵀ)/σ²

and F theta = F_s (F_s + F_c)⁻¹ b, where b is the right-hand side of the targets' residuals with the star
camera's own attitude. It equals the paper's cross-angle form where that one exists, and a frame with one
target still counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.information import InformationPairs, Solution, exact_sum, solve_total
from boresight.geometry.attitude_estimate import sums_over, wahba_matrices
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.sightings import VectorSets
from boresight.records.record import array, record, scalar

__all__ = ["FrameCalibration", "PreparedFrames", "calibrate_frames", "frame_pairs", "prepare_frames"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@record
class PreparedFrames:
    """What does not depend on the installation matrix: one pass over the vectors, then 3 x 3 matrices
    only.
    """

    F_s: Array = array("K, 3, 3", "information on that attitude, frame s")
    F_c: Array = array("K, 3, 3", "information of the targets on the attitude, frame c")
    profile: Array = array("K, 3, 3", "sum w (R_si v)ᵀ / σ²: c by s")
    is_informative: NDArray[np.bool_] = array("K", "at least two stars and one target")


@record
class FrameCalibration:
    """Installation matrix from frames: `R_cs = exp[[theta]] R_cs0`, covariance of a small rotation about the
    axes of c.
    """

    R_cs: Rotation = scalar("installation matrix")
    solution: Solution = scalar("last solution")
    theta_steps: tuple[Array, ...] = scalar("(3,) rad, one per iteration; the last is below the tolerance")
    pairs: InformationPairs = scalar("about the matrix of the last iteration")


def prepare_frames(frames: VectorSets) -> PreparedFrames:
    """Attitude of each frame from its stars (Wahba's problem, Markley's SVD) and the sums that the iteration
    needs.
    """
    weight = frames.sigma_s**-2.0
    weighted = weight[:, None] * frames.u_s
    R_is = wahba_matrices(_profile(frames.star_start, frames.v_stars, weighted))
    F_s = _information(
        sums_over(frames.star_start, weight), _profile(frames.star_start, frames.u_s, weighted)
    )
    weight = frames.sigma_c**-2.0
    weighted = weight[:, None] * frames.w_c
    F_c = _information(
        sums_over(frames.target_start, weight), _profile(frames.target_start, frames.w_c, weighted)
    )
    profile = _profile(frames.target_start, weighted, frames.v_targets) @ R_is
    is_informative = (np.diff(frames.star_start) >= 2) & (np.diff(frames.target_start) >= 1)
    return PreparedFrames(F_s, F_c, profile, is_informative)


def frame_pairs(prepared: PreparedFrames, R_cs: Rotation) -> tuple[Array, Array]:
    """F (K, 3, 3) and F theta (K, 3) of every frame about `R_cs`, frame c."""
    C = R_cs.as_matrix()
    F_s = C @ prepared.F_s @ C.T
    T = prepared.profile @ C.T  # sum w (R_cs R_si v)ᵀ / σ²
    b = np.stack([T[:, 1, 2] - T[:, 2, 1], T[:, 2, 0] - T[:, 0, 2], T[:, 0, 1] - T[:, 1, 0]], axis=1)
    both = F_s + prepared.F_c
    both[~prepared.is_informative] = np.eye(3)
    shared = np.linalg.solve(both, np.concatenate([F_s, b[:, :, None]], axis=2))
    left = F_s @ shared
    F = F_s - left[:, :, :3]
    F, F_theta = 0.5 * (F + F.transpose(0, 2, 1)), left[:, :, 3]
    F[~prepared.is_informative], F_theta[~prepared.is_informative] = 0.0, 0.0
    return F, F_theta


def calibrate_frames(frames: VectorSets, R_cs0: Rotation, *, most_iterations: int = 10) -> FrameCalibration:
    """The installation matrix from frames, iterated until the correction vanishes.

    Raises `ValueError` when it is above 1e-12 rad after `most_iterations`.
    """
    prepared = prepare_frames(frames)
    R_cs, steps = R_cs0, list[Array]()
    for _ in range(most_iterations):
        F, F_theta = frame_pairs(prepared, R_cs)
        solution = solve_total(*exact_sum(F, F_theta), sigma_observable_rad=1e-3)
        steps.append(solution.theta)
        reference, R_cs = R_cs, deviation_from_theta(solution.theta) * R_cs
        if np.linalg.norm(solution.theta) < 1e-12:
            names = np.char.mod("%07d", np.arange(len(F)))
            pairs = InformationPairs(names, F, F_theta, reference)
            return FrameCalibration(R_cs, solution, tuple(steps), pairs)
    raise ValueError(
        f"M is {np.linalg.norm(steps[-1]):.2g} rad from the identity after {most_iterations} iterations"
    )


def _profile(start: Index, a: Array, b: Array) -> Array:
    """Sum of a bᵀ over each group, (K, 3, 3)."""
    return sums_over(start, (a[:, :, None] * b[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)


def _information(weight: Array, profile: Array) -> Array:
    """sum (I - u uᵀ)/σ², from sum 1/σ² and sum u uᵀ/σ²."""
    return weight[:, None, None] * np.eye(3) - profile
