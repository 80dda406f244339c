"""Instants: seconds of International Atomic Time (TAI) since a stated epoch; conversion to UTC, TT, GPS time.

Inside the program an instant is `t_s`, a float of TAI seconds since an `Epoch`. An `Epoch` is a whole TAI
second near the observations, so that `t_s` stays small and resolves less than a nanosecond. UTC, with its
leap seconds, occurs only in text. UTC before 1972 (not a whole number of seconds from TAI) raises
`ValueError`.

Scales: TT = TAI + 32.184 s; GPS time = TAI - 19 s; UTC = TAI - (10 ... 37 s) by the table of leap seconds in
ERFA; NAIF's ephemeris time (ET) is barycentric dynamical time (TDB) past J2000 by the formula of SPICE, so
that instants agree to the rounding of ET, whose double resolves 0.1 µs in this century.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import erfa
import numpy as np
from numpy.typing import ArrayLike

from boresight.geometry.constants import DAY_S
from boresight.records.record import Floats, Ints

__all__ = [
    "GPS_MINUS_TAI_S",
    "TT_MINUS_TAI_S",
    "Epoch",
    "ephemeris_time",
    "seconds_from_ephemeris_time",
    "tai_minus_utc_s",
]


TT_MINUS_TAI_S = 32.184  # s, IAU 1991 Recommendation IV
GPS_MINUS_TAI_S = -19  # s, IS-GPS-200: GPS time met UTC on 1980-01-06
J2000_JD = 2451545.0  # 2000-01-01T12:00:00, the origin of `Epoch.tai_s`
MJD_ZERO_JD = 2400000.5  # Julian date of MJD 0
MJD_OF_ORIGIN = 51544  # the day whose noon is the origin
_DAY = 86_400  # seconds of a day without leap second
_NOON = 43_200  # seconds from midnight to noon: days of UTC begin at midnight, `tai_s` counts from noon
_NOON_OF_ORIGIN = datetime.datetime(2000, 1, 1, 12)  # origin of `Epoch.tai_s` as a calendar date
_MJD_1972 = 41317  # 1972-01-01, MJD: the first day of UTC with whole leap seconds
# Regular expression of a UTC date with or without time, ISO 8601, to 1e-18 s: day, minute, second, fraction.
_DATE_TIME = re.compile(r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d:\d\d):(\d\d)(\.\d{1,18})?)?Z?", re.A)
_NO_SUCH_TIME = "no such time of day (no leap second is known there)"
# Day 0 of MJD, 1858-11-17, in Python's count of days.
_MODIFIED_JULIAN_ZERO = datetime.date(1858, 11, 17).toordinal()


@dataclass(frozen=True, slots=True, order=True)
class Epoch:
    """A whole TAI second, counted from 2000-01-01T12:00:00 TAI. Times near it are float seconds since it."""

    tai_s: int

    @staticmethod
    def from_utc(utc: str) -> Epoch:
        """The whole TAI second at or before a UTC date and time in ISO form, `2024-06-30T23:59:60.5Z`.

        Raises `ValueError` for text of another form, a day that is not in the calendar, second 60 where no
        leap second was inserted, and any date before 1972.
        """
        return Epoch(_tai_from_utc(utc)[0])

    def seconds_from_utc(self, utc: Sequence[str]) -> Floats:
        """TAI seconds since this epoch of UTC dates in ISO form; (N,). Errors as in `from_utc`."""
        parts = [_tai_from_utc(text) for text in utc]
        whole = np.array([second - self.tai_s for second, _ in parts], dtype=float)
        return whole + np.array([fraction for _, fraction in parts], dtype=float)

    def seconds_from_gps_dates(self, dates: Sequence[str]) -> Floats:
        """TAI seconds since this epoch of calendar dates in GPS time, `2020-08-16T12:02:45.812731`; (N,).

        GPS time has no leap seconds, so such a date is 18 s ahead of UTC in 2020. `ValueError` for text of
        another form and days that are not in the calendar.
        """
        seconds = np.empty(len(dates))
        for n, text in enumerate(dates):
            match = _DATE_TIME.fullmatch(text.strip())
            if match is None or match[2] is None:
                raise ValueError(f"a GPS date must look like 2020-08-16T12:02:45.812731, found {text!r}")
            parts = (*match[1].split("-"), *match[2].split(":"), match[3])
            try:
                date = datetime.datetime(*(int(part) for part in parts))  # type: ignore[arg-type]
            except ValueError as error:
                raise ValueError(f"GPS date {text!r}: {error}") from None
            since = date - _NOON_OF_ORIGIN
            whole = since.days * _DAY + since.seconds - GPS_MINUS_TAI_S - self.tai_s
            seconds[n] = whole + float(match[4] or 0)
        return seconds

    def utc_from_seconds(self, t_s: ArrayLike) -> list[str]:
        """UTC in ISO form with nine decimals (rounded to the nanosecond) of TAI seconds since this epoch."""
        seconds = np.atleast_1d(np.asarray(t_s, dtype=float))
        whole = np.floor(seconds)
        nanoseconds = np.rint((seconds - whole) * 1e9).astype(np.int64)
        return [
            _utc_from_tai(self.tai_s + int(second) + int(nano) // 10**9, int(nano) % 10**9)
            for second, nano in zip(whole, nanoseconds)
        ]

    def tai_jd(self, t_s: ArrayLike) -> tuple[Floats, Floats]:
        """Two-part Julian date (TAI), elementwise: the epoch's noon and days since then, exact to 1e-11 s."""
        day, second = divmod(self.tai_s, _DAY)
        t = np.asarray(t_s, dtype=float)
        return np.full(t.shape, J2000_JD + day), (t + second) / DAY_S

    def tt_jd(self, t_s: ArrayLike) -> tuple[Floats, Floats]:
        """Two-part Julian date (TT) of TAI seconds since this epoch, elementwise, split as in `tai_jd`."""
        day, days_since = self.tai_jd(t_s)
        return day, days_since + TT_MINUS_TAI_S / DAY_S

    def julian_year(self, t_s: ArrayLike) -> Floats:
        """Julian epoch (TT, years, e.g. 1991.25) of TAI seconds since this epoch, elementwise."""
        day, days_since = self.tt_jd(t_s)
        return np.asarray(2000.0 + ((day - J2000_JD) + days_since) / 365.25)

    def mjd_tai(self, t_s: ArrayLike) -> Floats:
        """Modified Julian date (TAI) as floats, elementwise, exact to 1 µs: for slowly varying tables."""
        day, days_since = self.tai_jd(t_s)
        return np.asarray((day - MJD_ZERO_JD) + days_since)


def tai_minus_utc_s(mjd_utc: ArrayLike) -> Floats:
    """TAI - UTC, whole seconds, elementwise, on UTC days given as MJD. `ValueError` before 1972."""
    days, offsets = _leap_seconds()
    index = np.searchsorted(days, np.floor(np.asarray(mjd_utc, dtype=float)), side="right") - 1
    if np.any(index < 0):
        raise ValueError(f"UTC before 1972-01-01 (MJD {days[0]}) is not supported")
    return np.asarray(offsets[index], dtype=float)


def ephemeris_time(epoch: Epoch, t_s: ArrayLike) -> Floats:
    """Ephemeris time (N,), s, of TAI seconds since the epoch (N,)."""
    tt = epoch.tai_s + np.asarray(t_s, dtype=float) + TT_MINUS_TAI_S
    return np.asarray(tt + _tdb_minus_tt(tt))


def seconds_from_ephemeris_time(epoch: Epoch, et: ArrayLike) -> Floats:
    """TAI seconds since the epoch (N,) of ephemeris times (N,), s; exact to the rounding of `et`."""
    et = np.asarray(et, dtype=float)
    tt = et
    for _ in range(3):  # the difference changes by 3e-10 of the time
        tt = et - _tdb_minus_tt(tt)
    return np.asarray((et - epoch.tai_s) - TT_MINUS_TAI_S - _tdb_minus_tt(tt))


@cache
def _leap_seconds() -> tuple[Ints, Ints]:
    """MJD of the first day on which each TAI - UTC holds, and that TAI - UTC."""
    table = [row for row in erfa.leap_seconds.get() if row["year"] >= 1972]
    days = [_mjd(int(row["year"]), int(row["month"]), 1) for row in table]
    return np.array(days), np.array([round(float(row["tai_utc"])) for row in table])


def _mjd(year: int, month: int, day: int) -> int:
    return datetime.date(year, month, day).toordinal() - _MODIFIED_JULIAN_ZERO


@lru_cache(maxsize=4096)
def _minute(date: str, time: str) -> tuple[int, int]:
    """TAI seconds from the origin to the begin of a minute of UTC, "2016-12-31" "23:59", and its last one."""
    mjd = _mjd(*(int(part) for part in date.split("-")))
    if mjd < _MJD_1972:
        raise ValueError("dates before 1972-01-01 are not supported")
    hour, minute = (int(part) for part in time.split(":"))
    if hour > 23 or minute > 59:
        raise ValueError(_NO_SUCH_TIME)
    offset, next_day = (int(tai_minus_utc_s(day)) for day in (mjd, mjd + 1))
    begin = (mjd - MJD_OF_ORIGIN) * _DAY - _NOON + hour * 3600 + minute * 60 + offset
    return begin, 60 if next_day > offset and time == "23:59" else 59


def _tai_from_utc(text: str) -> tuple[int, float]:
    """TAI seconds since the origin: whole and fraction."""
    match = _DATE_TIME.fullmatch(text := text.strip())
    if match is None:
        raise ValueError(f"UTC must look like 2024-06-30T23:59:59.123456789, found {text!r}")
    date, time, seconds, fraction = match.groups("0")
    try:
        begin, last = _minute(date, time if len(time) > 1 else "00:00")
        if (second := int(seconds)) > last:
            raise ValueError(_NO_SUCH_TIME)
    except ValueError as error:
        raise ValueError(f"UTC {text!r}: {error}") from None
    return begin + second, float(fraction)


def _utc_from_tai(tai_s: int, nanosecond: int) -> str:
    days, offsets = _leap_seconds()
    starts = (days - MJD_OF_ORIGIN) * _DAY - _NOON + offsets  # TAI at which each offset becomes valid
    index = int(np.searchsorted(starts, tai_s, side="right")) - 1
    if index < 0:
        raise ValueError("UTC before 1972-01-01 is not supported")
    in_leap_second = index + 1 < len(starts) and tai_s >= starts[index + 1] - 1
    utc = tai_s + _NOON - int(offsets[index]) - int(in_leap_second)
    day, second = divmod(utc, _DAY)
    date = datetime.date.fromordinal(day + MJD_OF_ORIGIN + _MODIFIED_JULIAN_ZERO)
    hour, second = divmod(second, 3600)
    minute, second = divmod(second, 60)
    return f"{date.isoformat()}T{hour:02d}:{minute:02d}:{second + int(in_leap_second):02d}.{nanosecond:09d}"


def _tdb_minus_tt(tt: Floats) -> Floats:
    """K sin E, E = M + EB sin M, M = M0 + M1 t, s, with the constants of NAIF's leap-second kernels (Time
    Required Reading): 1.657 ms and yearly.
    """
    M = 6.239996 + 1.99096871e-7 * tt
    return np.asarray(1.657e-3 * np.sin(M + 1.671e-2 * np.sin(M)))
