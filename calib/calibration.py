"""The calibration: strips of sightings to the installation matrix (docs/notes/estimation.md, section 3).

Gauss-Newton on theta about the matrix of the last step until the correction vanishes (paper, end of section
2.3), all other unknowns being eliminated pass by pass (`simultaneous_strips`). Targets with gross errors are
searched for at the noise that is assumed, and rejected for good (`gross_errors`); the covariance is that of
least squares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from boresight.calib.error_table import BIASES, SharedError, common_bias
from boresight.calib.estimate import (
    HeadInstallation,
    InstallationEstimate,
    NotObservable,
    RejectionTest,
    TargetResiduals,
)
from boresight.calib.gross_errors import (
    detectable_bias,
    l1_start,
    refine_geman_mcclure,
    rejection_test,
    snoop,
    weigh,
)
from boresight.calib.heads import (
    HeadAgreement,
    WithoutHead,
    aligned,
    alignment_names,
    largest_turn,
    measured_alignment,
    periodic_errors,
    unknown_heads,
    without_head,
)
from boresight.calib.information import InformationPairs, Iteration, Solution, corrected, theta_of
from boresight.calib.joint_solution import (
    Posed,
    Problem,
    Step,
    linearised,
    solve_weighted,
    squared_mahalanobis,
)
from boresight.calib.rejection import rejected_observations
from boresight.calib.settings import CalibrationSettings
from boresight.calib.simultaneous_strips import passes_of
from boresight.calib.strips import PreparedStrip
from boresight.calib.taken_up import taken_up
from boresight.geometry.attitude_estimate import GROSS
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.records.ledger import Entry, Reason
from boresight.records.record import Floats, Ints, record

__all__ = ["calibrate_strips", "strip_pairs"]

NEGLIGIBLE_TURN_RAD = 1e-4  # of an alignment: its square is 0.002 arcsec
MOST_ALIGNMENTS = 3  # from degrees off the second is below a microradian
HEADS_PROBABILITY = 1e-3  # of looking for a head that contradicts where none does; the verdict decides


def calibrate_strips(
    strips: Sequence[StripSightings],
    R_cs0: Rotation | Mapping[str, Rotation],
    settings: CalibrationSettings,
    *,
    further: Sequence[SharedError] = (),
    prior: InformationPairs | None = None,
) -> InstallationEstimate | NotObservable:
    """The installation matrix with its covariance, or the rotations that the strips leave undetermined; of
    several cameras of one satellite (`StripSightings.camera`) a matrix each.

    `R_cs0`, star camera to remote-sensing camera, is the matrix to start from, of several cameras one each in
    the order of the result; milliradians off are no obstacle. `further` are errors to be estimated too,
    `prior` what is known of the matrix before: one pair, about `R_cs0`. The covariance is that of a small
    rotation about the axes of c, rad². An angle whose 1-sigma would exceed `settings.sigma_observable_rad` is
    undetermined.

    The result is the same, bit for bit, for any order of the strips. `ValueError` if two strips share one id,
    list exposures of one instant that differ, or are of unknown cameras.
    """
    passes = passes_of(strips, settings.attitudes)
    start = _Start(tuple(strips), *_matrices(strips, R_cs0), settings, further, prior)
    found = _calibrated(passes, start)
    if isinstance(found, NotObservable) or not _contradict(found.agreement):
        return found
    trials = [_without(passes, head, start) for head in ("", *unknown_heads(passes))]
    return replace(found, agreement=replace(found.agreement, without=tuple(t for t in trials if t)))


@record
class _Start:
    strips: tuple[StripSightings, ...]
    cameras: tuple[str, ...]
    R_cs0: Rotation  # (C,) of several
    settings: CalibrationSettings
    further: Sequence[SharedError]
    prior: InformationPairs | None  # on the matrix


def _matrices(
    strips: Sequence[StripSightings], R_cs0: Rotation | Mapping[str, Rotation]
) -> tuple[tuple[str, ...], Rotation]:
    """Cameras of the strips and matrices to start from, in the order given; a single camera has no name."""
    seen = {strip.camera for strip in strips}
    if isinstance(R_cs0, Rotation):
        if len(seen) > 1:
            raise ValueError(f"strips of the cameras {', '.join(sorted(seen))} need a matrix each")
        return ("",), R_cs0
    if unknown := sorted(seen - set(R_cs0)):
        raise ValueError(f"strips are of the camera {unknown[0]!r}, of which no matrix is given")
    names = tuple(name for name in R_cs0 if name in seen)
    if len(names) < 2:
        return ("",), R_cs0[names[0] if names else next(iter(R_cs0))]
    return names, Rotation.concatenate([R_cs0[name] for name in names])


def _contradict(agreement: HeadAgreement) -> bool:
    """Whether the heads differ by more than their stated errors explain: one of them is to be found."""
    tests = ((agreement.dof, agreement.chi2), (agreement.dof_gain, agreement.gain))
    return any(dof > 0 and chdtrc(dof, statistic) < HEADS_PROBABILITY for dof, statistic in tests)


def _without(strips: Sequence[StripSightings], head: str, start: _Start) -> WithoutHead | None:
    """Statistics of the estimate without one head; None where nothing can be estimated without it."""
    strips = aligned(strips, {name: measured_alignment(strips, name) for name in unknown_heads(strips)})
    rest = [without_head(strip, head) for strip in strips]
    found = _calibrated(rest, start)
    if isinstance(found, NotObservable):
        return None
    rejected = sum(entry.reason is Reason.TARGET_RESIDUAL for entry in found.rejected)
    total = found.chi2 + found.agreement.chi2 + found.rejection.limit * rejected
    return WithoutHead(head=head, chi2=total, dof=found.dof + found.agreement.dof)


def _calibrated(strips: Sequence[StripSightings], start: _Start) -> InstallationEstimate | NotObservable:
    """The estimate from passes, about the alignments of heads that the attitudes measure or, of heads that
    were never on together with another, that the targets show.
    """
    strips = aligned(strips, {head: measured_alignment(strips, head) for head in unknown_heads(strips)})
    found = _about(strips, start)
    for _ in range(MOST_ALIGNMENTS):
        if isinstance(found, NotObservable):
            break
        better = {head.name: found.heads[0].R_cs.inv() * head.R_cs for head in found.heads}
        if largest_turn(strips, better) < NEGLIGIBLE_TURN_RAD:
            break
        strips = aligned(strips, better)
        found = _about(strips, start)
    return found


def _about(strips: Sequence[StripSightings], start: _Start) -> InstallationEstimate | NotObservable:
    """The estimate about the alignments of heads that the strips assume."""
    R_cs0, settings = start.R_cs0, start.settings
    posed = Posed.of(start.strips, strips, settings, start.further, start.cameras, start.prior)
    of_heads, prepared, problem = posed.passes, posed.prepared, posed.problem
    test = rejection_test(settings.probability_false_alarm)
    if not problem.groups:
        return NotObservable(
            reason=f"{len(strips)} strips, none with a target between usable star exposures",
            directions_c=np.eye(3),
            rejected=rejected_observations(of_heads, prepared, test.limit),
        )
    step, iterations, rivals = _solve(problem, R_cs0, test)
    residuals = _residuals(prepared, problem, step, rivals, test)
    rejected = rejected_observations(of_heads, prepared, test.limit, residuals)
    R_cs = corrected(step.about.R_cs, step.solution.theta)
    if len(step.solution.unobservable):
        return _not_observable(step.solution, rejected, problem)
    carrying = [strip for strip in prepared if strip.inside.any()]
    exposures = [strip.attitudes for strip in carrying]
    n_kept, n_theta = int(np.sum(step.weight > 0.0)), len(step.solution.theta)
    last, covariance = np.abs(step.solution.theta), step.solution.covariance_all
    known = 0 if problem.prior is None else int(np.linalg.matrix_rank(problem.prior.F[0]))
    heads, cov_heads = _heads(R_cs if R_cs.single else R_cs[0], strips, step)
    return InstallationEstimate(
        R_cs=R_cs,
        R_cs0=R_cs0,
        cameras=problem.cameras,
        theta=theta_of(R_cs, R_cs0),
        cov_theta=step.solution.covariance,
        chi2=step.chi2,
        dof=2 * (n_kept - len(residuals.doubtful)) - n_theta + known,
        chi2_stars=float(sum(one.chi2[one.usable].sum() for one in exposures)),
        dof_stars=int(sum(one.dof[one.usable].sum() for one in exposures)),
        n_strips=len({name for strip in carrying for name in strip.strip[strip.inside].tolist()}),
        n_exposures=int(sum(one.usable.sum() for one in exposures)),
        n_stars=sum(int(a.kept[a.stars(k)].sum()) for a in exposures for k in np.flatnonzero(a.usable)),
        n_targets=n_kept,
        iterations=iterations,
        converged_matrix=bool(np.linalg.norm(last) <= settings.tolerance_rad),
        converged_covariance=bool(np.all(last <= settings.tolerance_sigma * step.sigma)),
        rejected=rejected,
        pairs=step.pairs,
        prior_shared=problem.prior_shared,
        shared_values=step.solution.shared,
        shared_covariance=covariance[n_theta:, n_theta:],
        theta_with_shared=covariance[:n_theta, n_theta:],
        targets=residuals,
        rejection=test,
        agreement=problem.agreement,
        bias=common_bias(*step.found(BIASES), settings) if BIASES[0] in step.pairs.shared else None,
        references=tuple(one.offset(*step.found(one.names)) for one in problem.shared.references),
        periodic=periodic_errors(strips, step.pairs.shared, step.found),
        heads=heads,
        cov_heads=cov_heads,
        prior=problem.prior,
        posed=posed,
        taken_up=taken_up(problem, step, prepared, [head.name for head in heads[1:]]),
    )


def strip_pairs(
    strips: Sequence[StripSightings], R_cs: Rotation | Mapping[str, Rotation], settings: CalibrationSettings
) -> tuple[InformationPairs, Floats]:
    """Normal equations of each pass about `R_cs`, no target rejected, and the prior information (G, G) of
    the unknowns that passes share. `ValueError` where no strip has a target that exposures cover.
    """
    cameras, about = _matrices(strips, R_cs)
    problem = Posed.of(strips, passes_of(strips, settings.attitudes), settings, (), cameras).problem
    if not problem.groups:
        raise ValueError(f"{len(strips)} strips, none with a target between usable star exposures")
    step = solve_weighted(problem, linearised(problem, about), problem.inside.astype(float))
    return step.pairs, problem.prior_shared


def _solve(
    problem: Problem, R_cs0: Rotation, test: RejectionTest
) -> tuple[Step, tuple[Iteration, ...], dict[int, Ints]]:
    """Plain fit; then, if its residuals show gross errors, the search for them, and the fit to the rest: its
    last step, all iterations, and the rivals of targets that the search rejects or doubts.
    """
    kept, iterations = problem.inside, list[Iteration]()
    weight, rivals = kept.astype(float), dict[int, Ints]()
    step = _iterated(problem, R_cs0, weight, iterations)
    R_cs = step.about.R_cs
    if problem.settings.robust:
        if np.any(squared_mahalanobis(step)[kept] > GROSS):
            R_cs, kept = refine_geman_mcclure(problem, l1_start(problem, R_cs0), iterations)
        step = snoop(problem, linearised(problem, R_cs, step), kept, test.limit, step)
        weight, rivals = weigh(problem, step, test.limit)
    step = _iterated(problem, R_cs, weight, iterations, step)
    return step, tuple(iterations), rivals


def _iterated(
    problem: Problem, R_cs: Rotation, weight: Floats, iterations: list[Iteration], known: Step | None = None
) -> Step:
    """Gauss-Newton on the weighted targets until the correction vanishes, the first step being `known` where
    that is the same; the last step, about its matrix.
    """
    settings = problem.settings
    for _ in range(settings.most_iterations):
        step = solve_weighted(problem, linearised(problem, R_cs, known), weight, known)
        iterations.append(step.iteration)
        if np.linalg.norm(step.solution.theta) <= settings.tolerance_rad:
            break
        R_cs = corrected(R_cs, step.solution.theta)
    return step


def _residuals(
    prepared: Sequence[PreparedStrip],
    problem: Problem,
    step: Step,
    all_rivals: dict[int, Ints],
    test: RejectionTest,
) -> TargetResiduals:
    """Residuals of all targets in order of strips; NaN for targets that the exposures do not cover."""
    start = np.cumsum([0, *(len(strip.v_s) for strip in prepared)])
    rows = np.concatenate([np.arange(*start[s : s + 2]) for s in problem.members])
    weight, found = np.zeros(start[-1]), np.full((start[-1], 4), np.nan)
    ground = GroundSightings.together([strip.ground for strip in prepared])
    range_m = np.where(ground.is_star, np.nan, ground.range_m)
    weight[rows] = step.weight
    columns = squared_mahalanobis(step), detectable_bias(step, test.noncentrality), step.residual_c
    found[rows[problem.inside]] = np.column_stack(columns)[problem.inside]
    strip_id = np.concatenate([strip.strip for strip in prepared])
    order = np.argsort(strip_id, kind="stable")
    place = np.argsort(order)[rows]  # row of each target of the problem
    return TargetResiduals(
        strip_id=strip_id[order],
        camera=np.concatenate([strip.camera for strip in prepared])[order],
        **{name: getattr(ground, name)[order] for name in ("target_id", "ccd", "is_star")},
        sample=ground.xy_px[order, 0],
        residual_c=found[order, 2:],
        statistic=found[order, 0],
        weight=weight[order],
        detectable_rad=found[order, 1],
        detectable_m=(found[:, 1] * range_m)[order],
        rivals={int(place[j]): place[others] for j, others in all_rivals.items()},
    )


def _not_observable(solution: Solution, rejected: tuple[Entry, ...], problem: Problem) -> NotObservable:
    limit = problem.settings.sigma_observable_rad
    text = ", ".join(_axis(d.reshape(-1, 3), problem.cameras) for d in solution.unobservable)
    reason = (
        f"the rotation about {text} (frame c) is not observable: its 1-sigma would exceed {limit:.3g} rad; "
        f"targets spread wider over the field, or a star camera that looks another way, would show it"
    )
    return NotObservable(reason=reason, directions_c=solution.unobservable, rejected=rejected)


def _axis(d: Floats, cameras: tuple[str, ...]) -> str:
    """A direction (C, 3) in words: its part in the camera that it concerns most."""
    n = int(np.argmax(np.linalg.norm(d, axis=1)))
    return "[" + " ".join(f"{x:+.3f}" for x in d[n]) + "]" + (f" of {cameras[n]}" if cameras[n] else "")


def _heads(
    R_cs: Rotation, strips: Sequence[StripSightings], step: Step
) -> tuple[tuple[HeadInstallation, ...], Floats]:
    """The matrix of the reference head and those of the other heads, R_ch = R_cs exp(alpha) R_sh, with their
    covariance; of several cameras about the first, whose `R_cs` is given.
    """
    unknowns, covariance, C = step.pairs.unknowns, step.solution.covariance_all, R_cs.as_matrix()
    R_sh = {other.head: other.R_sh for strip in strips for other in strip.others}
    names = [head for head in unknown_heads(strips) if set(alignment_names(head)) <= set(unknowns)]
    # theta of head h is that of the reference head less C alpha (theta has the paper's sign).
    lift = np.tile(np.eye(3, len(unknowns)), (1 + len(names), 1))
    heads = [HeadInstallation(name="", R_cs=R_cs)]
    for n, name in enumerate(names, start=1):
        columns = [unknowns.index(one) for one in alignment_names(name)]
        lift[3 * n : 3 * n + 3, columns] = -C
        alpha = Rotation.from_rotvec(step.found(alignment_names(name))[0])
        heads.append(HeadInstallation(name=name, R_cs=R_cs * alpha * R_sh[name]))
    return tuple(heads), lift @ covariance @ lift.T
