"""How targets move through the camera's view while a strip is taken, and at which pixels the CCDs meet them.

The path of a target is its apparent direction in frame c against the line number, at the present
installation matrix; a rotation of that matrix turns all paths alike. Only lines of the strip itself are
looked at: there the attitude is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.pushbroom import Pushbroom

__all__ = ["Paths", "displacements", "target_paths"]

Array = NDArray[np.float64]

_NODES = 65  # lines of a strip at which directions are computed
_STEPS = 3  # of the secant method: from a 1/64 of a strip to 1e-6 px


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """Targets seen from one strip."""

    pushbroom: Pushbroom
    p_e: Array  # (T, 3)
    lines: Array  # (K,)
    u_c: Array  # (T, K, 3) at the pushbroom's own installation matrix

    def pixels(self, ccd: int, theta: Array) -> Array:
        """(T, 2) (sample, line) in a CCD if the installation matrix is exp[[theta]] R_cs0; NaN if in no
        line.
        """
        turn = deviation_from_theta(theta)
        t, k = self.u_c.shape[:2]
        _, miss = self.pushbroom.camera.samples_from_directions(ccd, turn.apply(self.u_c.reshape(-1, 3)))
        miss = miss.reshape(t, k)
        out = np.full((t, 2), np.nan)
        crossing = np.signbit(miss[:, :-1]) != np.signbit(miss[:, 1:])
        found = np.nonzero(crossing.any(axis=1))[0]
        if len(found) == 0:
            return out
        first = crossing[found].argmax(axis=1)
        before, after = self.lines[first], self.lines[first + 1]
        f_before, f_after = miss[found, first], miss[found, first + 1]
        line = before - f_before * (after - before) / (f_after - f_before)
        for _ in range(_STEPS):
            u_c = turn.apply(self.pushbroom.directions_c(self.p_e[found], line))
            sample, f = self.pushbroom.camera.samples_from_directions(ccd, u_c)
            line = line - f * (after - before) / (f_after - f_before)
        out[found] = np.column_stack([sample, line])
        return out


def target_paths(pushbroom: Pushbroom, p_e: Array, lines: int) -> Paths:
    """The paths of points p_e (T, 3) through a strip of so many lines."""
    nodes = np.asarray(np.linspace(-0.5, lines - 0.5, _NODES), dtype=float)
    points = np.repeat(p_e, _NODES, axis=0)
    u_c = pushbroom.directions_c(points, np.tile(nodes, len(p_e)))
    return Paths(pushbroom, p_e, nodes, u_c.reshape(len(p_e), _NODES, 3))


def displacements(
    pushbroom: Pushbroom, p_e: Array, ccd: NDArray[np.int64], xy_px: Array
) -> tuple[Array, Array]:
    """How far pixels (N, 2) lie from where the model sees points p_e (N, 3), and its derivative by theta.

    Returns (N, 2) px and (N, 2, 3) px/rad. A rotation by theta of the installation matrix moves the
    direction u_c of a point by u x theta (paper, eq. 12); the pixel's Jacobian brings directions to pixels.
    """
    predicted = pushbroom.directions_c(p_e, xy_px[:, 1])
    measured, jacobian = np.empty((len(p_e), 3)), np.empty((len(p_e), 3, 2))
    for n in np.unique(ccd):
        here = ccd == n
        sample, line = xy_px[here].T
        measured[here] = pushbroom.camera.directions_from_pixels(int(n), sample)
        jacobian[here] = pushbroom.pixel_jacobian(int(n), sample, line)
    inverse = np.linalg.pinv(jacobian)
    return np.einsum("nij,nj->ni", inverse, measured - predicted), inverse @ cross_matrices(predicted)
