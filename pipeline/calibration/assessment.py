"""The verdict on a calibration and the findings about the dump's inputs, with the strips that these rest on:
all that was measured in them, what was left out too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from boresight.calib.estimate import InstallationEstimate
from boresight.calib.finding import Finding
from boresight.calib.hypotheses import MovedInput
from boresight.calib.reliability import Reliability
from boresight.calib.verdict import CheckKind, Verdict, assess
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.rounds import Measured, Round
from boresight.pipeline.diagnosis import input_findings, losses, readings
from boresight.pipeline.diagnosis.missing import wrong_convention
from boresight.pipeline.diagnosis.moved_inputs import examined, moved_inputs
from boresight.pipeline.diagnosis.suspects import MeasuredTargets, single_targets
from boresight.pipeline.files.orbit_and_earth import bundled_table
from boresight.pipeline.stages.head import Basis
from boresight.pipeline.stages.observed_strips import sighted_strips
from boresight.pipeline.stages.sky_strip import NamedStars, as_matched
from boresight.pipeline.stages.strip import MatchedTargets, contradicting_targets
from boresight.records.ledger import Entry, Kind, Ledger
from boresight.records.record import Ints

__all__ = ["Assessment", "assessed"]


@dataclass(frozen=True)
class Assessment:
    """What is said of a calibration, and what that rests on."""

    verdict: Verdict  # with all findings
    earth_table: input_findings.EarthTableCheck
    sighted: tuple[StripSightings, ...]  # the strips with what was measured in them and left out
    inputs: tuple[MovedInput, ...]  # what further inputs do to these, by prediction


def assessed(
    basis: Basis, first: Measured, last: Round, found: InstallationEstimate, omissions: Sequence[Entry]
) -> Assessment:
    """The verdict on the estimate `found` of the last round. `omissions` are all of the calibration."""
    dump = basis.dump
    targets = losses.ground_ledger(last.tasks, last.matched, found.R_cs)
    stars = losses.star_ledger(dump, last.sky, last.named, found.R_cs)
    sighted = _sighted(basis, first, last, targets, stars)
    inputs = moved_inputs(dump, sighted)
    reliability = examined(basis, found, sighted, basis.errors, inputs)
    of_attitudes = basis.of_attitudes
    of_inputs = [*of_attitudes, *input_findings.input_findings(basis, last.tasks, last.matched, omissions)]
    of_inputs += losses.repeated_lines(last.tasks)
    if any(one.refutes for one in of_inputs):  # places measured with a wrong input accuse no other one
        reliability = replace(reliability, findings=(), suspects=())
    verdict = assess(
        found,
        last.strips,
        basis.settings.verdict,
        sigma_installation_rad=dump.sigma_installation_rad,
        reliability=reliability,
        target_files=dump.target_files,
    )
    of_stars = [
        it for it in verdict.refuted_by if it.kind in (CheckKind.STAR_RESIDUALS, CheckKind.STARS_REJECTED)
    ]
    if of_stars:  # places by wrong attitudes accuse no single target
        reliability = replace(reliability, suspects=())
    earth = input_findings.check_earth_table(dump.orbit, dump.earth_table, bundled_table())
    start_fails = any(check.fails for check in verdict.checks if check.kind is CheckKind.START_MATRIX)
    convention = wrong_convention(basis) if start_fails else None
    explanations = [convention] if convention else list[Finding]()
    if any(one.refutes for one in (*of_attitudes, *explanations)):  # what follows accuses no other input
        verdict = replace(verdict, findings=())
    else:
        explanations = _explanations(basis, last, found, verdict, reliability, (targets, stars))
    if of_attitudes:  # by which heads contradict one another, and which move all CCDs of a strip alike
        others = (one for one in verdict.findings if {it.kind for it in one.subjects} != {Kind.HEAD})
        verdict = replace(verdict, findings=tuple(others))
        explanations = [one for one in explanations if one.refutes and one.subjects]
        explanations = [one for one in explanations if all(it.kind is Kind.CCD for it in one.subjects)]
    lost = {subject.strip for one in explanations for subject in one.subjects}
    noise = reliability.scatter  # where stars or strips are wrong, points scatter as a consequence
    if noise and (of_stars or {one.strip for one in noise.subjects} & lost - {""}):
        verdict = replace(verdict, findings=tuple(one for one in verdict.findings if one is not noise))
    findings = [
        *explanations,
        *of_inputs,
        *input_findings.assumed_motion(last.strips, basis.errors),
        *input_findings.earth_findings(earth, dump.earth_file, dump.ground_targets.values()),
    ]
    return Assessment(verdict.with_findings(findings), earth, sighted, inputs)


def _sighted(
    basis: Basis, first: Measured, last: Round, targets: Ledger, stars: Ledger
) -> tuple[StripSightings, ...]:
    """The strips of the last round, with all that was measured in them by any search, each by itself too.
    The ledgers hold the `targets` and the bright `stars` that they must show.
    """
    dump, heads = basis.dump, basis.heads
    known = {
        (strip.strip_id, name, ccd)
        for strip in last.strips
        for name, ccd in zip(strip.ground.target_id.tolist(), strip.ground.ccd.tolist())
    }

    def new(one: MatchedTargets | NamedStars) -> Ints:
        measured = as_matched(one) if isinstance(one, NamedStars) else one
        keys = [(one.strip_id, *key) for key in zip(measured.target_id.tolist(), measured.ccd.tolist())]
        rows = [n for n, key in enumerate(keys) if key not in known]
        known.update(keys)
        return np.array(rows, dtype=np.int64)

    measured: Measured = (
        *map(contradicting_targets, last.matched),
        *first,
        *losses.searched_alone(last.tasks, losses.lost_ccds(targets), dump.sigma_installation_rad),
        *losses.named_alone(dump, last.sky, last.named, stars),
        *losses.displaced_stars(dump, last.sky, last.named, stars, last.estimate.R_cs),
    )
    left_out = [one.take(new(one)) for one in measured]
    return losses.with_left_out(last.strips, sighted_strips([*last.tasks, *last.sky.tasks], left_out, heads))


def _explanations(
    basis: Basis,
    last: Round,
    estimate: InstallationEstimate,
    verdict: Verdict,
    reliability: Reliability,
    ledgers: tuple[Ledger, Ledger],
) -> list[Finding]:
    """Targets and stars that contradict the rest or were not found, and that no common cause of the verdict
    explains.
    """
    told = verdict.findings
    targets, stars = ledgers
    noise = reliability.scatter  # larger errors lose no observation
    explained = [subject for finding in told if finding is not noise for subject in finding.subjects]
    strips_told = {subject.strip for finding in told for subject in finding.explains}
    strips = [*(task.strip for task in last.tasks), *(task.strip for task in last.sky.tasks)]
    images = {strip.strip_id: strip.images for strip in strips}
    strips_exchanged = list(readings.exchanged_strips(last.tasks, last.matched))
    strips_exchanged = strips_exchanged or list(readings.reversed_in_ground(last.tasks, last.matched))
    exchanged = [
        *strips_exchanged,
        *readings.exchanged_in_ground(last.tasks, last.matched, targets),
        *readings.exchanged_in_sky(basis.dump, last.sky, last.named, stars, estimate.R_cs),
    ]
    lost = {*targets.subjects(~targets.found), *stars.subjects(~stars.found)}
    moves_all = (one for one in told if not one.subjects or one.subjects[0].kind is Kind.HEAD)
    if any(one.refutes for one in told) or any(lost & set(one.explains) for one in moves_all):
        return exchanged  # what is off or lost under a wrong matrix, or with a wrong input, accuses nothing
    explained += [subject for finding in exchanged for subject in finding.subjects]
    parts = [
        *losses.lost_groups(targets.take(~targets.within(explained)), losses.OF_TARGETS),
        *losses.lost_groups(stars.take(~stars.within(explained)), losses.OF_STARS),
    ]
    ccds = [subject for part in parts for subject in part.subjects if subject.kind is Kind.CCD]
    entries = [entry for strip in last.matched for entry in strip.omissions]
    suspected = list[Finding]()
    if reliability.suspects:
        measured = MeasuredTargets.of(last.tasks, last.matched, estimate.R_cs)
        suspected += single_targets(reliability.suspects, measured, targets, is_explained=bool(told))
    return [
        *exchanged,
        *parts,
        *suspected,
        *(() if strips_exchanged else losses.lost_targets(images, entries, targets, [*explained, *ccds])),
        *losses.lost_stars(images, stars, [*explained, *ccds]),
        *readings.strips_without_stars(basis.dump, last.sky, last.named, stars, strips_told),
    ]
