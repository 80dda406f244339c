"""Observations that an estimate left out, with the positions that they were measured at.

The tests of inputs need them: a strip that is found by its own search and not where the other strips' matrix
expects it, a target that contradicts its strip, a CCD that only a search of its own finds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from math import comb

import numpy as np
from scipy.special import bdtrc

from boresight.geometry.record import shape_of
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.pipeline.errors import Omission
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, match_strip_targets

__all__ = ["Counts", "counts_of", "lost_ccds", "over_strips", "searched_alone", "with_left_out"]

FEWEST = 3  # targets that agree by themselves
LOST_SHARE = 0.3  # of a CCD's targets that cloud and change take away in a good strip
PROBABILITY = 1e-4  # that a CCD is searched again without need
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
    names = [field.name for field in fields(GroundSightings) if shape_of(field) is not None]
    ground = GroundSightings(
        **{
            name: np.concatenate([getattr(strip.ground, name), getattr(more.ground, name)[new]])
            for name in names
        }
    )
    R_oi = strip.R_oi_targets.concatenate([strip.R_oi_targets, more.R_oi_targets[new]])
    return replace(strip, ground=ground, R_oi_targets=R_oi)


Counts = Mapping[tuple[str, int], tuple[int, int]]  # by strip and CCD: found, and in view


def lost_ccds(
    counts: Counts, share: float = LOST_SHARE, probability: float = PROBABILITY
) -> dict[int, tuple[int, int]]:
    """CCDs that lost more of their targets, or stars, than the share that good strips lose: found, in view.

    Those of which least was found are tested together, one more at a time, against all choices of as many.
    """
    every = over_strips(counts)
    order = sorted(every, key=lambda ccd: (every[ccd][0] / every[ccd][1], -every[ccd][1]))
    lost: list[int] = []
    for k in range(1, len(order)):
        kept, n = (sum(every[ccd][part] for ccd in order[:k]) for part in (0, 1))
        if float(bdtrc(n - kept - 1, n, share)) * comb(len(order), k) < probability:
            lost = [ccd for ccd in order[:k] if 2 * every[ccd][0] < every[ccd][1]]
    return {ccd: every[ccd] for ccd in sorted(lost)}


def over_strips(counts: Counts) -> dict[int, tuple[int, int]]:
    """Found, and in view, of each CCD over the strips that show any: a strip that shows nothing says nothing
    of its CCDs.
    """
    shown = {strip_id for (strip_id, _), (found, _) in counts.items() if found}
    every: dict[int, tuple[int, int]] = {}
    for (strip_id, ccd), (found, n) in sorted(counts.items()):
        if strip_id in shown and n:
            before = every.get(ccd, (0, 0))
            every[ccd] = before[0] + found, before[1] + n
    return every


def counts_of(matched: Sequence[MatchedTargets]) -> Counts:
    """Targets found, and in view, by strip and CCD."""
    counts: dict[tuple[str, int], tuple[int, int]] = {}
    for strip in matched:
        found = Counter(strip.ccd.tolist())
        behind = (one.name.partition(", CCD ")[2] for one in strip.omissions)
        lost = Counter(int(number) for number in behind if number.isdigit())
        for ccd in {*found, *lost}:
            counts[strip.strip_id, ccd] = found[ccd], found[ccd] + lost[ccd]
    return counts


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
