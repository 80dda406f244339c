"""Observations that an estimate left out, with the positions that they were measured at.

The tests of inputs need them: a strip that is found by its own search and not where the other strips' matrix
expects it, a target that contradicts its strip, a CCD that only a search of its own finds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace

import numpy as np
from scipy.special import bdtrc

from boresight.geometry.record import shape_of
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.pipeline.errors import Omission
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets

__all__ = ["counts_of_ccds", "lost_ccds", "searched_alone", "with_left_out"]

FEWEST = 3  # targets that agree by themselves
LOST_SHARE = 0.3  # of a CCD's targets that cloud and change take away in a good strip
PROBABILITY = 1e-4  # that a CCD is searched again without need
MOST_SEARCHES = 4


def with_left_out(
    strips: Sequence[StripSightings], more: Sequence[StripSightings]
) -> tuple[StripSightings, ...]:
    """`strips` with the observations of `more` that they do not hold; strips of the same id are one."""
    found = {strip.strip_id: strip for strip in strips}
    for strip in more:
        found[strip.strip_id] = _joined(found[strip.strip_id], strip) if strip.strip_id in found else strip
    return tuple(found.values())


def _joined(strip: StripSightings, more: StripSightings) -> StripSightings:
    known = set(zip(strip.ground.target_id.tolist(), strip.ground.ccd.tolist()))
    keys = zip(more.ground.target_id.tolist(), more.ground.ccd.tolist())
    new = np.array([n for n, key in enumerate(keys) if key not in known], dtype=np.int64)
    if not len(new):
        return strip
    names = [field.name for field in fields(GroundSightings) if shape_of(field) is not None]
    ground = GroundSightings(
        **{
            name: np.concatenate([getattr(strip.ground, name), getattr(more.ground, name)[new]])
            for name in names
        }
    )
    R_oi = strip.R_oi_targets.concatenate([strip.R_oi_targets, more.R_oi_targets[new]])
    return replace(strip, ground=ground, R_oi_targets=R_oi)


def lost_ccds(matched: Sequence[MatchedTargets]) -> dict[int, tuple[int, int]]:
    """CCDs that lost more of their targets than cloud and change take away: targets found, and in view."""
    every = counts_of_ccds(matched)
    return {
        ccd: (kept, n)
        for ccd, (kept, n) in every.items()
        if float(bdtrc(n - kept - 1, n, LOST_SHARE)) * max(len(every), 1) < PROBABILITY
    }


def counts_of_ccds(matched: Sequence[MatchedTargets]) -> dict[int, tuple[int, int]]:
    """Targets found, and in view, of each CCD over the strips that show any."""
    found: dict[int, int] = {}
    lost: dict[int, int] = {}
    for strip in matched:
        if not len(strip.target_id):
            continue  # a strip that shows nothing says nothing of its CCDs
        for ccd in strip.ccd.tolist():
            found[ccd] = found.get(ccd, 0) + 1
        for omission in strip.omissions:
            _, behind, number = omission.name.partition(", CCD ")
            if behind and number.isdigit():
                lost[int(number)] = lost.get(int(number), 0) + 1
    return {ccd: (found.get(ccd, 0), found.get(ccd, 0) + lost.get(ccd, 0)) for ccd in sorted({*found, *lost})}


def searched_alone(
    tasks: Sequence[StripTask], ccds: Mapping[int, tuple[int, int]], sigma_rad: np.ndarray
) -> list[MatchedTargets]:
    """Targets of the CCDs `ccds` in each of the first strips, searched in that CCD alone and as widely as
    `sigma_rad` (3,), the 1-sigma of the matrix, axes of c.
    """
    found: list[MatchedTargets] = []
    for ccd in list(ccds)[:MOST_SEARCHES]:
        for task in [one for one in tasks if ccd in one.strip.images.ccds][
            : max(1, MOST_SEARCHES // len(ccds))
        ]:
            strip = replace(task.strip, images=task.strip.images.of([ccd]))
            wide = replace(task, strip=strip, sigma_installation_rad=np.asarray(sigma_rad, dtype=float))
            one = match_strip_targets(wide)
            if not isinstance(one, Omission) and len(one.target_id) >= FEWEST:
                found.append(one)
    return found
