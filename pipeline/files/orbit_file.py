"""The orbit of a dump: a CCSDS Orbit Ephemeris Message (OEM 1.0 to 3.0, CCSDS 502.0-B), KVN or XML."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.earth_rotation import FrameOfDate, InertialFrame, of_date_to_gcrs, rotation_to_gcrs
from boresight.geometry.epoch import GPS_MINUS_TAI_S, TT_MINUS_TAI_S, Epoch
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.ccsds_messages import HEADER, OUTSIDE, Block, MessageKind, message_blocks
from boresight.pipeline.files.text_files import NUMBER, PLAIN_NUMBER, read_message
from boresight.records.record import Floats, RowRecord, array, record, scalar

__all__ = [
    "SAME_FRAME",
    "Ephemeris",
    "calendar_date",
    "check_components",
    "check_states",
    "check_time_system",
    "joined_segments",
    "orbit_message",
    "read_oem",
    "read_segments",
    "tai_seconds",
]

# REF_FRAMEs that do not rotate with the Earth.
INERTIAL: tuple[InertialFrame, ...] = ("GCRF", "ICRF", "EME2000")
# REF_FRAMEs of the equator and equinox of date, by their names in messages; those of CCSDS 502.0-B-3 (SANA)
# too.
OF_DATE: dict[str, FrameOfDate] = {
    "TEME": "TEME",
    "TEMEOFDATE": "TEME",
    "TEMEOFEPOCH": "TEME",
    "TOD": "TOD",
    "TOD_EARTH": "TOD",
}
SAME_FRAME = {"J2000": "EME2000"}  # other names of them in messages, as in the examples of CCSDS 504.0-B-2
# By how much clocks of these scales are ahead of GPS time, s; UTC is by leap seconds.
AHEAD_OF_GPS_S = {"GPS": 0.0, "TAI": -GPS_MINUS_TAI_S, "TT": TT_MINUS_TAI_S - GPS_MINUS_TAI_S}
LIMIT_KM = 1e9  # of a coordinate and of a velocity in km/s, far beyond those of any orbit
LOWEST_M, HIGHEST_M = 6.4e6, 5e7  # distances of a satellite from the centre of the Earth
EXPECTED = "an OEM that follows CCSDS 502.0-B"  # what messages say was expected
# An OEM: the keywords of CCSDS 502.0-B-3, tables 5-2 and 5-3.
OEM = MessageKind(
    name="OEM",
    versions=("1.0", "2.0", "3.0"),
    standard="CCSDS 502.0-B",
    required={
        HEADER: ("CCSDS_OEM_VERS", "CREATION_DATE", "ORIGINATOR"),
        "META": (
            *("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM", "START_TIME"),
            "STOP_TIME",
        ),
    },
    optional={
        HEADER: ("CLASSIFICATION", "MESSAGE_ID"),
        "META": (
            *("REF_FRAME_EPOCH", "USEABLE_START_TIME", "USEABLE_STOP_TIME", "INTERPOLATION"),
            "INTERPOLATION_DEGREE",
        ),
        OUTSIDE: (),
    },
    rows={OUTSIDE: ("", "stateVector")},
    unused=("COVARIANCE",),
)
_OF_TIMES = re.compile(r"TIME|(DATE|EPOCH)$")  # in keywords whose values are times
# A time, ISO 8601 with a date or a day of the year (CCSDS 301.0-B, codes A and B).
_STAMP = re.compile(r"(\d{4})-(?:\d\d-\d\d|(\d{3}))(T\d\d:\d\d:\d\d(?:\.\d+)?)Z?", re.ASCII)
_CALENDAR_STAMP = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?", re.ASCII)  # nearly all
_NUMBER = re.compile(NUMBER)  # a decimal number, whole word
# A line of an epoch with six coordinates, accelerations optional.
_STATE = re.compile(rf"\S++(?:\s++{NUMBER}){{6}}(?:(?:\s++{NUMBER}){{3}})?")
_COORDINATES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")  # names of the coordinates in errors
_ACCELERATIONS = ("X_DDOT", "Y_DDOT", "Z_DDOT")  # the same of the optional ones; not used


@record(kw_only=True)
class Ephemeris(RowRecord):
    """States of one segment of an OEM."""

    epoch: Epoch = scalar("zero of `t_s`: whole TAI second at or before the first segment's first state")
    t_s: Floats = array("N", "TAI seconds since `epoch`, strictly increasing")
    positions_m: Floats = array("N, 3", "m, axes of `frame`")
    velocities_m_s: Floats = array("N, 3", "m/s, axes of `frame`")
    frame: Literal["GCRF", "ITRF"] = scalar("GCRF (inertial) or ITRF (Earth-fixed)")
    method: Literal["lagrange", "hermite"] = scalar("interpolation that the file asks for")
    interpolation_degree: int = scalar("degree of the interpolating polynomial, 1 to 15")
    first_time: str = scalar("time of the first state, in the file's own time system")
    last_time: str = scalar("time of the last state, likewise")
    time_system: str = scalar("that time system", default="UTC")
    begins: tuple[int, ...] = scalar("first states of further segments that were joined", default=())


def read_oem(path: Path, file: str) -> Ephemeris:
    """The states of an OEM of one segment; `file` names it in errors.

    States in EME2000 are rotated to GCRF; comments, accelerations and covariances are not used. Raises
    `RawDataError`.
    """
    segments = read_segments(path, file)
    if len(segments) != 1:
        raise RawDataError(file, "segments", str(len(segments)), "one segment")
    return segments[0]


def read_segments(path: Path, file: str) -> tuple[Ephemeris, ...]:
    """The segments of an OEM, in the order of the file and with one epoch; otherwise as `read_oem`.

    Raises `RawDataError`, also for segments of several objects.
    """
    _, (header, *blocks) = message_blocks(read_message(path, file), file, OEM)
    _dated(header, file)
    if not [block for block in blocks if block.name == "META"]:
        raise RawDataError(file, "META_START", "nothing", EXPECTED)
    read = [_part(_dated(a, file), b, file) for a, b in pairwise(blocks) if a.name == "META"]
    for a, b in pairwise([header, *blocks]):
        if b.name == OUTSIDE and b.rows and a.name != "META":
            raise RawDataError(file, b.at(0), str(b.rows[0]), f"META_START, or no line after {a.name}_STOP")
    for meta, *_ in read[1:]:
        first, other = read[0][0].values["OBJECT_ID"], meta.values["OBJECT_ID"]
        if other != first:
            raise meta.error("OBJECT_ID", other, f"{first}, as in the first segment", file)
    names = [f"{file} (segment {n} of {len(read)})" for n in range(1, len(read) + 1)]
    parts = [_ephemeris(*one, name) for one, name in zip(read, names if len(read) > 1 else [file])]
    epoch = parts[0].epoch
    later_s = [float(one.epoch.tai_s - epoch.tai_s) for one in parts]
    return tuple(replace(one, epoch=epoch, t_s=one.t_s + later) for one, later in zip(parts, later_s))


def joined_segments(segments: Sequence[Ephemeris]) -> Ephemeris | None:
    """All segments as one ephemeris, the begin of each kept; None where they overlap, or differ in frame or
    interpolation.

    CCSDS 502.0-B forbids interpolation from one segment to the next.
    """
    first = segments[0]
    rule = first.frame, first.method, first.interpolation_degree
    if any((one.frame, one.method, one.interpolation_degree) != rule for one in segments):
        return None
    if any(a.t_s[-1] > b.t_s[0] for a, b in pairwise(segments)):
        return None
    begins = tuple(np.cumsum([len(one.t_s) for one in segments[:-1]]).tolist())
    return replace(Ephemeris.together(segments), last_time=segments[-1].last_time, begins=begins)


Part = tuple[Block, list[str], Floats]  # metadata of a segment, times, values (N, 6)


def _ephemeris(meta: Block, times: list[str], values: Floats, file: str) -> Ephemeris:
    """The checked states, SI units, in GCRF or ITRF, of values (N, 6) in km and km/s."""
    check_components(values, file)
    if not times:
        raise RawDataError(file, "states", "0", "at least 2")
    scale, start, stop = (meta.values[key] for key in ("TIME_SYSTEM", "START_TIME", "STOP_TIME"))
    check_time_system(scale, file, meta.fields["TIME_SYSTEM"])
    epoch, t_s = tai_seconds(times, scale, file)
    _, (first, last) = tai_seconds([start, stop], scale, file)
    if not first <= last:
        raise meta.error("STOP_TIME", stop, f"a time after START_TIME, {start}", file)
    frame, R = _frame(meta, epoch, t_s, file)
    method, degree = _method(meta, file), _degree(meta, file)
    positions, velocities = R.apply(1e3 * values[:, :3]), R.apply(1e3 * values[:, 3:])
    check_states(t_s, positions, file, degree + 1 if method == "lagrange" else degree // 2 + 1)
    return Ephemeris(
        epoch=epoch,
        t_s=t_s,
        positions_m=positions,
        velocities_m_s=velocities,
        frame=frame,
        method=method,
        interpolation_degree=degree,
        first_time=times[0],
        last_time=times[-1],
        time_system=scale,
    )


def _dated(block: Block, file: str) -> Block:
    """A block whose times are calendar dates."""
    keys = [key for key in block.values if key != "TIME_SYSTEM" and _OF_TIMES.search(key)]
    dates = {key: calendar_date(block.values[key], file, block.fields[key]) for key in keys}
    return replace(block, values=block.values | dates)


def _part(meta: Block, states: Block, file: str) -> Part:
    """Metadata, times and values (N, 6) of a segment."""
    lines = states.lines(_COORDINATES, file)
    for n, line in enumerate(lines):
        if not _STATE.fullmatch(line):
            raise _wrong_state(states.at(n), line, file)
    words = " ".join(lines).split()
    if len(words) not in (7 * len(lines), 10 * len(lines)):  # some lines have accelerations
        words = [word for line in lines for word in line.split()[:7]]
    width = len(words) // len(lines) if lines else 7
    values = np.array([list(map(float, words[k::width])) for k in range(1, 7)]).T
    stamps = words[::width]
    times = [stamp.removesuffix("Z") for stamp in stamps]
    for n in [n for n, time in enumerate(times) if not _CALENDAR_STAMP.fullmatch(time)]:
        times[n] = calendar_date(stamps[n], file, f"{states.at(n)}, time")
    return meta, times, np.ascontiguousarray(values).reshape(-1, 6)


def _wrong_state(where: str, line: str, file: str) -> RawDataError:
    """What is wrong with a line that is no time and six numbers, or nine with accelerations."""
    words = line.split()
    for name, word in zip(_COORDINATES + _ACCELERATIONS, words[1:]):
        if not _NUMBER.fullmatch(word):
            return RawDataError(file, f"{where}, {name}", word, PLAIN_NUMBER)
    expected = "a time and six numbers, with accelerations nine"
    return RawDataError(file, where, f"{len(words)} words: {line}", expected)


def _frame(meta: Block, epoch: Epoch, t_s: Floats, file: str) -> tuple[Literal["GCRF", "ITRF"], Rotation]:
    """The frame that states at t_s (N,) are kept in, and the rotation to it from that of the file: of frames
    of date one for each state, or that of REF_FRAME_EPOCH.
    """
    if (centre := meta.values["CENTER_NAME"].upper()) != "EARTH":
        raise meta.error("CENTER_NAME", centre, "EARTH", file)
    frame = meta.values["REF_FRAME"].upper()
    for inertial in INERTIAL:
        if SAME_FRAME.get(frame, frame) == inertial:
            return "GCRF", rotation_to_gcrs(inertial)
    if frame in OF_DATE:
        if (at := meta.values.get("REF_FRAME_EPOCH")) is None:
            return "GCRF", of_date_to_gcrs(OF_DATE[frame], epoch, t_s)
        since, t_s = tai_seconds([at], meta.values["TIME_SYSTEM"], file, meta.fields["REF_FRAME_EPOCH"])
        return "GCRF", of_date_to_gcrs(OF_DATE[frame], since, t_s)[0]
    if frame.startswith("ITRF"):
        return "ITRF", Rotation.identity()
    expected = "GCRF, ICRF, EME2000, TEME, TOD or ITRF (with or without a year)"
    raise meta.error("REF_FRAME", frame, expected, file)


def _method(meta: Block, file: str) -> Literal["lagrange", "hermite"]:
    method = meta.values.get("INTERPOLATION", "LAGRANGE").upper()
    if method not in ("LAGRANGE", "HERMITE"):
        raise meta.error("INTERPOLATION", method, "LAGRANGE or HERMITE", file)
    return "lagrange" if method == "LAGRANGE" else "hermite"


def _degree(meta: Block, file: str) -> int:
    if "INTERPOLATION" not in meta.values:
        return 7
    degree = meta.values.get("INTERPOLATION_DEGREE", "nothing")
    if not re.fullmatch(r"[0-9]{1,2}", degree) or not 1 <= int(degree) <= 15:
        raise meta.error("INTERPOLATION_DEGREE", degree, "1 to 15", file)
    return int(degree)


def calendar_date(stamp: str, file: str, field: str) -> str:
    """A time of a message as calendar date without Z: of `2024-325T03:40:00Z` that is 2024-11-20T03:40:00.

    `RawDataError`, which names `field`, for text that is neither a date nor a day of the year.
    """
    if (match := _STAMP.fullmatch(stamp)) is None:
        expected = "a time such as 2024-11-20T03:40:00.5 or 2024-325T03:40:00.5"
        raise RawDataError(file, field, stamp, expected)
    year, day, time = match.groups()
    if day is None:
        return stamp.removesuffix("Z")
    with refusing(file, field, "a day of that year", found=stamp):
        return f"{datetime.datetime.strptime(f'{year} {day}', '%Y %j').date()}{time}"


def tai_seconds(
    times: Sequence[str], time_system: str, file: str, field: str = "time of the states"
) -> tuple[Epoch, Floats]:
    """Epoch, and TAI seconds (N,) since it, of calendar dates in a time system.

    `RawDataError` for another time system and for times that do not exist, which it names by `field`.
    """
    check_time_system(time_system, file)
    scale = time_system.upper()
    with refusing(file, field, "times that exist"):
        if scale == "UTC":
            epoch = Epoch.from_utc(times[0])
            return epoch, epoch.seconds_from_utc(times)
        ahead_s = AHEAD_OF_GPS_S["TT" if scale == "TDB" else scale]
        epoch = Epoch(int(np.floor(Epoch(0).seconds_from_gps_dates(times[:1])[0] - ahead_s)))
        t_s = np.round(epoch.seconds_from_gps_dates(times) - ahead_s, 12)
        # TDB - TT at the Earth's centre, at most 2 ms
        return epoch, t_s - erfa.dtdb(*epoch.tt_jd(t_s), 0.0, 0.0, 0.0, 0.0) if scale == "TDB" else t_s


def check_time_system(time_system: str, file: str, field: str = "TIME_SYSTEM") -> None:
    """`RawDataError`, which names `field`, for a time system that is not read."""
    if time_system.upper() not in ("UTC", "TDB", *AHEAD_OF_GPS_S):
        raise RawDataError(file, field, time_system, "UTC, TAI, TT, TDB or GPS")


def check_components(values: Floats, file: str) -> None:
    """`RawDataError` for a state of (N, 6), km and km/s, that no orbit has."""
    for name, numbers in (("position", values[:, :3]), ("velocity", values[:, 3:])):
        if len(bad := np.flatnonzero(~(np.abs(numbers) < LIMIT_KM).all(axis=1))):
            expected = f"finite numbers below {LIMIT_KM:g} (unit km)"
            raise RawDataError(file, f"state {bad[0] + 1}, {name}", str(numbers[bad[0]]), expected)


def check_states(t_s: Floats, positions: Floats, file: str, least: int = 8) -> None:
    """`RawDataError` for too few states, times (N,) not increasing, positions (N, 3), m, of no orbit."""
    if len(t_s) < max(least, 2):
        raise RawDataError(file, "states", str(len(t_s)), f"at least {max(least, 2)}")
    if len(bad := np.flatnonzero(np.diff(t_s) <= 0)):
        found = f"{t_s[bad[0] + 1]:.6f} s after {t_s[bad[0]]:.6f} s"
        raise RawDataError(file, f"state {bad[0] + 2}, time", found, "strictly increasing times")
    radius = np.linalg.norm(positions, axis=1)
    if len(bad := np.flatnonzero((radius < LOWEST_M) | (radius > HIGHEST_M))):
        found = f"{radius[bad[0]] / 1e3:.1f} km from the centre"
        raise RawDataError(file, f"state {bad[0] + 1}, position", found, "6400 to 50000 km (unit km)")


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
