"""Observations that an estimate left out, with the positions that they were measured at.

The tests of inputs need them: a strip that is found by its own search and not where the other strips' matrix
expects it, a target that contradicts its strip, a CCD that only a search of its own finds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from boresight.geometry.ledger import Entry
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets

__all__ = ["searched_alone", "with_left_out"]

FEWEST = 3  # targets that agree by themselves
# Most searches of single CCDs and targets that a run makes for what was not found; bounds their time.
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
    ground = GroundSightings.together([strip.ground, more.ground.take(new)])
    R_oi = strip.R_oi_targets.concatenate([strip.R_oi_targets, more.R_oi_targets[new]])
    return replace(strip, ground=ground, R_oi_targets=R_oi)


def searched_alone(
    tasks: Sequence[StripTask], ccds: Sequence[int], sigma_rad: np.ndarray
) -> list[MatchedTargets]:
    """Targets of the CCDs `ccds` in each of the first strips, searched in that CCD alone and as widely as
    `sigma_rad` (3,), the 1-sigma of the matrix, axes of c.
    """
    found: list[MatchedTargets] = []
    for ccd in ccds[:MOST_SEARCHES]:
        for task in [one for one in tasks if ccd in one.strip.images.ccds][
            : max(1, MOST_SEARCHES // len(ccds))
        ]:
            strip = replace(task.strip, images=task.strip.images.of([ccd]))
            sigma = np.asarray(sigma_rad, dtype=float)
            wide = replace(task, strip=strip, sigma_installation_rad=sigma, is_known=False)
            one = match_strip_targets(wide)
            if not isinstance(one, Entry) and len(one.target_id) >= FEWEST:
                found.append(one)
    return found
