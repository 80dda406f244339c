"""Attitudes of star cameras (heads) over a record, and those of one carried to the instants of another."""

from __future__ import annotations

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from boresight.pipeline.head_noise.spectrum import pieces_of
from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = ["HeadTrack", "carried_to", "common_instants"]

SMOOTHING_S = 2.0  # over which the rate of the motion is found that carries an attitude to a close instant


@record(kw_only=True)
class HeadTrack:
    """Attitudes of one head over a record."""

    name: str = scalar("name of the head")
    t_s: Floats = array("K", "instants, TAI seconds since the dump's epoch, increasing")
    R_hi: Rotation = scalar("(K,) GCRS to the head")
    R_oi: Rotation = scalar("(K,) GCRS to the orbital frame")


def common_instants(reference: HeadTrack, other: HeadTrack) -> tuple[Ints, Ints]:
    """Rows (M,) of both heads that are nearest to one another, at most half a step apart."""
    step, _ = pieces_of(reference.t_s)
    right = np.clip(np.searchsorted(reference.t_s, other.t_s), 1, len(reference.t_s) - 1)
    nearer_left = other.t_s - reference.t_s[right - 1] < reference.t_s[right] - other.t_s
    nearest = np.where(nearer_left, right - 1, right)
    rows = np.flatnonzero(np.abs(reference.t_s[nearest] - other.t_s) <= 0.5 * step + 1e-9)
    return nearest[rows], rows


def carried_to(track: HeadTrack, rows: Ints, t_s: Floats, R_oi: Rotation) -> Rotation:
    """Attitudes of rows (M,), each carried to a close instant (M,) by the smoothed motion around it."""

    D = track.R_hi * track.R_oi.inv()
    away = t_s - track.t_s[rows]
    step, pieces = pieces_of(track.t_s)
    rate = np.zeros((len(track.t_s), 3))
    window = 2 * int(0.5 * SMOOTHING_S / step) + 1
    for piece in pieces:
        if np.any(away) and window >= 5 and piece.stop - piece.start >= window:
            middle = D[(piece.start + piece.stop) // 2]
            rotvec = (D[piece] * middle.inv()).as_rotvec()
            rate[piece] = scipy.signal.savgol_filter(rotvec, window, 2, deriv=1, delta=step, axis=0)
    return Rotation.from_rotvec(rate[rows] * away[:, None]) * D[rows] * R_oi
