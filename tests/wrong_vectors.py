"""Sets of star and target vectors with wrong ones among them (also of `benchmarks/vectors_wrong_stars.py`).

A wrong vector is a wrong identification or a wrong match: its known direction is that of another, or it is
displaced, by twelve standard errors or by degrees.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

R_TRUE = Rotation.from_euler("xyz", [150.0, 12.0, -55.0], degrees=True)  # bold and lopsided
SIGMA_S, SIGMA_C = 8e-6, 1.5e-6  # rad: 1.7 and 0.3 arcsec, the two cameras of a mission of metres
N = 20
LEAST_SIGMAS = 12.0


class Given(NamedTuple):
    """Arguments of `calibrate_vectors`, one table a frame."""

    u_s: list[np.ndarray]
    v_stars: list[np.ndarray]
    sigma_s: float
    w_c: list[np.ndarray]
    v_targets: list[np.ndarray]
    sigma_c: float
    R_cs0: Rotation


def drawn_vectors(
    rng: np.random.Generator, *, frames: int = 1, stars: int = 0, targets: int = 0, all_random: bool = False
) -> Given:
    """20 stars and 20 targets in each frame, so many of them wrong in the first frame, or all of them."""
    parts: list[tuple[np.ndarray, ...]] = []
    for k, R_si in enumerate(Rotation.random(frames, random_state=rng)):
        u, w = _field(rng, 0.15), _field(rng, 0.03)
        v_stars, v_targets = R_si.inv().apply(u), (R_TRUE * R_si).inv().apply(w)
        if all_random:
            v_stars, v_targets = unit_vectors(rng.normal(size=(2, N, 3)))
        elif k == 0:
            v_stars = _with_wrong(rng, v_stars, stars, SIGMA_S)
            v_targets = _with_wrong(rng, v_targets, targets, SIGMA_C)
        parts.append((_measured(rng, u, SIGMA_S), v_stars, _measured(rng, w, SIGMA_C), v_targets))
    u_s, v_s, w_c, v_t = (list(part) for part in zip(*parts))
    R_cs0 = Rotation.from_rotvec(rng.normal(0.0, 2e-3, 3)) * R_TRUE
    return Given(u_s, v_s, SIGMA_S, w_c, v_t, SIGMA_C, R_cs0)


def nees_of(R_cs: Rotation, cov_theta: np.ndarray) -> float:
    """Squared error of the matrix over its stated covariance."""
    error = -(R_cs * R_TRUE.inv()).as_rotvec()
    return float(error @ np.linalg.solve(cov_theta, error))


def unit_vectors(v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at length 1."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _field(rng: np.random.Generator, half_width: float) -> np.ndarray:
    return unit_vectors(np.column_stack([rng.uniform(-half_width, half_width, (N, 2)), np.ones(N)]))


def _measured(rng: np.random.Generator, u: np.ndarray, sigma: float) -> np.ndarray:
    return unit_vectors(u + rng.normal(0.0, sigma, u.shape))


def _with_wrong(rng: np.random.Generator, v: np.ndarray, n: int, sigma: float) -> np.ndarray:
    v = v.copy()
    for row in rng.choice(N, n, replace=False).tolist():
        if rng.random() < 0.3:
            v[row] = v[rng.choice([other for other in range(N) if other != row])]
            continue
        size = np.exp(rng.uniform(np.log(LEAST_SIGMAS * sigma), np.log(0.1)))
        across = np.cross(v[row], rng.normal(size=3))
        v[row] = Rotation.from_rotvec(size * unit_vectors(across)).apply(v[row])
    return v
