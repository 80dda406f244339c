"""Targets chosen among candidates for the smallest covariance of the installation matrix, before any match.

Each candidate adds rows to the normal equations of the strips that see it, with all that targets of a strip
share (attitudes, position, clock, distortion) as unknowns. Targets are taken one after another, each time the
one that makes the trace of the covariance of theta smallest (A-optimal, greedy).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.joint_solution import Problem
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import linearise, prepare_strip
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Floats, array, record, scalar

__all__ = ["TargetChoice", "choose_targets"]


@record
class TargetChoice:
    """Targets in the order in which they were taken, and what they forecast."""

    target_id: tuple[str, ...] = array("N", "ids")
    sigma_rad: Floats = array("N, 3", "1-sigma about the axes of c with the targets so far")


@record
class _Rows:
    """Whitened rows of one strip: derivatives by theta, distortion and the strip's own unknowns."""

    X: Floats = array("R, M", "two rows a candidate; theta first")
    candidate: tuple[str, ...] = scalar("id of each pair of rows")


def choose_targets(
    strips: Sequence[StripSightings],
    probability: Sequence[Floats],
    R_cs: Rotation,
    sigma_installation_rad: Floats,
    settings: CalibrationSettings,
    most: int,
) -> TargetChoice:
    """At most `most` of the candidates that strips may show.

    Each of `strips` has all candidates that it may show, with the expected covariance of a match as `cov_c`,
    and a `probability` (J,) that they are in view and matched, which weights their information. The 1-sigma
    error (3,) of `R_cs`, rad, is the information before any target; the distortion is each strip's own.
    """
    rows = [_rows(one, p, R_cs, settings) for one, p in zip(strips, probability)]
    left = sorted({name for one in rows for name in one.candidate})
    normal = [np.diag([0.0] * 3 + [1.0] * (one.X.shape[1] - 3)) for one in rows]
    own = [_theta_information(N) for N in normal]
    prior = np.diag(np.asarray(sigma_installation_rad) ** -2.0)
    chosen: list[str] = []
    sigmas: list[Floats] = []
    while left and len(chosen) < most:
        trials = {name: _with(name, rows, normal, own) for name in left}
        trace = {name: float(np.trace(np.linalg.inv(prior + sum(of)))) for name, (_, of) in trials.items()}
        best = min(left, key=trace.__getitem__)
        normal, own = trials[best]
        left.remove(best)
        chosen.append(best)
        sigmas.append(np.sqrt(np.diag(np.linalg.inv(prior + sum(own)))))
    return TargetChoice(tuple(chosen), np.array(sigmas).reshape(-1, 3))


def _rows(strip: StripSightings, probability: Floats, R_cs: Rotation, settings: CalibrationSettings) -> _Rows:
    problem = Problem.of([prepare_strip(strip, settings)], settings)
    if not problem.groups:
        return _Rows(np.zeros((0, 3)), ())
    linear = linearise(problem.groups[0], R_cs, settings)
    n = sum(name.startswith("distortion/") for name in problem.shared.names)
    common = linear.along(np.eye(linear.n_common, 3 + n))[0]
    root = np.linalg.cholesky(np.linalg.inv(problem.prior_shared[:n, :n]))  # of the distortion's covariance
    weight = np.repeat(np.sqrt(probability), 2)[:, None]
    X = weight * np.concatenate([common[:, :3], common[:, 3:] @ root, linear.X_q[0]], axis=1)
    return _Rows(X, tuple(strip.ground.target_id.tolist()))


def _with(
    name: str, rows: list[_Rows], normal: list[Floats], own: list[Floats]
) -> tuple[list[Floats], list[Floats]]:
    """Normal matrices of all strips with one candidate more, and their information on theta."""
    more, information = list(normal), list(own)
    for k, one in enumerate(rows):
        for j in [j for j, other in enumerate(one.candidate) if other == name]:
            added = one.X[2 * j : 2 * j + 2]
            more[k] = more[k] + added.T @ added
            information[k] = _theta_information(more[k])
    return more, information


def _theta_information(N: Floats) -> Floats:
    """Information (3, 3) on theta of normal equations (M, M), the other unknowns eliminated."""
    return np.asarray(N[:3, :3] - N[:3, 3:] @ np.linalg.solve(N[3:, 3:], N[3:, :3]))
