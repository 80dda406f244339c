"""Rounds of a calibration: matching and estimation from a matrix, the first from that before launch, each
further one from the estimate before it.

A search as wide as the pre-launch matrix is uncertain decodes whole strips. All strips have one matrix: they
are searched one after another until one determines it, and the others start from there. A strip in which
nothing is found that way is searched as widely as the first. It is matched again where its templates were
predicted less well than a later matching predicts them, or where a target was refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.diagnosis.input_findings import shifted_chips
from boresight.pipeline.diagnosis.missing import cause_of_no_result, what_is_missing
from boresight.pipeline.diagnosis.unused_rows import unseen_targets
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.coverage import stated_mountings
from boresight.pipeline.stages.head import Basis
from boresight.pipeline.stages.observed_strips import sighted_strips
from boresight.pipeline.stages.sky_side import SkySide, name_in_sky_strips
from boresight.pipeline.stages.sky_strip import NamedStars, as_matched
from boresight.pipeline.stages.strip import (
    MatchedTargets,
    StripTask,
    match_strip_targets,
    predicted_again,
    with_points,
)
from boresight.pipeline.stages.strip_tasks import strip_tasks
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Floats, array, record, scalar

__all__ = [
    "Measured",
    "Round",
    "first_and_last_round",
    "is_settled",
    "match_again",
    "match_first",
    "match_strips",
    "unused_so_far",
]

Measured = tuple[MatchedTargets | NamedStars, ...]
Start = tuple[Rotation, Floats]  # a matrix and its 1-sigma (3,), rad, axes of c


def match_strips(tasks: Sequence[StripTask], runner: StageRunner, folder: str) -> list[MatchedTargets]:
    """Targets matched in strips."""
    outcomes = runner.run(match_strip_targets, tasks, folder=folder, in_parts=True)
    return [with_points(one, task.points) for task, one in zip(tasks, outcomes)]


def match_first(
    tasks: Sequence[StripTask],
    start_from: Callable[[StripTask, MatchedTargets], Start | None],
    runner: StageRunner,
) -> tuple[list[StripTask], list[MatchedTargets]]:
    """Tasks as they were matched, and targets matched in them.

    `start_from` gives the matrix that one strip determines.
    """
    if not any(task.targets for task in tasks[1:]):  # nothing that a better matrix would find
        return list(tasks), match_strips(tasks, runner, "matching-0")
    matched: list[MatchedTargets] = []
    start = None
    while start is None and len(matched) < len(tasks):
        task = tasks[len(matched)]
        matched += match_strips([task], runner, "matching-0")
        start = start_from(task, matched[-1])
    n = len(matched)
    if start is None or n == len(tasks):
        return list(tasks), matched
    R_cs, sigma = start
    near = [replace(task, R_cs=R_cs, sigma_installation_rad=sigma, is_known=True) for task in tasks[n:]]
    used, matched = [*tasks[:n], *near], matched + match_strips(near, runner, "matching-1")
    if missed := [k for k, one in enumerate(matched) if k >= n and not len(one.target_id)]:
        for k, one in zip(missed, match_strips([tasks[k] for k in missed], runner, "matching-0")):
            used[k], matched[k] = tasks[k], one
    return used, matched


def match_again(
    tasks: Sequence[StripTask],
    before: Sequence[MatchedTargets],
    settled_px: float,
    runner: StageRunner,
    folder: str,
) -> list[MatchedTargets]:
    """Targets matched in strips.

    Settled strips of the matching `before`, in any order, stay as they are (`is_settled`).
    """
    settled = {one.strip_id: one for one in before if is_settled(one, settled_px)}
    open_tasks = [task for task in tasks if task.strip.strip_id not in settled]
    again = {one.strip_id: one for one in match_strips(open_tasks, runner, folder)} if open_tasks else {}
    return [
        predicted_again(settled[name], task) if (name := task.strip.strip_id) in settled else again[name]
        for task in tasks
    ]


def is_settled(matched: MatchedTargets, settled_px: float) -> bool:
    """Whether all targets in view were placed, each within `settled_px` of where its template was predicted.

    Another matching gives positions as good as these, with other errors of half a sigma.
    """
    return not matched.omissions and 0.0 < matched.farthest_px <= settled_px


@record(kw_only=True)
class Round:
    """Matching and estimation from one matrix."""

    estimate: InstallationEstimate = scalar("installation matrix")
    tasks: tuple[StripTask, ...] = array("S", "strips that were matched")
    matched: tuple[MatchedTargets, ...] = array("S", "their targets")
    sky: SkySide = scalar("strips of the sky, their attitudes in frame s by the heads' matrices")
    named: tuple[NamedStars, ...] = scalar("named stars of the strips of the sky")
    strips: tuple[StripSightings, ...] = scalar("those that the estimate is made from, ground first")
    omissions: tuple[Entry, ...] = scalar("strips, targets and stars that are not used")

    @property
    def observed(self) -> tuple[MatchedTargets, ...]:
        """Targets of the strips of the ground, and named stars of those of the sky."""
        return (*self.matched, *map(as_matched, self.named))


def first_and_last_round(basis: Basis, sky: SkySide) -> tuple[Measured, Round]:
    """What the first round measures, from the pre-launch matrix, and the last, each from the estimate before.
    `DataNotSufficientError` where the data do not determine all three angles.
    """
    start = basis.dump.R_cs0, basis.dump.sigma_installation_rad
    mountings = stated_mountings(basis.heads)
    last = _one_round(1, None, basis, sky, start, mountings)
    first: Measured = (*last.matched, *last.named)
    for number in range(2, basis.settings.run.rounds + 1):
        if not (last.named or any(task.targets for task in last.tasks)):
            break  # measured image points alone: no matrix moves them
        start = last.estimate.R_cs, _rematch_sigma(last.estimate, basis.settings)
        mountings |= {one.name: one.R_cs for one in last.estimate.with_reference(basis.reference).heads}
        last = _one_round(number, last, basis, sky, start, mountings)
    return first, last


def _one_round(
    number: int,
    before: Round | None,
    basis: Basis,
    sky: SkySide,
    start: Start,
    mountings: Mapping[str, Rotation],
) -> Round:
    """Round `number` from the matrix `start` and those of all heads; `before`: the one before it, if any."""
    dump, heads, settings = basis.dump, basis.heads, basis.settings

    def start_from(task: StripTask, matched: MatchedTargets) -> Start | None:
        strips = sighted_strips([task], [matched], heads)
        alone = calibrate_strips(strips, dump.R_cs0, basis.errors) if strips else None
        if not isinstance(alone, InstallationEstimate):
            return None
        return alone.R_cs, _rematch_sigma(alone, settings)

    tasks, uncovered = strip_tasks(dump, heads, *start, mountings, settings)
    if before is None:
        tasks, matched = match_first(tasks, start_from, basis.runner)
    else:
        tasks, settled_px = [replace(task, is_known=True) for task in tasks], settings.run.settled_px
        matched = match_again(tasks, before.matched, settled_px, basis.runner, f"matching-{number}")
    sky = sky.aligned(heads, mountings)
    named = name_in_sky_strips(dump, sky, *start, known=before is not None)
    strips = sighted_strips([*tasks, *sky.tasks], [*matched, *named], heads)
    estimate = calibrate_strips(strips, dump.R_cs0, basis.errors)
    unmatched = [omission for one in matched for omission in one.omissions]
    unnamed = [omission for one in named for omission in one.omissions]
    if isinstance(estimate, NotObservable):
        known_so_far = [*unused_so_far(basis, sky), *uncovered, *unnamed]
        text = what_is_missing(estimate, basis, tasks, matched, known_so_far)
        seen = strips or (before.strips if before else ())  # names that the strips together took away
        shifted = next(shifted_chips(dump, [*unmatched, *unseen_targets(dump, tasks, matched)]), None)
        if cause := shifted or cause_of_no_result(basis, sky, seen, tasks, matched):
            text = f"{cause.cause}, {cause.item}: {cause.text} Otherwise: {text}"
        raise DataNotSufficientError(text, [*known_so_far, *unmatched])
    without_targets = [
        Entry(Subject(Kind.STRIP, strip=one.strip_id), Reason.NO_TARGET, "no target was matched in it")
        for one in matched
        if not len(one.target_id)
    ]
    return Round(
        estimate=estimate,
        tasks=tuple(tasks),
        matched=tuple(matched),
        sky=sky,
        named=tuple(named),
        strips=tuple(strips),
        omissions=(*uncovered, *unmatched, *without_targets, *unnamed),
    )


def unused_so_far(basis: Basis, sky: SkySide) -> list[Entry]:
    """What was left out before a strip was matched."""
    of_heads = [omission for head in basis.heads for omission in head.omissions]
    return [*basis.dump.omissions, *of_heads, *sky.omissions]


def _rematch_sigma(estimate: InstallationEstimate, settings: Settings) -> Floats:
    return np.sqrt(np.diag(estimate.cov_theta) + settings.run.rematch_sigma_rad**2)
