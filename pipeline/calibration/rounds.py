"""Rounds of a calibration: matching and estimation from a matrix, the first from that before launch, each
further one from the estimate before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.geometry.ledger import Entry, Kind, Reason, Subject
from boresight.geometry.record import array, record, scalar
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.matchings import match_again, match_first
from boresight.pipeline.diagnosis.causes import cause_of_no_result
from boresight.pipeline.diagnosis.input_findings import shifted_chips
from boresight.pipeline.diagnosis.missing import what_is_missing
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.basis import Basis
from boresight.pipeline.stages.coverage import stated_mountings
from boresight.pipeline.stages.sky_side import SkySide, name_in_sky_strips, named_sightings
from boresight.pipeline.stages.sky_strip import NamedStars, as_matched
from boresight.pipeline.stages.strip import MatchedTargets, StripTask
from boresight.pipeline.stages.strip_tasks import matched_strips, strip_tasks

__all__ = ["Round", "first_and_last_round", "unused_so_far"]

Array = NDArray[np.float64]


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
    computed: tuple[bool, ...] = scalar("which matchings had to be computed")

    @property
    def observed(self) -> tuple[MatchedTargets, ...]:
        """Targets of the strips of the ground, and named stars of those of the sky."""
        return (*self.matched, *map(as_matched, self.named))


def first_and_last_round(basis: Basis, sky: SkySide) -> tuple[Round, Round, list[bool]]:
    """The first round, from the pre-launch matrix, and the last, each from the estimate before it; and which
    matchings of all rounds had to be computed. `DataNotSufficientError` where the data do not determine all
    three angles.
    """
    start = basis.dump.R_cs0, basis.dump.sigma_installation_rad
    mountings = stated_mountings(basis.heads)
    first = last = _one_round(1, None, basis, sky, start, mountings)
    computed = list(first.computed)
    for number in range(2, basis.settings.run.rounds + 1):
        if not (last.named or any(task.targets for task in last.tasks)):
            break  # measured image points alone: no matrix moves them
        start = last.estimate.R_cs, _rematch_sigma(last.estimate, basis.settings)
        mountings |= {one.name: one.R_cs for one in last.estimate.with_reference(basis.reference).heads}
        last = _one_round(number, last, basis, sky, start, mountings)
        computed += last.computed
    return first, last, computed


def _one_round(
    number: int,
    before: Round | None,
    basis: Basis,
    sky: SkySide,
    start: tuple[Rotation, Array],
    mountings: Mapping[str, Rotation],
) -> Round:
    """Round `number`, from 1, from the matrix `start` and its 1-sigma (3,), and from those of all heads;
    `before` is the round before.
    """
    dump, heads, settings = basis.dump, basis.heads, basis.settings

    def start_from(task: StripTask, matched: MatchedTargets) -> tuple[Rotation, Array] | None:
        strips = matched_strips([task], [matched], heads)
        alone = calibrate_strips(strips, dump.R_cs0, basis.errors) if strips else None
        if not isinstance(alone, InstallationEstimate):
            return None
        return alone.R_cs, _rematch_sigma(alone, settings)

    tasks, uncovered = strip_tasks(dump, heads, *start, mountings, settings)
    if number == 1:
        tasks, matched, flags = match_first(tasks, start_from, basis.runner)
    else:
        known, folder = before.matched if before else (), f"matching-{number}"
        tasks = [replace(task, is_known=True) for task in tasks]
        matched, flags = match_again(tasks, known, settings.run.settled_px, basis.runner, folder)
    sky = sky.aligned(heads, mountings)
    named = name_in_sky_strips(dump, sky, *start, known=number > 1)
    strips = [*matched_strips(tasks, matched, heads), *named_sightings(sky, named, heads)]
    estimate = calibrate_strips(strips, dump.R_cs0, basis.errors)
    unmatched = [omission for one in matched for omission in one.omissions]
    unnamed = [omission for one in named for omission in one.omissions]
    if isinstance(estimate, NotObservable):
        known_so_far = [*unused_so_far(basis, sky), *uncovered, *unnamed]
        text = what_is_missing(estimate, dump, settings, heads[0], tasks, matched, known_so_far)
        seen = strips or (before.strips if before else ())  # names that the strips together took away
        shifted = next(shifted_chips(dump, unmatched), None)
        if cause := shifted or cause_of_no_result(basis, sky, seen, tasks):
            text = f"{cause.cause}, {cause.item}: {cause.text} Otherwise: {text}"
        raise DataNotSufficientError(text, [*known_so_far, *unmatched])
    return Round(
        estimate=estimate,
        tasks=tuple(tasks),
        matched=tuple(matched),
        sky=sky,
        named=tuple(named),
        strips=tuple(strips),
        omissions=(*uncovered, *unmatched, *_without_targets(matched), *unnamed),
        computed=tuple(flags),
    )


def unused_so_far(basis: Basis, sky: SkySide) -> list[Entry]:
    """What was left out before a strip was matched."""
    of_heads = [omission for head in basis.heads for omission in head.omissions]
    return [*basis.dump.omissions, *of_heads, *sky.omissions]


def _rematch_sigma(estimate: InstallationEstimate, settings: Settings) -> Array:
    return np.sqrt(np.diag(estimate.cov_theta) + settings.run.rematch_sigma_rad**2)


def _without_targets(matched: Iterable[MatchedTargets]) -> list[Entry]:
    return [
        Entry(Subject(Kind.STRIP, strip=m.strip_id), Reason.NO_TARGET, "no target was matched in it")
        for m in matched
        if not len(m.target_id)
    ]
