"""CCSDS attitude messages (504.0-B, KVN): calibrated attitude of the remote-sensing camera over a strip.

The Attitude Ephemeris Message 1.0 (AEM) holds attitudes; that with covariances is the Attitude Comprehensive
Message 2.0 (ACM), whose covariance is the diagonal, deg², about the axes of the camera.

A is the inertial frame (ICRF axes; with the Earth as centre those of GCRS), B the camera. The standard's
quaternion, scalar last, gives the matrix that takes components in A to components in B with 2 (q1 q2 + q3 qc)
in its first row. That is the quaternion of the `Rotation` (which acts on vectors) from B to A.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.exports.notes import one_line
from boresight.features.exports.quaternions import continuous_quaternions
from boresight.geometry.epoch import Epoch
from boresight.records.record import Floats, record, scalar

__all__ = ["AemHeader", "attitude_message", "comprehensive_message"]


@record(kw_only=True)
class AemHeader:
    """Header and metadata of the message. Control characters of texts are written as spaces."""

    creation_utc: str = scalar("date of the message, ISO 8601")
    object_name: str = scalar("OBJECT_NAME: the mission")
    object_id: str = scalar("OBJECT_ID: international designator; empty: the object's name", default="")
    instrument: str = scalar("REF_FRAME_B: the remote-sensing camera", default="INSTRUMENT_0")


def attitude_message(header: AemHeader, comments: Sequence[str], utc: Sequence[str], R_ci: Rotation) -> str:
    """Text of the message, one segment: `utc` (N,) instants, `R_ci` (N,) from GCRS to the camera.

    Raises `ValueError` for fewer than two states or different lengths.
    """
    if len(utc) != len(R_ci) or len(utc) < 2:
        raise ValueError(f"an attitude ephemeris needs two or more states, got {len(utc)} and {len(R_ci)}")
    start, stop = utc[0].rstrip("Z"), utc[-1].rstrip("Z")
    lines = [
        "CCSDS_AEM_VERS = 1.0",
        *_preamble(header, comments),
        f"OBJECT_ID = {one_line(header.object_id or header.object_name)}",
        "CENTER_NAME = EARTH",
        "REF_FRAME_A = ICRF",
        f"REF_FRAME_B = {one_line(header.instrument)}",
        "ATTITUDE_DIR = A2B",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {start}",
        f"STOP_TIME = {stop}",
        "ATTITUDE_TYPE = QUATERNION",
        "QUATERNION_TYPE = LAST",
        "INTERPOLATION_METHOD = LINEAR",
        "INTERPOLATION_DEGREE = 1",
        "META_STOP",
        "",
        "DATA_START",
    ]
    for instant, q in zip(utc, continuous_quaternions(R_ci.inv())):
        lines.append(" ".join([instant.rstrip("Z"), *(f"{value: .15f}" for value in q)]))
    return "\n".join([*lines, "DATA_STOP", ""])


def comprehensive_message(
    header: AemHeader, comments: Sequence[str], utc: Sequence[str], R_ci: Rotation, variance_c: Floats
) -> str:
    """Text of an ACM: `utc` (N,) instants, `R_ci` (N,) from GCRS to the camera, `variance_c` (N, 3) rad²
    about the axes of the camera.

    Raises `ValueError` for fewer than two states or different lengths.
    """
    if not len(utc) == len(R_ci) == len(variance_c) or len(utc) < 2:
        raise ValueError(f"an attitude message needs two or more states, got {len(utc)} and {len(R_ci)}")
    zero, frame = utc[0].rstrip("Z"), one_line(header.instrument)
    t_s = Epoch.from_utc(zero).seconds_from_utc(utc)
    since = [f"{t:.9f}" for t in t_s - t_s[0]]
    lines = [
        "CCSDS_ACM_VERS = 2.0",
        *_preamble(header, comments),
        f"INTERNATIONAL_DESIGNATOR = {one_line(header.object_id or header.object_name)}",
        "TIME_SYSTEM = UTC",
        f"EPOCH_TZERO = {zero}",
        "META_STOP",
        "",
        "ATT_START",
        "REF_FRAME_A = ICRF",
        f"REF_FRAME_B = {frame}",
        "NUMBER_STATES = 4",
        "ATT_TYPE = QUATERNION",
        *(
            " ".join([t, *(f"{value: .15f}" for value in q)])
            for t, q in zip(since, continuous_quaternions(R_ci.inv()))
        ),
        "ATT_STOP",
        "",
        "COV_START",
        f"COV_REF_FRAME = {frame}",
        "COV_TYPE = ANGLE",
        *(
            " ".join([t, *(f"{value:.9e}" for value in row)])
            for t, row in zip(since, np.degrees(np.degrees(variance_c)))
        ),
        "COV_STOP",
        "",
    ]
    return "\n".join(lines)


def _preamble(header: AemHeader, comments: Sequence[str]) -> list[str]:
    """The lines of either message after its version, up to the object's name."""
    return [
        f"CREATION_DATE = {header.creation_utc.rstrip('Z')}",
        "ORIGINATOR = BORESIGHT",
        "",
        "META_START",
        *(f"COMMENT {one_line(comment)}" for comment in comments),
        f"OBJECT_NAME = {one_line(header.object_name)}",
    ]
