"""The heads of a dump by themselves: their noise from the whole record of attitudes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.pipeline.head_noise.spectrum import NoiseFit, Signal, difference_signal, fit_noise, pieces_of
from boresight.pipeline.head_noise.tracks import HeadTrack, carried_to, common_instants
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.head import covered_instants, sight_head
from boresight.records.record import Floats, array, record, scalar

__all__ = ["HeadNoise", "attitude_signal", "head_track", "noise_of_heads", "noise_of_tracks"]

LOWEST_HZ = 0.5  # of a single head: slower motion is the satellite's
PIECE_S = 10.0  # length over which errors count as constant, where the dump has no longer strip


@record(kw_only=True)
class HeadNoise:
    """Noise of the heads of a dump."""

    names: tuple[str, ...] = array("H", "heads; the first is the reference head")
    signal: Signal = scalar("what the noise was found from")
    fit: NoiseFit = scalar("noise with errors")


def noise_of_heads(dump: Dump, settings: Settings, lowest_hz: float = LOWEST_HZ) -> HeadNoise:
    """Noise of a dump's heads: by their differences, or of a single one above the motion's frequencies.

    `DataNotSufficientError` for a record that is too short or has too many gaps.
    """
    return noise_of_tracks(dump, [head_track(dump, head, settings)[0] for head in dump.heads], lowest_hz)


def attitude_signal(dump: Dump, settings: Settings) -> tuple[tuple[str, ...], Signal, Floats] | None:
    """Names of the heads that deliver attitudes, the signal that shows their noise, rotation vectors in rad,
    and its instants (K,), s: their differences, or that of a single one against the nominal motion. None
    without such heads or with too few attitudes.
    """
    solved = [head for head in dump.heads if isinstance(head.source, SolvedAttitudes)]
    if not solved:
        return None
    try:
        if len(solved) == len(dump.heads) > 1:
            tracks = [head_track(dump, head, settings)[0] for head in solved]
            return tuple(track.name for track in tracks), *_differences(dump, tracks)
        track = head_track(dump, solved[0], settings)[0]
        return (track.name,), _single(track, LOWEST_HZ), track.t_s
    except (DataNotSufficientError, ValueError):  # too short, or no common instants: no signal
        return None


def head_track(dump: Dump, head: Head, settings: Settings) -> tuple[HeadTrack, Floats | None]:
    """All attitudes (K,) of a head that the orbit covers, and its temperatures (K,), °C, if it states them.

    `DataNotSufficientError` for fewer than two.
    """
    if isinstance(head.source, SolvedAttitudes):
        rows = head.source.rows
        at = np.flatnonzero(covered_instants(dump.orbit, rows.t_s, np.ones(len(rows.t_s), dtype=bool)))
        t_s, temperature = rows.t_s[at], rows.temperature_c
        R_hi = head.source.with_all_aberration(at, dump.epoch, dump.orbit)
        warm = None if temperature is None else temperature[at]
        return HeadTrack(name=head.name, t_s=t_s, R_hi=R_hi, R_oi=dump.orbit.R_oi(t_s)), warm
    sighted = sight_head(dump, head, settings, StageRunner())
    usable = sighted.attitudes.usable
    t_s = np.array([exposure.t_s for exposure in sighted.stars])[usable]
    if len(t_s) < 2:
        raise DataNotSufficientError(f"{head.name}: {len(t_s)} exposures with an attitude, 2 are needed")
    R_hi = Rotation.from_matrix(sighted.attitudes.R_si[usable])
    return HeadTrack(name=head.name, t_s=t_s, R_hi=R_hi, R_oi=dump.orbit.R_oi(t_s)), None


def noise_of_tracks(dump: Dump, tracks: Sequence[HeadTrack], lowest_hz: float = LOWEST_HZ) -> HeadNoise:
    """As `noise_of_heads`, of tracks in the order of the heads; raises `DataNotSufficientError`, too."""
    every = (*dump.strips, *dump.sky_strips)
    longest = max((strip.lines * strip.row_period_s for strip in every), default=0.0)
    signal = _single(tracks[0], lowest_hz) if len(tracks) == 1 else _differences(dump, tracks)[0]
    try:
        fit = fit_noise(signal, max(longest, PIECE_S))
    except ValueError as error:
        raise DataNotSufficientError(f"noise of {', '.join(t.name for t in tracks)}: {error}") from error
    return HeadNoise(names=tuple(track.name for track in tracks), signal=signal, fit=fit)


def _single(track: HeadTrack, lowest_hz: float) -> Signal:
    """A head against the nominal motion."""
    D = track.R_hi * track.R_oi.inv()
    step, pieces = pieces_of(track.t_s)
    values = (D * D[len(D) // 2].inv()).as_rotvec()
    return Signal(values=values, pieces=pieces, step_s=step, enters=np.eye(3)[None], lowest_hz=lowest_hz)


def _differences(dump: Dump, tracks: Sequence[HeadTrack]) -> tuple[Signal, Floats]:
    """The further heads against the reference head at the instants that all have in common."""
    reference, *others = tracks
    pairs = [common_instants(reference, other) for other in others]
    rows = pairs[0][0]
    for first, _ in pairs[1:]:
        rows = np.intersect1d(rows, first)
    if len(rows) < 2:
        raise DataNotSufficientError(f"{', '.join(t.name for t in tracks)}: no attitudes at common instants")
    R_si = reference.R_hi[rows]
    moved = []
    for other, (first, own), head in zip(others, pairs, dump.heads[1:]):
        take = own[np.searchsorted(first, rows)]
        R_hi = carried_to(other, take, reference.t_s[rows], reference.R_oi[rows])
        R_sh = dump.R_cs0.inv() * head.R_cs0
        mean = (R_si * R_hi.inv() * R_sh.inv()).as_rotvec()
        moved.append((R_hi, Rotation.from_rotvec(np.median(mean, axis=0)) * R_sh))
    t_s = reference.t_s[rows]
    return difference_signal(R_si, moved, pieces_of(t_s)), t_s
