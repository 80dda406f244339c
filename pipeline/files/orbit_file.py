"""The orbit of a dump: a CCSDS Orbit Ephemeris Message (OEM, CCSDS 502.0-B) in its keyword = value form."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import read_text

__all__ = ["Ephemeris", "read_oem"]

Array = NDArray[np.float64]
INERTIAL = ("GCRF", "ICRF")  # with CENTER_NAME EARTH both have the axes of GCRS
SECOND_OF_TIME_SYSTEM = {"UTC": "utc", "TAI": "tai", "TT": "tt", "GPS": "gps"}
GPS_BEHIND_TAI_S = 19.0  # GPS time = TAI - 19 s (IS-GPS-200)


@dataclass(frozen=True, slots=True, eq=False)
class Ephemeris:
    """States of one OEM segment, as the file gives them but in metres and TAI seconds since `epoch`."""

    epoch: Epoch
    t_s: Array  # (N,) strictly increasing
    positions_m: Array  # (N, 3)
    velocities_m_s: Array  # (N, 3)
    frame: Literal["GCRF", "ITRF"]
    method: Literal["lagrange", "hermite"]
    interpolation_degree: int
    object_name: str
    first_time: str  # of the states, as the file has it, in its own time system
    last_time: str


def read_oem(path: Path, file: str) -> Ephemeris:
    """The one segment of an OEM. The dump's epoch is the whole TAI second at or before the first state."""
    from oem import OrbitEphemerisMessage  # with astropy 0.6 s to load, which workers need not

    if not read_text(path, file).startswith("CCSDS_OEM_VERS"):
        raise RawDataError(file, "line 1", "another text", "CCSDS_OEM_VERS = ..., an OEM in KVN form")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            message: Any = OrbitEphemerisMessage.open(path)
            segments = message.segments
            if len(segments) != 1:
                raise RawDataError(file, "META_START", f"{len(segments)} segments", "one segment")
            states = list(segments[0].states)
    except RawDataError:
        raise
    except Exception as error:  # the library raises many kinds; what it says names the line
        raise RawDataError(file, "OEM text", f"{error}", "an OEM that follows CCSDS 502.0-B") from error
    meta = segments[0].metadata
    epoch, t_s = _tai_seconds([state.epoch for state in states], str(meta["TIME_SYSTEM"]), file)
    positions = 1e3 * np.array([state.position for state in states], dtype=float)
    velocities = 1e3 * np.array([state.velocity for state in states], dtype=float)
    _check_states(t_s, positions, velocities, file)
    return Ephemeris(
        epoch,
        t_s,
        positions,
        velocities,
        _frame(meta, file),
        _method(meta, file),
        _degree(meta, file),
        str(meta["OBJECT_NAME"])[:64],
        f"{states[0].epoch}",
        f"{states[-1].epoch}",
    )


def _frame(meta: Any, file: str) -> Literal["GCRF", "ITRF"]:
    if (centre := str(meta["CENTER_NAME"]).strip().upper()) != "EARTH":
        raise RawDataError(file, "CENTER_NAME", centre, "EARTH")
    frame = str(meta["REF_FRAME"]).strip().upper()
    if frame in INERTIAL:
        return "GCRF"
    if frame.startswith("ITRF"):
        return "ITRF"
    raise RawDataError(file, "REF_FRAME", frame, "GCRF, ICRF or ITRF (with or without a year)")


def _method(meta: Any, file: str) -> Literal["lagrange", "hermite"]:
    method = str(meta["INTERPOLATION"]).strip().upper() if "INTERPOLATION" in meta else "LAGRANGE"
    if method == "LAGRANGE":
        return "lagrange"
    if method == "HERMITE":
        return "hermite"
    raise RawDataError(file, "INTERPOLATION", method, "LAGRANGE or HERMITE")


def _degree(meta: Any, file: str) -> int:
    if "INTERPOLATION" not in meta:
        return 7
    degree = int(meta["INTERPOLATION_DEGREE"])
    if not 1 <= degree <= 15:
        raise RawDataError(file, "INTERPOLATION_DEGREE", str(degree), "1 to 15")
    return degree


def _tai_seconds(epochs: list[Any], time_system: str, file: str) -> tuple[Epoch, Array]:
    from astropy.time import Time

    scale = SECOND_OF_TIME_SYSTEM.get(time_system.strip().upper())
    if scale is None:
        raise RawDataError(file, "TIME_SYSTEM", time_system, "UTC, TAI, TT or GPS")
    if scale == "gps":
        times, behind = Time(epochs, scale="tai"), GPS_BEHIND_TAI_S
    else:
        times, behind = Time(epochs).tai, 0.0
    whole, fraction = np.atleast_1d(times.jd1) - 2_451_545.0, np.atleast_1d(times.jd2)
    tai_s = int(np.floor(whole[0] * 86_400.0 + fraction[0] * 86_400.0 + behind))
    t_s = (whole * 86_400.0 - tai_s) + fraction * 86_400.0 + behind
    return Epoch(tai_s), np.round(t_s, 12)


def _check_states(t_s: Array, positions: Array, velocities: Array, file: str) -> None:
    for name, values in (("time", t_s[:, None]), ("position", positions), ("velocity", velocities)):
        if len(bad := np.flatnonzero(~np.isfinite(values).all(axis=1))):
            raise RawDataError(file, f"state {bad[0] + 1}, {name}", str(values[bad[0]]), "finite numbers")
    if len(t_s) < 8:
        raise RawDataError(file, "states", str(len(t_s)), "at least 8")
    if len(bad := np.flatnonzero(np.diff(t_s) <= 0)):
        found = f"{t_s[bad[0] + 1]:.6f} s after {t_s[bad[0]]:.6f} s"
        raise RawDataError(file, f"state {bad[0] + 2}, time", found, "strictly increasing times")
    radius = np.linalg.norm(positions, axis=1)
    if len(bad := np.flatnonzero((radius < 6.4e6) | (radius > 5e7))):
        found = f"{radius[bad[0]] / 1e3:.1f} km from the centre"
        raise RawDataError(file, f"state {bad[0] + 1}, position", found, "6400 to 50000 km (unit km)")
