"""Search for gross errors among the targets: a robust start, data snooping, and its separability.

Data snooping (Baarda 1968; Teunissen, Testing Theory, 2006) tests one target at a time. With its residual e_j
of covariance Q_j, T_j = e_jᵀ Q_j⁻¹ e_j is chi-square of 2 degrees of freedom if target j is good: the
decrease of chi2 when it is rejected and, computed without it, the increase when it is re-admitted. The search
minimises

    chi2(kept targets) + k * (number of rejected targets)                                           (1)

by steps that decrease it, k being the limit of T_j, and so ends, whatever the order of the targets.

An error of one target may look like one of another (Foerstner 1983: separability). With a rejected target
re-admitted, T_j - T_i is twice the logarithm of the likelihood ratio of "j is wrong" to "i is wrong", each
with the error that fits best; targets i that it does not rule out are j's rivals. With the likelihood
integrated over the error, of information N_i (rad⁻²) and one density for all targets (Torr & Zisserman 2000),
target i is the wrong one with probability

    p_i = z_i / sum_k z_k,    z_i = exp(T_i / 2) / sqrt(det N_i),    k over j and its rivals.           (2)

Only if p_j reaches a stated probability is j rejected. Otherwise j and its rivals stay, each with the weight
(1 - p_i) min(1, k / T_i): the probability that it is good (a mixture of good and gross errors: Box & Tiao
1968), less if it is far off.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import chdtri, chndtr, softmax

from boresight.calib.estimate import RejectionTest
from boresight.calib.information import Iteration, corrected
from boresight.calib.joint_solution import (
    Linearised,
    Problem,
    Step,
    linearised,
    readmitted,
    solve_weighted,
    squared_mahalanobis,
)
from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.installation import deviation_from_theta
from boresight.records.record import Bools, Floats, Ints

__all__ = [
    "detectable_bias",
    "l1_start",
    "noncentrality_of",
    "refine_geman_mcclure",
    "rejection_test",
    "snoop",
    "weigh",
]

POWER = 0.8  # of the test, for the minimal detectable bias: the value usual in geodesy
SEPARABLE_ODDS = 19.0  # likelihood ratio by which one of two targets is the wrong one: 95 %
LEAST_PROBABILITY = 0.7  # that the target rejected is the wrong one (docs/notes/estimation.md says why)
MOST_REJECTED = 1.0 / 3.0  # share of targets up to which each rejected one is searched for
FEW_REJECTED = 10  # that are searched for whatever their share
SMALLEST_GAIN = 1e-6  # of the limit: (1) must fall by more than rounding


def rejection_test(probability_false_alarm: float) -> RejectionTest:
    """Limit, and noncentrality of a bias that is found with the stated power."""
    limit = float(chdtri(2, probability_false_alarm))
    return RejectionTest(limit, noncentrality_of(limit, 2, POWER))


def noncentrality_of(limit: float, dof: int, power: float) -> float:
    """Of the chi-square distribution that exceeds `limit` with the probability `power`."""
    return float(brentq(lambda size: 1.0 - chndtr(limit, dof, size) - power, 1e-3, 1e3))


def _too_many(problem: Problem, kept: Bools) -> bool:
    """Whether so many targets are rejected that the stated errors are wrong, and not the targets."""
    return bool(np.sum(problem.inside & ~kept) > max(MOST_REJECTED * np.sum(problem.inside), FEW_REJECTED))


def snoop(problem: Problem, about: Linearised, kept: Bools, limit: float, known: Step | None = None) -> Step:
    """The solution with the targets to keep, searched from `kept` (J,), whose solution may be `known`: no
    rejection, re-admission or exchange decreases (1).
    """

    def solved(kept: Bools, known: Step | None) -> tuple[Step, float]:
        step = solve_weighted(problem, about, kept.astype(float), known)
        return step, step.chi2 + limit * int(np.sum(problem.inside & ~kept))

    step, criterion = solved(kept, known)
    while True:
        for other in _moves(problem, kept, step, limit):
            moved, value = solved(other, step)
            if value < criterion - SMALLEST_GAIN * limit:
                kept, step, criterion = other, moved, value
                break
        else:
            return step


def _moves(problem: Problem, kept: Bools, step: Step, limit: float) -> Iterator[Bools]:
    """Sets of targets to try: one less, all that pass re-admitted, the best of them; at last, exchanges.

    For an exchange a rejected target is re-admitted and the one with the largest residual then is rejected;
    it changes (1) by the difference of their statistics. Where a third of the targets is rejected, the stated
    errors are wrong and not the targets: then all that fail are rejected at once, and none is exchanged.
    """
    rows, rejected, statistic = np.arange(len(kept)), problem.inside & ~kept, squared_mahalanobis(step)
    over, back = kept & (statistic > limit), rejected & (statistic < limit)
    if over.any() and _too_many(problem, kept):
        yield kept & ~over
    if over.any():
        yield kept & (rows != _largest(statistic, over, problem.rank))
    if back.any():
        yield kept | back
        yield kept | (rows == _largest(-statistic, back, problem.rank))
    if _too_many(problem, kept):
        return
    nearest = np.flatnonzero(rejected)
    nearest = nearest[np.lexsort((problem.rank[nearest], statistic[nearest]))]
    for first, (then, _) in zip(nearest.tolist(), readmitted(step, nearest)):
        more = kept | (rows == first)
        other = _largest(then, more, problem.rank)
        if then[other] > statistic[first]:
            yield more & (rows != other)


def _largest(values: Floats, among: Bools, rank: Ints) -> int:
    """Index of the largest value; of values equal but for rounding, the first in rank."""
    rows = np.flatnonzero(among)
    top = np.max(values[rows])
    rows = rows[values[rows] >= top - 1e-9 * abs(top)]
    return int(rows[np.argmin(rank[rows])])


def weigh(problem: Problem, step: Step, limit: float) -> tuple[Floats, dict[int, Ints]]:
    """Weights (J,) of the targets, and the rivals (N,) of each that `step` rejects: those that may be wrong
    in its place, the odds being below 19 to 1 against. It has weight 0 only where (2) is at least 0.7. Where
    too many are rejected, they have weight 0 and no rivals.
    """
    kept = step.weight == 1.0
    weight, rivals, rejected = kept.astype(float), {}, np.flatnonzero(problem.inside & ~kept)
    if not len(rejected) or _too_many(problem, kept):
        return weight, {int(j): np.zeros(0, dtype=np.int64) for j in rejected}
    for j, (statistic, variance) in zip(rejected.tolist(), readmitted(step, rejected)):
        rivals[j] = np.flatnonzero(kept & (statistic[j] - statistic < 2.0 * np.log(SEPARABLE_ODDS)))
        suspects = np.append(j, rivals[j])
        whitener = step.whitener[suspects]
        information = np.swapaxes(whitener, 1, 2) @ variance[suspects] @ whitener
        probability = softmax(0.5 * (statistic[suspects] - np.linalg.slogdet(information)[1]))
        if probability[0] < LEAST_PROBABILITY:
            weight[j] = 1.0
            weight[suspects] *= (1.0 - probability) * np.minimum(1.0, limit / statistic[suspects])
    return weight, rivals


def detectable_bias(step: Step, noncentrality: float) -> Floats:
    """Minimal detectable bias (J,) of each target's direction along its least controlled axis, rad.

    A bias b (rad along the tangent axes) gives T_j the noncentrality bᵀ Wᵀ Q⁻¹ W b, with W the whitener and Q
    the covariance of the whitened residual predicted by all other targets; inf where none controls it.
    """
    unit, weighted = np.eye(2), step.weight[:, None, None] * step.leverage
    information = np.linalg.solve(unit + (step.leverage - weighted), unit - weighted)
    weakest = np.linalg.eigvalsh(np.swapaxes(step.whitener, 1, 2) @ information @ step.whitener)[:, 0]
    controlled = np.linalg.eigvalsh(information)[:, 0] > 1e-9
    return np.sqrt(np.divide(noncentrality, weakest, out=np.full(len(weakest), np.inf), where=controlled))


def l1_start(problem: Problem, R_cs: Rotation) -> Rotation:
    """The matrix with the least sum of absolute residuals, by iterative re-weighting from `R_cs`."""
    parts = [(g.u_c[g.inside], g.v_s[g.inside], g.which[g.inside]) for g in problem.groups]
    u_c, v_s, camera = (np.concatenate(part) for part in zip(*parts))
    if R_cs.single:
        return _l1(u_c, v_s, R_cs)
    each = [camera == n for n in range(len(R_cs))]
    return Rotation.concatenate([_l1(u_c[own], v_s[own], R_cs[n]) for n, own in enumerate(each)])


def _l1(u_c: Floats, v_s: Floats, R_cs: Rotation) -> Rotation:
    """The same of one camera with directions (N, 3) in its frame and in frame s."""
    for _ in range(50):
        w = R_cs.apply(v_s)
        difference = u_c - w
        weight = 1.0 / np.maximum(np.linalg.norm(difference, axis=1), 1e-6)  # 1e-6 rad: 0.2 arcsec
        cross = cross_matrices(w)
        N = np.einsum("n,nia,nib->ab", weight, cross, cross)
        right = np.einsum("n,nia,ni->a", weight, cross, difference)
        values, vectors = np.linalg.eigh(N)
        known = values > 1e-10 * values[-1]
        theta = (vectors[:, known] / values[known]) @ (vectors[:, known].T @ right)
        R_cs = deviation_from_theta(theta) * R_cs
        if np.linalg.norm(theta) < 1e-9:
            break
    return R_cs


def refine_geman_mcclure(
    problem: Problem, R_cs: Rotation, iterations: list[Iteration]
) -> tuple[Rotation, Bools]:
    """Matrix by Geman and McClure's weights, and the targets (J,) of more than a quarter of full weight.

    The weights' scale halves until it is three sigma, so that the minimum found is that near `R_cs`.
    """
    about = linearised(problem, R_cs)
    at_start = np.linalg.norm(np.concatenate([line.r.reshape(-1, 2) for line in about.strips]), axis=1)
    scale = max(3.0, 3.0 * float(np.median(at_start[problem.inside])))
    weight = problem.inside * (1.0 + (at_start / scale) ** 2) ** -2.0
    for _ in range(40):
        step = solve_weighted(problem, linearised(problem, R_cs), weight)
        iterations.append(step.iteration)
        R_cs = corrected(R_cs, step.solution.theta)
        scale, before = max(3.0, 0.5 * scale), weight
        weight = problem.inside * (1.0 + (np.linalg.norm(step.whitened, axis=1) / scale) ** 2) ** -2.0
        if scale == 3.0 and np.max(np.abs(weight - before)) < 1e-2:
            break
    return R_cs, weight > 0.25
