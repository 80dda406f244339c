"""From an open dump to the installation matrix: the whole calculation on one screen.

    each exposure -> identified stars (`sight_exposure`)     each strip -> matched targets (`match_targets`)
    each strip of the sky -> detections (`find_sky_stars`) -> named stars (`name_sky_stars`)
    stars + matched targets, named stars -> StripSightings -> calib.calibrate -> R_cs
    matching and estimation once more with that R_cs, of strips whose templates were not predicted as well

With a store, finished work is on disk. In whatever order tasks finish, sums are made in the order of time and
id, so the result is the same bit for bit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.finding import Finding
from boresight.calib.moved_input import MovedInput
from boresight.calib.reliability import Reliability, examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import CheckKind, Verdict, assess
from boresight.geometry.line_camera import LineCamera, LineSensor
from boresight.geometry.record import array, record, scalar
from boresight.geometry.sightings import ExposureAttitudes, StarSightings, StripSightings
from boresight.pipeline.errors import Cause, DataNotSufficientError, Omission
from boresight.pipeline.files.dump import Dump, bundled_table, surface_of
from boresight.pipeline.files.ground_points import NO_POINTS
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.run.unit_store import UnitStore
from boresight.pipeline.stages.cached import Progress, StageRunner
from boresight.pipeline.stages.conventions import likely_convention, sees_its_targets
from boresight.pipeline.stages.coverage import attitudes_in_s, carriers, covered_strips, stated_mountings
from boresight.pipeline.stages.earth_table import EarthTableCheck, check_earth_table, earth_findings
from boresight.pipeline.stages.exchanged_exposures import exchanged_exposures
from boresight.pipeline.stages.exchanged_files import exchanged_in_ground, exchanged_in_sky, exchanged_strips
from boresight.pipeline.stages.head import HeadSightings, sight_head
from boresight.pipeline.stages.input_findings import assumed_motion, input_findings, shifted_chips
from boresight.pipeline.stages.left_out import Counts, counts_of, lost_ccds, searched_alone, with_left_out
from boresight.pipeline.stages.loss_groups import LookedFor
from boresight.pipeline.stages.matchings import match_again, match_first
from boresight.pipeline.stages.missing import targets_out_of_view, what_is_missing
from boresight.pipeline.stages.moved_inputs import moved_inputs
from boresight.pipeline.stages.point_slips import without_hidden_points
from boresight.pipeline.stages.reasons import rejection_reason
from boresight.pipeline.stages.repeated_targets import targets_once
from boresight.pipeline.stages.sky_losses import (
    displaced_stars,
    named_alone,
    reversed_strips,
    sky_counts,
    sky_looked_for,
    strips_without_stars,
    without_stars,
)
from boresight.pipeline.stages.sky_side import (
    SkySide,
    find_in_sky_strips,
    name_in_sky_strips,
    named_sightings,
)
from boresight.pipeline.stages.sky_strip import NamedStars, as_matched
from boresight.pipeline.stages.strip import (
    MatchedTargets,
    StripTask,
    contradicting_targets,
    ground_sightings,
    orbit_around,
    targets_near,
)
from boresight.pipeline.stages.strip_sightings import strip_sightings
from boresight.pipeline.stages.target_findings import (
    lost_parts,
    lost_stars,
    lost_targets,
    single_targets,
    suspected_targets,
)
from boresight.pipeline.stages.unused_rows import Rows, rows_used, unused_rows

__all__ = ["DumpCalibration", "calibrate_dump", "rejections_of", "strips_to_match", "strips_with_stars"]

Array = NDArray[np.float64]


@record(kw_only=True)
class DumpCalibration:
    """Everything that a calibration found, ready to be written or drawn."""

    estimate: InstallationEstimate = scalar("installation matrix with covariance and statistics")
    verdict: Verdict = scalar("whether the data contradict themselves")
    earth_table: EarthTableCheck = scalar("how well the Earth orientation is known at the dump's date")
    stars: tuple[StarSightings, ...] = array("K", "all identified exposures, in order of time")
    attitudes: ExposureAttitudes = scalar("attitudes of the same exposures")
    tasks: tuple[StripTask, ...] = array("S", "strips of the last matching")
    matched: tuple[MatchedTargets, ...] = array("S", "targets matched in the same strips")
    sky: SkySide = scalar("strips of the sky with their detections")
    named: tuple[NamedStars, ...] = scalar("named stars of the same strips")
    strips: tuple[StripSightings, ...] = scalar("those that the estimate is made from, ground first")
    sighted: tuple[StripSightings, ...] = scalar("the same, with what was measured and left out")
    inputs: tuple[MovedInput, ...] = scalar("what further inputs do to the sighted strips, by prediction")
    settings: CalibrationSettings = scalar("of the estimate, with the dump's stated errors")
    omissions: tuple[Omission, ...] = scalar("everything that is not used, with reasons")
    rows: tuple[Rows, ...] = scalar("how many rows of each table the estimate depends on")
    n_computed: int = scalar("exposures and strips that were computed in this run")
    n_reused: int = scalar("those that were read from the store")

    @property
    def camera(self) -> LineSensor:
        """Model of the remote-sensing camera."""
        return self.tasks[0].camera if self.tasks else self.sky.tasks[0].camera

    @property
    def observed(self) -> tuple[MatchedTargets, ...]:
        """Targets of the strips of the ground, and named stars of those of the sky."""
        return (*self.matched, *map(as_matched, self.named))

    @property
    def ground_strips(self) -> tuple[StripSightings, ...]:
        """The strips of the ground."""
        return tuple(strip for strip in self.strips if not strip.ground.is_star.any())


def calibrate_dump(
    dump: Dump,
    settings: Settings | None = None,
    store: UnitStore | None = None,
    executor: Executor | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> DumpCalibration:
    """Installation matrix of a dump, estimated from its raw images.

    Parameters
    ----------
    dump : Dump
        An open dump (`open_dump`).
    settings : Settings, optional
        Thresholds and error model; default: `Settings()`, the dump's stated errors.
    store : UnitStore, optional
        Where finished exposures and strips are kept and looked for; default: all in memory.
    executor : Executor, optional
        Who computes; default: this process, one task after another.
    progress : callable, optional
        Called with the stage's name, the tasks done and all tasks.

    Returns
    -------
    Calibration
        Estimate, verdict, sightings, attitudes, matched targets, omissions.

    Raises
    ------
    DataNotSufficientError
        If the data do not determine all three angles.
    """
    settings = settings or Settings()
    dump = targets_once(dump, settings.match)
    runner = StageRunner(store, executor or InOrder(), progress)
    error_model = calibration_settings(settings, dump.errors, dump.line_camera)
    heads = [sight_head(dump, head, settings, error_model.attitudes, runner) for head in dump.heads]
    sky = find_in_sky_strips(dump, heads, settings, runner)
    surface_of(dump.terrain)  # of several dumps the last one's is in memory: processes forked here share this
    first, last, matchings = _first_and_last_pass(dump, heads, sky, settings, error_model, runner)
    computed = [*sky.computed, *(flag for head in heads for flag in head.computed), *matchings]
    found = last.estimate.with_reference(heads[0].head.name)
    observed = [*last.matched, *map(as_matched, last.named)]
    omissions = (
        *_unused_so_far(dump, heads, sky),
        *last.omissions,
        *rejections_of(found),
        *unused_rows(dump, last.tasks, observed, settings.run.exposure_margin_s),
    )
    looked_for = sky_looked_for(dump, last.sky, last.named, found.R_cs)
    stars = sky_counts(last.sky, looked_for)
    sighted = _sighted(dump, heads, first, last, stars)
    inputs = moved_inputs(dump, sighted, last.tasks)
    reliability = _examined(dump, found, sighted, error_model, inputs, settings)
    of_inputs = [
        *targets_out_of_view(dump, last.tasks, last.matched),
        *input_findings(dump, last.tasks, omissions),
    ]
    if any(one.refutes for one in of_inputs):  # places measured with a wrong input accuse no other one
        reliability = replace(reliability, findings=(), suspects=())
    verdict = assess(
        found,
        last.strips,
        settings.verdict,
        sigma_installation_rad=dump.sigma_installation_rad,
        reliability=reliability,
        target_files=dump.target_files,
    )
    earth = check_earth_table(dump.orbit, dump.earth_table, bundled_table())
    findings = [
        *_explanations(dump, heads, last, found, verdict, reliability, looked_for, settings),
        *of_inputs,
        *assumed_motion(last.strips, error_model),
        *earth_findings(earth, dump.earth_file),
    ]
    return DumpCalibration(
        estimate=found,
        verdict=verdict.with_findings(findings),
        earth_table=earth,
        stars=heads[0].stars,
        attitudes=heads[0].attitudes,
        tasks=last.tasks,
        matched=last.matched,
        sky=last.sky,
        named=last.named,
        strips=last.strips,
        sighted=sighted,
        inputs=inputs,
        settings=error_model,
        omissions=omissions,
        rows=rows_used(dump, found, last.strips),
        n_computed=sum(computed),
        n_reused=len(computed) - sum(computed),
    )


@record(kw_only=True)
class _Pass:
    """Matching and estimation from one matrix."""

    estimate: InstallationEstimate = scalar("installation matrix")
    tasks: tuple[StripTask, ...] = array("S", "strips that were matched")
    matched: tuple[MatchedTargets, ...] = array("S", "their targets")
    sky: SkySide = scalar("strips of the sky, their attitudes in frame s by the heads' matrices")
    named: tuple[NamedStars, ...] = scalar("named stars of the strips of the sky")
    strips: tuple[StripSightings, ...] = scalar("those that the estimate is made from, ground first")
    omissions: tuple[Omission, ...] = scalar("strips, targets and stars that are not used")
    computed: tuple[bool, ...] = scalar("which matchings had to be computed")


def _first_and_last_pass(
    dump: Dump,
    heads: Sequence[HeadSightings],
    sky: SkySide,
    settings: Settings,
    error_model: CalibrationSettings,
    runner: StageRunner,
) -> tuple[_Pass, _Pass, list[bool]]:
    """The first pass, from the pre-launch matrix, and the last, each from the estimate before it; and which
    matchings of all passes had to be computed.
    """
    start, mountings = (dump.R_cs0, dump.sigma_installation_rad), stated_mountings(heads)
    first = last = _one_pass(1, None, dump, heads, sky, start, mountings, settings, error_model, runner)
    computed = list(first.computed)
    for number in range(2, settings.run.passes + 1):
        if not (last.named or any(task.targets for task in last.tasks)):
            break  # measured image points alone: no matrix moves them
        start = last.estimate.R_cs, _rematch_sigma(last.estimate, settings)
        mountings |= {one.name: one.R_cs for one in last.estimate.with_reference(heads[0].head.name).heads}
        last = _one_pass(number, last, dump, heads, sky, start, mountings, settings, error_model, runner)
        computed += last.computed
    return first, last, computed


def _one_pass(
    number: int,
    before: _Pass | None,
    dump: Dump,
    heads: Sequence[HeadSightings],
    sky: SkySide,
    start: tuple[Rotation, Array],
    mountings: Mapping[str, Rotation],
    settings: Settings,
    error_model: CalibrationSettings,
    runner: StageRunner,
) -> _Pass:
    """Pass `number`, from 1, from the matrix `start` and its 1-sigma (3,), and from those of all heads;
    `before` is the pass before. `DataNotSufficientError` where the data do not determine all three angles.
    """

    def start_from(task: StripTask, matched: MatchedTargets) -> tuple[Rotation, Array] | None:
        strips = _strips([task], [matched], heads)
        alone = calibrate_strips(strips, dump.R_cs0, error_model) if strips else None
        if not isinstance(alone, InstallationEstimate):
            return None
        return alone.R_cs, _rematch_sigma(alone, settings)

    tasks, uncovered = _strip_tasks(dump, heads, *start, mountings, settings)
    if number == 1:
        tasks, matched, flags = match_first(tasks, start_from, runner)
    else:
        matched, flags = match_again(
            tasks, before.matched if before else (), settings.run.settled_px, runner, f"matching-{number}"
        )
    sky = sky.aligned(heads, mountings)
    named = name_in_sky_strips(dump, sky, *start, known=number > 1)
    strips = [*_strips(tasks, matched, heads), *named_sightings(sky, named, heads)]
    estimate = calibrate_strips(strips, dump.R_cs0, error_model)
    unmatched = [omission for one in matched for omission in one.omissions]
    unnamed = [omission for one in named for omission in one.omissions]
    if isinstance(estimate, NotObservable):
        known = [*_unused_so_far(dump, heads, sky), *uncovered, *unnamed]
        text = what_is_missing(estimate, dump, settings, heads[0], tasks, matched, known)
        seen = strips or (before.strips if before else ())  # names that the strips together took away
        shifted = next(shifted_chips(dump, unmatched), None)
        if cause := shifted or _cause_of_no_result(dump, heads, sky, seen, tasks, settings, error_model):
            text = f"{cause.cause}, {cause.item}: {cause.text} Otherwise: {text}"
        raise DataNotSufficientError(text, [*known, *unmatched])
    return _Pass(
        estimate=estimate,
        tasks=tuple(tasks),
        matched=tuple(matched),
        sky=sky,
        named=tuple(named),
        strips=tuple(strips),
        omissions=(*uncovered, *unmatched, *_without_targets(matched), *unnamed),
        computed=tuple(flags),
    )


def _cause_of_no_result(
    dump: Dump,
    heads: Sequence[HeadSightings],
    sky: SkySide,
    strips: Sequence[StripSightings],
    tasks: Sequence[StripTask],
    settings: Settings,
    error_model: CalibrationSettings,
) -> Finding | None:
    """Why strips do not determine a matrix: a convention, or what the hypotheses tell of all observations
    together, none rejected.
    """
    if exchanged := exchanged_exposures(dump, heads):
        return exchanged[0]
    if reversed_strip := next(reversed_strips(dump, sky), None):
        return reversed_strip
    if finding := likely_convention(dump, lambda changed: _agreeing_strips(changed, heads, settings)):
        return finding
    plain = replace(error_model, robust=False)
    together = calibrate_strips(strips, dump.R_cs0, plain) if strips else None
    if not isinstance(together, InstallationEstimate):
        return None
    found = _examined(dump, together, strips, plain, moved_inputs(dump, strips, tasks), settings)
    return next(iter(found.findings), None)


def _examined(
    dump: Dump,
    estimate: InstallationEstimate,
    strips: Sequence[StripSightings],
    error_model: CalibrationSettings,
    inputs: Sequence[MovedInput],
    settings: Settings,
) -> Reliability:
    """The hypotheses about the inputs of a dump, held against an estimate."""
    return examine(
        estimate,
        strips,
        error_model,
        pixel_rad=dump.line_camera.pixel_rad,
        star_camera=dump.star_camera,
        inputs=inputs,
        pivots=_pivots(dump.line_camera),
        target_files=dump.target_files,
        limits=settings.verdict.of_reliability,
    )


def _pivots(camera: LineSensor) -> dict[int, float]:
    """Samples about which CCDs are rotated; none where the camera states look angles."""
    ccds = camera.ccds if isinstance(camera, LineCamera) else ()
    return {n: ccd.principal_sample for n, ccd in enumerate(ccds)}


def _agreeing_strips(dump: Dump, heads: Sequence[HeadSightings], settings: Settings) -> int:
    """Strips of a dump that see their stars or targets by the pre-launch matrices; `heads` were sighted with
    other conventions.
    """
    runner, sigma = StageRunner(None, InOrder()), dump.sigma_installation_rad
    fit = calibration_settings(settings, dump.errors, dump.line_camera).attitudes
    now = [
        sight_head(dump, head, settings, fit, runner)
        if isinstance(head.source, SolvedAttitudes)
        else replace(before, head=head)
        for head, before in zip(dump.heads, heads)
    ]
    tasks, _ = _strip_tasks(dump, now, dump.R_cs0, sigma, stated_mountings(now), settings)
    sky = find_in_sky_strips(dump, now, settings, runner)
    named = name_in_sky_strips(dump, sky, dump.R_cs0, sigma, known=False)
    return sum(sees_its_targets(task, dump) for task in tasks) + sum(len(one.rows) > 0 for one in named)


def _explanations(
    dump: Dump,
    heads: Sequence[HeadSightings],
    last: _Pass,
    estimate: InstallationEstimate,
    verdict: Verdict,
    reliability: Reliability,
    looked_for: Sequence[LookedFor],
    settings: Settings,
) -> list[Finding]:
    """Exposures that are exchanged and a convention that is wrong; without either, what `_target_findings`
    says.
    """
    exchanged = exchanged_exposures(dump, heads)
    convention = None
    if any(not check.holds for check in verdict.checks if check.kind is CheckKind.START_MATRIX):
        convention = likely_convention(dump, lambda changed: _agreeing_strips(changed, heads, settings))
    if convention or exchanged:
        return [*exchanged, *([convention] if convention else [])]
    return _target_findings(dump, last, estimate, reliability, verdict.findings, looked_for)


def _target_findings(
    dump: Dump,
    last: _Pass,
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
        *exchanged_in_sky(dump, last.sky, last.named, stars, estimate.R_cs),
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
        *strips_without_stars(dump, last.sky, last.named, stars, strips),
    ]


def _sighted(
    dump: Dump, heads: Sequence[HeadSightings], first: _Pass, last: _Pass, stars: Counts
) -> tuple[StripSightings, ...]:
    """The strips of the last pass, with all that was measured in them by any search, each by itself too."""
    alone = searched_alone(last.tasks, lost_ccds(counts_of(last.matched)), dump.sigma_installation_rad)
    tasks = {task.strip.strip_id: task for task in last.tasks}
    parts = (
        (last.tasks, [contradicting_targets(one) for one in last.matched]),
        (last.tasks, first.matched),
        ([tasks[one.strip_id] for one in alone], alone),
    )
    more = [strip for of_tasks, matched in parts for strip in _strips(of_tasks, matched, heads)]
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


def _unused_so_far(dump: Dump, heads: Sequence[HeadSightings], sky: SkySide) -> list[Omission]:
    of_heads = [omission for head in heads for omission in head.omissions]
    return [*dump.omissions, *of_heads, *sky.omissions]


def _rematch_sigma(estimate: InstallationEstimate, settings: Settings) -> Array:
    return np.sqrt(np.diag(estimate.cov_theta) + settings.run.rematch_sigma_rad**2)


def rejections_of(estimate: InstallationEstimate) -> list[Omission]:
    """Omissions for what the estimate itself rejects: outliers, and what exposures do not cover."""
    return [
        Omission(
            r.kind,
            _full_name(r.exposure_id or r.strip_id, r.name),
            reason=rejection_reason(r),
            cause=r.why.value,
        )
        for r in estimate.rejected
    ]


def strips_to_match(
    dump: Dump, settings: Settings, executor: Executor | None = None
) -> tuple[list[StripTask], list[Omission]]:
    """Tasks of a dump's strips with the pre-launch installation matrix, and what cannot be used."""
    dump = targets_once(dump, settings.match)
    heads, tasks, uncovered = _before_launch(dump, settings, executor or InOrder())
    return tasks, [*dump.omissions, *(one for head in heads for one in head.omissions), *uncovered]


def strips_with_stars(
    dump: Dump,
    settings: Settings,
    shown: Callable[[StripTask], tuple[StripTask, MatchedTargets]],
) -> list[StripSightings]:
    """The strips of a dump with its star exposures and the image points that `shown` states for each, with
    the pre-launch installation matrix; without strips that show nothing.
    """
    heads, tasks, _ = _before_launch(dump, settings, InOrder())
    parts = [shown(task) for task in tasks]
    return _strips([task for task, _ in parts], [matched for _, matched in parts], heads)


def _before_launch(
    dump: Dump, settings: Settings, executor: Executor
) -> tuple[list[HeadSightings], list[StripTask], list[Omission]]:
    """The heads of a dump with their attitudes, nothing of them kept; a task for each strip that they cover,
    with the pre-launch matrices, and an omission for each other one.
    """
    fit = calibration_settings(settings, dump.errors, dump.line_camera).attitudes
    runner = StageRunner(None, executor)
    heads = [sight_head(dump, head, settings, fit, runner) for head in dump.heads]
    sigma_rad, mountings = dump.sigma_installation_rad, stated_mountings(heads)
    return heads, *_strip_tasks(dump, heads, dump.R_cs0, sigma_rad, mountings, settings)


def _strip_tasks(
    dump: Dump,
    heads: Sequence[HeadSightings],
    R_cs: Rotation,
    sigma_rad: Array,
    mountings: Mapping[str, Rotation],
    settings: Settings,
) -> tuple[list[StripTask], list[Omission]]:
    """A task for each strip that orbit and star exposures cover, and an omission for each other one.

    Where another head carries the strip, its attitudes are turned to frame s by the matrices `mountings`.
    """
    tasks = []
    points = {one.strip_id: one for one in dump.points}
    run = settings.run
    covered, omitted = covered_strips(dump.strips, carriers(dump, heads, run.exposure_margin_s))
    for strip, head, near in covered:
        times = np.array([head.stars[k].t_s for k in near])
        first, last = dump.span_s(strip)
        margin = run.exposure_margin_s
        task = StripTask(
            strip=strip,
            camera=dump.line_camera,
            orbit=orbit_around(dump.orbit, first - margin, last + margin),
            t_attitude_s=times,
            R_si=attitudes_in_s(head, near, heads[0], mountings),
            R_cs=R_cs,
            sigma_installation_rad=np.asarray(sigma_rad, dtype=float),
            effects=dump.light,
            targets=(),
            chips=(),
            terrain=dump.terrain,
            settings=settings.match,
            points=points.get(strip.strip_id, NO_POINTS),
            interpolation=head.head.interpolation,
            carrier=head.head.name,
        )
        task, hidden = without_hidden_points(task)
        omitted += hidden
        targets, chips = targets_near(task, dump.targets, dump.chips)
        tasks.append(replace(task, targets=targets, chips=chips))
    return tasks, omitted


def _strips(
    tasks: Sequence[StripTask],
    matched: Sequence[MatchedTargets],
    heads: Sequence[HeadSightings],
) -> list[StripSightings]:
    """Strips with at least one matched target, with the exposures around them and their attitudes."""
    return [
        strip_sightings(
            task.strip.strip_id,
            ground_sightings(of_strip, task),
            task.t_attitude_s,
            task.orbit,
            heads,
            task.carrier,
            earth=task.orbit.earth.prediction,
        )
        for task, of_strip in zip(tasks, matched)
        if len(of_strip.target_id)
    ]


def _without_targets(matched: Iterable[MatchedTargets]) -> list[Omission]:
    return [
        Omission("strip", m.strip_id, reason="no target was matched in it", cause=Cause.NO_TARGET)
        for m in matched
        if not len(m.target_id)
    ]


def _full_name(of: str, name: str) -> str:
    return name if of in ("", name) else f"{of}/{name}"
