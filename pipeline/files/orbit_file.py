"""Read the orbit of a dump: a CCSDS Orbit Ephemeris Message (OEM 1.0 to 3.0, CCSDS 502.0-B), KVN or XML."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import GPS_MINUS_TAI_S, TT_MINUS_TAI_S, Epoch
from boresight.geometry.inertial_frames import InertialFrame, rotation_to_gcrs
from boresight.geometry.record import Floats, array, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import NUMBER, PLAIN_NUMBER, read_message
from boresight.pipeline.files.xml_files import elements_of, numbers_of, xml_root
from boresight.pipeline.files.xml_files import text_of as element_text

__all__ = ["Ephemeris", "check_components", "check_states", "read_oem", "tai_seconds"]

# REF_FRAMEs that do not rotate with the Earth.
INERTIAL: tuple[InertialFrame, ...] = ("GCRF", "ICRF", "EME2000")
# By how much clocks of these scales are ahead of GPS time, s; UTC is by leap seconds.
AHEAD_OF_GPS_S = {"GPS": 0.0, "TAI": -GPS_MINUS_TAI_S, "TT": TT_MINUS_TAI_S - GPS_MINUS_TAI_S}
LIMIT_KM = 1e9  # of a coordinate and of a velocity in km/s, far beyond those of any orbit
EXPECTED = "an OEM that follows CCSDS 502.0-B"  # what messages say was expected
VERSIONS = ("1.0", "2.0", "3.0")  # values of CCSDS_OEM_VERS that are read
# Keywords of CCSDS 502.0-B-3, tables 5-2 and 5-3: the required ones, then those that may be there.
HEADER = ("CCSDS_OEM_VERS", "CREATION_DATE", "ORIGINATOR"), ("CLASSIFICATION", "MESSAGE_ID")
METADATA = (
    ("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM", "START_TIME", "STOP_TIME"),
    ("REF_FRAME_EPOCH", "USEABLE_START_TIME", "USEABLE_STOP_TIME", "INTERPOLATION", "INTERPOLATION_DEGREE"),
)
_KEYWORD = re.compile(r"([A-Z_]+)\s*=\s*(\S.*)")  # a line KEYWORD = value
# A time, ISO 8601 with a date or a day of the year (CCSDS 301.0-B, codes A and B).
_STAMP = re.compile(r"(\d{4})-(?:\d\d-\d\d|(\d{3}))(T\d\d:\d\d:\d\d(?:\.\d+)?)Z?", re.ASCII)
_CALENDAR_STAMP = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?", re.ASCII)  # nearly all
_NUMBER = re.compile(NUMBER)  # a decimal number, whole word
# A line of an epoch with six coordinates, accelerations optional.
_STATE = re.compile(rf"\S+(?:\s+{NUMBER}){{6}}(?:(?:\s+{NUMBER}){{3}})?")
_COORDINATES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")  # names of the coordinates in errors
_ACCELERATIONS = ("X_DDOT", "Y_DDOT", "Z_DDOT")  # the same of the optional ones; not used


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

    States in EME2000 are rotated to GCRF; comments, accelerations and covariances are not used. Raises
    `RawDataError`.
    """
    text = read_message(path, file)
    if text.lstrip().startswith("<"):
        return _ephemeris(*_of_xml(text, file), file)
    return _ephemeris(*_of_lines(text, file), file)


def _ephemeris(meta: dict[str, str], times: list[str], values: Floats, file: str) -> Ephemeris:
    """The checked states, SI units, in GCRF or ITRF, of values (N, 6) in km and km/s."""
    check_components(values, file)
    if not times:
        raise RawDataError(file, "states", "0", "at least 8")
    epoch, t_s = tai_seconds(times, meta["TIME_SYSTEM"], file)
    _, (first, last) = tai_seconds([meta["START_TIME"], meta["STOP_TIME"]], meta["TIME_SYSTEM"], file)
    if not first <= last:
        raise RawDataError(
            file, "STOP_TIME", meta["STOP_TIME"], f"a time after START_TIME, {meta['START_TIME']}"
        )
    frame, R = _frame(meta, file)
    positions, velocities = R.apply(1e3 * values[:, :3]), R.apply(1e3 * values[:, 3:])
    check_states(t_s, positions, velocities, file)
    return Ephemeris(
        epoch=epoch,
        t_s=t_s,
        positions_m=positions,
        velocities_m_s=velocities,
        frame=frame,
        method=_method(meta, file),
        interpolation_degree=_degree(meta, file),
        first_time=times[0],
        last_time=times[-1],
        time_system=meta["TIME_SYSTEM"],
    )


def _of_lines(text: str, file: str) -> tuple[dict[str, str], list[str], Floats]:
    """Metadata, times and values (N, 6) of the keyword = value form."""
    if not text.startswith("CCSDS_OEM_VERS"):
        raise RawDataError(file, "line 1", "another text", "CCSDS_OEM_VERS = ..., or an OEM in XML")
    every = [given.strip() for given in text.splitlines()]
    numbers = [n for n, line in enumerate(every, start=1) if line and not line.startswith("COMMENT")]
    lines = [every[n - 1] for n in numbers]
    if (segments := lines.count("META_START")) != 1 or lines.count("META_STOP") != 1:
        raise RawDataError(file, "META_START", f"{segments} segments", "one segment")
    begin, end = lines.index("META_START"), lines.index("META_STOP")
    pairs = [_pair(number, line, file) for number, line in zip(numbers, lines[:end]) if line != "META_START"]
    _keywords(pairs[:begin], HEADER, file)
    meta = _keywords(pairs[begin:], METADATA, file)
    last = len(lines)
    if "COVARIANCE_START" in lines[end:]:
        if lines[-1] != "COVARIANCE_STOP":
            raise RawDataError(file, f"line {numbers[-1]}", lines[-1], "COVARIANCE_STOP")
        last = lines.index("COVARIANCE_START", end)
    data, numbers = lines[end + 1 : last], numbers[end + 1 : last]
    for number, line in zip(numbers, data):
        if not _STATE.fullmatch(line):
            raise _wrong_state(number, line, file)
    words = " ".join(data).split()
    if len(words) not in (7 * len(data), 10 * len(data)):  # some lines have accelerations
        words = [word for line in data for word in line.split()[:7]]
    width = len(words) // len(data) if data else 7
    values = np.array([list(map(float, words[k::width])) for k in range(1, 7)]).T
    stamps = words[::width]
    times = [stamp.removesuffix("Z") for stamp in stamps]
    for n in [n for n, time in enumerate(times) if not _CALENDAR_STAMP.fullmatch(time)]:
        times[n] = _calendar(stamps[n], file, f"line {numbers[n]}, time")
    return meta, times, np.ascontiguousarray(values)


def _wrong_state(number: int, line: str, file: str) -> RawDataError:
    """What is wrong with a line that is no time and six numbers, or nine with accelerations."""
    words = line.split()
    for name, word in zip(_COORDINATES + _ACCELERATIONS, words[1:]):
        if not _NUMBER.fullmatch(word):
            return RawDataError(file, f"line {number}, {name}", word, PLAIN_NUMBER)
    expected = "a time and six numbers, with accelerations nine"
    return RawDataError(file, f"line {number}", f"{len(words)} words: {line}", expected)


def _of_xml(text: str, file: str) -> tuple[dict[str, str], list[str], Floats]:
    """Metadata, times and values (N, 6) of the XML form."""
    root = xml_root(text, file)  # well-formed, without DTD
    if root.tag != "oem":
        raise RawDataError(file, "root element", root.tag[:64], "oem")
    (body,) = elements_of(root, "body", file, 1, 1)
    (segment,) = elements_of(body, "segment", file, 1, 1)
    header = [(one.tag, one.text or "") for one in root.iterfind("header/*")]
    _keywords([("CCSDS_OEM_VERS", root.get("version", "")), *header], HEADER, file)
    meta = _keywords([(one.tag, one.text or "") for one in segment.iterfind("metadata/*")], METADATA, file)
    states = segment.findall("data/stateVector")
    values = [
        [numbers_of(state, name, file, 1, f"state {n + 1}, ")[0] for name in _COORDINATES]
        for n, state in enumerate(states)
    ]
    times = [
        _calendar(element_text(one, "EPOCH", file), file, f"state {n + 1}") for n, one in enumerate(states)
    ]
    return meta, times, np.array(values).reshape(-1, 6)


def _pair(number: int, line: str, file: str) -> tuple[str, str]:
    if (match := _KEYWORD.fullmatch(line)) is None:
        raise RawDataError(file, f"line {number}", line, "KEYWORD = value")
    return match[1], match[2]


def _keywords(
    pairs: Iterable[tuple[str, str]], known: tuple[tuple[str, ...], tuple[str, ...]], file: str
) -> dict[str, str]:
    """Values by keyword; `RawDataError` for an unknown, a repeated, an empty and a missing one."""
    values: dict[str, str] = {}
    for key, value in pairs:
        if key == "COMMENT":
            continue
        if key not in known[0] + known[1]:
            raise RawDataError(file, key, "an unknown keyword", EXPECTED)
        if key in values:
            raise RawDataError(file, key, "a second time", "each keyword once")
        values[key] = value.strip()
        if ("TIME" in key and key != "TIME_SYSTEM") or key.endswith(("DATE", "EPOCH")):
            values[key] = _calendar(values[key], file, key)
    for key in known[0]:
        if not values.get(key):
            raise RawDataError(file, key, "nothing", EXPECTED)
    if (version := values.get("CCSDS_OEM_VERS", VERSIONS[0])) not in VERSIONS:
        raise RawDataError(file, "CCSDS_OEM_VERS", version, ", ".join(VERSIONS))
    return values


def _calendar(stamp: str, file: str, field: str) -> str:
    """A time as calendar date without Z: of `2024-325T03:40:00Z` that is 2024-11-20T03:40:00."""
    if (match := _STAMP.fullmatch(stamp)) is None:
        expected = "a time such as 2024-11-20T03:40:00.5 or 2024-325T03:40:00.5"
        raise RawDataError(file, field, stamp, expected)
    year, day, time = match.groups()
    if day is None:
        return stamp.removesuffix("Z")
    try:
        return f"{datetime.datetime.strptime(f'{year} {day}', '%Y %j').date()}{time}"
    except ValueError as error:
        raise RawDataError(file, field, stamp, "a day of that year") from error


def _frame(meta: dict[str, str], file: str) -> tuple[Literal["GCRF", "ITRF"], Rotation]:
    """The frame that the states are kept in, and the rotation to it from that of the file."""
    if (centre := meta["CENTER_NAME"].upper()) != "EARTH":
        raise RawDataError(file, "CENTER_NAME", centre, "EARTH")
    frame = meta["REF_FRAME"].upper()
    for inertial in INERTIAL:
        if frame == inertial:
            return "GCRF", rotation_to_gcrs(inertial)
    if frame.startswith("ITRF"):
        return "ITRF", Rotation.identity()
    raise RawDataError(file, "REF_FRAME", frame, "GCRF, ICRF, EME2000 or ITRF (with or without a year)")


def _method(meta: dict[str, str], file: str) -> Literal["lagrange", "hermite"]:
    method = meta.get("INTERPOLATION", "LAGRANGE").upper()
    if method == "LAGRANGE":
        return "lagrange"
    if method == "HERMITE":
        return "hermite"
    raise RawDataError(file, "INTERPOLATION", method, "LAGRANGE or HERMITE")


def _degree(meta: dict[str, str], file: str) -> int:
    if "INTERPOLATION" not in meta:
        return 7
    degree = meta.get("INTERPOLATION_DEGREE", "nothing")
    if not re.fullmatch(r"[0-9]{1,2}", degree) or not 1 <= int(degree) <= 15:
        raise RawDataError(file, "INTERPOLATION_DEGREE", degree, "1 to 15")
    return int(degree)


def tai_seconds(
    times: Sequence[str], time_system: str, file: str, field: str = "time of the states"
) -> tuple[Epoch, Floats]:
    """Epoch, and TAI seconds (N,) since it, of calendar dates in a time system.

    `RawDataError` for another time system and for times that do not exist, which it names by `field`.
    """
    scale = time_system.upper()
    if scale != "UTC" and scale not in AHEAD_OF_GPS_S:
        raise RawDataError(file, "TIME_SYSTEM", time_system, "UTC, TAI, TT or GPS")
    try:
        if scale == "UTC":
            epoch = Epoch.from_utc(times[0])
            return epoch, epoch.seconds_from_utc(times)
        ahead_s = AHEAD_OF_GPS_S[scale]
        epoch = Epoch(int(np.floor(Epoch(0).seconds_from_gps_dates(times[:1])[0] - ahead_s)))
        return epoch, np.round(epoch.seconds_from_gps_dates(times) - ahead_s, 12)
    except ValueError as error:
        raise RawDataError(file, field, str(error), "times that exist") from error


def check_components(values: Floats, file: str) -> None:
    """`RawDataError` for a state of (N, 6), km and km/s, that no orbit has."""
    for name, numbers in (("position", values[:, :3]), ("velocity", values[:, 3:])):
        if len(bad := np.flatnonzero(~(np.abs(numbers) < LIMIT_KM).all(axis=1))):
            expected = f"finite numbers below {LIMIT_KM:g} (unit km)"
            raise RawDataError(file, f"state {bad[0] + 1}, {name}", str(numbers[bad[0]]), expected)


def check_states(t_s: Floats, positions: Floats, velocities: Floats, file: str) -> None:
    """`RawDataError` for fewer than 8 states, times (N,) that do not increase, and positions (N, 3), m, of no
    orbit.
    """
    if len(t_s) < 8:
        raise RawDataError(file, "states", str(len(t_s)), "at least 8")
    if len(bad := np.flatnonzero(np.diff(t_s) <= 0)):
        found = f"{t_s[bad[0] + 1]:.6f} s after {t_s[bad[0]]:.6f} s"
        raise RawDataError(file, f"state {bad[0] + 2}, time", found, "strictly increasing times")
    radius = np.linalg.norm(positions, axis=1)
    if len(bad := np.flatnonzero((radius < 6.4e6) | (radius > 5e7))):
        found = f"{radius[bad[0]] / 1e3:.1f} km from the centre"
        raise RawDataError(file, f"state {bad[0] + 1}, position", found, "6400 to 50000 km (unit km)")
