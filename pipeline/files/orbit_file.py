"""Read the orbit of a dump: a CCSDS Orbit Ephemeris Message (OEM, CCSDS 502.0-B), keyword = value or XML."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import Epoch
from boresight.geometry.inertial_frames import InertialFrame, rotation_to_gcrs
from boresight.geometry.record import Floats, array, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import read_text
from boresight.pipeline.files.xml_files import numbers_of, read_xml

__all__ = ["Ephemeris", "read_oem", "tai_seconds"]

INERTIAL: tuple[InertialFrame, ...] = ("GCRF", "ICRF", "EME2000")
TIME_SCALES = {"UTC": "utc", "TAI": "tai", "TT": "tt", "GPS": "gps"}  # names of astropy, but for GPS
LIMIT_KM = 1e9  # of a coordinate and of a velocity in km/s, far beyond those of any orbit
GPS_BEHIND_TAI_S = 19.0  # GPS time = TAI - 19 s (IS-GPS-200)
EXPECTED = "an OEM that follows CCSDS 502.0-B"
# A state line without acceleration; a message may hold comments, covariances and other notations of time too.
_TIME = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?"
_STAMP = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d{1,12})?Z?", re.ASCII)
_STATE_CHARACTERS = b"0123456789+-.eE:TZ \t"
_PLAIN_HEAD = re.compile(
    rf"CCSDS_OEM_VERS = [12]\.0\s+CREATION_DATE = {_TIME}\s+ORIGINATOR = \S[^\n]*\s+META_START\s+"
    r"((?:[A-Z_]+ = \S[^\n]*\s+)+)META_STOP\s*",
    re.ASCII,
)
_REQUIRED = ("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM", "START_TIME", "STOP_TIME")
_COORDINATES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
_INTERPOLATION = ("INTERPOLATION", "INTERPOLATION_DEGREE")


@record(kw_only=True)
class Ephemeris:
    """States of the one segment of an OEM."""

    epoch: Epoch = scalar("zero of `t_s`: the whole TAI second at or before the first state")
    t_s: Floats = array("N", "TAI seconds since `epoch`, strictly increasing")
    positions_m: Floats = array("N, 3", "m, axes of `frame`")
    velocities_m_s: Floats = array("N, 3", "m/s, axes of `frame`")
    frame: Literal["GCRF", "ITRF"] = scalar("GCRF (inertial) or ITRF (Earth-fixed)")
    method: Literal["lagrange", "hermite"] = scalar("interpolation that the file asks for")
    interpolation_degree: int = scalar("degree of the interpolating polynomial, 1 to 15")
    first_time: str = scalar("time of the first state, in the file's own time system")
    last_time: str = scalar("time of the last state, likewise")
    time_system: str = scalar("that time system", default="UTC")


def read_oem(path: Path, file: str) -> Ephemeris:
    """The states of an OEM of one segment; `file` names it in errors.

    A message of the plain form (the usual keywords only, UTC, each state a calendar date, position, velocity)
    is parsed here, many times faster; the library `oem` checks and reads any other, XML too. It takes
    0.6 s to load, with astropy. States in EME2000 are rotated to GCRF. Raises `RawDataError`.
    """
    text = read_text(path, file)
    if text.lstrip().startswith("<"):
        return _ephemeris(*_xml_reading(path, text, file), file)
    if not text.startswith("CCSDS_OEM_VERS"):
        raise RawDataError(file, "line 1", "another text", "CCSDS_OEM_VERS = ..., or an OEM in XML")
    lines = text.splitlines()
    begin = 1 + next((n for n, line in enumerate(lines) if line.strip() == "META_STOP"), len(lines))
    data = [line for text in lines[begin:] if (line := text.strip())]
    plain = _plain_states(data)
    all_plain = plain is not None
    head = "\n".join(lines[:begin])
    states: list[Any] = []
    meta: Any
    if not all_plain or (meta := _plain_metadata(head)) is None:
        meta, states = _library_reading("\n".join([head, *(data[:1] if all_plain else lines[begin:])]), file)
    times: list[Any]
    if plain is not None:
        times, values = plain
    else:
        _check_numbers(data, file)
        times, values = _of_library(states)
    return _ephemeris(meta, times, values, file)


def _ephemeris(meta: Any, times: list[Any], values: Floats, file: str) -> Ephemeris:
    """The checked states, SI units, in GCRF or ITRF."""
    for name, numbers in (("position", values[:, :3]), ("velocity", values[:, 3:])):
        if len(bad := np.flatnonzero(~(np.abs(numbers) < LIMIT_KM).all(axis=1))):
            expected = f"finite numbers below {LIMIT_KM:g} (unit km)"
            raise RawDataError(file, f"state {bad[0] + 1}, {name}", str(numbers[bad[0]]), expected)
    epoch, t_s = tai_seconds(times, str(meta["TIME_SYSTEM"]), file)
    frame, R = _frame(meta, file)
    positions, velocities = R.apply(1e3 * values[:, :3]), R.apply(1e3 * values[:, 3:])
    _check_states(t_s, positions, velocities, file)
    return Ephemeris(
        epoch=epoch,
        t_s=t_s,
        positions_m=positions,
        velocities_m_s=velocities,
        frame=frame,
        method=_method(meta, file),
        interpolation_degree=_degree(meta, file),
        first_time=f"{times[0]}",
        last_time=f"{times[-1]}",
        time_system=str(meta["TIME_SYSTEM"]),
    )


def _plain_states(data: list[str]) -> tuple[list[str], Floats] | None:
    """Times and values (N, 6) of lines of a date and six decimal numbers each; None for any others."""
    rows = [line.split() for line in data]
    content = "".join(data)
    if not rows or not content.isascii() or content.encode().translate(None, _STATE_CHARACTERS):
        return None
    if any(len(row) != 7 or not _STAMP.fullmatch(row[0]) for row in rows):
        return None
    try:
        values = np.fromiter(map(float, (word for row in rows for word in row[1:])), float, 6 * len(rows))
    except ValueError:
        return None
    return [row[0].removesuffix("Z") for row in rows], values.reshape(-1, 6)


def _plain_metadata(head: str) -> dict[str, str] | None:
    """Metadata of a message of the plain form; None for any other, which may be right or wrong."""
    if (match := _PLAIN_HEAD.fullmatch(head)) is None:
        return None
    pairs = [line.strip().split(" = ", 1) for line in match[1].splitlines() if line.strip()]
    meta = {key: value.strip() for key, value in pairs}
    interpolation = _INTERPOLATION if "INTERPOLATION" in meta else ()
    if len(meta) < len(pairs) or meta.keys() != {*_REQUIRED, *interpolation} or meta["TIME_SYSTEM"] != "UTC":
        return None
    if interpolation and not re.fullmatch(r"\d{1,2}", meta["INTERPOLATION_DEGREE"], re.ASCII):
        return None
    span = meta["START_TIME"], meta["STOP_TIME"]
    with suppress(ValueError):  # of dates that do not exist
        if all(re.fullmatch(_TIME, time, re.ASCII) for time in span):
            first, last = Epoch.from_utc(span[0]).seconds_from_utc(span)
            return meta if first <= last else None
    return None


def _of_library(states: list[Any]) -> tuple[list[Any], Floats]:
    """Times and values (N, 6), km and km/s, of the library's states."""
    values = [[*state.position, *state.velocity] for state in states]
    return [state.epoch for state in states], np.array(values, dtype=float).reshape(-1, 6)


def _xml_reading(path: Path, text: str, file: str) -> tuple[Any, list[Any], Floats]:
    """Metadata, times and values of the one segment of an OEM in XML, as the library reads it."""
    from oem.parsers import parse_xml_oem

    root = read_xml(path, file)  # well-formed, without DTD
    if root.tag != "oem":
        raise RawDataError(file, "root element", root.tag[:64], "oem")
    if root.find("body/segment") is None:
        raise RawDataError(file, "body", "no segment", "one segment with metadata and states")
    for state in root.iter("stateVector"):
        for name in _COORDINATES:
            numbers_of(state, name, file, 1)
    meta, states = _segment_of(lambda: parse_xml_oem(io.StringIO(text)), file)
    return meta, *_of_library(states)


def _library_reading(text: str, file: str) -> tuple[Any, list[Any]]:
    """Metadata and states of the one segment of an OEM, as the library reads it."""
    from oem.parsers import parse_kvn_oem

    return _segment_of(lambda: parse_kvn_oem(io.StringIO(text + "\n")), file)


def _segment_of(parse: Callable[[], Any], file: str) -> tuple[Any, list[Any]]:
    """Metadata and states of the one segment of what a parser of the library gives."""
    from oem import OrbitEphemerisMessage

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Its `open` takes paths only, and unpacks archives.
            message: Any = OrbitEphemerisMessage._from_raw_data(parse())
            segments = message.segments
            if len(segments) == 1:
                return segments[0].metadata, list(segments[0].states)
    except Exception as error:  # the library raises many kinds; the message names the line
        raise RawDataError(file, "OEM text", f"{error}", EXPECTED) from error
    raise RawDataError(file, "META_START", f"{len(segments)} segments", "one segment")


def _check_numbers(data: list[str], file: str) -> None:
    """Refuse what Python alone reads as a number: `2_000`, digits of other scripts."""
    for line in data:
        keyword = "=" in line or line.strip().startswith(("COMMENT", "META_", "COVARIANCE_"))
        if not keyword and ("_" in line or not line.isascii()):
            raise RawDataError(file, "OEM text", line, "numbers of ASCII digits, without _")


def _frame(meta: Any, file: str) -> tuple[Literal["GCRF", "ITRF"], Rotation]:
    """The frame that the states are kept in, and the rotation to it from that of the file."""
    if (centre := str(meta["CENTER_NAME"]).strip().upper()) != "EARTH":
        raise RawDataError(file, "CENTER_NAME", centre, "EARTH")
    frame = str(meta["REF_FRAME"]).strip().upper()
    for inertial in INERTIAL:
        if frame == inertial:
            return "GCRF", rotation_to_gcrs(inertial)
    if frame.startswith("ITRF"):
        return "ITRF", Rotation.identity()
    raise RawDataError(file, "REF_FRAME", frame, "GCRF, ICRF, EME2000 or ITRF (with or without a year)")


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


def tai_seconds(times: list[Any], time_system: str, file: str) -> tuple[Epoch, Floats]:
    """Epoch, and TAI seconds (N,) since it, of times given as text or as the library's `Time`.

    `RawDataError` for another time system and for times that do not exist.
    """
    if time_system == "UTC" and isinstance(times[0], str):
        try:
            epoch = Epoch.from_utc(times[0])
            return epoch, epoch.seconds_from_utc(times)
        except ValueError as error:
            raise RawDataError(file, "time of the states", str(error), "times that exist") from error
    from astropy.time import Time

    scale = TIME_SCALES.get(time_system.strip().upper())
    if scale is None:
        raise RawDataError(file, "TIME_SYSTEM", time_system, "UTC, TAI, TT or GPS")
    behind = GPS_BEHIND_TAI_S if scale == "gps" else 0.0
    try:
        tai = Time(times, scale="tai" if scale == "gps" else scale).tai
    except ValueError as error:
        raise RawDataError(file, "time of the states", str(error), "times that exist") from error
    whole, fraction = np.atleast_1d(tai.jd1) - 2_451_545.0, np.atleast_1d(tai.jd2)
    tai_s = int(np.floor(whole[0] * 86_400.0 + fraction[0] * 86_400.0 + behind))
    t_s = (whole * 86_400.0 - tai_s) + fraction * 86_400.0 + behind
    return Epoch(tai_s), np.round(t_s, 12)


def _check_states(t_s: Floats, positions: Floats, velocities: Floats, file: str) -> None:
    if len(t_s) < 8:
        raise RawDataError(file, "states", str(len(t_s)), "at least 8")
    if len(bad := np.flatnonzero(np.diff(t_s) <= 0)):
        found = f"{t_s[bad[0] + 1]:.6f} s after {t_s[bad[0]]:.6f} s"
        raise RawDataError(file, f"state {bad[0] + 2}, time", found, "strictly increasing times")
    radius = np.linalg.norm(positions, axis=1)
    if len(bad := np.flatnonzero((radius < 6.4e6) | (radius > 5e7))):
        found = f"{radius[bad[0]] / 1e3:.1f} km from the centre"
        raise RawDataError(file, f"state {bad[0] + 1}, position", found, "6400 to 50000 km (unit km)")
