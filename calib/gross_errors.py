"""The matrix that most targets share, whatever the rest say: where to start when some matches are wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.attitudes import cross_matrices
from boresight.calib.estimate import Iteration
from boresight.calib.joint_solution import Problem, iteration_record, linear_solution, residuals_about
from boresight.geometry.installation import deviation_from_theta

__all__ = ["down_to_the_noise", "most_shared_matrix"]

Array = NDArray[np.float64]


def most_shared_matrix(problem: Problem, R_cs: Rotation) -> Rotation:
    """The matrix with the least sum of absolute residuals: what most targets share, whatever the others
    say.
    """
    u_c = np.concatenate([group.u_c[group.inside] for group in problem.groups])
    v_s = np.concatenate([group.v_s[group.inside] for group in problem.groups])
    for _ in range(50):
        w = R_cs.apply(v_s)
        difference = u_c - w
        weight = 1.0 / np.maximum(
            np.linalg.norm(difference, axis=1), 1e-6
        )  # 0.2 arcsec: below this all is equal
        turn = cross_matrices(w)
        N = np.einsum("n,nia,nib->ab", weight, turn, turn)
        right = np.einsum("n,nia,ni->a", weight, turn, difference)
        values, vectors = np.linalg.eigh(N)
        known = values > 1e-10 * values[-1]
        theta = (vectors[:, known] / values[known]) @ (vectors[:, known].T @ right)
        R_cs = deviation_from_theta(theta) * R_cs
        if np.linalg.norm(theta) < 1e-9:
            break
    return R_cs


def down_to_the_noise(
    problem: Problem, R_cs: Rotation, iterations: list[Iteration], scale_c: float
) -> tuple[Rotation, Array]:
    """Geman and McClure's weights with a limit that halves until it is three sigma."""
    weight = problem.inside.astype(float)
    limit = np.inf
    for _ in range(40):
        step = linear_solution(problem, R_cs, weight, scale_c)
        if np.isinf(limit):  # nothing may move yet: residuals about the starting matrix
            distance = np.linalg.norm(residuals_about(problem, R_cs, scale_c), axis=1)
            limit = max(3.0, 3.0 * float(np.median(distance[problem.inside])))
        else:
            iterations.append(iteration_record(step, weight))
            R_cs = deviation_from_theta(step.solution.theta) * R_cs
            distance = np.linalg.norm(step.whitened, axis=1)
            limit = max(3.0, 0.5 * limit)
        before = weight
        weight = problem.inside * (1.0 + (distance / limit) ** 2) ** -2.0
        if limit == 3.0 and np.max(np.abs(weight - before)) < 1e-2:
            break
    return R_cs, weight
