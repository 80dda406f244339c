"""All strips together: one linear solution for theta and the shared unknowns, and its residuals.

The normal equations of each strip (`strips`), its own unknowns eliminated, are added exactly and solved.
Every target then gets its residual and the covariance of that residual, by which gross errors are tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from boresight.calib.correlated_passes import correlated_passes
from boresight.calib.error_table import SharedError, SharedUnknowns, find_shared, prior_of
from boresight.calib.heads import HeadAgreement, carried, of_heads
from boresight.calib.information import InformationPairs, Iteration, Solution, solve_total, theta_of
from boresight.calib.settings import CalibrationSettings
from boresight.calib.strips import (
    LinearStrips,
    PreparedStrip,
    StripGroup,
    group_strips,
    linearise,
    prepare_strips,
)
from boresight.geometry.sightings import StripSightings, sigma_of
from boresight.records.record import Bools, Floats, Ints, Texts, array, inner, record, scalar

__all__ = [
    "Linearised",
    "Posed",
    "Problem",
    "Step",
    "absorbed",
    "linearised",
    "readmitted",
    "respond",
    "solve_weighted",
    "squared_mahalanobis",
    "squared_over",
]


@record(kw_only=True)
class Problem:
    """All strips in groups of equal shape. The J targets of all are in the order group, strip, target."""

    groups: list[StripGroup] = scalar("strips of equal shape")
    names: Texts = array("S", "ids of the passes, group after group")
    members: tuple[int, ...] = scalar("which of the prepared strips they hold, in the order of the targets")
    shared: SharedUnknowns = scalar("unknowns beside theta that several strips share")
    prior_shared: Floats = array("G, G", "prior information of the shared unknowns")
    inside: Bools = array("J", "whether exposures cover the target's instant")
    rank: Ints = array("J", "place of each sighting in the order of strip, target and CCD")
    settings: CalibrationSettings = scalar("priors and limits")
    cameras: tuple[str, ...] = scalar("of the matrices; a single one has no name")
    agreement: HeadAgreement = scalar("of the heads with one another, without any target")
    prior: InformationPairs | None = scalar("on theta, from before the calibration", default=None)

    @classmethod
    def of(
        cls,
        prepared: list[PreparedStrip],
        settings: CalibrationSettings,
        further: Sequence[SharedError] = (),
        cameras: tuple[str, ...] = ("",),
        prior: InformationPairs | None = None,
    ) -> Problem:
        """The problem that these strips of `cameras` pose, with `further` rows of the table of errors;
        without groups where no target is covered. `prior` is on theta.
        """
        units = correlated_passes(prepared, settings)
        passes = [one for one, _ in units]
        carrying = [strip for strip in prepared if strip.inside.any()]
        of_any = {name for strip in carrying for name in strip.of_heads}
        heads = tuple(sorted(of_any, key=lambda name: name.split("/")))
        seen = [one for one in passes if one.inside.any()]
        shared = find_shared(seen, settings, heads, further)
        groups = group_strips(passes, shared, settings)
        places = [n for group in groups for n in group.place.tolist()]
        members = [passes[n] for n in places]
        keys = [[strip.ground.ccd, strip.ground.target_id, strip.strip] for strip in members]
        rows = np.lexsort([np.concatenate(column) for column in zip(*keys)]) if keys else np.arange(0)
        return cls(
            groups=groups,
            names=np.array([strip.strip_id for strip in members], dtype=str),
            members=tuple(n for place in places for n in units[place][1]),
            shared=shared,
            prior_shared=shared.prior_information(),
            inside=np.concatenate([np.zeros(0, dtype=bool), *(group.inside.ravel() for group in groups)]),
            rank=np.argsort(rows),
            settings=settings,
            cameras=cameras,
            agreement=_agreement(carrying, heads),
            prior=prior,
        )


@record(kw_only=True)
class Posed:
    """A problem, and what poses it."""

    strips: tuple[StripSightings, ...] = scalar("as they were given")
    passes: tuple[StripSightings, ...] = array("P", "of these, about alignments of the heads")
    prepared: tuple[PreparedStrip, ...] = array("P", "the same, linearised but for the installation matrix")
    problem: Problem = scalar("all together")

    @classmethod
    def of(
        cls,
        strips: Sequence[StripSightings],
        passes: Sequence[StripSightings],
        settings: CalibrationSettings,
        further: Sequence[SharedError] = (),
        cameras: tuple[str, ...] = ("",),
        prior: InformationPairs | None = None,
    ) -> Posed:
        """The problem that `passes` of `strips` pose; further parameters as `Problem.of`."""
        of_heads = [carried(strip) for strip in passes]
        prepared = prepare_strips(of_heads, settings, cameras)
        problem = Problem.of(prepared, settings, further, cameras, prior)
        return cls(strips=tuple(strips), passes=tuple(of_heads), prepared=tuple(prepared), problem=problem)

    def __reduce__(self) -> tuple[Any, ...]:
        """None in another process: columns of errors are functions."""
        return type(None), ()


def _agreement(strips: Sequence[PreparedStrip], names: tuple[str, ...]) -> HeadAgreement:
    """The heads' own weighted sum of squares, all attitude errors and the unknowns `names` estimated."""
    ties = [tie for strip in strips for tie in strip.ties]
    parts = np.zeros((len(ties), len(names) + 1, len(names) + 1))
    for s, tie in enumerate(ties):
        Y = np.column_stack([of_heads(tie.unknowns, tie.by_alpha, names), tie.r])
        G = tie.by_phi.T @ Y
        parts[s] = Y.T @ Y - G.T @ np.linalg.solve(np.eye(len(G)) + tie.by_phi.T @ tie.by_phi, G)
    prior, total = prior_of(names, np.zeros((0, 0))), parts.sum(axis=0)
    together, apart = _left(total, prior), sum(_left(part, prior) for part in parts)
    alignments = [n for n, name in enumerate(names) if name.startswith("head/")]  # others have a stated size
    known = int(np.linalg.matrix_rank(total[np.ix_(alignments, alignments)])) if ties else 0
    rows = sum(len(tie.r) - 1 for tie in ties) - known
    return HeadAgreement(
        chi2=max(together, 0.0),
        dof=rows + sum(tie.dof for tie in ties),
        gain=max(together - apart, 0.0),
        dof_gain=rows,
    )


def _left(N: Floats, prior: Floats) -> float:
    """The sum of squares that the best unknowns of heads leave; `N` (A + 1, A + 1), the residual last."""
    return float(N[-1, -1] - N[:-1, -1] @ np.linalg.solve(N[:-1, :-1] + prior, N[:-1, -1]))


@record
class Linearised:
    """Whitened residuals of all groups and their derivatives about `R_cs`."""

    R_cs: Rotation
    strips: list[LinearStrips]  # one a group


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """One linear solution with given weights."""

    about: Linearised  # the problem about a matrix
    pairs: InformationPairs  # normal equations of each strip
    solution: Solution  # theta and the shared unknowns
    chi2: float  # weighted sum of squares, priors included, less that of the heads by themselves
    whitened: Floats  # (J, 2) residuals, all unknowns estimated, in units of the noise
    weight: Floats  # (J,) of the targets, 0 to 1
    reduced: list[_Reduced]  # groups with their own unknowns eliminated, at these weights
    sigma = inner[Floats]("solution.covariance", "1-sigma (3 C,) of theta, rad", of=sigma_of)

    @cached_property
    def leverage(self) -> Floats:
        """Covariance (J, 2, 2) of the fitted direction in units of the noise."""
        covariance = self.solution.covariance_all
        return np.concatenate([_leverage(*of, covariance) for of in zip(self.about.strips, self.reduced)])

    @cached_property
    def whitener(self) -> Floats:
        """(J, 2, 2), takes residuals in rad along the two tangent axes to `whitened`."""
        return np.concatenate([line.whitener.reshape(-1, 2, 2) for line in self.about.strips])

    @property
    def across(self) -> Floats:
        """(J, 2, 3), takes a change of a look, frame c, to that of the whitened residual."""
        return np.concatenate([line.across.reshape(-1, 2, 3) for line in self.about.strips])

    @property
    def residual_c(self) -> Floats:
        """Residuals (J, 2) along x and y of frame c, rad."""
        return np.asarray(np.linalg.solve(self.whitener, self.whitened[:, :, None])[:, :, 0])

    @property
    def variance(self) -> Floats:
        """Covariance (J, 2, 2) of `whitened`: I - leverage for weight one, I + leverage for weight zero."""
        return np.eye(2) + (1.0 - 2.0 * self.weight[:, None, None]) * self.leverage

    @property
    def iteration(self) -> Iteration:
        """The step as `InstallationEstimate.iterations` keeps it."""
        return Iteration(self.solution.theta, self.sigma, self.chi2, float(np.sum(self.weight)))

    def found(self, names: Sequence[str]) -> tuple[Floats, Floats]:
        """Best values (n,) and covariance (n, n) of some of the shared unknowns."""
        rows = np.array([self.pairs.shared.index(name) for name in names], dtype=np.int64)
        columns = len(self.solution.theta) + rows
        return self.solution.shared[rows], self.solution.covariance_all[np.ix_(columns, columns)]


def linearised(problem: Problem, R_cs: Rotation, known: Step | None = None) -> Linearised:
    """The problem about `R_cs`, that of the solution `known` where it is the same."""
    if known and known.about.R_cs is R_cs:
        return known.about
    return Linearised(R_cs, [linearise(group, R_cs, problem.settings) for group in problem.groups])


def solve_weighted(problem: Problem, about: Linearised, weight: Floats, known: Step | None = None) -> Step:
    """Eliminate each strip's own unknowns, add, solve, and compute all residuals; `weight` (J,) between 0
    and 1. A solution `known` is returned where it is the same; what it has of groups of strips with the same
    weights is taken from it.
    """
    known = known if known and known.about is about else None
    if known and np.array_equal(known.weight, weight):
        return known
    reduced, first = [], 0
    for n, (group, line) in enumerate(zip(problem.groups, about.strips)):
        own = slice(first, first := first + group.inside.size)
        same = known if known and np.array_equal(known.weight[own], weight[own]) else None
        reduced.append(same.reduced[n] if same else _reduced(line, weight[own].reshape(group.inside.shape)))
    N = np.concatenate([part.N for part in reduced])
    F, right, shared = N[:, :-1, :-1], N[:, :-1, -1], problem.shared.names
    pairs = InformationPairs(problem.names, F, right, about.R_cs, shared, problem.cameras)
    of_prior = 0.0
    if problem.prior is not None:
        pairs, off = pairs.with_prior(problem.prior), theta_of(problem.prior.R_cs_ref, about.R_cs)
        of_prior = float(off @ problem.prior.F[0] @ off)
    F, right = pairs.total()
    limit = problem.settings.sigma_observable_rad
    solution = solve_total(F, right, problem.prior_shared, sigma_observable_rad=limit)
    x = np.concatenate([solution.theta, solution.shared])
    return Step(
        about=about,
        pairs=pairs,
        solution=solution,
        chi2=float(np.sum(N[:, -1, -1]) - x @ right) - problem.agreement.chi2 + of_prior,
        whitened=np.concatenate([_whitened(*of, x) for of in zip(about.strips, reduced)]),
        weight=weight,
        reduced=reduced,
    )


@record
class _Reduced:
    """A group with its strips' own unknowns eliminated."""

    N: Floats  # (S, n + 1, n + 1) normal matrix of theta, the shared unknowns and, last, the residual
    back: Floats  # (S, n_q, n + 1) change of the strip's own unknowns by each of those
    cov_q: Floats  # (S, n_q, n_q) covariance of the strip's own unknowns, the others given


def _reduced(line: LinearStrips, weight: Floats) -> _Reduced:
    root: Floats = np.repeat(np.sqrt(weight), 2, axis=1)[:, :, None]
    (S, _, n_q), n, A = line.X_q.shape, line.n_common + 1, line.ties.shape[2]
    X_q, N, G = root * line.X_q, np.zeros((S, n, n)), np.zeros((S, n_q, n))
    cov_q = np.asarray(np.linalg.inv(np.eye(n_q) + np.swapaxes(X_q, 1, 2) @ X_q), dtype=np.float64)
    N[:, n - A :, n - A :] = np.swapaxes(line.ties, 1, 2) @ line.ties
    for part in line.common:
        at = np.append(part.columns, line.n_common)
        Y = root[:, part.rows] * np.concatenate([part.X, line.r[:, part.rows, None]], axis=2)
        N[:, at[:, None], at] += np.swapaxes(Y, 1, 2) @ Y
        G[:, :, at] += np.swapaxes(X_q[:, part.rows], 1, 2) @ Y
    back = cov_q @ G
    N -= np.swapaxes(G, 1, 2) @ back
    return _Reduced(np.asarray(0.5 * (N + np.swapaxes(N, 1, 2))), back, cov_q)


def _whitened(line: LinearStrips, part: _Reduced, x: Floats) -> Floats:
    """Whitened residuals (J, 2) at the solution x (3 C + g,)."""
    q = part.back[:, :, -1] - part.back[:, :, :-1] @ x
    e = line.r - (line.along(x[:, None]) + line.X_q @ q[:, :, None])[:, :, 0]
    return np.asarray(e.reshape(-1, 2))


def _leverage(line: LinearStrips, part: _Reduced, cov_x: Floats) -> Floats:
    """Covariance (J, 2, 2) of the fitted directions, that of the common unknowns being `cov_x`."""
    by_x = part.back[:, :, :-1]
    with_x = -by_x @ cov_x
    cov_q = part.cov_q - with_x @ np.swapaxes(by_x, 1, 2)
    S, leverage = len(line.r), np.empty((*line.r.shape, 2))
    for own in line.common:
        at = own.columns
        across, of_x = with_x[:, :, at], np.broadcast_to(cov_x[at[:, None], at], (S, len(at), len(at)))
        both = np.block([[cov_q, across], [np.swapaxes(across, 1, 2), of_x]])
        X = np.concatenate([line.X_q[:, own.rows], own.X], axis=2)
        pairs = X.reshape(-1, 2, X.shape[2])
        fitted = (X @ both).reshape(pairs.shape) @ np.swapaxes(pairs, 1, 2)
        leverage[:, own.rows] = fitted.reshape(S, -1, 2)
    return leverage.reshape(-1, 2, 2)


def _after(line: LinearStrips, part: _Reduced, x: Floats) -> Floats:
    """(S, 2 J, n) change of r by x (3 C + g, n), the strip's own unknowns following."""
    return line.along(x) - line.X_q @ (part.back[:, :, :-1] @ x)


def squared_mahalanobis(step: Step) -> Floats:
    """(J,) squared residual over its covariance; 0 for a residual that no other observation controls.

    For a target in the fit it is the decrease of chi2 if the target is rejected; for one of weight zero, the
    increase if it is added.
    """
    return squared_over(step.whitened, step.variance)


def squared_over(e: Floats, v: Floats) -> Floats:
    """(J,) squared residuals (J, 2) over their covariances (J, 2, 2); 0 where a covariance is singular."""
    det = v[:, 0, 0] * v[:, 1, 1] - v[:, 0, 1] ** 2
    inside = v[:, 1, 1] * e[:, 0] ** 2 - 2.0 * v[:, 0, 1] * e[:, 0] * e[:, 1] + v[:, 0, 0] * e[:, 1] ** 2
    return np.divide(inside, det, out=np.zeros(len(det)), where=det > 1e-9)


def readmitted(step: Step, rows: Ints) -> Iterator[tuple[Floats, Floats]]:
    """What `squared_mahalanobis` (J,) and `Step.variance` (J, 2, 2) are with one more target in the fit, each
    of `rows` in turn; those have weight zero, and all others zero or one.

    One more target changes the solution by a matrix of rank two, so that the change needs no new one.
    """
    sign = 1.0 - 2.0 * step.weight[:, None, None]
    leverage, alone = step.leverage, np.zeros((len(step.weight), 2, 2))
    for row in rows.tolist():
        alone[row] = np.eye(2)
        across = alone - respond(step, alone, alone[:, 0, 0])[0]
        alone[row] = 0.0
        gain = across @ np.linalg.inv(np.eye(2) + leverage[row])
        e = step.whitened - gain @ step.whitened[row]
        of_row = sign.copy()
        of_row[row] = -1.0
        variance = np.eye(2) + of_row * (leverage - gain @ np.swapaxes(across, 1, 2))
        yield squared_over(e, variance), variance


def respond(step: Step, columns: Floats, weight: Floats | None = None) -> tuple[Floats, Floats]:
    """What a change of the residuals does to the solution `step`, each of H columns by itself.

    `columns` (J, 2, H) is the change of the whitened residuals by a unit of each, `weight` (J,) that of the
    targets in it; None: that of the solution. Returned are the part of the change that is left as residuals,
    all unknowns estimated (J, 2, H), and the change of theta and of the shared unknowns (3 + G, H).
    """
    weight = step.weight if weight is None else weight
    H, parts, last = columns.shape[2], [], 0
    right = np.zeros((len(step.solution.covariance_all), H))
    for line, part in zip(step.about.strips, step.reduced):
        S, rows = line.r.shape
        first, last = last, last + S * rows // 2
        B = columns[first:last].reshape(S, rows, H)
        weighted = np.repeat(weight[first:last].reshape(S, -1), 2, axis=1)[:, :, None] * B
        of_q = np.swapaxes(line.X_q, 1, 2) @ weighted
        right += (line.onto(weighted) - np.swapaxes(part.back[:, :, :-1], 1, 2) @ of_q).sum(axis=0)
        parts.append((line, part, B, part.cov_q @ of_q))
    x = step.solution.covariance_all @ right
    left = [B - _after(line, part, x) - line.X_q @ own for line, part, B, own in parts]
    return np.concatenate([one.ravel() for one in left]).reshape(columns.shape), x


def absorbed(step: Step, B: sparse.csc_array, chosen: Sequence[int] = ()) -> tuple[Floats, Floats, Floats]:
    """What `respond` finds of many changes, each of few residuals, without what each of them leaves.

    `B` (2 J, H) are the changes of the whitened residuals, two rows a target. Returned are the information
    (H,) on the size of each, that of the columns `chosen` (k,) with all (k, H), and the change of theta and
    of the shared unknowns (3 + G, H).
    """
    weighted = sparse.csr_array(B.multiply(np.repeat(step.weight, 2)[:, None]))
    each, with_chosen = B.multiply(weighted).sum(axis=0), (B[:, chosen].T @ weighted).toarray()
    right, first = np.zeros((len(step.solution.covariance_all), B.shape[1])), 0
    for line, part in zip(step.about.strips, step.reduced):
        n = line.r.shape[1]
        for s in range(len(line.r)):
            own = weighted[first : first + n]
            first += n
            of_q = (own.T @ line.X_q[s]).T
            taken = part.cov_q[s] @ of_q
            each -= np.einsum("qh,qh->h", of_q, taken)
            with_chosen -= of_q[:, chosen].T @ taken
            for common in line.common:
                of_part = (own[common.rows].T @ common.X[s]).T
                right[common.columns] += of_part
            right -= part.back[s, :, :-1].T @ of_q
    x = step.solution.covariance_all @ right
    return each - np.einsum("nh,nh->h", right, x), with_chosen - right[:, chosen].T @ x, x
