"""The forms in which attitude messages (CCSDS 504.0-B) state a rotation: quaternion, Euler angles, matrix.

A rotation relates frames A and B; here it takes components in B to components in A. The standard's
quaternion (scalar last) gives the matrix from A to B whose first row holds 2 (q1 q2 + q3 qc), so that
scipy's `from_quat` of it is that rotation. Euler angles, in the order of their sequence, turn the axes of A
into those of B. A matrix takes components in A to components in B and is listed column by column.
"""

from __future__ import annotations

import re

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.record import Floats
from boresight.pipeline.errors import RawDataError

__all__ = ["ANGLES", "EULER", "MATRIX", "QUATERNION", "rotation_sequence", "rotations_of"]

QUATERNION = ("Q1", "Q2", "Q3", "QC")  # names of a quaternion's components, scalar last
ANGLES = ("ANGLE_1", "ANGLE_2", "ANGLE_3")  # of Euler angles, deg, in the order of their sequence
MATRIX = tuple(f"C{row}{column}" for column in "123" for row in "123")  # of a matrix
EULER = "EULER_ROT_SEQ"  # keyword of the sequence: axes as digits or letters
# Three axes of which no two neighbours are the same.
_SEQUENCE = re.compile(r"([XYZ])(?!\1)([XYZ])(?!\2)[XYZ]")
# Tolerated error of a quaternion's length, and of a matrix' elements: three decimals, as telemetry may have.
UNIT_LENGTH = 1e-3


def rotation_sequence(text: str | None, file: str, field: str) -> str:
    """The axes of Euler angles, such as "ZXY", of a value of EULER_ROT_SEQ. `RawDataError` for others."""
    axes = (text or "").upper().translate(str.maketrans("123", "XYZ"))
    if not _SEQUENCE.fullmatch(axes):
        raise RawDataError(file, field, text or "nothing", "three axes, such as ZXY or 312")
    return axes


def rotations_of(values: Floats, sequence: str, file: str) -> Rotation:
    """Rotations (N,) of rows (N, M): quaternions (M = 4), Euler angles (3) or matrices (9), B to A.

    `RawDataError` for quaternions that are not of unit length and matrices that are no rotations.
    """
    if not len(values):
        return Rotation.identity(0)
    if values.shape[1] == len(ANGLES):
        return Rotation.from_euler(sequence, values, degrees=True)
    if values.shape[1] == len(MATRIX):
        R_ab = values.reshape(-1, 3, 3)  # columns of the matrix from A to B, so rows of that from B to A
        error = np.abs(R_ab @ np.swapaxes(R_ab, 1, 2) - np.eye(3)).max(axis=(1, 2))
        if len(bad := np.flatnonzero(~(error <= 2.0 * UNIT_LENGTH) | (np.linalg.det(R_ab) < 0.0))):
            expected = f"a rotation, its elements within {UNIT_LENGTH:g}"
            raise RawDataError(file, f"attitude {bad[0] + 1}", values[bad[0]].tolist(), expected)
        return Rotation.from_matrix(R_ab)
    length = np.hypot.reduce(values, axis=1)  # no squares, which may overflow
    if len(bad := np.flatnonzero(~(np.abs(length - 1.0) <= UNIT_LENGTH))):
        found = f"{values[bad[0]].tolist()} of length {length[bad[0]]:.6g}"
        raise RawDataError(file, f"attitude {bad[0] + 1}", found, f"length 1 within {UNIT_LENGTH:g}")
    return Rotation.from_quat(values)
