"""Inertial frames that files name, and the rotation from each to GCRS.

GCRF and, with the Earth as centre, ICRF have the axes of GCRS. EME2000 has the mean equator and equinox of
J2000; the rotation between the two is the frame bias of IAU 2000, 23 mas (erfa.bp00).

Two frames are of date. TOD has the true equator and equinox by IAU 2006/2000A. TEME, the frame of SGP4, has
the true equator and a mean equinox that the sidereal time of 1982 defines: rotated by it about the pole it
becomes the Earth-fixed frame without polar motion, which the Earth rotation angle makes of the intermediate
frame (as in astropy). Their difference changes by 1.5e-6 arcsec with a second of UT1, so that UTC serves.
"""

from __future__ import annotations

from typing import Literal

import erfa
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import DAY_S
from boresight.geometry.epoch import J2000_JD, MJD_ZERO_JD, Epoch, tai_minus_utc_s

__all__ = ["AttitudeFrame", "FrameOfDate", "InertialFrame", "of_date_to_gcrs", "rotation_to_gcrs"]

InertialFrame = Literal["GCRF", "ICRF", "EME2000"]
AttitudeFrame = Literal[InertialFrame, "ITRF"]  # what attitudes may be stated against
FrameOfDate = Literal["TEME", "TOD"]


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
