"""Inertial frames that files name, and the rotation from each to GCRS.

GCRF and, with the Earth as centre, ICRF have the axes of GCRS. EME2000 has the mean equator and equinox of
J2000; the rotation between the two is the frame bias of IAU 2000, 23 mas (erfa.bp00).
"""

from __future__ import annotations

from typing import Literal

import erfa
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import J2000_JD

__all__ = ["InertialFrame", "rotation_to_gcrs"]

InertialFrame = Literal["GCRF", "ICRF", "EME2000"]


def rotation_to_gcrs(frame: InertialFrame) -> Rotation:
    """The rotation that takes vectors of an inertial frame to GCRS."""
    if frame == "EME2000":
        bias, _, _ = erfa.bp00(J2000_JD, 0.0)
        return Rotation.from_matrix(bias).inv()
    return Rotation.identity()
