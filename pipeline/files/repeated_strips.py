"""Strips that a dump gives twice: the same rows of a CCD under two ids are one measurement, counted once.

A camera takes one strip at a time, so strips with the same times have the same pixels; where they have not,
one of the times is wrong. Equal files with different times are an error of the table: neither is used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from boresight.geometry.ledger import Entry, Reason
from boresight.geometry.record import Floats
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.equal_files import equal_files

if TYPE_CHECKING:
    from boresight.pipeline.files.strip_table import Strip

__all__ = ["strips_once"]

OVERLAP = 0.5  # of the rows of the shorter strip: from here two strips are one
WINDOW_PX, WINDOWS = 64, 5  # of two strips that are compared
SAME_GROUND = 0.5  # least correlation of windows of the same ground; of independent ground it stays below

Image = tuple[str, int]  # strip and CCD


def strips_once(strips: Sequence[Strip], file: str) -> tuple[tuple[Strip, ...], tuple[Entry, ...]]:
    """The strips without CCDs that repeat those of another one, and omissions for these.

    `RawDataError` for two strips with the same times that show different ground. `file` is their table.
    """
    twice = _same_times(strips, file)
    why = {key: (reason, Reason.REPEATED) for key, reason in twice.items()}
    why |= {key: (reason, Reason.SAME_PIXELS) for key, reason in _same_files(strips, twice).items()}
    once, omitted = [], []
    for strip in strips:
        own = {ccd: why[strip.strip_id, ccd] for ccd in strip.ccd_lines if (strip.strip_id, ccd) in why}
        names = strip.images.names
        if len(own) == len(strip.ccd_lines):
            ccd, (detail, reason) = min(own.items())
            omitted.append(Entry(strip.subject, reason, detail, names.get(ccd, "")))
            continue
        omitted += [
            Entry(strip.ccd_subject(ccd), reason, detail, names.get(ccd, ""))
            for ccd, (detail, reason) in own.items()
        ]
        left = {ccd: lines for ccd, lines in strip.ccd_lines.items() if ccd not in own}
        once.append(replace(strip, ccd_lines=left, images=strip.images.of(left)) if own else strip)
    return tuple(once), tuple(omitted)


def _same_times(strips: Sequence[Strip], file: str) -> dict[Image, str]:
    """Why CCDs are left out whose rows have the times of another strip; of two strips that with more CCDs
    stays, then the earlier one.
    """
    why: dict[Image, str] = {}
    kept: list[Strip] = []
    order = sorted(strips, key=lambda one: (-len(one.ccd_lines), one.t_first_row_s, one.strip_id))
    for strip in order:
        for other in kept:
            if _time_in_common(strip, other) > OVERLAP:
                twice = [ccd for ccd in strip.ccd_lines if ccd in other.ccd_lines]
                _check_same_ground(strip, other, twice, file)
                text = f"its rows have the times of strip {other.strip_id} (utc_first_row): one strip given "
                text += "twice is counted once"
                why = {(strip.strip_id, ccd): text for ccd in twice} | why
        if not all((strip.strip_id, ccd) in why for ccd in strip.ccd_lines):
            kept.append(strip)
    return why


def _same_files(strips: Sequence[Strip], but: Mapping[Image, str]) -> dict[Image, str]:
    """Why images are left out that are equal although their times or CCDs are not; dead detectors stay."""
    every = {(one.strip_id, ccd): one for one in strips for ccd in one.images.paths}
    paths = {key: one.images.paths[key[1]] for key, one in every.items() if key not in but}
    why = {}
    for group in equal_files(paths):
        if _is_flat(every[group[0]], group[0][1]):
            continue
        for key in group:
            other = next(one for one in group if one != key)
            names = [every[strip_id, ccd].images.names[ccd] for strip_id, ccd in (key, other)]
            why[key] = f"{names[0]} has the same pixels as {names[1]} of strip {other[0]}, CCD {other[1]}: "
            why[key] += "one of the two rows names a wrong file"
    return why


def _span_s(strip: Strip) -> tuple[float, float]:
    return strip.t_first_row_s, strip.t_first_row_s + strip.lines * strip.row_period_s


def _time_in_common(a: Strip, b: Strip) -> float:
    """Share of the shorter one of two strips that lies within the time of the other."""
    (a0, a1), (b0, b1) = _span_s(a), _span_s(b)
    return max(0.0, min(a1, b1) - max(a0, b0)) / min(a1 - a0, b1 - b0)


def _check_same_ground(a: Strip, b: Strip, ccds: Sequence[int], file: str) -> None:
    """`RawDataError` where two strips with the same times show different ground."""
    both = [ccd for ccd in ccds if ccd in a.images.paths and ccd in b.images.paths]
    alike = [value for ccd in both[:1] for value in _correlations(a, b, ccd)]
    if alike and float(np.median(alike)) < SAME_GROUND:
        found = f"the same time for {b.strip_id} and {a.strip_id}, whose images of CCD {both[0]} differ"
        raise RawDataError(file, "utc_first_row", found, "a time of its own for each strip")


def _correlations(a: Strip, b: Strip, ccd: int) -> Iterator[float]:
    """Correlations of windows of two strips at the same times."""
    (a0, a1), (b0, b1) = _span_s(a), _span_s(b)
    for share in np.linspace(0.1, 0.9, WINDOWS).tolist():
        t_s = max(a0, b0) + share * (min(a1, b1) - max(a0, b0))
        with suppress(RawDataError, ValueError):
            one, other = _window(a, ccd, t_s, share), _window(b, ccd, t_s, share)
            if one.std() > 0.0 and other.std() > 0.0:
                yield float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def _window(strip: Strip, ccd: int, t_s: float, share: float) -> Floats:
    """Counts around an instant, at a share of the CCD's samples."""
    lines, samples = strip.images.shape(ccd)
    middle = float(strip.clock.lines_of_rows(ccd, strip.clock.row(t_s)))
    top = round(middle) - WINDOW_PX // 2
    top, left = min(max(top, 0), max(lines - WINDOW_PX, 0)), int(share * max(samples - WINDOW_PX, 0))
    below, right = min(top + WINDOW_PX, lines), min(left + WINDOW_PX, samples)
    return strip.images.read(ccd, top, below, left, right).astype(float)


def _is_flat(strip: Strip, ccd: int) -> bool:
    """Whether the middle of an image has one grey value."""
    try:
        return bool(np.ptp(_window(strip, ccd, 0.5 * sum(_span_s(strip)), 0.5)) == 0.0)
    except RawDataError:
        return False
