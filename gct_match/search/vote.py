"""Vote of candidate positions on one common motion, and the probability of such an agreement by chance.

Every target has several candidate positions, of which at most one is right. The displacement of a candidate
from where the model predicts its target is d = D p for the common parameters p (three small angles for a
strip, two shifts for a picture). Each candidate proposes the p that explains it; candidates of the other
targets near that proposal support it, with a weight that grows as their correlation is rarer by chance.
"""

from __future__ import annotations

from itertools import accumulate

import numpy as np
from scipy.spatial import cKDTree

from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = ["Candidates", "Vote", "fit_common", "log_chance_of_ranks", "vote"]

# Steps into which the score of a vote is divided; each target's share of it is rounded up to whole steps,
# so that the probability of a sum is exact (set by hand: more steps cost time, fewer a looser bound).
_STEPS = 480
_NOTHING: Floats = np.eye(1, _STEPS + 1)[0]  # probabilities of a share that is none
_LEAST = 1e-300  # probability: smaller ones are stated as this one
_REFINEMENTS = 4  # steps of fitting the common rotation to its supporters, at most (set by hand)
# Most values of the rotation about the line of sight that are tried with each pair of candidates (set by
# hand; bounds the time).
_MOST_THIRD_VALUES = 61


@record
class Candidates:
    """Candidate positions of targets. Row n of every array refers to the same candidate."""

    owner: Ints = array("C", "index of the target")
    displacement_px: Floats = array("C, 2", "displacement from the predicted position, px")
    design: Floats = array("C, 2, P", "its derivative by the common parameters")
    log_chance: Floats = array(
        "C", "log probability of such a rank or a better one within the tolerance by chance"
    )


@record
class Vote:
    """The common parameters on which the candidates agree."""

    parameters: Floats = array("P", "common parameters; rad for a strip")
    covariance: Floats = array("P, P", "their covariance")
    supporters: Ints = array("S", "rows of the supporting candidates, one for each target that agrees")
    log_probability_chance: float = scalar("log of a bound of the probability of this agreement by chance")


def vote(
    candidates: Candidates, prior_sigma: Floats, reach: float, tolerance_px: float, sigma_px: float
) -> Vote:
    """The best supported parameters within `reach` standard errors `prior_sigma` (P,) of zero.

    `tolerance_px` is the largest distance of a supporting candidate from the common motion, `sigma_px` the
    standard error of a candidate. Without candidates the parameters are zero and chance is certain.
    """
    if len(candidates.owner) == 0:
        return Vote(np.zeros(len(prior_sigma)), np.diag(prior_sigma**2), np.zeros(0, dtype=np.int64), 0.0)
    n_targets = int(candidates.owner.max()) + 1
    third_values = _third_values(candidates, prior_sigma, reach, tolerance_px)
    proposal, per_third = _proposals(candidates)
    px_per_unit = np.abs(candidates.design[:, :, :2]).sum(axis=2).mean()
    best, start = 0.0, np.zeros(len(prior_sigma))
    for third in third_values:
        q = proposal - per_third * third
        inside = (np.abs(q) <= reach * prior_sigma[:2] * 1.05).all(axis=1)
        if not inside.any():
            continue
        owner, log_chance = candidates.owner[inside], candidates.log_chance[inside]
        score = _support(q[inside] * px_per_unit, owner, log_chance, n_targets, tolerance_px)
        n = int(np.argmin(score))
        if score[n] < best:
            best = float(score[n])
            start = np.concatenate([q[inside][n], [third]])[: len(prior_sigma)]
    # every value of the third parameter is one more opportunity for chance
    log_bound = min(log_chance_of_score(candidates, -best) + float(np.log(len(third_values))), 0.0)
    p, covariance, supporters = _refined(candidates, start, prior_sigma, tolerance_px, sigma_px)
    return Vote(p, covariance, supporters, log_bound)


def log_chance_of_ranks(count: int, share: float) -> Floats:
    """(count,) log of the probability that one of a target's k + 1 best positions lies in a given area by
    chance, k = 0..count - 1: (k + 1) share, where `share` is that area's part of the searched area.

    Ranks are valid for chips of repeated patterns, too: the picture itself shows how often it resembles the
    chip, whereas a high correlation may be frequent.
    """
    return np.minimum(np.log(np.arange(1.0, count + 1.0)) + np.log(share), 0.0)


def log_chance_of_score(candidates: Candidates, score: float) -> float:
    """Log of a bound of the probability that somewhere the targets' log chances add up to -score by chance.

    If the positions of target t are random, its share X_t of the score is -log p, where p is the chance of
    its best position within the tolerance, or 0. Some candidate of some target must be part of the
    agreement (Boole's inequality over the candidates):

        P  <=  sum_t sum_k P(sum_(other targets u) X_u  >=  score + log p_tk)

    The distributions of the sums are exact for shares rounded up to 1/480 of the score.
    """
    if not score > 0.0:
        return 0.0
    of_targets = [np.sort(candidates.log_chance[candidates.owner == n]) for n in np.unique(candidates.owner)]
    steps = [_steps_of(log_p, score) for log_p in of_targets]
    shares = [_shares(log_p, at) for log_p, at in zip(of_targets, steps)]
    before = accumulate(shares[:-1], _sum_of, initial=_NOTHING)
    after, bound = _NOTHING, 0.0
    for at, share, others in zip(steps[::-1], shares[::-1], [*before][::-1]):
        reaches = np.cumsum(_sum_of(others, after)[::-1])  # by any n, counted from the score down
        bound += float(reaches[at].sum())
        after = _sum_of(share, after)
    return float(np.log(max(bound, _LEAST)))


def _steps_of(log_p: Floats, score: float) -> Ints:
    """Shares -log p of a score in steps of 1/480 of it, rounded up, the whole score at most."""
    return np.ceil(np.minimum(-log_p / score, 1.0) * _STEPS).astype(np.int64)


def _shares(log_p: Floats, steps: Ints) -> Floats:
    """(481,) probabilities of a target's share of the score, by steps; the last: of that and more."""
    p = np.exp(log_p)
    out: Floats = np.bincount(steps, np.diff(p, prepend=0.0), minlength=_STEPS + 1).astype(float)
    out[0] += 1.0 - p[-1]
    return out


def _sum_of(one: Floats, other: Floats) -> Floats:
    """Probabilities of the sum of two independent shares, as `_shares`."""
    out: Floats = np.convolve(one, other).astype(float, copy=False)
    out[_STEPS] = out[_STEPS:].sum()
    return out[: _STEPS + 1]


def fit_common(
    displacement_px: Floats, design: Floats, cov_px: Floats, prior_sigma: Floats
) -> tuple[Floats, Floats]:
    """Least-squares parameters (P,) and covariance (P, P) from displacements (N, 2), their design matrices
    (N, 2, P) and covariances (N, 2, 2), with a Gaussian prior of `prior_sigma` (P,) about zero.
    """
    weight = np.linalg.inv(cov_px)
    normal = np.einsum("nai,nab,nbj->ij", design, weight, design) + np.diag(prior_sigma**-2.0)
    right = np.einsum("nai,nab,nb->i", design, weight, displacement_px)
    covariance = np.linalg.inv(normal)
    return covariance @ right, covariance


def _third_values(candidates: Candidates, prior_sigma: Floats, reach: float, tolerance_px: float) -> Floats:
    """Values of the third parameter at steps of the tolerance; a single zero if there are two parameters."""
    if len(prior_sigma) < 3:
        return np.zeros(1)
    design = candidates.design[:, :, 2]
    lever = float(np.abs(design - design.mean(axis=0)).max()) + 1e-9
    half = reach * prior_sigma[2]
    count = min(2 * int(np.ceil(half * lever / tolerance_px)) + 1, _MOST_THIRD_VALUES)
    return np.array([half * k / max(count // 2, 1) for k in range(-(count // 2), count // 2 + 1)])


def _proposals(candidates: Candidates) -> tuple[Floats, Floats]:
    """(C, 2) first two parameters that explain each candidate if the third is zero, and (C, 2) their decrease
    per unit of the third.
    """
    inverse = np.linalg.inv(candidates.design[:, :, :2])
    proposal = np.einsum("cij,cj->ci", inverse, candidates.displacement_px)
    return proposal, np.einsum("cij,cjk->cik", inverse, candidates.design[:, :, 2:]).sum(axis=2)


def _support(q_px: Floats, owner: Ints, log_chance: Floats, n_targets: int, tolerance_px: float) -> Floats:
    """(C,) sum over targets of the lowest log chance among their candidates near each proposal."""
    pairs = cKDTree(q_px).query_pairs(tolerance_px, output_type="ndarray")
    lowest = np.zeros((len(owner), n_targets))
    every = np.arange(len(owner))
    first = np.concatenate([every, pairs[:, 0], pairs[:, 1]])
    second = np.concatenate([every, pairs[:, 1], pairs[:, 0]])
    np.minimum.at(lowest, (first, owner[second]), log_chance[second])
    return lowest.sum(axis=1)


def _refined(
    candidates: Candidates, start: Floats, prior_sigma: Floats, tolerance_px: float, sigma_px: float
) -> tuple[Floats, Floats, Ints]:
    """Least-squares parameters from the candidates near the common motion, their covariance, and the rows of
    these candidates: of each target the one with the lowest log chance.
    """
    p, covariance = start, np.diag(prior_sigma**2)
    chosen = np.zeros(0, dtype=np.int64)
    for _ in range(_REFINEMENTS):
        off = candidates.displacement_px - candidates.design @ p
        distance = np.hypot(off[:, 0], off[:, 1])
        near = np.nonzero(distance <= tolerance_px)[0]
        near = near[np.lexsort((distance[near], candidates.log_chance[near]))]
        _, first = np.unique(candidates.owner[near], return_index=True)
        chosen = near[first]
        if len(chosen) == 0:
            break
        cov_px = np.broadcast_to(np.eye(2) * sigma_px**2, (len(chosen), 2, 2))
        p, covariance = fit_common(
            candidates.displacement_px[chosen], candidates.design[chosen], cov_px, prior_sigma
        )
    return p, covariance, chosen
