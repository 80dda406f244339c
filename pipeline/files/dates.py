"""Dates of a dump's parts against one another: the orbit, star exposures and strips have times in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boresight.geometry.epoch import GPS_MINUS_TAI_S, TT_MINUS_TAI_S, Epoch, tai_minus_utc_s
from boresight.pipeline.errors import RawDataError, refusing
from boresight.records.record import Floats

__all__ = [
    "check_exposure_dates",
    "check_orbit_dates",
    "n_covered",
    "orbit_covers",
    "other_scales",
    "seconds_of",
    "span_text",
]

FAR_S = 60.0  # from every strip: exposures of another pass

Span = tuple[float, float]  # TAI seconds since the epoch


def seconds_of(epoch: Epoch, utc: Sequence[str], file: str, field: str) -> Floats:
    """TAI seconds (N,) since `epoch` of N UTC times; `RawDataError` for times that do not exist."""
    with refusing(file, field, "UTC times that exist"):
        return epoch.seconds_from_utc(utc)


def span_text(epoch: Epoch, first_s: float, last_s: float) -> str:
    """A span of time in UTC to the second: "2024-11-20T03:39:49 to 03:40:57 UTC"."""
    first, last = (text[:19] for text in epoch.utc_from_seconds(np.array([first_s, last_s])))
    return f"{first} to {last[11:] if last[:10] == first[:10] else last} UTC"


def orbit_covers(epoch: Epoch, t_s: Floats, time_system: str, file: str, strips: Sequence[Span]) -> str:
    """What an orbit covers, for a message; and the time system in which its dates would cover every strip,
    where they do not as stated. `t_s` (N,) are its states' times, s.
    """
    text = f"{file} covers {span_text(epoch, float(t_s[0]), float(t_s[-1]))}"
    if n_covered(t_s, strips) < len(strips):
        for other, later_s in other_scales(epoch, time_system, float(t_s[0])):
            if n_covered(t_s + later_s, strips) == len(strips):
                return f"{text}; with TIME_SYSTEM {other}, not {time_system}, it would cover every strip"
    return text


def check_orbit_dates(covers: str, epoch: Epoch, t_s: Floats, file: str, strips: Sequence[Span]) -> None:
    """`RawDataError` where states at `t_s` (N,), s, cover no strip; `covers` as `orbit_covers` has it."""
    if strips and not n_covered(t_s, strips):
        expected = f"states over {_dates_of(epoch, strips)}"
        raise RawDataError(file, "time of the states", covers.removeprefix(f"{file} covers "), expected)


def check_exposure_dates(epoch: Epoch, t_s: Floats, file: str, strips: Sequence[Span]) -> None:
    """`RawDataError` where exposures or attitudes of a dump, at instants (K,), are all far from strips."""
    if (
        strips
        and len(t_s)
        and not any(((t_s > first - FAR_S) & (t_s < last + FAR_S)).any() for first, last in strips)
    ):
        found = span_text(epoch, float(t_s.min()), float(t_s.max()))
        expected = f"times around {_dates_of(epoch, strips)}"
        raise RawDataError(file, "time", found, expected)


def _dates_of(epoch: Epoch, strips: Sequence[Span]) -> str:
    first, last = min(first for first, _ in strips), max(last for _, last in strips)
    return f"the strips, {span_text(epoch, first, last)} (utc_first_row of strips.csv)"


def n_covered(t_s: Floats, strips: Sequence[Span]) -> int:
    """How many strips lie within the times (N,) of an orbit, or of a segment of one."""
    return sum(bool(t_s[0] <= first and last <= t_s[-1]) for first, last in strips)


def other_scales(epoch: Epoch, stated: str, first_s: float) -> list[tuple[str, float]]:
    """The time systems but the `stated` one, and by how many seconds later an instant is whose date is of
    them; `first_s` is about when, TAI seconds since the epoch.
    """
    leap_s = float(tai_minus_utc_s(epoch.mjd_tai(first_s)))
    ahead_s = {"UTC": leap_s, "TAI": 0.0, "TT": -TT_MINUS_TAI_S, "GPS": -float(GPS_MINUS_TAI_S)}
    own = ahead_s.get(stated.strip().upper().replace("TDB", "TT"), 0.0)  # within 2 ms of it
    return [(name, value - own) for name, value in ahead_s.items() if value != own]
