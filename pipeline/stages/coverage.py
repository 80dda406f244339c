"""Which star exposures belong to a strip, or why it cannot be used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.ledger import Entry, Reason
from boresight.geometry.record import Floats, Ints
from boresight.pipeline.files.dates import span_text
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.files.strip_table import Strip

if TYPE_CHECKING:
    from boresight.pipeline.stages.head import HeadSightings  # loads all that finds stars

__all__ = [
    "attitudes_around",
    "attitudes_in_s",
    "carriers",
    "covered_strips",
    "covers",
    "rows_not_covered",
    "stated_mountings",
    "turn_to_reference",
]


def carriers(
    dump: Dump, heads: Sequence[HeadSightings], margin_s: float
) -> dict[str, tuple[HeadSightings, Ints] | Entry]:
    """For each strip, by its id, the first head that covers it and the rows (K,) of its exposures, or why the
    reference head, the first of `heads`, does not. Others carry only where it covers one strip at least:
    without that nothing ties its matrix to theirs.
    """
    found: dict[str, tuple[HeadSightings, Ints] | Entry] = {}
    strips = (*dump.strips, *dump.sky_strips)
    by_reference = [attitudes_around(dump, strip, heads[0], margin_s) for strip in strips]
    able = heads if any(not isinstance(rows, Entry) for rows in by_reference) else heads[:1]
    for strip, own in zip(strips, by_reference):
        if not isinstance(own, Entry):
            found[strip.strip_id] = (heads[0], own)
            continue
        others = [(one, attitudes_around(dump, strip, one, margin_s)) for one in able[1:]]
        covering = ((one, rows) for one, rows in others if not isinstance(rows, Entry))
        found[strip.strip_id] = next(covering, own)
    return found


def covered_strips(
    strips: Sequence[Strip], covering: Mapping[str, tuple[HeadSightings, Ints] | Entry]
) -> tuple[list[tuple[Strip, HeadSightings, Ints]], list[Entry]]:
    """Strips with what `carriers` found for them, head and rows (K,) of its exposures, and the omissions of
    all others.
    """
    pairs = [(strip, covering[strip.strip_id]) for strip in strips]
    omitted = [carrier for _, carrier in pairs if isinstance(carrier, Entry)]
    return [(strip, *carrier) for strip, carrier in pairs if not isinstance(carrier, Entry)], omitted


def stated_mountings(heads: Sequence[HeadSightings]) -> dict[str, Rotation]:
    """The matrices of the heads before launch, by name."""
    return {one.head.name: one.head.R_cs0 for one in heads}


def turn_to_reference(head: str, reference: str, mountings: Mapping[str, Rotation]) -> Rotation:
    """Rotation from the frame of a head to that of the reference head, by the matrices of both."""
    return mountings[reference].inv() * mountings[head]


def attitudes_in_s(
    head: HeadSightings, rows: Ints, reference: HeadSightings, mountings: Mapping[str, Rotation]
) -> Rotation:
    """Attitudes (K,) of a head, turned to frame s of the reference head by the matrices of both."""
    R_hi = Rotation.from_matrix(head.attitudes.R_si[rows])
    if head is reference:
        return R_hi
    return turn_to_reference(head.head.name, reference.head.name, mountings) * R_hi


def attitudes_around(dump: Dump, strip: Strip, head: HeadSightings, margin_s: float) -> Ints | Entry:
    """Rows (K,) of a head's usable exposures around a strip, or why it is not covered."""
    first, last = dump.span_s(strip)
    times = np.array([s.t_s for s in head.stars])
    begin, end = first - margin_s, last + margin_s
    near = np.flatnonzero(head.attitudes.usable & (times >= begin) & (times <= end))
    if not covers(dump, strip):
        rows = span_text(dump.epoch, first, last)
        reason = f"{dump.orbit_covers}, without gaps not all of its rows, {rows} (utc_first_row)"
    else:
        reason = rows_not_covered(times[near], first, last)
        if reason and (wider := _margin_that_covers(head, first, last)) > margin_s:
            reason += f"; with run.exposure_margin_s = {np.ceil(wider):.0f} those around it would"
        if reason and (able := _others_that_cover(dump, first, last)):
            reason += f"; {able} covers them: first in [[star_cameras]] it would carry this strip"
    return Entry(strip.subject, Reason.NOT_COVERED, reason) if reason else near


def rows_not_covered(times: Floats, first: float, last: float) -> str:
    """Why exposures at `times` (K,), s, miss rows of a strip from `first` to `last`; empty if they do not."""
    if len(times) < 2:
        return f"{len(times)} usable star exposures around it, 2 are needed"
    early = times[0] - 0.5 * (times[1] - times[0]) - first
    late = last - times[-1] - 0.5 * (times[-1] - times[-2])
    if early > 0.0 or late > 0.0:
        gaps = f"{max(early, 0.0):.2f} s are missing at the beginning, {max(late, 0.0):.2f} s at the end"
        return f"star exposures do not cover all of its rows: {gaps}"
    return ""


def _margin_that_covers(head: HeadSightings, first: float, last: float) -> float:
    """Seconds from a strip within which a head has attitudes before and after it; 0 where it has not."""
    source = head.head.source
    near: Floats = np.array([one.t_s for one in head.stars])
    t_s = source.rows.t_s if isinstance(source, SolvedAttitudes) else near
    before, after = t_s[t_s <= first], t_s[t_s >= last]
    return float(max(first - before[-1], after[0] - last)) if len(before) and len(after) else 0.0


def _others_that_cover(dump: Dump, first: float, last: float) -> str:
    """The first of the further heads with attitudes over all rows; empty where there is none."""
    for head in dump.heads[1:]:
        if isinstance(head.source, SolvedAttitudes):
            t_s = head.source.rows.t_s
            if not rows_not_covered(t_s[(t_s >= first - 1.0) & (t_s <= last + 1.0)], first, last):
                return head.name
    return ""


def covers(dump: Dump, strip: Strip) -> bool:
    """Whether the orbit has states for every row of a strip."""
    label = np.array([0.0, strip.lines - 1.0]) * strip.row_period_s + strip.t_first_row_s
    instants = label + dump.line_camera.delay_to_middle_s(strip.row_period_s)
    try:
        dump.orbit.positions_i(instants)
    except ValueError:
        return False
    return True
