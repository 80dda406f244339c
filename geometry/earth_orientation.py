"""Earth orientation parameters of the IERS, day by day: UT1, polar motion and celestial pole offsets.

The bundled tables come with the package astropy-iers-data, so nothing is downloaded at run time: the final
series EOP 20 C04 to its end, then the rapid values and predictions of finals2000A (Bulletin A). The
celestial pole offsets refer to IAU 2006/2000A precession-nutation.
"""

from __future__ import annotations

import importlib.resources
from functools import cache

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC, EARTH_ROTATION_RATE
from boresight.geometry.epoch import tai_minus_utc_s
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = [
    "EarthOrientationError",
    "EarthOrientationTable",
    "EarthOrientationWarning",
    "bundled_earth_orientation",
    "expected_error_m",
    "expected_rotation_error_rad",
]


_MJD_1972 = 41317.0  # 1972-01-01, MJD: before it UTC had no leap seconds, and the table is not used
_EQUATOR_SPEED = 465.1  # m/s on the equator: displacement per second of UT1
# Metres on the ground by a rotation of the Earth of one arc-second, for its mean radius of 6371 km.
_METRES_PER_ARCSEC = 6_371_000.0 * ARCSEC


class EarthOrientationError(ValueError):
    """A date lies outside the Earth-orientation table."""


class EarthOrientationWarning(UserWarning):
    """Earth orientation is extrapolated, or predicted so far ahead that it shows on the ground."""


@record(kw_only=True)
class EarthOrientationTable:
    """Daily values at 0h UTC (N rows, N >= 4). Values after `mjd_last_measured` are predictions.

    Raises `ValueError` for values that are not finite or days that are not consecutive.
    """

    mjd_utc: Floats = array("N", "whole days (UTC), increasing by one")
    ut1_utc_s: Floats = array("N", "UT1 - UTC, s")
    xp_rad: Floats = array("N", "pole coordinate x, rad")
    yp_rad: Floats = array("N", "pole coordinate y, rad")
    dx_rad: Floats = array("N", "celestial pole offset dX to IAU 2006/2000A, rad")
    dy_rad: Floats = array("N", "celestial pole offset dY to IAU 2006/2000A, rad")
    source: str = scalar("name of the series")
    mjd_last_measured: float = scalar("modified Julian date (UTC) of the last measured UT1")

    def __post_init__(self) -> None:
        n = len(self.mjd_utc)
        for name in ("mjd_utc", "ut1_utc_s", "xp_rad", "yp_rad", "dx_rad", "dy_rad"):
            values = getattr(self, name)
            if not np.all(np.isfinite(values)):
                raise ValueError(f"EarthOrientationTable.{name} must be finite")
        if n < 4 or not np.all(np.diff(self.mjd_utc) == 1.0) or np.any(self.mjd_utc % 1.0):
            raise ValueError("EarthOrientationTable.mjd_utc must be at least 4 consecutive whole days")


@cache
def bundled_earth_orientation() -> EarthOrientationTable:
    """Table of the installed astropy-iers-data: EOP 20 C04 from 1972, then finals2000A with predictions; read
    once per process.

    Raises `EarthOrientationError` where its leap seconds are not those of ERFA.
    """
    package = importlib.resources.files("astropy_iers_data")
    final = _parse_c04((package / "data" / "eopc04.1962-now").read_bytes())
    rapid, last_measured = _parse_finals((package / "data" / "finals2000A.all").read_bytes(), final[-1, 0])
    _check_leap_seconds((package / "data" / "Leap_Second.dat").read_text(encoding="ascii"))
    final = final[final[:, 0] >= _MJD_1972]
    table = np.vstack([final, rapid])
    mjd, ut1_utc, xp, yp, dx, dy = np.ascontiguousarray(table.T)
    return EarthOrientationTable(
        mjd_utc=mjd,
        ut1_utc_s=ut1_utc,
        xp_rad=xp,
        yp_rad=yp,
        dx_rad=dx,
        dy_rad=dy,
        source="astropy-iers-data: EOP 20 C04, then finals2000A",
        mjd_last_measured=max(final[-1, 0], last_measured),
    )


def expected_error_m(days_ahead: float, days_past: float) -> float:
    """1-sigma displacement on the equator, m, of values predicted `days_ahead` past the last measurement,
    then extrapolated `days_past` the table.
    """
    return float(np.hypot(np.hypot(*_prediction_m(days_ahead)), np.hypot(*_extrapolation_m(days_past))))


def expected_rotation_error_rad(days_ahead: float, days_past: float) -> Floats:
    """1-sigma (3,), rad, of a small rotation of the Earth about the axes of ITRS: twice the pole, then UT1.

    Values are predicted `days_ahead` past the last measurement, then extrapolated `days_past` the table.
    """
    ut1_m, pole_m = np.hypot(_prediction_m(days_ahead), _extrapolation_m(days_past))
    pole_rad = pole_m / _METRES_PER_ARCSEC * ARCSEC
    return np.array([pole_rad, pole_rad, ut1_m / _EQUATOR_SPEED * EARTH_ROTATION_RATE])


def _prediction_m(days_ahead: float) -> tuple[float, float]:
    """1-sigma on the ground of predicted UT1 and of each predicted pole coordinate: IERS Bulletin A states
    0.00025 s D^0.75 and 0.00068" D^0.80.
    """
    days = max(days_ahead, 0.0)
    return 0.00025 * days**0.75 * _EQUATOR_SPEED, 0.00068 * days**0.80 * _METRES_PER_ARCSEC


def _extrapolation_m(days_past: float) -> tuple[float, float]:
    """The same where UT1 goes on at its mean rate of a year and the pole stays: rms over the tables since
    1990, UT1 10 m after 60 days.
    """
    days = max(days_past, 0.0)
    return 0.25 * days**0.9, min(0.05 * days, 6.0)


def _parse_c04(text: bytes) -> Floats:
    """Rows of MJD, UT1 - UTC, xp, yp, dX, dY (s and rad) of an EOP 20 C04 file."""
    lines = _lines(text[text.rindex(b"#") :].partition(b"\n")[2])
    places = ((16, 26), (50, 62), (26, 38), (38, 50), (62, 74), (74, 86))
    columns = np.column_stack([_numbers(lines[:, slice(*place)]) for place in places])
    columns[:, 2:] *= ARCSEC
    return columns


def _parse_finals(text: bytes, after_mjd: float) -> tuple[Floats, float]:
    """Rows of MJD, UT1 - UTC, xp, yp, dX, dY (s, rad) of finals2000A.all after a day, and the MJD of its last
    measured UT1.

    Days without a celestial pole offset (late predictions) take the last one given.
    """
    lines = _lines(text)
    lines = lines[_is_given(lines, 58, 68) & _is_given(lines, 18, 27)]
    mjd = _field(lines, 7, 15).astype(float)
    measured, new = mjd[lines[:, 57] == b"I"], mjd > after_mjd
    given = _is_given(lines, 97, 106) & _is_given(lines, 116, 125)
    latest = np.maximum.accumulate(np.where(given, np.arange(len(lines)), 0))[new]
    columns = np.zeros((len(latest), 6))
    columns[:, 0] = mjd[new]
    for n, place in enumerate(((58, 68), (18, 27), (37, 46)), 1):
        columns[:, n] = _field(lines[new], *place)
    for n, place in enumerate(((97, 106), (116, 125)), 4):
        columns[:, n] = 1e-3 * np.where(given[latest], _field(lines[latest], *place), b"0").astype(float)
    columns[:, 2:] *= ARCSEC
    return columns, float(measured[-1]) if len(measured) else -np.inf


def _lines(text: bytes) -> NDArray[np.bytes_]:
    """(N, W) characters of lines of equal lengths; `ValueError` for others."""
    return np.frombuffer(text, dtype="S1").reshape(-1, text.index(b"\n") + 1)


def _numbers(field: NDArray[np.bytes_]) -> Floats:
    """(N,) decimal numbers (N, W) with their points one below the other, each a whole number over a power of
    ten: rounded once, as one that is read from text.
    """
    code, point = np.ascontiguousarray(field).view(np.uint8), int(np.flatnonzero(field[0] == b".")[0])
    places = np.insert(10.0 ** np.arange(field.shape[1] - 1)[::-1], point, 0.0)
    whole = np.where(code >= ord("0"), code - float(ord("0")), 0.0) @ places
    return np.copysign(whole, 0.5 - (code == ord("-")).any(axis=1)) / 10.0 ** (field.shape[1] - 1 - point)


def _field(lines: NDArray[np.bytes_], first: int, end: int) -> NDArray[np.bytes_]:
    """(N,) the characters `first` to before `end` of each line."""
    return np.ascontiguousarray(lines[:, first:end]).view(f"S{end - first}")[:, 0]


def _is_given(lines: NDArray[np.bytes_], first: int, end: int) -> Bools:
    """(N,) whether a field of each line is not blank."""
    return np.asarray((lines[:, first:end] != b" ").any(axis=1))


def _check_leap_seconds(text: str) -> None:
    """Raise `EarthOrientationError` unless the tables' leap seconds are ERFA's (else UT1 is wrong by 1 s)."""
    for line in text.splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            mjd, *_, offset = line.split()
            if float(tai_minus_utc_s(float(mjd))) != float(offset):
                raise EarthOrientationError(
                    f"TAI - UTC at MJD {mjd} is {offset} s in the IERS tables and "
                    f"{tai_minus_utc_s(float(mjd))} s in ERFA; install a newer pyerfa"
                )
