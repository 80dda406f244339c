"""The one small motion on which candidate places of many targets agree, and how likely chance would agree
so well.

Every target offers several candidate places, of which at most one is right. A candidate's displacement
from where the model put it is d = D p for the common parameters p (three small angles for a strip, two
shifts for a picture). Each candidate proposes the p that explains it; the other targets' candidates nearby
support it, the more the less likely chance would give such a correlation there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import logsumexp

__all__ = ["Candidates", "Vote", "fit_common", "log_chance_of_ranks", "vote"]

Array = NDArray[np.float64]

_ORDERS = np.linspace(
    0.05, 0.95, 19
)  # of the moments that bound a chance; between them the bound hardly changes


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Places where targets may lie. Row n of every array speaks of the same candidate."""

    owner: NDArray[np.int64]  # (C,) which target, 0..T-1
    displacement_px: Array  # (C, 2) from where the model put the target
    design: Array  # (C, 2, P) its derivative by the common parameters
    log_chance: Array  # (C,) of such a correlation, or a higher one, within the tolerance, by chance


@dataclass(frozen=True, slots=True, eq=False)
class Vote:
    """What the candidates agree on."""

    parameters: Array  # (P,)
    covariance: Array  # (P, P)
    supporters: NDArray[np.int64]  # one candidate of each target that agrees
    log_probability_chance: float


def vote(
    candidates: Candidates, prior_sigma: Array, reach: float, tolerance_px: float, sigma_px: float
) -> Vote:
    """The best supported parameters within `reach` standard errors of zero.

    `tolerance_px` is how far a supporting candidate may lie from the common motion, `sigma_px` its
    standard error.
    """
    if len(candidates.owner) == 0:
        return Vote(np.zeros(len(prior_sigma)), np.diag(prior_sigma**2), np.zeros(0, dtype=np.int64), 0.0)
    n_targets = int(candidates.owner.max()) + 1
    third = _third_parameters(candidates, prior_sigma, reach, tolerance_px)
    best, start = 0.0, np.zeros(len(prior_sigma))
    scale = np.abs(candidates.design[:, :, :2]).sum(axis=2).mean()
    q_of = _proposals(candidates)
    for value in third:
        q = q_of(value)
        inside = (np.abs(q) <= reach * prior_sigma[:2] * 1.05).all(axis=1)
        if not inside.any():
            continue
        owner, chance = candidates.owner[inside], candidates.log_chance[inside]
        score = _support(q[inside] * scale, owner, chance, n_targets, tolerance_px)
        n = int(np.argmin(score))
        if score[n] < best:
            best = float(score[n])
            start = np.concatenate([q[inside][n], [value]])[: len(prior_sigma)]
    log_chance = log_chance_of_score(candidates, -best) + np.log(len(third))
    return _polished(candidates, start, min(log_chance, 0.0), prior_sigma, tolerance_px, sigma_px)


def log_chance_of_ranks(count: int, share: float) -> Array:
    """Log of the chance that one of a target's k + 1 best places lies in a given spot by accident, k =
    0..count-1.

    `share` is that of the spot in the area that was searched. High correlations are no rarer for chips of
    repeated patterns than ranks say: the picture itself shows how often a place looks like the chip.
    """
    return np.minimum(np.log(np.arange(1.0, count + 1.0)) + np.log(share), 0.0)


def log_chance_of_score(candidates: Candidates, score: float) -> float:
    """Log of a bound of the chance that somewhere the targets' log chances add up to -score, by accident.

    If target t's places lie anywhere, its share -log p of the score has the moments M_t(s) = E[p^-s], where
    p is the chance of its best place within the tolerance, or 1. Some candidate of some target must be part
    of the agreement:

        P  <=  sum_t sum_k p_tk^-s  prod_(other targets u) M_u(s)  exp(-s score)     for every s in (0, 1)

    (Boole's inequality over the candidates, Chernoff's for the sum of the others).
    """
    seeds, moments = [], []
    for n in np.unique(candidates.owner):
        log_p = np.sort(candidates.log_chance[candidates.owner == n])
        p, raised = np.exp(log_p), np.exp(-_ORDERS[:, None] * log_p)
        seeds.append(np.log(raised.sum(axis=1)))
        moments.append(np.log(raised @ np.diff(p, prepend=0.0) + 1.0 - p[-1]))
    others = np.sum(moments, axis=0) - np.array(moments)
    bounds = logsumexp(np.array(seeds) + others, axis=0) - _ORDERS * score
    return float(bounds.min())


def fit_common(
    displacement_px: Array, design: Array, cov_px: Array, prior_sigma: Array
) -> tuple[Array, Array]:
    """Least squares for the common parameters and their covariance; (N, 2), (N, 2, P), (N, 2, 2), (P,)."""
    weight = np.linalg.inv(cov_px)
    normal = np.einsum("nai,nab,nbj->ij", design, weight, design) + np.diag(prior_sigma**-2.0)
    right = np.einsum("nai,nab,nb->i", design, weight, displacement_px)
    covariance = np.linalg.inv(normal)
    return covariance @ right, covariance


def _third_parameters(candidates: Candidates, prior_sigma: Array, reach: float, tolerance_px: float) -> Array:
    """Values of the third parameter to try, so close that none is missed; one zero where there is no
    third.
    """
    if len(prior_sigma) < 3:
        return np.zeros(1)
    design = candidates.design[:, :, 2]
    lever = float(np.abs(design - design.mean(axis=0)).max()) + 1e-9
    half = reach * prior_sigma[2]
    count = min(2 * int(np.ceil(half * lever / tolerance_px)) + 1, 61)
    return np.array([half * k / max(count // 2, 1) for k in range(-(count // 2), count // 2 + 1)])


def _proposals(candidates: Candidates) -> Callable[[float], Array]:
    """The first two parameters (C, 2) that explain each candidate, as a function of the third."""
    inverse = np.linalg.inv(candidates.design[:, :, :2])
    alone = np.einsum("cij,cj->ci", inverse, candidates.displacement_px)
    by_third = np.einsum("cij,cjk->cik", inverse, candidates.design[:, :, 2:]).sum(axis=2)
    return lambda third: alone - by_third * third


def _support(q_px: Array, owner: NDArray, log_chance: Array, n_targets: int, tolerance_px: float) -> Array:
    """(C,) sum over targets of the lowest log chance among their candidates near each proposal."""
    pairs = cKDTree(q_px).query_pairs(tolerance_px, output_type="ndarray")
    lowest = np.zeros((len(owner), n_targets))
    every = np.arange(len(owner))
    first = np.concatenate([every, pairs[:, 0], pairs[:, 1]])
    second = np.concatenate([every, pairs[:, 1], pairs[:, 0]])
    np.minimum.at(lowest, (first, owner[second]), log_chance[second])
    return lowest.sum(axis=1)


def _polished(
    candidates: Candidates,
    start: Array,
    log_chance: float,
    prior_sigma: Array,
    tolerance_px: float,
    sigma_px: float,
) -> Vote:
    p, covariance = start, np.diag(prior_sigma**2)
    chosen = np.zeros(0, dtype=np.int64)
    for _ in range(4):
        miss = candidates.displacement_px - candidates.design @ p
        distance = np.hypot(miss[:, 0], miss[:, 1])
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
    return Vote(p, covariance, chosen, log_chance)
