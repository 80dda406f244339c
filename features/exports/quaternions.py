"""Quaternions of a series of rotations, as formats of attitudes take them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.record import Floats

__all__ = ["continuous_quaternions"]


def continuous_quaternions(rotations: Rotation) -> Floats:
    """Quaternions (N, 4), scalar last, of rotations (N,), each with the sign nearer to the one before it, so
    that neighbours can be interpolated.
    """
    q = rotations.as_quat()
    turned = np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0
    return np.asarray(q * np.cumprod(np.concatenate([[1.0], np.where(turned, -1.0, 1.0)]))[:, None])
