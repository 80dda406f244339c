"""Text of a CCSDS Orbit Ephemeris Message (502.0-B, KVN)."""

from __future__ import annotations

from collections.abc import Sequence

from boresight.geometry.record import Floats

__all__ = ["orbit_message"]


def orbit_message(
    object_name: str,
    frame: str,
    interpolation: tuple[str, int],
    utc: Sequence[str],
    positions_m: Floats,
    velocities_m_s: Floats,
    object_id: str = "",
) -> str:
    """Text of the message, one segment of N states: positions (N, 3) to the micrometre, velocities (N, 3) to
    the nanometre per second, in `frame` (GCRF or ITRF), with the name and degree of their interpolation.
    Where the international designator `object_id` ("2015-028A") is empty, the name stands for it.
    """
    utc = [text.rstrip("Z") for text in utc]
    lines = [
        "CCSDS_OEM_VERS = 2.0",
        f"CREATION_DATE = {utc[0][:19]}",
        "ORIGINATOR = BORESIGHT",
        "",
        "META_START",
        f"OBJECT_NAME = {object_name.upper()}",
        f"OBJECT_ID = {object_id or object_name.upper()}",
        "CENTER_NAME = EARTH",
        f"REF_FRAME = {frame}",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {utc[0]}",
        f"STOP_TIME = {utc[-1]}",
        f"INTERPOLATION = {interpolation[0].upper()}",
        f"INTERPOLATION_DEGREE = {interpolation[1]}",
        "META_STOP",
        "",
    ]
    for instant, p, v in zip(utc, positions_m / 1e3, velocities_m_s / 1e3):
        numbers = [f"{x:.9f}" for x in p] + [f"{x:.12f}" for x in v]
        lines.append(f"{instant} " + " ".join(numbers))
    return "\n".join(lines) + "\n"
