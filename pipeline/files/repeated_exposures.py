"""Exposures and attitudes that a dump gives twice: one measurement with one error, counted once.

A star camera takes one image at a time: exposures that overlap are one, and of equal images with different
times at most one is what its row says. Attitudes that follow others closely and share their error are copies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtr

from boresight.geometry.ledger import Entry, Reason
from boresight.geometry.record import Bools, Floats
from boresight.pipeline.files.attitude_files import AttitudeRows
from boresight.pipeline.files.equal_files import equal_files, grouped
from boresight.pipeline.files.star_side import Exposure, Head, SolvedAttitudes, StarCentroids, StarImages

__all__ = ["exposures_once"]

OVERLAP = 0.5  # of the shorter exposure: mid-exposures closer than this are those of one exposure
CLOSE = 0.1  # of the longer step beside: attitudes closer than this may be one attitude given twice
PROBABILITY_COMMON = 1e-6  # that independent errors agree as well as those of attitudes given twice


def exposures_once(heads: Sequence[Head]) -> tuple[tuple[Head, ...], tuple[Entry, ...]]:
    """The heads without exposures or attitudes that repeat others, and omissions for these."""
    once, omitted = [], list[Entry]()
    for head in heads:
        source, omissions = _once(head)
        once.append(replace(head, source=source) if omissions else head)
        omitted += omissions
    return tuple(once), tuple(omitted)


def _once(head: Head) -> tuple[StarImages | StarCentroids | SolvedAttitudes, list[Entry]]:
    if isinstance(head.source, SolvedAttitudes):
        return _attitudes_once(head, head.source)
    return _images_once(head.source)


def _images_once(
    source: StarImages | StarCentroids,
) -> tuple[StarImages | StarCentroids, list[Entry]]:
    exposures = source.exposures
    if isinstance(source, StarCentroids):
        lists = {k: one.xy_px.tobytes() for k, one in enumerate(source.lists) if one is not None}
        equal = grouped(lists, lists.__getitem__)
    else:
        equal = equal_files({k: one.path for k, one in enumerate(exposures)})
    twice = overlapping(exposures)
    wrong = _same_pixels(exposures, [[k for k in group if k not in twice] for group in equal])
    omitted = [exposures[k].item.because(Reason.REPEATED, why) for k, why in twice.items()]
    omitted += [exposures[k].item.because(Reason.SAME_PIXELS, why) for k, why in wrong.items()]
    left = [k for k in range(len(exposures)) if k not in twice and k not in wrong]
    once = replace(source, exposures=tuple(exposures[k] for k in left))
    if isinstance(once, StarCentroids):
        once = replace(once, lists=tuple(once.lists[k] for k in left))
    return once, omitted


def overlapping(exposures: Sequence[Exposure]) -> dict[int, str]:
    """Why exposures, in order of time, are left out that overlap the last one before them that is not."""
    why, last = dict[int, str](), 0
    for k, one in enumerate(exposures[1:], start=1):
        before = exposures[last]
        if (apart_s := one.t_s - before.t_s) < OVERLAP * min(one.exposure_s, before.exposure_s):
            why[k] = f"its utc_mid is {apart_s:.3g} s after that of {before.exposure_id}, which lasts "
            why[k] += f"{before.exposure_s:g} s: one exposure given twice is counted once"
        else:
            last = k
    return why


def _same_pixels(exposures: Sequence[Exposure], groups: Sequence[Sequence[int]]) -> dict[int, str]:
    """Why exposures are left out whose images are equal although their times are not."""
    why = {}
    for group in groups:
        for k in group if len(group) > 1 else ():
            one, other = exposures[k], exposures[next(n for n in group if n != k)]
            why[k] = f"{one.file} has the same pixels as {other.file} of {other.exposure_id}, "
            why[k] += f"{abs(one.t_s - other.t_s):.3g} s apart: one of the two rows names a wrong file"
    return why


def _attitudes_once(head: Head, source: SolvedAttitudes) -> tuple[SolvedAttitudes, list[Entry]]:
    repeated = common_errors(source.rows, head.noise.white_covariance_s)
    if not repeated.any():
        return source, []
    reason = f"{repeated.sum()} of {len(repeated)} attitudes of {source.file} follow another one closely and "
    reason += "have the same error: each is counted once"
    omission = Entry(head.subject, Reason.REPEATED, reason, source.file)
    return replace(source, rows=_rows(source.rows, ~repeated)), [omission]


def common_errors(rows: AttitudeRows, white_s: Floats) -> Bools:
    """Which attitudes (N,) are copies of the one before: they follow it closely, and all such rows together
    differ from it by less than independent errors do.

    `white_s` (3, 3) is the covariance of an attitude where the rows state none, rad².
    """
    t_s, R = rows.t_s, rows.R_si
    repeated, step = np.zeros(len(t_s), dtype=bool), np.diff(t_s)
    beside = np.maximum(np.append(step[1:], 0.0), np.append(0.0, step[:-1]))
    close = np.flatnonzero(step < CLOSE * beside)
    if not len(close):
        return repeated
    first, last = np.maximum(close - 1, 0), np.minimum(close + 2, len(t_s) - 1)
    rate = (R[last] * R[first].inv()).as_rotvec() / (t_s[last] - t_s[first])[:, None]
    apart = (R[close + 1] * R[close].inv()).as_rotvec() - rate * step[close, None]
    one = np.tile(white_s, (len(close), 1, 1)) if rows.covariance_s is None else rows.covariance_s[close]
    statistic = float(np.einsum("ni,nij,nj->", apart, np.linalg.inv(2.0 * one), apart))
    repeated[close + 1] = chdtr(3 * len(close), statistic) < PROBABILITY_COMMON
    return repeated


def _rows(rows: AttitudeRows, kept: Bools) -> AttitudeRows:
    return replace(
        rows,
        t_s=rows.t_s[kept],
        R_si=rows.R_si[kept],
        covariance_s=None if rows.covariance_s is None else rows.covariance_s[kept],
        temperature_c=None if rows.temperature_c is None else rows.temperature_c[kept],
    )
