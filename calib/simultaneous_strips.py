"""Strips that the satellite took at the same time, as one pass.

Such strips (of CCDs with clocks of their own, of bands, pieces of a long strip) see the same attitudes, the
same position and the same clock. How they are cut and named is bookkeeping: their errors are eliminated once,
and each exposure counts once, whichever strips list it. Strips are of one pass where the spans of their
exposures overlap or touch, at most one and a half steps of the exposures apart; errors of the satellite are
constant over a pass, and independent from pass to pass. A strip around which the reference head has no
exposure is of the pass whose exposures cover it; else another head carries it (`heads`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from boresight.calib.hypotheses import MovedInput
from boresight.geometry.attitude import ConstantRate
from boresight.geometry.attitude_estimate import AttitudeSettings, with_attitudes
from boresight.geometry.gyro import GyroRows, longest_without_gap
from boresight.geometry.sightings import ExposureAttitudes, GroundSightings, HeadAttitudes, StripSightings
from boresight.records.record import Floats, Ints, concatenated

__all__ = ["groups_of", "moved_in_passes", "passes_of"]

REACH_STEPS = 0.75  # beyond the first and last exposure of a strip, within which another strip touches it
REACH_S = 0.5  # the same of one exposure alone: it covers half a second (`strips`)
INSTANT_S = 1e-9  # exposures of one instant: two dumps count seconds from epochs of their own

Span = tuple[float, float]


def passes_of(strips: Sequence[StripSightings], limits: AttitudeSettings) -> list[StripSightings]:
    """The passes of strips in any order, each with the id of its first strip, in order of ids; attitudes are
    fitted by `limits` where strips have none. A strip by itself stays what it is.

    Raises `ValueError` if two strips share one id, or list exposures of one instant that differ.
    """
    strips = sorted(strips, key=lambda strip: strip.strip_id)
    for one, after in pairwise(strips):
        if one.strip_id == after.strip_id:
            raise ValueError(f"two strips have the id {one.strip_id!r}")
    groups = groups_of(with_attitudes(strips, limits))
    return sorted(map(_joined, groups), key=lambda strip: strip.strip_id)


def groups_of(strips: Sequence[StripSightings]) -> list[list[StripSightings]]:
    """The strips of each pass."""
    groups: list[list[StripSightings]] = []
    for carrier in sorted({strip.carrier for strip in strips}):
        seen = [strip for strip in strips if strip.exposures and strip.carrier == carrier]
        groups += _touching(seen, [_reach_s(strip.times_s) for strip in seen])
    covered = [_reach_s(np.unique(np.concatenate([one.times_s for one in group]))) for group in groups]
    blind: list[StripSightings] = []
    for strip in strips:
        if strip.exposures:
            continue
        t_s = strip.ground.t_s
        by = [
            group
            for group, (first, last) in zip(groups, covered)
            if len(t_s) and first <= t_s.min() and t_s.max() <= last
        ]
        (by[0] if by else blind).append(strip)
    spans = []
    for strip in blind:
        times = np.unique(np.concatenate([np.zeros(0), *(other.t_s for other in strip.others)]))
        spans.append(_reach_s(times if len(times) else np.unique(strip.ground.t_s)))
    return groups + _touching(blind, spans)


def moved_in_passes(
    moved: MovedInput, strips: Sequence[StripSightings], passes: Sequence[StripSightings]
) -> MovedInput:
    """What a moved input does, pass by pass, from what it does strip by strip."""
    by_id = {strip.strip_id: strip for strip in strips}
    directions, turns = dict(moved.directions_i), dict(moved.turns_s)
    for one in passes:
        members = [by_id[name] for name, _, _ in one.parts]
        own = [directions.get(s.strip_id, np.zeros((len(s.ground.t_s), 3))) for s in members]
        directions[one.strip_id] = np.concatenate(own)
        rows = _first_of_each(np.concatenate([strip.times_s for strip in members]))
        own = [turns.get(s.strip_id, np.zeros((len(s.exposures), 3))) for s in members]
        turns[one.strip_id] = np.concatenate(own)[rows]
    return replace(moved, directions_i=directions, turns_s=turns)


def _touching(strips: Sequence[StripSightings], spans: Sequence[Span]) -> list[list[StripSightings]]:
    """Groups of strips whose spans overlap."""
    groups: list[list[StripSightings]] = []
    end = -np.inf
    for n in sorted(range(len(strips)), key=lambda n: (spans[n], strips[n].strip_id)):
        if spans[n][0] > end or np.isinf(end):
            groups.append([])
        groups[-1].append(strips[n])
        end = max(end, spans[n][1])
    return groups


def _reach_s(times: Floats) -> Span:
    """Span within which another strip touches one with exposures at `times` (K,), increasing."""
    if not len(times):
        return np.inf, np.inf
    reach = REACH_STEPS * float(np.diff(times).max()) if len(times) > 1 else REACH_S
    return float(times[0]) - reach, float(times[-1]) + reach


def _joined(strips: list[StripSightings]) -> StripSightings:
    """Strips of one pass as one: all targets, in order of the strips' ids, and every exposure once.

    `ValueError` where exposures of one instant hold other stars.
    """
    if len(strips) == 1:
        return strips[0]
    strips = sorted(strips, key=lambda strip: strip.strip_id)
    listed = [(strip.strip_id, exposure) for strip in strips for exposure in strip.exposures]
    number = _instants(np.array([exposure.t_s for _, exposure in listed]))
    rows = np.unique(number, return_index=True)[1]
    for (strip_id, exposure), n in zip(listed, rows[number].tolist()):
        other_id, other = listed[n]
        if exposure is not other and not np.array_equal(exposure.u_s, other.u_s):
            raise ValueError(
                f"exposure {exposure.exposure_id} of strip {strip_id} and {other.exposure_id} of strip "
                f"{other_id} are of one instant, {exposure.t_s:.6f} s, and hold other stars"
            )
    others = [other for strip in strips for other in strip.others]
    heads = sorted({other.head for other in others})
    records = [HeadAttitudes.together([one for one in others if one.head == head]) for head in heads]
    found = replace(
        strips[0],
        exposures=tuple(listed[n][1] for n in rows.tolist()),
        ground=GroundSightings.together([strip.ground for strip in strips]),
        R_oi_exposures=concatenated([strip.R_oi_exposures for strip in strips])[rows],
        R_oi_targets=concatenated([strip.R_oi_targets for strip in strips]),
        attitudes=ExposureAttitudes.together([strip.fitted for strip in strips]).take(rows),
        others=tuple(one.take(_first_of_each(one.t_s)) for one in records),
        gyro=_gyro_of(strips),
        joined=tuple(part for strip in strips for part in strip.parts),
    )
    same = all(np.array_equal(strip.times_s, strips[0].times_s) for strip in strips)
    return found if same or not found.ground.is_star.all() else _about_one_motion(found)


def _about_one_motion(scan: StripSightings) -> StripSightings:
    """A scan of the sky, whose nominal motion was that of each piece, about one motion."""
    times, R_si, _, _ = scan.usable()
    if len(times) < 2:
        return scan
    motion = ConstantRate.fitted(times, R_si)
    return replace(
        scan,
        R_oi_exposures=motion.R_oi(scan.times_s),
        R_oi_targets=motion.R_oi(scan.ground.t_s),
        others=tuple(replace(one, R_oi=motion.R_oi(one.t_s)) for one in scan.others),
        gyro=scan.gyro and replace(scan.gyro, R_oi=motion.R_oi(scan.gyro.t_s)),
    )


def _gyro_of(strips: Sequence[StripSightings]) -> GyroRows | None:
    """Rows of the gyro around strips, each once, as long as they have no gap."""
    parts = [strip.gyro for strip in strips if strip.gyro is not None]
    if not parts:
        return None
    every = GyroRows.together(parts)
    once = every.take(_first_of_each(every.t_s))
    return once.take(longest_without_gap(once.t_s))


def _first_of_each(t_s: Floats) -> Ints:
    """Rows, in order of time, of the first that has each instant."""
    return np.asarray(np.unique(_instants(t_s), return_index=True)[1], dtype=np.int64)


def _instants(t_s: Floats) -> Ints:
    """Number, in order of time, of the instant of each row (N,)."""
    order = np.argsort(t_s, kind="stable")
    number = np.zeros(len(t_s), dtype=np.int64)
    number[order[1:]] = np.cumsum(np.diff(t_s[order]) > INSTANT_S)
    return number
