"""CCSDS Attitude Ephemeris Message (504.0-B-1, KVN): calibrated attitude of the remote-sensing camera over a
strip.

A is the inertial frame (ICRF axes; with the Earth as centre those of GCRS), B the camera. The standard's
quaternion, scalar last, gives the matrix that takes components in A to components in B with 2 (q1 q2 + q3 qc)
in its first row. That is the quaternion of the `Rotation` (which acts on vectors) from B to A.
"""

from __future__ import annotations

from collections.abc import Sequence

from scipy.spatial.transform import Rotation

from boresight.geometry.record import record, scalar
from boresight.pipeline.exports.one_line import one_line

__all__ = ["AemHeader", "attitude_message"]


@record(kw_only=True)
class AemHeader:
    """Header and metadata of the message. Control characters of texts are written as spaces."""

    creation_utc: str = scalar("date of the message, ISO 8601")
    object_name: str = scalar("OBJECT_NAME: the mission")
    object_id: str = scalar("OBJECT_ID", default="0000-000A")
    originator: str = scalar("ORIGINATOR", default="BORESIGHT")
    instrument: str = scalar("REF_FRAME_B: the remote-sensing camera", default="INSTRUMENT_0")
    interpolation_degree: int = scalar("INTERPOLATION_DEGREE, at most the number of states - 1", default=7)


def attitude_message(header: AemHeader, comments: Sequence[str], utc: Sequence[str], R_ci: Rotation) -> str:
    """Text of the message, one segment: `utc` (N,) instants, `R_ci` (N,) from GCRS to the camera.

    Raises `ValueError` for fewer than two states or different lengths.
    """
    if len(utc) != len(R_ci) or len(utc) < 2:
        raise ValueError(f"an attitude ephemeris needs two or more states, got {len(utc)} and {len(R_ci)}")
    start, stop = utc[0].rstrip("Z"), utc[-1].rstrip("Z")
    lines = [
        "CCSDS_AEM_VERS = 1.0",
        f"CREATION_DATE = {header.creation_utc.rstrip('Z')}",
        f"ORIGINATOR = {one_line(header.originator)}",
        "",
        "META_START",
        *(f"COMMENT {one_line(comment)}" for comment in comments),
        f"OBJECT_NAME = {one_line(header.object_name)}",
        f"OBJECT_ID = {one_line(header.object_id)}",
        "CENTER_NAME = EARTH",
        "REF_FRAME_A = ICRF",
        f"REF_FRAME_B = {one_line(header.instrument)}",
        "ATTITUDE_DIR = A2B",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {start}",
        f"STOP_TIME = {stop}",
        "ATTITUDE_TYPE = QUATERNION",
        "QUATERNION_TYPE = LAST",
        "INTERPOLATION_METHOD = LAGRANGE",
        f"INTERPOLATION_DEGREE = {min(header.interpolation_degree, len(utc) - 1)}",
        "META_STOP",
        "",
        "DATA_START",
    ]
    for instant, q in zip(utc, _continuous(R_ci.inv())):
        lines.append(" ".join([instant.rstrip("Z"), *(f"{value: .15f}" for value in q)]))
    return "\n".join([*lines, "DATA_STOP", ""])


def _continuous(rotations: Rotation) -> list[list[float]]:
    """Quaternions (scalar last) with the sign chosen so that neighbours can be interpolated."""
    quaternions: list[list[float]] = []
    for q in rotations.as_quat():
        if quaternions and sum(a * b for a, b in zip(q, quaternions[-1])) < 0.0:
            q = -q
        quaternions.append(q.tolist())
    return quaternions
