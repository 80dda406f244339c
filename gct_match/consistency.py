"""Consistency of a strip's matches: they share one rotation and, between star exposures, the attitude error.

Each match is compared with what the others predict; the worst is refused first, until all agree. Of more than
`_MOST_TOGETHER`, those that follow one another in time are compared: time and memory grow with the number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from boresight.gct_match.predict.scene import Scene
from boresight.gct_match.predict.trajectories import displacements
from boresight.gct_match.records import TargetMatch
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.installation import deviation_from_theta, theta_from_deviation
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Floats

__all__ = ["consistent_matches"]

_MOST_TOGETHER = 400  # matches: 10 MB, and a rotation to a twentieth of one match's error
_GATE = 4.0  # standard errors by which a match may differ from the prediction of the others


def consistent_matches(
    scene: Scene, found: Sequence[TargetMatch], theta: Floats
) -> tuple[list[TargetMatch], list[Entry], Floats]:
    """Matches that agree with one another, refusals of the others, and their common rotation.

    The last is theta (3,), rad, axes of c, against the scene's initial installation matrix; `theta` is the
    rotation with which the matches were predicted. Two matches that contradict one another are both kept.
    """
    sigma_rad = scene.sigma_installation_rad
    if not found:
        return [], [], theta
    positions = {target.target_id: target.p_e for target in scene.targets}
    p_e = np.array([positions[match.target_id] for match in found])
    xy = np.array([match.xy_px for match in found])
    model = scene.pushbroom.with_installation(deviation_from_theta(theta) * scene.pushbroom.R_cs)
    ccd = np.array([match.ccd for match in found])
    d, design = displacements(model, p_e, ccd, xy)
    t_s = scene.pushbroom.instants_of_lines(ccd, xy[:, 1])
    cov_px = np.array([match.cov_px for match in found])
    parts = -(-len(found) // _MOST_TOGETHER)
    groups = np.array_split(np.argsort(t_s, kind="stable"), parts) if parts > 1 else [np.arange(len(found))]
    keep, refused = [], []
    information: Floats = np.diag(sigma_rad**-2.0)
    pull: Floats = np.zeros(3)
    attitude = _attitude_covariance(scene, design, t_s)
    for group in groups:
        scatter = _scatter(scene.settings, cov_px[group], t_s[group], attitude[group])
        left, off, distance = _agreeing(d[group], design[group], scatter, sigma_rad)
        keep += group[left].tolist()
        refused += [_inconsistent(found[group[n]], off[n], float(distance[n])) for n in off]
        of_group, towards = _information(d[group][left], design[group][left], scatter[np.ix_(left, left)])
        information, pull = information + of_group, pull + towards
    p = np.asarray(np.linalg.solve(information, pull), dtype=float)
    total = deviation_from_theta(p) * deviation_from_theta(theta)
    matches = [replace(found[k], residual_px=d[k] - design[k] @ p) for k in sorted(keep)]
    return matches, refused, theta_from_deviation(total)


def _agreeing(
    d: Floats, design: Floats, scatter: Floats, sigma_rad: Floats
) -> tuple[list[int], dict[int, Floats], dict[int, float]]:
    """Which of N displacements (N, 2) agree, and of the others, worst first, the difference (2,) px from what
    those left predict, and its size in standard errors.
    """
    keep, off_px, distances = list(range(len(d))), dict[int, Floats](), dict[int, float]()
    while True:
        off, distance = _from_the_others(d[keep], design[keep], scatter[np.ix_(keep, keep)], sigma_rad)
        worst = int(np.argmax(distance))
        if distance[worst] <= _GATE or len(keep) <= 2:
            return keep, off_px, distances
        off_px[keep[worst]], distances[keep[worst]] = off[worst], float(distance[worst])
        keep.pop(worst)


def _inconsistent(match: TargetMatch, off_px: Floats, distance: float) -> Entry:
    (x, y), ((xx, xy), (_, yy)) = match.xy_px.tolist(), match.cov_px.tolist()
    return Entry(
        Subject(Kind.TARGET, ccd=match.ccd, id=match.target_id),
        Reason.INCONSISTENT,
        value=distance,
        limit=_GATE,
        more=(float(off_px[0]), float(off_px[1])),
        xy_px=(x, y),
        cov_px=(xx, xy, yy),
    )


def _attitude_covariance(scene: Scene, design: Floats, t_s: Floats) -> Floats:
    """Covariance (N, 2, 2), px², of displacements by errors of smoothed attitudes at instants (N,), zero
    without them; `design` (N, 2, 3) is the change by a rotation about the axes of c.
    """
    track, by_rotation = scene.pushbroom.attitude, design @ scene.pushbroom.R_cs.as_matrix()
    if not (isinstance(track, AttitudeTrack) and track.is_smoothed):
        return np.zeros((len(t_s), 2, 2))
    return np.asarray(by_rotation @ track.covariance_s(t_s) @ np.swapaxes(by_rotation, 1, 2))


def _scatter(settings: MatchSettings, cov_px: Floats, t_s: Floats, attitude: Floats | None = None) -> Floats:
    """(N, N, 2, 2) covariance of displacements about the common rotation: that of each match, (N, 2, 2), and
    the attitude error, common to matches seen, at instants (N,), between the same star exposures; beside the
    usual one that of `attitude` (N, 2, 2).
    """
    correlated = np.maximum(1.0 - np.abs(t_s[:, None] - t_s) / settings.attitude_step_s, 0.0)
    out = np.asarray(settings.attitude_sigma_px**2 * correlated[:, :, None, None] * np.eye(2))
    if attitude is not None and attitude.any():
        values, vectors = np.linalg.eigh(attitude)
        root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        out += correlated[:, :, None, None] * (root[:, None] @ root)
    every = np.arange(len(t_s))
    out[every, every] += cov_px + settings.consistency_sigma_px**2 * np.eye(2)
    return out


def _from_the_others(d: Floats, design: Floats, scatter: Floats, sigma_rad: Floats) -> tuple[Floats, Floats]:
    """Difference of each displacement (N, 2) from what the others predict: (N, 2) px and (N,) in sigmas.

    With S the covariance of all displacements, the rotation's own included, and Q its inverse, the others
    leave of displacement n  e_n = Q_nn^-1 (Q d)_n,  with covariance Q_nn^-1.
    """
    n = len(d)
    prior = np.einsum("nap,p,mbp->nmab", design, sigma_rad**2, design)
    Q = np.linalg.inv(_flat(scatter + prior)).reshape(n, 2, n, 2)
    pull = np.einsum("namb,mb->na", Q, d)
    own = np.einsum("nanb->nab", Q)
    off = np.linalg.solve(own, pull[:, :, None])[:, :, 0]
    return off, np.sqrt(np.einsum("na,na->n", off, pull))


def _information(d: Floats, design: Floats, scatter: Floats) -> tuple[Floats, Floats]:
    """Normal matrix (3, 3) and right side (3,) of the rotation that displacements (N, 2) have in common."""
    D = design.reshape(-1, 3)
    weighted = np.linalg.solve(_flat(scatter), D)
    return D.T @ weighted, weighted.T @ d.ravel()


def _flat(blocks: Floats) -> Floats:
    """(N, N, 2, 2) as one matrix (2 N, 2 N)."""
    n = len(blocks)
    return blocks.transpose(0, 2, 1, 3).reshape(2 * n, 2 * n)
