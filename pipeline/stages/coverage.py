"""Which star exposures belong to a strip, or why it cannot be used; the attitudes of all heads around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import NominalMotion
from boresight.geometry.attitude_smoother import HeadRows
from boresight.pipeline.files.dates import span_text
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.files.strip_table import Strip
from boresight.records.ledger import Entry, Reason
from boresight.records.record import Floats, Ints

if TYPE_CHECKING:
    from boresight.pipeline.stages.head import HeadSightings  # loads all that finds stars

__all__ = [
    "attitudes_in_s",
    "covered_strips",
    "covers",
    "rows_not_covered",
    "rows_of_heads",
    "stated_mountings",
]


def covered_strips(
    dump: Dump, strips: Sequence[Strip], heads: Sequence[HeadSightings], margin_s: float
) -> tuple[list[tuple[Strip, HeadSightings, Ints]], list[Entry]]:
    """Some strips of a dump, each with the first head that covers it and the rows (K,) of its exposures; and
    why the reference head, the first of `heads`, does not cover the others. Further heads carry only where it
    covers one strip of the dump at least: without that nothing ties their matrices to its own.
    """
    every = (*dump.strips, *dump.sky_strips)
    around = (attitudes_around(dump, strip, heads[0], margin_s) for strip in every)
    able = heads if any(not isinstance(rows, Entry) for rows in around) else heads[:1]
    covered, omitted = [], []
    for strip in strips:
        reasons = []
        for head in able:
            rows = attitudes_around(dump, strip, head, margin_s)
            if not isinstance(rows, Entry):
                covered.append((strip, head, rows))
                break
            reasons.append(rows)
        else:
            omitted.append(reasons[0])
    return covered, omitted


def stated_mountings(heads: Sequence[HeadSightings]) -> dict[str, Rotation]:
    """The matrices of the heads before launch, by name."""
    return {one.head.name: one.head.R_cs0 for one in heads}


def attitudes_in_s(
    head: HeadSightings, rows: Ints, reference: HeadSightings, mountings: Mapping[str, Rotation]
) -> Rotation:
    """Attitudes (K,) of a head, turned to frame s of the reference head by the matrices of both."""
    R_hi = Rotation.from_matrix(head.attitudes.R_si[rows])
    if head is reference:
        return R_hi
    return mountings[reference.head.name].inv() * mountings[head.head.name] * R_hi


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
    seen = [exposure.t_s for exposure in head.stars]
    t_s = source.rows.t_s if isinstance(source, SolvedAttitudes) else np.array(seen)
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
    try:
        dump.orbit.positions_i(np.array(dump.span_s(strip)))
    except ValueError:
        return False
    return True


INSTANT_S = 1e-7  # instants that are one and the same


def rows_of_heads(
    dump: Dump,
    t_s: Floats,
    mountings: Mapping[str, Rotation],
    carrier: str = "",
    nominal: NominalMotion | None = None,
) -> list[HeadRows]:
    """Attitudes that the carrier, else the reference head, has solved from the first of instants (K,) to the
    last, and those of all other such heads, in frame s of the reference head by the matrices of all, relative
    to a nominal motion; None: the orbit's.
    """
    nominal = nominal or dump.orbit
    by_name = {head.name: head for head in dump.heads if head.is_smoothed}
    reference, rows = dump.heads[0].name, []
    first, R_cs = by_name.pop(carrier or reference), mountings[reference]
    for head in (first, *by_name.values()):
        assert isinstance(head.source, SolvedAttitudes)
        of_head = head.source.rows
        at = np.flatnonzero((of_head.t_s >= t_s[0] - INSTANT_S) & (of_head.t_s <= t_s[-1] + INSTANT_S))
        if not len(at):
            continue
        R_sh, white = R_cs.inv() * mountings[head.name], head.noise.white_covariance_s
        own = np.tile(white, (len(at), 1, 1)) if of_head.covariance_s is None else of_head.covariance_s[at]
        A, R_hi = R_sh.as_matrix(), head.source.with_all_aberration(at, dump.epoch, dump.orbit)
        rows.append(
            HeadRows(
                t_s=of_head.t_s[at],
                R_so=R_sh * R_hi * nominal.R_oi(of_head.t_s[at]).inv(),
                covariance_s=A @ own @ A.T,
                noise=replace(head.noise, R_sn=R_sh * head.noise.R_sn),
                name=head.name,
            )
        )
    return rows
