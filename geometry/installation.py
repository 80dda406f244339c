"""The installation matrix, its deviation from a reference, and their angles (paper, eqs. 11-13).

`R_cs` takes star-camera vectors to the remote-sensing camera. Its deviation from a reference `R_cs0` is
`R_cs = M R_cs0` with `M = exp[[theta]]`; the paper's `[[theta]]` is minus the cross-product matrix, so M is
the right-handed rotation by **-theta** about the axes of frame c. Angles in radians.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.records.record import Floats

__all__ = ["deviation_from_theta", "euler_zxy_from_theta", "theta_between", "theta_from_deviation"]


def deviation_from_theta(theta: Floats) -> Rotation:
    """M = exp[[theta]] (paper, eq. 12): the right-handed rotation by -theta; theta (3,) or (N, 3), rad."""
    return Rotation.from_rotvec(-np.asarray(theta, dtype=float))


def theta_from_deviation(M: Rotation) -> Floats:
    """The theta (3,), rad, of `M = exp[[theta]]`, |theta| <= pi: inverse of `deviation_from_theta`."""
    return -M.as_rotvec()


def theta_between(R_cs: Rotation, R_cs0: Rotation) -> Floats:
    """The theta (3,), rad, from reference `R_cs0` to `R_cs` (paper, eq. 11): R_cs = exp[[theta]] R_cs0."""
    return theta_from_deviation(R_cs * R_cs0.inv())


def euler_zxy_from_theta(theta: Floats) -> Floats:
    """Deviation angles in the order Z-X-Y (paper, section 3.3), rad, returned as (..., 3) = about x, y, z.

    M changes axes, so the *axes* are rotated, first about Z, then about the new X, then about the new Y.
    Small angles equal theta.
    """
    rotation_of_axes = deviation_from_theta(theta).inv()
    z, x, y = np.moveaxis(rotation_of_axes.as_euler("ZXY"), -1, 0)
    return np.stack([x, y, z], axis=-1)
