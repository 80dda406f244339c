"""Measured points that are listed again under another id: one measurement has one error, and counts once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from boresight.geometry.ledger import Entry, Kind, Reason, Subject
from boresight.geometry.record import Bools
from boresight.pipeline.files.ground_points import StripPoints

__all__ = ["points_once"]

SAME_PX = 0.01  # image positions of two measurements, whose noise is larger, are never so near ...
SAME_M = 0.1  # ... at points of the ground that are so near


def points_once(points: Sequence[StripPoints], file: str) -> tuple[tuple[StripPoints, ...], list[Entry]]:
    """The points of each strip without repetitions, and an omission for each of these; the first id stays."""
    kept, omitted = [], []
    for one in points:
        first = _first_alike(one)
        again = first != np.arange(len(first))
        kept.append(one.take(~again) if again.any() else one)
        omitted += [
            Entry(
                Subject(Kind.TARGET, strip=one.strip_id, id=one.targets[n].target_id),
                Reason.REPEATED,
                f"the same measurement as {one.targets[first[n]].target_id}",
                file,
            )
            for n in np.flatnonzero(again).tolist()
        ]
    return tuple(kept), omitted


def _first_alike(points: StripPoints) -> np.ndarray:
    """Row (N,) of the first measurement that each one repeats; its own where it repeats none."""
    first = np.arange(len(points.ccd))
    if len(first) < 2:
        return first
    place = np.column_stack([points.ccd * 10.0 * SAME_PX * 1e6, points.xy_px])
    p_e = np.array([target.p_e for target in points.targets])
    near = KDTree(place).query_pairs(SAME_PX, output_type="ndarray")
    same: Bools = np.linalg.norm(p_e[near[:, 0]] - p_e[near[:, 1]], axis=1) < SAME_M
    for a, b in np.sort(near[same], axis=1)[np.lexsort(np.sort(near[same], axis=1).T[::-1])]:
        first[b] = min(first[b], first[a])
    return first
