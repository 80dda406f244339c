"""Strips of the ground as tasks: each with the exposures around it, their attitudes, and the targets that it
may show; and what was matched in them, as sightings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.ledger import Entry
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.ground_points import NO_POINTS
from boresight.pipeline.files.repeats import targets_once
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.stages.cached import StageRunner
from boresight.pipeline.stages.coverage import attitudes_in_s, carriers, covered_strips, stated_mountings
from boresight.pipeline.stages.head import HeadSightings, sight_head
from boresight.pipeline.stages.point_slips import without_hidden_points
from boresight.pipeline.stages.strip import (
    MatchedTargets,
    StripTask,
    ground_sightings,
    orbit_around,
    targets_near,
)
from boresight.pipeline.stages.strip_sightings import strip_sightings

__all__ = ["matched_strips", "strip_tasks", "strips_to_match", "strips_with_stars"]

Array = NDArray[np.float64]


def strip_tasks(
    dump: Dump,
    heads: Sequence[HeadSightings],
    R_cs: Rotation,
    sigma_rad: Array,
    mountings: Mapping[str, Rotation],
    settings: Settings,
) -> tuple[list[StripTask], list[Entry]]:
    """A task for each strip that orbit and star exposures cover, and an omission for each other one.

    `R_cs` with 1-sigma (3,) predicts where targets lie. Where another head carries the strip, its attitudes
    are turned to frame s by `mountings`.
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


def matched_strips(
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


def strips_to_match(
    dump: Dump, settings: Settings, executor: Executor | None = None
) -> tuple[list[StripTask], list[Entry]]:
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
    return matched_strips([task for task, _ in parts], [matched for _, matched in parts], heads)


def _before_launch(
    dump: Dump, settings: Settings, executor: Executor
) -> tuple[list[HeadSightings], list[StripTask], list[Entry]]:
    """The heads of a dump with their attitudes, nothing of them kept; a task for each strip that they cover,
    with the pre-launch matrices, and an omission for each other one.
    """
    fit = calibration_settings(settings, dump.errors, dump.line_camera).attitudes
    runner = StageRunner(None, executor)
    heads = [sight_head(dump, head, settings, fit, runner) for head in dump.heads]
    sigma_rad, mountings = dump.sigma_installation_rad, stated_mountings(heads)
    return heads, *strip_tasks(dump, heads, dump.R_cs0, sigma_rad, mountings, settings)
