"""Rotations to GCRS: from ITRS at many epochs, and from the other frames that files name.

ITRS: IAU 2006/2000A precession-nutation, Earth rotation angle, polar motion. Slow parts are interpolated by
cubics: X, Y and s from nodes every six hours, the IERS parameters from their daily values (UT1 as UT1 - TAI,
which has no leap seconds). The Earth rotation angle is exact at each epoch. Not modelled: diurnal and
semi-diurnal tides in UT1 and polar motion (<= 0.03 m on the ground).

GCRF and, with the Earth as centre, ICRF have the axes of GCRS. EME2000 has the mean equator and equinox of
J2000; the rotation between the two is the frame bias of IAU 2000, 23 mas (erfa.bp00). Two frames are of date.
TOD has the true equator and equinox by IAU 2006/2000A. TEME, the frame of SGP4, has the true equator and a
mean equinox that the sidereal time of 1982 defines: rotated by it about the pole it becomes the Earth-fixed
frame without polar motion, which the Earth rotation angle makes of the intermediate frame (as in astropy).
Their difference changes by 1.5e-6 arcsec with a second of UT1, so that UTC serves.
"""

from __future__ import annotations

import warnings
from typing import Literal

import erfa
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import DAY_S, EARTH_ROTATION_RATE
from boresight.geometry.earth_orientation import (
    EarthOrientationError,
    EarthOrientationTable,
    EarthOrientationWarning,
    expected_error_m,
    expected_rotation_error_rad,
)
from boresight.geometry.epoch import J2000_JD, MJD_ZERO_JD, Epoch, tai_minus_utc_s
from boresight.records.record import Floats, array, record, scalar

__all__ = [
    "AttitudeFrame",
    "EarthRotation",
    "FrameOfDate",
    "InertialFrame",
    "of_date_to_gcrs",
    "rotation_to_gcrs",
]

InertialFrame = Literal["GCRF", "ICRF", "EME2000"]
AttitudeFrame = Literal[InertialFrame, "ITRF"]  # what attitudes may be stated against
FrameOfDate = Literal["TEME", "TOD"]

_NODE_DAYS = 0.25  # nutation of 9 days and 50 mas is interpolated to 1e-9 rad and better
# Days before the end of the table from which its trend is taken: a shorter baseline is biased by tides and
# seasons.
_YEAR_DAYS = 365
_NOTICEABLE_M = 0.1  # predictions with a larger stated error give a warning


@record(kw_only=True)
class EarthRotation:
    """Rotation between ITRS (e) and GCRS (i) over a time interval; built by `EarthRotation.over`."""

    epoch: Epoch = scalar("origin of t_s")
    t_start_s: float = scalar("begin of the interval, TAI seconds since the epoch")
    t_stop_s: float = scalar("end of the interval, TAI seconds since the epoch")
    node_mjd_tai: Floats = array("K", "nodes of precession-nutation, MJD (TAI)")
    node_xys_rad: Floats = array("K, 3", "X and Y without offsets, and s, rad")
    day_mjd_tai: Floats = array("D", "days of the IERS table, MJD (TAI)")
    day_values: Floats = array("D, 5", "UT1 - TAI (s), xp, yp, dX, dY (rad)")
    omega_e: Floats = array("3", "angular velocity of e relative to i at mid-interval, axes of e, rad/s")
    expected_error_m: float = scalar("1-sigma on the equator of predicted or extrapolated values, else 0")
    sigma_e_rad: Floats = array("3", "1-sigma of a rotation about the axes of e by these values, rad; else 0")
    mjd_last_measured: float = scalar("day of the last measured UT1 of the table, MJD (UTC)")

    @property
    def prediction(self) -> str:
        """Which prediction this is, "LAST/DAY": days (MJD) of the last measured value and of the end of the
        interval; empty for measured values.
        """
        day = np.ceil(float(self.epoch.mjd_tai(self.t_stop_s)) - 37.0 / DAY_S)
        return f"{self.mjd_last_measured:.0f}/{day:.0f}" if self.sigma_e_rad.any() else ""

    @staticmethod
    def over(
        epoch: Epoch,
        t_start_s: float,
        t_stop_s: float,
        table: EarthOrientationTable,
        *,
        allow_stale_eop: bool = False,
    ) -> EarthRotation:
        """Earth rotation for `t_start_s` <= t_s <= `t_stop_s` (TAI seconds since `epoch`).

        Raises `EarthOrientationError` for a date outside the table, `ValueError` for an inverted interval.
        With `allow_stale_eop`, later dates use the last values (UT1 extrapolated at its mean rate of a year),
        with an `EarthOrientationWarning` that states the size of the effect.
        """
        start, stop = (float(epoch.mjd_tai(t)) for t in (t_start_s, t_stop_s))
        if not start <= stop:
            raise ValueError(f"t_start_s must not be after t_stop_s, got {t_start_s} and {t_stop_s}")
        error_m, sigma_e_rad = _check_dates(epoch, t_start_s, t_stop_s, table, allow_stale_eop)
        days, values = _daily_values(table, start, stop)
        nodes = np.arange(np.floor(start / _NODE_DAYS) - 1, np.ceil(stop / _NODE_DAYS) + 2) * _NODE_DAYS
        nodes = nodes if len(nodes) >= 4 else nodes[0] + _NODE_DAYS * np.arange(4)
        xys = np.stack(erfa.xys06a(MJD_ZERO_JD, nodes + (32.184 / DAY_S)), axis=-1)
        omega_e = _angular_velocity(days, values, 0.5 * (start + stop))
        return EarthRotation(
            epoch=epoch,
            t_start_s=float(t_start_s),
            t_stop_s=float(t_stop_s),
            node_mjd_tai=nodes,
            node_xys_rad=xys,
            day_mjd_tai=days,
            day_values=values,
            omega_e=omega_e,
            expected_error_m=error_m,
            sigma_e_rad=sigma_e_rad,
            mjd_last_measured=float(table.mjd_last_measured),
        )

    def matrices_ie(self, t_s: ArrayLike) -> Floats:
        """Matrices `R_ie` (N, 3, 3), ITRS to GCRS, at `t_s` (N,). `ValueError` outside the interval."""
        t = np.atleast_1d(np.asarray(t_s, dtype=float))
        self._check_inside(t)
        mjd = self.epoch.mjd_tai(t)
        x, y, s = _cubic(self.node_mjd_tai, self.node_xys_rad, mjd).T
        ut1_tai_s, xp, yp, dx, dy = _cubic(self.day_mjd_tai, self.day_values, mjd).T
        # era00 at each epoch would round to 2e-14 rad (0.1 um on the ground): from one epoch on it is linear
        era = erfa.era00(*self.epoch.tai_jd(0.0)) + EARTH_ROTATION_RATE * (t + ut1_tai_s)
        tt_day, tt_since = self.epoch.tt_jd(t)
        polar_motion = erfa.pom00(xp, yp, erfa.sp00(tt_day, tt_since))
        celestial = erfa.c2ixys(x + dx, y + dy, s)
        return np.asarray(np.swapaxes(erfa.c2tcio(celestial, era, polar_motion), -1, -2))

    def rotations_ie(self, t_s: ArrayLike) -> Rotation:
        """Rotations `R_ie` (N,), ITRS to GCRS, at `t_s` (N,). `ValueError` outside the interval."""
        return Rotation.from_matrix(self.matrices_ie(t_s))

    def _check_inside(self, t: Floats) -> None:
        slack = 1e-3  # s, light times and rounding
        if t.size and not (t.min() >= self.t_start_s - slack and t.max() <= self.t_stop_s + slack):
            raise ValueError(
                f"Earth rotation was prepared for {self.t_start_s:.3f} to {self.t_stop_s:.3f} s, "
                f"asked for {t.min():.3f} to {t.max():.3f} s"
            )


def rotation_to_gcrs(frame: InertialFrame) -> Rotation:
    """The rotation that takes vectors of an inertial frame to GCRS."""
    if frame == "EME2000":
        bias, _, _ = erfa.bp00(J2000_JD, 0.0)
        return Rotation.from_matrix(bias).inv()
    return Rotation.identity()


def of_date_to_gcrs(frame: FrameOfDate, epoch: Epoch, t_s: ArrayLike) -> Rotation:
    """The rotations (N,) that take vectors of a frame of date to GCRS at instants (N,), TAI seconds."""
    t = np.atleast_1d(np.asarray(t_s, dtype=float))
    tt = epoch.tt_jd(t)
    if frame == "TOD":
        return Rotation.from_matrix(erfa.pnm06a(*tt)).inv()
    mjd = epoch.mjd_tai(t)
    ut1 = MJD_ZERO_JD, mjd - tai_minus_utc_s(mjd) / DAY_S
    turn = erfa.era00(*ut1) - erfa.gmst82(*ut1)
    R_teme_cirs = Rotation.from_rotvec(np.outer(turn, [0.0, 0.0, -1.0]))
    return (R_teme_cirs * Rotation.from_matrix(erfa.c2i06a(*tt))).inv()


def _check_dates(
    epoch: Epoch, t_start_s: float, t_stop_s: float, table: EarthOrientationTable, allow_stale: bool
) -> tuple[float, Floats]:
    """Expected error on the equator, m, and about the axes of e, rad, of predicted or extrapolated values;
    raises for dates not covered.
    """
    first, last = table.mjd_utc[0], table.mjd_utc[-1]
    start, stop = (float(epoch.mjd_tai(t)) - 37.0 / DAY_S for t in (t_start_s, t_stop_s))
    span = f"the Earth-orientation table ({table.source}) holds {_date(first)} to {_date(last)}"
    if start < first:
        raise EarthOrientationError(f"{epoch.utc_from_seconds(t_start_s)[0]} is before the table: {span}")
    ahead, past = min(stop, last) - table.mjd_last_measured, stop - last
    error_m = expected_error_m(ahead, past)
    if stop > last and not allow_stale:
        raise EarthOrientationError(
            f"{epoch.utc_from_seconds(t_stop_s)[0]} is past the table: {span}; "
            f"install a newer astropy-iers-data, or allow stale Earth orientation "
            f"(about {error_m:.1f} m on the ground)"
        )
    if stop > last or error_m > _NOTICEABLE_M:
        what = "extrapolated" if stop > last else "predicted"
        warnings.warn(
            f"Earth orientation at {epoch.utc_from_seconds(t_stop_s)[0]} is {what}: "
            f"expected error {error_m:.2f} m on the equator (1 sigma); "
            f"measured until {_date(table.mjd_last_measured)}, {span}",
            EarthOrientationWarning,
            stacklevel=3,
        )
    return error_m, expected_rotation_error_rad(ahead, past)


def _date(mjd: float) -> str:
    year, month, day, _ = erfa.jd2cal(MJD_ZERO_JD, mjd)
    return f"{int(year):04d}-{int(month):02d}-{int(day):02d}"


def _daily_values(table: EarthOrientationTable, start: float, stop: float) -> tuple[Floats, Floats]:
    """Days (TAI) and values (D, 5) around an interval, with UT1 - TAI; extrapolated past the table's end."""
    tai_utc = tai_minus_utc_s(table.mjd_utc)
    days = table.mjd_utc + tai_utc / DAY_S
    values = np.column_stack(
        [table.ut1_utc_s - tai_utc, table.xp_rad, table.yp_rad, table.dx_rad, table.dy_rad]
    )
    if (missing := int(np.ceil(stop - days[-1])) + 2) > 0:
        step = np.arange(1, missing + 1)
        more = np.repeat(values[-1:], missing, axis=0)
        back = min(_YEAR_DAYS, len(values) - 1)  # a shorter baseline is biased by tides and seasons
        more[:, 0] += (values[-1, 0] - values[-1 - back, 0]) / back * step
        days, values = np.concatenate([days, days[-1] + step]), np.vstack([values, more])
    low = max(int(np.searchsorted(days, start)) - 3, 0)
    high = max(int(np.searchsorted(days, stop)) + 3, low + 4)
    return days[low:high], values[low:high]


def _angular_velocity(days: Floats, values: Floats, mjd: float) -> Floats:
    """Angular velocity (3,) of the ITRS in its own axes, rad/s: pole of rotation, rate by length of day."""
    about = np.array([mjd - 0.5, mjd, mjd + 0.5])
    before, middle, after = _cubic(days, values, np.clip(about, days[0], days[-1]))
    ut1_rate = (after[0] - before[0]) / (np.ptp(np.clip(about[[0, 2]], days[0], days[-1])) * DAY_S)
    pole_e = erfa.pom00(middle[1], middle[2], 0.0) @ np.array([0.0, 0.0, 1.0])
    return np.asarray(EARTH_ROTATION_RATE * (1.0 + ut1_rate) * pole_e)


def _cubic(nodes: Floats, values: Floats, at: Floats) -> Floats:
    """Values (N, M) at `at` (N,) by cubic Lagrange interpolation of values (K, M) at nodes (K,)."""
    first = np.clip(np.searchsorted(nodes, at) - 2, 0, len(nodes) - 4)
    near = [nodes[first + k] for k in range(4)]
    away = [at - node for node in near]
    result = np.zeros((len(at), values.shape[1]))
    for k in range(4):
        a, b, c = (away[m] / (near[k] - near[m]) for m in range(4) if m != k)
        result += (a * b * c)[:, None] * values[first + k]
    return result
