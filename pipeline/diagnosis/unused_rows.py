"""Rows of a dump's tables that no strip needs, each with its reason, and how many of every table were used.

What cannot be used is reported where that is found. Here is the rest: targets that no strip shows, exposures
far from every strip, images of strips in which no target or star was measured.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.files.coordinate_slips import contradiction
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.ground_points import ChipFile
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.stages.head import around_strips
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, misses
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import record, scalar

__all__ = [
    "Rows",
    "rows_of_cameras",
    "rows_together",
    "rows_used",
    "unneeded_exposures",
    "unseen_targets",
    "unused_rows",
    "without_measurement",
]

MOST_CHIPS = 200  # of unseen targets whose chips are looked at: a list of a whole country has thousands


@record
class Rows:
    """How many rows of a table were used."""

    name: str = scalar("what the rows are: targets, points, strips, exposures")
    used: int = scalar("rows that the result depends on")
    listed: int = scalar("all rows")
    ids: frozenset[Any] = scalar("what is used", default=frozenset())

    def __str__(self) -> str:
        return f"{self.used} of {self.listed} {self.name}"


def rows_used(
    dump: Dump, estimate: InstallationEstimate, strips: Sequence[StripSightings]
) -> tuple[Rows, ...]:
    """Rows of the tables of a dump that an estimate from `strips` depends on, without empty tables."""
    kept = estimate.targets.kept
    seen = set(zip(estimate.targets.strip_id[kept].tolist(), estimate.targets.target_id[kept].tolist()))
    measured = {(one.strip_id, target.target_id) for one in dump.points for target in one.targets}
    used: dict[str, set[Any]] = {
        "targets": {name for _, name in seen} & {target.target_id for target in dump.targets},
        "points": seen & measured,
        "strips": {strip_id for strip_id, _ in seen},
        "exposures": {one.exposure_id for strip in strips for one in strip.exposures},
    }
    listed = ((name, frozenset(used[name]), n) for name, n in dump.listed.items() if n)
    return tuple(Rows(name, len(ids), n, ids) for name, ids, n in listed)


def rows_of_cameras(views: Sequence[Sequence[Rows]]) -> tuple[Rows, ...]:
    """Rows of the tables of one dump: its cameras share targets and exposures, not strips and points."""

    def join(a: Rows, b: Rows) -> Rows:
        listed = a.listed + b.listed if a.name in ("strips", "points") else max(a.listed, b.listed)
        return Rows(a.name, len(a.ids | b.ids), listed, a.ids | b.ids)

    return _joined(views, join)


def rows_together(of_dumps: Sequence[Sequence[Rows]]) -> tuple[Rows, ...]:
    """Rows of the tables of several dumps, table by table."""
    return _joined(of_dumps, lambda a, b: Rows(a.name, a.used + b.used, a.listed + b.listed))


def _joined(several: Sequence[Sequence[Rows]], join: Callable[[Rows, Rows], Rows]) -> tuple[Rows, ...]:
    joined: dict[str, Rows] = {}
    for one in (row for rows in several for row in rows):
        joined[one.name] = join(joined[one.name], one) if one.name in joined else one
    return tuple(joined.values())


def unused_rows(
    dump: Dump, tasks: Sequence[StripTask], observed: Sequence[MatchedTargets], margin_s: float
) -> list[Entry]:
    """All of these. `observed` are the targets matched in strips of the ground (`tasks`), and
    the stars of those of the sky; exposures are needed within `margin_s` of a strip.
    """
    return [
        *unseen_targets(dump, tasks, observed),
        *without_measurement((*dump.strips, *dump.sky_strips), observed),
        *unneeded_exposures(dump, margin_s),
    ]


def unseen_targets(dump: Dump, tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> list[Entry]:
    """Targets that no strip shows: first those that do not lie in their chip either, then by distance."""
    named = {name for one in matched for name in one.target_id.tolist()}
    named |= {entry.subject.id for one in matched for entry in one.omissions}
    unseen = [both for both in zip(dump.targets, dump.chips) if both[0].target_id not in named]
    if not unseen:
        return []
    if not tasks:
        return [_of_chip(chip, Reason.OUT_OF_VIEW, "no strip can be used") for _, chip in unseen]
    off_m = np.array([np.hypot(*misses(task, [target for target, _ in unseen])[0].T) for task in tasks])
    contradicted, others = list[Entry](), list[Entry]()
    for n in np.argsort(off_m.min(axis=0), kind="stable").tolist():
        (target, chip), nearest = unseen[n], int(np.argmin(off_m[:, n]))
        far_m, strip_id = float(off_m[nearest, n]), tasks[nearest].strip.strip_id
        reason = f"it lies {far_m / 1e3:.3g} km from the nearest strip, {strip_id}"
        if far_m == 0.0:
            reason = f"it lies in a gap between the CCDs of strip {strip_id}"
        looked_at = len(contradicted) + len(others) < MOST_CHIPS
        why, slip = contradiction(target, chip, dump.chips) if looked_at else ("", "")
        if why:
            contradicted.append(_of_chip(chip, Reason.OUTSIDE_CHIP, f"{reason}; {why}", slip))
        else:
            others.append(_of_chip(chip, Reason.OUT_OF_VIEW, reason))
    return contradicted + others


def _of_chip(chip: ChipFile, reason: Reason, detail: str, slip: str = "") -> Entry:
    """Entry of the target that a chip shows."""
    return Entry(Subject(Kind.TARGET, id=chip.target_id), reason, detail, chip.file, slip=slip)


def unneeded_exposures(dump: Dump, margin_s: float) -> list[Entry]:
    """Exposures, or attitudes of a head, further than `margin_s` from every strip."""
    found = []
    for head in dump.heads:
        far = np.flatnonzero(~around_strips(dump, head.t_s, margin_s)).tolist()
        if not isinstance(head.source, SolvedAttitudes):
            reason = f"more than {margin_s:g} s from every strip (run.exposure_margin_s)"
            found += [head.source.exposures[k].item.because(Reason.NOT_NEEDED, reason) for k in far]
        elif far:
            reason = f"{len(far)} of {len(head.t_s)} attitudes are more than {margin_s:g} s from every strip"
            found.append(Entry(head.subject, Reason.ATTITUDES_NOT_NEEDED, reason, head.source.file))
    return found


def without_measurement(strips: Sequence[Strip], observed: Sequence[MatchedTargets]) -> list[Entry]:
    """CCDs in which nothing was measured, of strips in which something was."""
    found = []
    of_strip = {one.strip_id: one for one in observed}
    for strip in (one for one in strips if one.strip_id in of_strip):
        one = of_strip[strip.strip_id]
        lost = Counter(entry.subject.ccd for entry in one.omissions if entry.subject.kind is Kind.TARGET)
        for ccd in sorted(set(strip.ccd_lines) - set(one.ccd.tolist())) if len(one.ccd) else ():
            n, what = lost[ccd], "star" if strip.kind == "sky" else "target"
            reason = f"none of its {n} {what}s was matched" if n else f"no {what} lies in it"
            file = strip.images.names.get(ccd, "")
            found.append(Entry(strip.ccd_subject(ccd), Reason.NO_TARGET, reason, file))
    return found
