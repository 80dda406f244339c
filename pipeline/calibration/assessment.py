"""The verdict on a calibration and the findings about the dump's inputs, with the strips that these rest on:
all that was measured in them, what was left out too.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from boresight.calib.estimate import InstallationEstimate
from boresight.calib.finding import Finding
from boresight.calib.moved_input import MovedInput
from boresight.calib.reliability import Reliability
from boresight.calib.verdict import CheckKind, Verdict, assess
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.passes import Pass
from boresight.pipeline.diagnosis.causes import examined, wrong_convention
from boresight.pipeline.diagnosis.earth_table import EarthTableCheck, check_earth_table, earth_findings
from boresight.pipeline.diagnosis.exchanged_exposures import exchanged_exposures
from boresight.pipeline.diagnosis.exchanged_files import (
    exchanged_in_ground,
    exchanged_in_sky,
    exchanged_strips,
)
from boresight.pipeline.diagnosis.input_findings import assumed_motion, input_findings
from boresight.pipeline.diagnosis.left_out import counts_of, lost_ccds, searched_alone, with_left_out
from boresight.pipeline.diagnosis.loss_groups import LookedFor
from boresight.pipeline.diagnosis.missing import targets_out_of_view
from boresight.pipeline.diagnosis.moved_inputs import moved_inputs
from boresight.pipeline.diagnosis.sky_losses import (
    displaced_stars,
    named_alone,
    sky_counts,
    sky_looked_for,
    strips_without_stars,
    without_stars,
)
from boresight.pipeline.diagnosis.target_findings import (
    lost_parts,
    lost_stars,
    lost_targets,
    single_targets,
    suspected_targets,
)
from boresight.pipeline.errors import Omission
from boresight.pipeline.files.dump import bundled_table
from boresight.pipeline.stages.basis import Basis
from boresight.pipeline.stages.sky_side import SkySide, named_sightings
from boresight.pipeline.stages.sky_strip import NamedStars
from boresight.pipeline.stages.strip import contradicting_targets
from boresight.pipeline.stages.strip_tasks import matched_strips

__all__ = ["Assessment", "assessed"]


@dataclass(frozen=True)
class Assessment:
    """What is said of a calibration, and what that rests on."""

    verdict: Verdict  # with all findings
    earth_table: EarthTableCheck
    sighted: tuple[StripSightings, ...]  # the strips with what was measured in them and left out
    inputs: tuple[MovedInput, ...]  # what further inputs do to these, by prediction


def assessed(
    basis: Basis, first: Pass, last: Pass, found: InstallationEstimate, omissions: Sequence[Omission]
) -> Assessment:
    """The verdict on the estimate `found` of the last pass. `omissions` are all of the calibration."""
    dump = basis.dump
    looked_for = sky_looked_for(dump, last.sky, last.named, found.R_cs)
    sighted = _sighted(basis, first, last, looked_for)
    inputs = moved_inputs(dump, sighted, last.tasks)
    reliability = examined(basis, found, sighted, basis.errors, inputs)
    of_inputs = [
        *targets_out_of_view(dump, last.tasks, last.matched),
        *input_findings(dump, last.tasks, omissions),
    ]
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
    earth = check_earth_table(dump.orbit, dump.earth_table, bundled_table())
    findings = [
        *_explanations(basis, last, found, verdict, reliability, looked_for),
        *of_inputs,
        *assumed_motion(last.strips, basis.errors),
        *earth_findings(earth, dump.earth_file),
    ]
    return Assessment(verdict.with_findings(findings), earth, sighted, inputs)


def _sighted(
    basis: Basis, first: Pass, last: Pass, looked_for: Sequence[LookedFor]
) -> tuple[StripSightings, ...]:
    """The strips of the last pass, with all that was measured in them by any search, each by itself too."""
    dump, heads = basis.dump, basis.heads
    stars = sky_counts(last.sky, looked_for)
    alone = searched_alone(last.tasks, lost_ccds(counts_of(last.matched)), dump.sigma_installation_rad)
    tasks = {task.strip.strip_id: task for task in last.tasks}
    parts = (
        (last.tasks, [contradicting_targets(one) for one in last.matched]),
        (last.tasks, first.matched),
        ([tasks[one.strip_id] for one in alone], alone),
    )
    more = [strip for of_tasks, matched in parts for strip in matched_strips(of_tasks, matched, heads)]
    more += named_sightings(last.sky, first.named, heads)
    alone_in_sky = {one.strip_id: one for one in named_alone(dump, last.sky, stars)}
    side = _of_strips(last.sky, list(alone_in_sky.values()))
    more += named_sightings(side, [alone_in_sky[task.strip.strip_id] for task in side.tasks], heads)
    displaced = displaced_stars(dump, last.sky, last.named, stars, last.estimate.R_cs)
    more += named_sightings(_of_strips(last.sky, displaced), displaced, heads)
    return with_left_out(last.strips, more)


def _of_strips(sky: SkySide, named: Sequence[NamedStars]) -> SkySide:
    """The strips of the sky that are among `named`."""
    ids = {one.strip_id for one in named}
    rows = [n for n, task in enumerate(sky.tasks) if task.strip.strip_id in ids]
    return replace(sky, tasks=tuple(sky.tasks[n] for n in rows), found=tuple(sky.found[n] for n in rows))


def _explanations(
    basis: Basis,
    last: Pass,
    estimate: InstallationEstimate,
    verdict: Verdict,
    reliability: Reliability,
    looked_for: Sequence[LookedFor],
) -> list[Finding]:
    """Exposures that are exchanged and a convention that is wrong; without either, what `_target_findings`
    says.
    """
    exchanged = exchanged_exposures(basis.dump, basis.heads)
    convention = None
    if any(not check.holds for check in verdict.checks if check.kind is CheckKind.START_MATRIX):
        convention = wrong_convention(basis)
    if convention or exchanged:
        return [*exchanged, *([convention] if convention else [])]
    return _target_findings(basis, last, estimate, reliability, verdict.findings, looked_for)


def _target_findings(
    basis: Basis,
    last: Pass,
    estimate: InstallationEstimate,
    reliability: Reliability,
    told: Sequence[Finding],
    looked_for: Sequence[LookedFor],
) -> list[Finding]:
    """Targets and stars that contradict the rest or were not found, and that no common cause
    `told` explains.
    """
    items = [one.item for one in told]
    strips = {name.rpartition("/")[0] for one in told for name in one.targets}
    suspected = suspected_targets(reliability.suspects, estimate.R_cs, last.tasks, last.matched)
    images = {task.strip.strip_id: task.strip.images for task in last.sky.tasks}
    stars = sky_counts(last.sky, looked_for)
    strips_exchanged = list(exchanged_strips(last.tasks, last.matched))
    exchanged = [
        *strips_exchanged,
        *exchanged_in_ground(last.tasks, last.matched),
        *exchanged_in_sky(basis.dump, last.sky, last.named, stars, estimate.R_cs),
    ]
    items += [ccd for one in exchanged for ccd in re.findall(r"CCD \d+", one.item)]
    if any(one.refutes for one in told):  # what is off or lost under a wrong matrix accuses nothing else
        return exchanged
    apart = {key: count for key, count in stars.items() if f"strip {key[0]}" not in items}
    parts = list(lost_parts(last.tasks, last.matched, looked_for, estimate.R_cs, items))
    items += [ccd for one in parts for ccd in re.findall(r"CCD \d+", one.item)]
    return [
        *exchanged,
        *parts,
        *single_targets(list(suspected), counts_of(last.matched), is_explained=bool(told)),
        *(() if strips_exchanged else lost_targets(last.tasks, last.matched, items)),
        *lost_stars(images, apart, without_stars(apart), items),
        *strips_without_stars(basis.dump, last.sky, last.named, stars, strips),
    ]
