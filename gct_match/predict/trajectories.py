"""Image trajectories: apparent directions of targets while a strip is scanned, and where CCDs see them.

The trajectory of a target is its apparent direction in frame c as a function of the strip's row, at the
initial installation matrix; a rotation of that matrix rotates all trajectories. They are computed for the
rows of the strip only, where the attitude is known.
"""

from __future__ import annotations

import numpy as np

from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.pushbroom import Pushbroom
from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = ["Trajectories", "displacements", "trajectories_of"]

_NODES = 65  # rows of a strip at which directions are computed
_BLOCK = 256  # targets whose directions are computed at once: 10 MB of intermediate matrices
_STEPS = 3  # of the secant method: from a 1/64 of a strip to 1e-6 px


@record
class Trajectories:
    """Image trajectories of T targets in one strip, sampled at K rows."""

    pushbroom: Pushbroom = scalar("rigorous model at the initial installation matrix R_cs0")
    p_e: Floats = array("T, 3", "target positions, ITRS, m")
    rows: Floats = array("K", "rows of the strip")
    u_c: Floats = array("T, K, 3", "apparent directions, frame c at R_cs0")

    def pixels(self, ccd: int, theta: Floats) -> Floats:
        """(T, 2) (sample, line) in a CCD if the installation matrix is exp[[theta]] R_cs0 with theta (3,) in
        rad; NaN for a target that crosses the CCD at no row of the strip.
        """
        rotation = deviation_from_theta(theta)
        t, k = self.u_c.shape[:2]
        u_c = rotation.apply(self.u_c.reshape(-1, 3))
        off_line = self.pushbroom.camera.samples_from_directions(ccd, u_c)[1].reshape(t, k)
        out = np.full((t, 2), np.nan)
        crossing = np.signbit(off_line[:, :-1]) != np.signbit(off_line[:, 1:])
        found = np.nonzero(crossing.any(axis=1))[0]
        if len(found) == 0:
            return out
        first = crossing[found].argmax(axis=1)
        before, after = self.rows[first], self.rows[first + 1]
        f_before, f_after = off_line[found, first], off_line[found, first + 1]
        row = before - f_before * (after - before) / (f_after - f_before)
        for _ in range(_STEPS):
            u_c = rotation.apply(self.pushbroom.directions_c(self.p_e[found], row))
            sample, f = self.pushbroom.camera.samples_from_directions(ccd, u_c)
            row = row - f * (after - before) / (f_after - f_before)
        out[found] = np.column_stack([sample, self.pushbroom.rows.lines_of_rows(ccd, row)])
        return out


def trajectories_of(pushbroom: Pushbroom, p_e: Floats, rows: tuple[float, float]) -> Trajectories:
    """Trajectories of targets p_e (T, 3), ITRS in m, from the first to the last of `rows`."""
    nodes = np.asarray(np.linspace(*rows, _NODES), dtype=float)
    u_c = np.empty((len(p_e), _NODES, 3))
    for first in range(0, len(p_e), _BLOCK):
        part = p_e[first : first + _BLOCK]
        looks = pushbroom.directions_c(np.repeat(part, _NODES, axis=0), np.tile(nodes, len(part)))
        u_c[first : first + _BLOCK] = looks.reshape(len(part), _NODES, 3)
    return Trajectories(pushbroom, p_e, nodes, u_c)


def displacements(pushbroom: Pushbroom, p_e: Floats, ccd: Ints, xy_px: Floats) -> tuple[Floats, Floats]:
    """Displacement of pixels xy_px (N, 2) from where the model sees points p_e (N, 3), and its derivative.

    Returns (N, 2) px and, by theta, (N, 2, 3) px/rad. A rotation of the installation matrix by theta changes
    the direction u_c of a point by u x theta (paper, eq. 12); the pixel's Jacobian takes it to pixels.
    """
    predicted = pushbroom.directions_c(p_e, pushbroom.rows.rows_of_lines(ccd, xy_px[:, 1]))
    measured, jacobian = pushbroom.directions_and_jacobian(ccd, xy_px)
    inverse = np.linalg.pinv(jacobian)
    return np.einsum("nij,nj->ni", inverse, measured - predicted), inverse @ cross_matrices(predicted)
