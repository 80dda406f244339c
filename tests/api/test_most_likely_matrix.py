"""`calibrate_vectors` against the most likely matrix by another solver: all unknowns in one system, with no
elimination, rejection or code of the package.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from seen_by_astropy import directions_by_astropy, frame_of, ground_of, places_below, states_of
from wrong_vectors import R_TRUE, SIGMA_C, SIGMA_S, Given, drawn_vectors

import boresight as bs

SETS = 16  # of each kind
# Between the two solvers, of each axis: the package is linear about the attitudes by the stars alone, whose
# errors squared, 4e-10 rad, are 3e-4 sigma.
MOST_SIGMAS = 5e-4
REFRACTION_SIGMAS = 0.2  # that the directions by astropy leave out
PRIOR_RAD = 2e-6  # 1-sigma of R_cs0, near what the vectors give
PLACE_M = 5.0  # 1-sigma of a place: 1e-5 rad from 500 km
STATES = states_of(bs.example("mini"))


class Case(NamedTuple):
    """Arguments of `calibrate_vectors`, and what a solver needs of them."""

    given: Given
    more: dict[str, Any]
    free: list[int]  # axes of c that are estimated
    v_targets: list[np.ndarray]  # directions, GCRS
    cov_targets: list[np.ndarray] | None = None  # of them, rad², GCRS


def start_of(theta: np.ndarray) -> Rotation:
    """A matrix that theta takes to the true one."""
    return Rotation.from_rotvec(theta) * R_TRUE


def plain(rng: np.random.Generator) -> Case:
    given = drawn_vectors(rng, frames=int(rng.choice([1, 4])))
    return Case(given, {}, [0, 1, 2], given.v_targets)


def with_prior(rng: np.random.Generator) -> Case:
    case = plain(rng)
    R_cs0 = start_of(rng.normal(0.0, PRIOR_RAD, 3))
    return case._replace(given=case.given._replace(R_cs0=R_cs0), more={"sigma_R_cs0_rad": PRIOR_RAD})


def with_fixed_axes(rng: np.random.Generator) -> Case:
    case = plain(rng)
    free = sorted(rng.choice(3, int(rng.integers(1, 3)), replace=False).tolist())
    theta, sigma = np.zeros(3), np.zeros(3)
    theta[free], sigma[free] = rng.normal(0.0, 1e-5, len(free)), np.inf
    given = case.given._replace(R_cs0=start_of(theta))
    return case._replace(given=given, more={"sigma_R_cs0_rad": sigma}, free=free)


def with_places(rng: np.random.Generator) -> Case:
    """Frames along the orbit, each with places of its own, that are off by their stated errors."""
    parts, tables, covariances = [], [], []
    for n in rng.choice(np.arange(10, len(STATES) - 10), int(rng.choice([1, 4])), replace=False).tolist():
        table = places_below(STATES, n, seed=int(rng.integers(2**31)))
        # equal along all axes: of ITRF as of east, north, up
        moved = rng.normal(0.0, PLACE_M, (len(table), 3))
        parts.append(frame_of(directions_by_astropy(STATES, table, moved), rng))
        p_e = STATES.loc[n, ["x_m", "y_m", "z_m"]].to_numpy(float)
        range_m = np.linalg.norm(ground_of(table) - p_e, axis=1)
        covariances.append((PLACE_M / range_m)[:, None, None] ** 2 * np.eye(3))
        tables.append(table.assign(sigma_east_m=PLACE_M, sigma_north_m=PLACE_M, sigma_up_m=PLACE_M))
    u_s, v_stars, w_c = (list(part) for part in zip(*parts))
    given = Given(u_s, v_stars, SIGMA_S, w_c, tables, SIGMA_C, start_of(rng.normal(0.0, 2e-3, 3)))
    directions = [directions_by_astropy(STATES, table) for table in tables]
    return Case(given, {"orbit": STATES}, [0, 1, 2], directions, covariances)


def cross(v: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) of v x."""
    return np.cross(v[:, None, :], np.eye(3)[None], axisa=2, axisb=2).swapaxes(1, 2)


def most_likely(case: Case, stars: np.ndarray, targets: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Matrix and covariance (3, 3) of theta by Newton's steps on theta and the attitudes of all frames at
    once; `stars` and `targets`: which of all vectors take part.
    """
    given, K = case.given, len(case.given.u_s)
    R_cs = given.R_cs0
    R_si = [Rotation.align_vectors(u, v)[0] for u, v in zip(given.u_s, given.v_stars)]
    for _ in range(5):
        rows, right = [], []
        s = c = 0
        for k, (u, v, w, t) in enumerate(zip(given.u_s, given.v_stars, given.w_c, case.v_targets)):
            a, b = R_si[k].apply(v), (R_cs * R_si[k]).apply(t)
            block = np.zeros((len(a), 3, 3 + 3 * K))
            block[:, :, 3 + 3 * k : 6 + 3 * k] = -cross(a)  # a rotated by phi: a + phi x a
            keep = stars[s : s + len(a)]
            rows.append((block / SIGMA_S)[keep].reshape(-1, 3 + 3 * K))
            right.append(((u - a) / SIGMA_S)[keep].ravel())
            block = np.zeros((len(b), 3, 3 + 3 * K))
            block[:, :, :3] = cross(b)  # R_cs rotated by -theta: b - theta x b
            block[:, :, 3 + 3 * k : 6 + 3 * k] = -cross(b) @ R_cs.as_matrix()
            cov = np.broadcast_to(SIGMA_C**2 * np.eye(3), (len(b), 3, 3))
            if case.cov_targets is not None:
                R = (R_cs * R_si[k]).as_matrix()
                cov = cov + R @ case.cov_targets[k] @ R.T
            whiten = np.linalg.inv(np.linalg.cholesky(cov))
            keep = targets[c : c + len(b)]
            rows.append((whiten @ block)[keep].reshape(-1, 3 + 3 * K))
            right.append((whiten @ (w - b)[:, :, None])[keep].ravel())
            s, c = s + len(a), c + len(b)
        sigma = np.broadcast_to(case.more.get("sigma_R_cs0_rad", np.inf), 3)
        known = np.zeros((3, 3 + 3 * K))
        known[:, :3] = np.diag(1.0 / np.maximum(sigma, 1e-9))
        rows.append(known)
        right.append(known[:, :3] @ (R_cs * given.R_cs0.inv()).as_rotvec())
        A, r = np.vstack(rows), np.concatenate(right)
        step, covariance = np.linalg.lstsq(A, r, rcond=None)[0], np.linalg.pinv(A.T @ A, rcond=1e-20)
        R_cs = Rotation.from_rotvec(-step[:3]) * R_cs
        R_si = [Rotation.from_rotvec(step[3 + 3 * k : 6 + 3 * k]) * R_si[k] for k in range(K)]
    return R_cs, covariance[:3, :3]


class Tried(NamedTuple):
    apart: float  # sigmas between the two matrices, of the worst axis
    of_sigma: float  # largest relative difference of the stated sigmas
    nees: float
    dof: int


def tried(case: Case) -> Tried:
    found = bs.calibrate_vectors(*case.given, **case.more)
    stars, targets = found.residuals("stars"), found.residuals()
    kept = stars.sort_values(["frame", "star"])["kept"].to_numpy(), targets["kept"].to_numpy()
    R_cs, covariance = most_likely(case, *kept)
    free, sigma = case.free, np.sqrt(np.diag(covariance))
    apart = np.abs((found.R_cs * R_cs.inv()).as_rotvec() / sigma)[free].max()
    stated = np.sqrt(np.diag(found.cov_theta))
    error = (found.R_cs * R_TRUE.inv()).as_rotvec()[free]
    nees = error @ np.linalg.solve(found.cov_theta[np.ix_(free, free)], error)
    return Tried(float(apart), float(np.abs(stated / sigma - 1.0)[free].max()), float(nees), len(free))


KINDS: dict[str, Callable[[np.random.Generator], Case]] = {
    "plain": plain,
    "prior": with_prior,
    "fixed axes": with_fixed_axes,
    "places": with_places,
}


def scaled_nees(all_tried: list[Tried]) -> tuple[float, float]:
    """Mean NEES for each three degrees of freedom, and three of its standard errors."""
    dof = sum(one.dof for one in all_tried)
    return 3.0 * sum(one.nees for one in all_tried) / dof, 9.0 * np.sqrt(2.0 / dof)


@pytest.mark.parametrize("kind", KINDS)
def test_the_matrix_is_the_most_likely_one(kind: str) -> None:
    rng = np.random.default_rng([61, len(kind)])
    all_tried = [tried(KINDS[kind](rng)) for _ in range(SETS)]
    limit = REFRACTION_SIGMAS if kind == "places" else MOST_SIGMAS
    assert max(one.apart for one in all_tried) < limit
    assert max(one.of_sigma for one in all_tried) < 1e-3
    mean, three_sigma = scaled_nees(all_tried)
    assert abs(mean - 3.0) < three_sigma
