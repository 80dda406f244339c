"""From an open dump to the installation matrix: the whole calculation on one screen.

    every exposure -> stars (in any process)          every strip -> targets placed, with R_cs as known so far
    exposures + placed targets -> StripSightings -> calib -> R_cs
    once more from there, since the first places were found with a matrix that is wrong by thousands of pixels

What is finished is on disk; whatever order units finish in, everything below is done in the order of time and
id, so the result is the same bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude_estimate import fit_exposures
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.sightings import ExposureAttitudes, StarSightings, StripSightings
from boresight.pipeline.errors import DataNotSufficientError, Omission
from boresight.pipeline.files.dump import Dump, Strip, surface_of
from boresight.pipeline.settings import Settings, calibration_settings
from boresight.pipeline.stages.cached import Made, StarUnit, StripUnit
from boresight.pipeline.stages.exposure import (
    in_order,
    sightings_from_table,
    star_tasks,
)
from boresight.pipeline.stages.reasons import rejection_reason
from boresight.pipeline.stages.strip import (
    Placings,
    StripTask,
    covers,
    ground_sightings,
    orbit_around,
    placings_from_table,
    targets_near,
)
from boresight.pipeline.work.executor import Executor
from boresight.pipeline.work.unit_store import UnitStore

__all__ = ["Calibration", "Progress", "calibrate_dump", "left_out_of", "strips_to_match"]

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]  # stage, units done, units in all


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Everything that a run found, ready to be written."""

    estimate: InstallationEstimate
    stars: tuple[StarSightings, ...]  # all identified exposures, in order of time
    attitudes: ExposureAttitudes  # of the same exposures
    tasks: tuple[StripTask, ...]  # of the last matching
    placings: tuple[Placings, ...]  # of the same strips
    strips: tuple[StripSightings, ...]  # that went into the estimate
    settings: CalibrationSettings
    omissions: tuple[Omission, ...]
    units_made: int
    units_found: int


def calibrate_dump(
    dump: Dump,
    settings: Settings,
    store: UnitStore,
    executor: Executor,
    progress: Progress = lambda stage, done, total: None,
) -> Calibration:
    """The installation matrix of a dump. `DataNotSufficientError` when its data do not fix all three
    angles.
    """
    believed = calibration_settings(settings, dump.errors, dump.line_camera)
    omissions = list(dump.omissions)
    tasks, uncovered = star_tasks(dump, settings.stars)
    made = executor.map(StarUnit(store), tasks, _told(progress, "exposures", len(tasks)))
    counts = [unit.redone for unit in made]
    stars, failed = _exposures(store, made)
    omissions += [*uncovered, *failed]
    attitudes = fit_exposures(stars, believed.attitudes)
    surface_of(dump.terrain)  # of several dumps the last one's is in memory: processes forked here share this
    R_cs, sigma = dump.R_cs0, dump.sigma_installation_rad
    for number in range(1, settings.run.passes + 1):
        strip_tasks, left_out = _strip_tasks(dump, stars, attitudes, R_cs, sigma, settings)
        stage = f"strips, matching {number}"
        unit = StripUnit(store, f"places-{number}")
        made = executor.map(unit, strip_tasks, _told(progress, stage, len(strip_tasks)))
        counts += [unit.redone for unit in made]
        placings = [_placings(store, f"places-{number}", unit) for unit in made]
        strips = _strips(strip_tasks, placings, stars, attitudes)
        estimate = calibrate(strips, dump.R_cs0, believed)
        if isinstance(estimate, NotObservable):
            raise DataNotSufficientError(_what_lacks(estimate, stars, placings, left_out, omissions))
        found = estimate
        R_cs = estimate.R_cs
        sigma = np.sqrt(np.diag(estimate.cov_theta) + settings.run.rematch_sigma_rad**2)
    omissions += left_out + [o for p in placings for o in p.omissions] + _without_targets(placings)
    omissions += left_out_of(found)
    return Calibration(
        found,
        tuple(stars),
        attitudes,
        tuple(strip_tasks),
        tuple(placings),
        tuple(strips),
        believed,
        tuple(omissions),
        sum(counts),
        len(counts) - sum(counts),
    )


def left_out_of(estimate: InstallationEstimate) -> list[Omission]:
    """What the estimate itself left out: gross errors, and what exposures do not cover."""
    return [
        Omission(r.kind, _full_name(r.exposure_id or r.strip_id, r.name), "", rejection_reason(r))
        for r in estimate.rejected
    ]


def strips_to_match(
    dump: Dump,
    settings: Settings,
    store: UnitStore,
    executor: Executor,
    progress: Progress = lambda stage, done, total: None,
) -> tuple[list[StripTask], list[Omission]]:
    """The beginning alone: stars and attitudes, and a task for each strip with the ground's matrix."""
    tasks, uncovered = star_tasks(dump, settings.stars)
    made = executor.map(StarUnit(store), tasks, _told(progress, "exposures", len(tasks)))
    stars, failed = _exposures(store, made)
    believed = calibration_settings(settings, dump.errors, dump.line_camera)
    attitudes = fit_exposures(stars, believed.attitudes)
    strip_tasks, left_out = _strip_tasks(
        dump, stars, attitudes, dump.R_cs0, dump.sigma_installation_rad, settings
    )
    return strip_tasks, [*dump.omissions, *uncovered, *failed, *left_out]


def _told(progress: Progress, stage: str, total: int) -> Callable[[int], None]:
    progress(stage, 0, total)
    return lambda done: progress(stage, done, total)


def _exposures(store: UnitStore, made: Sequence[Made]) -> tuple[list[StarSightings], list[Omission]]:
    found, omitted = [], []
    for unit in made:
        outcome = sightings_from_table(_finished(store, "exposures", unit))
        if isinstance(outcome, Omission):
            omitted.append(outcome)
        else:
            found.append(outcome)
    return in_order(found), omitted


def _placings(store: UnitStore, stage: str, unit: Made) -> Placings:
    return placings_from_table(_finished(store, stage, unit))


def _finished(store: UnitStore, stage: str, unit: Made):  # type: ignore[no-untyped-def]
    table = store.read(stage, unit.name, unit.key)
    if table is None:
        raise OSError(f"{store.path(stage, unit.name, unit.key)} was written and cannot be read")
    return table


def _strip_tasks(
    dump: Dump,
    stars: Sequence[StarSightings],
    attitudes: ExposureAttitudes,
    R_cs: Rotation,
    sigma_rad: Array,
    settings: Settings,
) -> tuple[list[StripTask], list[Omission]]:
    """A task for each strip that orbit and star exposures cover; the others are named."""
    tasks, omitted = [], []
    times = np.array([s.t_s for s in stars])
    run = settings.run
    effects = LightEffects(run.geometric_light_time, run.aberration, run.refraction)
    for strip in dump.strips:
        first, last = _span(dump, strip)
        near = np.flatnonzero(
            attitudes.usable
            & (times >= first - run.exposure_margin_s)
            & (times <= last + run.exposure_margin_s)
        )
        if not covers(dump, strip):
            omitted.append(
                Omission("strip", strip.strip_id, "", "the orbit has no states for all of its rows")
            )
            continue
        if reason := _not_covered(times[near], first, last):
            omitted.append(Omission("strip", strip.strip_id, "", reason))
            continue
        task = StripTask(
            strip,
            dump.line_camera,
            orbit_around(dump.orbit, first - run.exposure_margin_s, last + run.exposure_margin_s),
            times[near],
            Rotation.from_matrix(attitudes.R_si[near]),
            R_cs,
            np.asarray(sigma_rad, dtype=float),
            effects,
            (),
            (),
            dump.terrain,
            settings.match,
        )
        targets, chips = targets_near(task, dump.targets, dump.chips)
        tasks.append(replace(task, targets=targets, chips=chips))
    return tasks, omitted


def _span(dump: Dump, strip: Strip) -> tuple[float, float]:
    """Instants of the first and the last row."""
    first = strip.t_first_row_s + dump.line_camera.delay_to_middle_s(strip.row_period_s)
    return first, first + (strip.lines - 1) * strip.row_period_s


def _not_covered(times: Array, first: float, last: float) -> str:
    if len(times) < 2:
        return f"{len(times)} usable star exposures around it, 2 are needed; raise run.exposure_margin_s?"
    early = times[0] - 0.5 * (times[1] - times[0]) - first
    late = last - times[-1] - 0.5 * (times[-1] - times[-2])
    if early > 0.0 or late > 0.0:
        gaps = f"{max(early, 0.0):.2f} s are missing at their begin, {max(late, 0.0):.2f} s at their end"
        return f"star exposures do not reach over all of its rows: {gaps}"
    return ""


def _strips(
    tasks: Sequence[StripTask],
    placings: Sequence[Placings],
    stars: Sequence[StarSightings],
    attitudes: ExposureAttitudes,
) -> list[StripSightings]:
    """Strips with at least one placed target, with the exposures around them and their attitudes."""
    by_time = {s.t_s: k for k, s in enumerate(stars)}
    strips = []
    for task, placed in zip(tasks, placings):
        if not len(placed.target_id):
            continue
        ground = ground_sightings(placed, task)
        rows = np.array([by_time[t] for t in task.t_attitude_s.tolist()])
        strips.append(
            StripSightings(
                task.strip.strip_id,
                tuple(stars[k] for k in rows),
                ground,
                task.orbit.R_oi(task.t_attitude_s),
                task.orbit.R_oi(ground.t_s),
                attitudes.take(rows),
            )
        )
    return strips


def _without_targets(placings: Iterable[Placings]) -> list[Omission]:
    return [
        Omission("strip", p.strip_id, "", "no target was placed in it")
        for p in placings
        if not len(p.target_id)
    ]


def _what_lacks(
    outcome: NotObservable,
    stars: Sequence[StarSightings],
    placings: Sequence[Placings],
    left_out: Sequence[Omission],
    omissions: Sequence[Omission],
) -> str:
    placed = sum(len(p.target_id) for p in placings)
    text = f"{outcome.reason}; {len(stars)} exposures identified, "
    text += f"{placed} targets placed in {len(placings)} strips"
    every = [*omissions, *left_out, *(o for p in placings for o in p.omissions)]
    return text + (f"; left out: {every[0].kind} {every[0].name}: {every[0].reason}" if every else "")


def _full_name(of: str, name: str) -> str:
    return name if of in ("", name) else f"{of}/{name}"
