"""The matchings: from the pre-launch matrix, wrong by thousands of pixels, and again from what it gave.

A search as wide as that matrix is uncertain decodes whole strips. All strips have one matrix: they are
searched one after another until one determines it, and the others start from there. A strip in which nothing
is found that way is searched as widely as the first.

A strip is matched again where its templates were predicted less well than a later matching predicts them, or
where a target was refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from scipy.spatial.transform import Rotation

from boresight.geometry.ledger import Entry
from boresight.geometry.record import Floats
from boresight.pipeline.stages.cached import StageRunner
from boresight.pipeline.stages.strip import (
    MatchedTargets,
    StripTask,
    match_strip_targets,
    no_matches,
    predicted_again,
    with_points,
)

__all__ = ["is_settled", "match_again", "match_first", "match_strips"]

Start = tuple[Rotation, Floats]  # a matrix and its 1-sigma (3,), rad, axes of c


def match_strips(
    tasks: Sequence[StripTask], runner: StageRunner, folder: str
) -> tuple[list[MatchedTargets], list[bool]]:
    """Targets matched in strips, and which strips were computed now."""
    outcomes, flags = runner.run(match_strip_targets, tasks, folder=folder, in_parts=True)
    return [
        with_points(no_matches(one) if isinstance(one, Entry) else one, task.points)
        for task, one in zip(tasks, outcomes)
    ], flags


def match_first(
    tasks: Sequence[StripTask],
    start_from: Callable[[StripTask, MatchedTargets], Start | None],
    runner: StageRunner,
) -> tuple[list[StripTask], list[MatchedTargets], list[bool]]:
    """Tasks as they were matched, targets matched in them, and which units of work were computed now.

    `start_from` gives the matrix that one strip determines.
    """
    if not any(task.targets for task in tasks[1:]):  # nothing that a better matrix would find
        return list(tasks), *match_strips(tasks, runner, "matching-0")
    matched: list[MatchedTargets] = []
    computed: list[bool] = []
    start = None
    while start is None and len(matched) < len(tasks):
        task = tasks[len(matched)]
        found, flags = match_strips([task], runner, "matching-0")
        matched, computed = matched + found, computed + flags
        start = start_from(task, found[0])
    n = len(matched)
    if start is None or n == len(tasks):
        return list(tasks), matched, computed
    R_cs, sigma = start
    near = [replace(task, R_cs=R_cs, sigma_installation_rad=sigma, is_known=True) for task in tasks[n:]]
    found, flags = match_strips(near, runner, "matching-1")
    used, matched, computed = [*tasks[:n], *near], matched + found, computed + flags
    if missed := [k for k, one in enumerate(matched) if k >= n and not len(one.target_id)]:
        found, flags = match_strips([tasks[k] for k in missed], runner, "matching-0")
        computed += flags
        for k, one in zip(missed, found):
            used[k], matched[k] = tasks[k], one
    return used, matched, computed


def match_again(
    tasks: Sequence[StripTask],
    before: Sequence[MatchedTargets],
    settled_px: float,
    runner: StageRunner,
    folder: str,
) -> tuple[list[MatchedTargets], list[bool]]:
    """Targets matched in strips, and which strips were computed now.

    Settled strips of the matching `before`, in any order, stay as they are (`is_settled`).
    """
    settled = {one.strip_id: one for one in before if is_settled(one, settled_px)}
    open_tasks = [task for task in tasks if task.strip.strip_id not in settled]
    found, flags = match_strips(open_tasks, runner, folder) if open_tasks else ([], [])
    again = {one.strip_id: one for one in found}
    return [
        predicted_again(settled[name], task) if (name := task.strip.strip_id) in settled else again[name]
        for task in tasks
    ], flags


def is_settled(matched: MatchedTargets, settled_px: float) -> bool:
    """Whether all targets in view were placed, each within `settled_px` of where its template was predicted.

    Another matching gives positions as good as these, with other errors of half a sigma.
    """
    return not matched.omissions and 0.0 < matched.farthest_px <= settled_px
