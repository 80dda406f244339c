"""NAIF's ephemeris time (ET): seconds of barycentric dynamical time (TDB) past J2000, from and to TAI.

TDB - TT = K sin E, E = M + EB sin M, M = M0 + M1 t, with the constants of NAIF's leap-second kernels (Time
Required Reading): 1.657 ms and yearly. SPICE uses this formula, so that instants agree to the rounding of ET,
whose double resolves 0.1 µs in this century.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from boresight.geometry.epoch import TT_MINUS_TAI_S, Epoch
from boresight.geometry.record import Floats

__all__ = ["ephemeris_time", "seconds_from_ephemeris_time"]


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


def _tdb_minus_tt(tt: Floats) -> Floats:
    M = 6.239996 + 1.99096871e-7 * tt
    return np.asarray(1.657e-3 * np.sin(M + 1.671e-2 * np.sin(M)))
