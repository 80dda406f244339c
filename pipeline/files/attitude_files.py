"""Read attitudes of a star camera: CSV, or a CCSDS Attitude Ephemeris Message (AEM 1.0 and 2.0, KVN and XML)
or Attitude Comprehensive Message (ACM 2.0, KVN and XML).

The result are rotations R_si from GCRS to the star camera, as the file has them; what aberration the head has
left in is put right by `geometry.starlight`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import get_args
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.earth_rotation import AttitudeFrame, EarthRotation, InertialFrame, rotation_to_gcrs
from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.acm_text import (
    ANGLES,
    EULER,
    QUATERNION,
    AcmAttitudes,
    is_acm,
    read_acm,
    rotation_sequence,
    rotations_of,
)
from boresight.pipeline.files.orbit_file import SAME_FRAME, calendar_date, check_time_system, tai_seconds
from boresight.pipeline.files.text_files import MAX_ROWS, check_number, csv_rows, read_message
from boresight.pipeline.files.xml_files import xml_root
from boresight.records.record import Floats, RowRecord, array, record, scalar

__all__ = ["COMPONENTS", "COVARIANCES", "SIGMAS", "AttitudeRows", "check_rows", "read_attitudes"]

EARTH_FIXED: AttitudeFrame = "ITRF"
# Names of frames that a file may state; realisations of ITRF differ by centimetres on the ground.
OUTER: tuple[AttitudeFrame, ...] = (*get_args(InertialFrame), EARTH_FIXED)
VERSION, VERSIONS = "CCSDS_AEM_VERS", ("1.0", "2.0")  # first keyword of an AEM, and its values that are read
# Keywords of CCSDS 504.0-B-1 that 504.0-B-2 has no more, and what it has instead of them.
OF_VERSION_1 = {"ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "LAST"}
# Columns of attitude tables: the quaternion, scalar last; 1-sigmas and covariances about x, y, z of the head.
COMPONENTS = ("qx", "qy", "qz", "qw")
# Columns of 1-sigma errors about x, y, z of the head.
SIGMAS = tuple(f"sigma_{axis}_arcsec" for axis in "xyz")
PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")  # of axes, upper triangle row by row
COVARIANCES = tuple(f"cov_{pair}_arcsec2" for pair in PAIRS)  # columns of covariances, same axes
LARGEST_ARCSEC = 36_000.0  # 10 degrees: not a star camera
# What is expected of the first line of a file that is neither a message nor a CSV table.
MESSAGES = "CCSDS_AEM_VERS or CCSDS_ACM_VERS = ..., an AEM or ACM in XML, or a CSV file"
EXPECTED = "an attitude message that follows CCSDS 504.0-B, or a CSV file"  # what messages say was expected


@record(kw_only=True)
class AttitudeRows(RowRecord):
    """Attitudes as a file has them, rows marked invalid left out."""

    t_s: Floats = array("N", "TAI seconds since the dump's epoch, strictly increasing")
    R_si: Rotation = array("N", "GCRS to star camera, aberration as the head has it")
    covariance_s: Floats | None = array("N, 3, 3", "rad², axes of s; None: not stated", default=None)
    temperature_c: Floats | None = array("N", "of the head, degrees Celsius; None: not stated", default=None)
    n_invalid: int = scalar("rows marked invalid", default=0)
    is_earth_fixed: bool = scalar("whether `R_si` is from ITRS axes so far", default=False)

    def to_gcrs(self, epoch: Epoch, table: EarthOrientationTable, file: str) -> AttitudeRows:
        """Attitudes (N,) from GCRS axes; `RawDataError` about `file` for dates without Earth rotation."""
        if not self.is_earth_fixed:
            return self
        first_s, last_s = float(self.t_s[0]), float(self.t_s[-1])
        # Whether old tables are allowed is decided where the orbit is opened.
        with refusing(file, "times", "dates within the Earth-orientation table"):
            earth = EarthRotation.over(epoch, first_s, last_s, table, allow_stale_eop=True)
        R_si = self.R_si * earth.rotations_ie(self.t_s).inv()
        return replace(self, R_si=R_si, is_earth_fixed=False)


def read_attitudes(
    path: Path,
    file: str,
    epoch: Epoch,
    frame: AttitudeFrame | None,
    rotation: str | None,
    time_scale: str | None = None,
) -> AttitudeRows:
    """Attitudes of a CSV file, of an AEM or of an ACM, told apart by their first line.

    Times count from `epoch`. A message states its own frame, sense and time scale; of a CSV file `frame` is
    the axes ("GCRF", "ICRF", "EME2000" or, Earth-fixed, "ITRF"), `rotation` the sense of its quaternions
    ("head to inertial" or "inertial to head"), `time_scale` the scale and column of its times ("UTC", also
    for None, "TAI", "GPS"). `RawDataError` names `file`, line or field, found and expected.
    """
    text = read_message(path, file)
    start = text.lstrip()
    message = is_acm(start) or start.startswith((VERSION, "<"))
    if start.startswith("CCSDS_") and not message:
        line = 1 + text[: len(text) - len(start)].count("\n")
        raise RawDataError(file, f"line {line}", start.splitlines()[0][:64], MESSAGES)
    for key, value in (("frame", frame), ("rotation", rotation), ("time_scale", time_scale)):
        if message and value is not None:
            expected = "no such key: a message states its own"
            raise RawDataError("dump.toml", f"{key} of {file}", value, expected)
        if not message and value is None and key != "time_scale":
            raise RawDataError("dump.toml", f"{key} of {file}", "nothing", "this key, for a CSV file")
    root = xml_root(start, file) if start.startswith("<") else None
    if is_acm(start) or is_acm(root):
        rows = _from_acm(read_acm(text if root is None else root, file), file, epoch)
    elif frame is None:
        segments = list(_kvn_segments(text, file) if root is None else _xml_segments(root, file))
        if not segments:
            raise RawDataError(file, "segments", "none", EXPECTED)
        rows = AttitudeRows.together([_segment(*one, file, epoch) for one in segments])
    else:
        rows = _from_csv(path, file, epoch, frame, str(rotation), time_scale or "UTC")
    check_rows(rows, file)
    return rows


def check_rows(rows: AttitudeRows, file: str) -> None:
    """`RawDataError` for fewer than two attitudes, and for times that do not increase."""
    if len(rows.t_s) < 2:
        found = f"{len(rows.t_s)} valid rows, {rows.n_invalid} marked invalid"
        raise RawDataError(file, "rows", found, "at least two valid attitudes")
    if len(bad := np.flatnonzero(np.diff(rows.t_s) <= 0.0)):
        found = f"{rows.t_s[bad[0] + 1] - rows.t_s[bad[0]]:.6f} s after the attitude before it"
        raise RawDataError(file, f"attitude {bad[0] + 2}, time", found, "strictly increasing times")


def _from_csv(
    path: Path, file: str, epoch: Epoch, frame: AttitudeFrame, rotation: str, time_scale: str
) -> AttitudeRows:
    clock = time_scale.lower()  # name of the column of times
    optional = (*SIGMAS, *COVARIANCES, "valid", "temperature_c")
    times: list[str] = []
    values: list[list[float]] = []
    names: tuple[str, ...] = ()
    invalid = 0
    for line, row in csv_rows(path, (clock, *COMPONENTS), optional, file):
        if not names:
            names = tuple(name for name in row if name not in (clock, "valid"))
            _check_complete(names, file)
        if (valid := row.get("valid", "1").strip()) not in ("0", "1"):
            raise RawDataError(file, f"{line}, valid", valid, "0 or 1")
        if valid == "0":
            invalid += 1
            continue
        times.append(row[clock].strip())
        values.append([check_number(row[name], file, f"{line}, {name}") for name in names])
    if not times:
        found = f"none valid, {invalid} marked invalid"
        raise RawDataError(file, "rows", found, "at least two valid attitudes")
    since, t_s = tai_seconds(times, time_scale, file, clock)
    table = np.array(values, dtype=float).reshape(len(times), len(names))
    column = {name: table[:, n] for n, name in enumerate(names)}
    q = np.column_stack([column[name] for name in COMPONENTS])
    return AttitudeRows(
        t_s=t_s + float(since.tai_s - epoch.tai_s),
        R_si=_from_outer(rotations_of(q, "", file), rotation == "inertial to head", frame),
        is_earth_fixed=frame == EARTH_FIXED,
        covariance_s=_covariance(column, file),
        temperature_c=column.get("temperature_c"),
        n_invalid=invalid,
    )


def _check_complete(names: tuple[str, ...], file: str) -> None:
    for group in (SIGMAS, COVARIANCES):
        given = [name for name in group if name in names]
        if given and len(given) < len(group):
            raise RawDataError(file, "header", f"{', '.join(given)} only", f"all of {', '.join(group)}")
    if SIGMAS[0] in names and COVARIANCES[0] in names:
        raise RawDataError(file, "header", "sigmas and covariances", "one of them")


def _covariance(column: dict[str, Floats], file: str) -> Floats | None:
    """(N, 3, 3) covariances, rad², or None where the file states none."""
    if SIGMAS[0] in column:
        sigma = np.column_stack([column[name] for name in SIGMAS])
        within = (sigma > 0.0) & (sigma <= LARGEST_ARCSEC)
        covariance = np.where(within, sigma, 1.0)[:, :, None] ** 2 * np.eye(3)
        bad = ~within.all(axis=1)
        what, stated = "sigma", sigma
    elif COVARIANCES[0] in column:
        covariance = np.empty((len(column["qx"]), 3, 3))
        for pair, name in zip(PAIRS, COVARIANCES):
            a, b = ("xyz".index(letter) for letter in pair)
            covariance[:, a, b] = covariance[:, b, a] = column[name]
        within = np.all(np.abs(covariance) <= LARGEST_ARCSEC**2, axis=(1, 2))
        scale = np.where(within, np.trace(covariance, axis1=1, axis2=2), 0.0)
        bad = np.ones(len(covariance), dtype=bool)
        smallest = np.linalg.eigvalsh(covariance[within])[:, 0] if within.any() else np.zeros(0)
        bad[within] = smallest <= 1e-12 * scale[within]
        what, stated = "covariance", covariance
    else:
        return None
    if bad.any():
        k = int(np.argmax(bad))
        expected = f"positive (definite), sigma at most {LARGEST_ARCSEC:g} arcsec"
        raise RawDataError(file, f"valid row {k + 1}, {what}", stated[k].tolist(), expected)
    return covariance * ARCSEC**2


def _from_outer(R: Rotation, is_outer_to_head: bool, frame: AttitudeFrame) -> Rotation:
    """Rotations from GCRS, or from ITRS, to the head, from those between the head and its outer frame."""
    R_head = R if is_outer_to_head else R.inv()
    return R_head if frame == "ITRF" else R_head * rotation_to_gcrs(frame).inv()


def _from_acm(found: AcmAttitudes, file: str, epoch: Epoch) -> AttitudeRows:
    t_s = found.t_s + float(found.since.tai_s - epoch.tai_s)
    rows = _between(found.frames, t_s, found.R_ab, file)
    if found.variance_rad2 is None:
        return rows
    return replace(rows, covariance_s=found.variance_rad2[:, :, None] * np.eye(3))


State = tuple[str, list[float]]  # time; quaternion or Euler angles
Segment = tuple[str, dict[str, str], list[State]]  # name in errors, metadata, states


def _kvn_segments(text: str, file: str) -> Iterator[Segment]:
    """Metadata and states of each segment of a message in KVN form."""
    meta: dict[str, str] = {}
    fields: dict[str, str] = {}  # keywords as errors name them
    states: list[State] = []
    where, part, version = "", "header", ""
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("COMMENT"):
            continue
        if line in ("META_START", "META_STOP", "DATA_START", "DATA_STOP"):
            if line == "META_START":
                meta, fields, states, where = {}, {}, [], f"META_START of line {number}, "
            if line == "DATA_START":
                _check_metadata(meta, version, file, where, fields)
            if line == "DATA_STOP":
                if part != "DATA_START":
                    raise RawDataError(file, f"line {number}", line, "DATA_START before it")
                yield where, meta, states
            part = line
        elif part == "DATA_START":
            states.append(_state(line.split(), meta, file, f"line {number}"))
            if len(states) > MAX_ROWS:
                raise RawDataError(file, f"line {number}", f"more than {MAX_ROWS} states", "fewer")
        elif part == "META_START":
            key, equals, value = line.partition("=")
            if not equals:
                raise RawDataError(file, f"line {number}", line, "KEYWORD = value")
            meta[key.strip()], fields[key.strip()] = value.strip(), f"line {number}, {key.strip()}"
        elif part == "header" and line.startswith(VERSION):
            version = _version(line.partition("=")[2].strip(), file, f"line {number}, {VERSION}")
    if part not in ("DATA_STOP", "header"):
        raise RawDataError(file, "end of the file", f"after {part}", "DATA_STOP")


def _version(text: str, file: str, field: str) -> str:
    if text not in VERSIONS:
        raise RawDataError(file, field, text or "nothing", " or ".join(VERSIONS))
    return text


def _check_metadata(
    meta: dict[str, str], version: str, file: str, where: str, fields: Mapping[str, str]
) -> None:
    """`RawDataError` where a keyword is missing, the attitudes are neither quaternions nor Euler angles, or a
    keyword not of version 2.0 contradicts that; it names a keyword by `fields`, and a missing one as missing
    `where`.
    """
    for key in ("REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE"):
        if key not in meta:
            raise RawDataError(file, where + key, "nothing", "this keyword")
    if not (kind := meta["ATTITUDE_TYPE"].upper()).startswith(("QUATERNION", "EULER_ANGLE")):
        expected = "QUATERNION or EULER_ANGLE, with or without rates; a spin is not read"
        raise RawDataError(file, fields.get("ATTITUDE_TYPE", f"{where}ATTITUDE_TYPE"), kind, expected)
    if _is_euler(meta):
        rotation_sequence(meta.get(EULER), file, fields.get(EULER, where + EULER))
    for key, only in OF_VERSION_1.items() if version != VERSIONS[0] else ():
        if (value := meta.get(key, only).upper()) != only:
            expected = f"{only}, as in version 2.0, which has no {key}; or CCSDS_AEM_VERS = 1.0"
            raise RawDataError(file, fields.get(key, where + key), value, expected)
    check_time_system(meta["TIME_SYSTEM"], file, fields.get("TIME_SYSTEM", f"{where}TIME_SYSTEM"))


def _state(cells: list[str], meta: dict[str, str], file: str, where: str) -> State:
    """The state of a line; what may follow (rates) is not used."""
    names: tuple[str, ...] = ANGLES if _is_euler(meta) else QUATERNION
    what = "three Euler angles" if names == ANGLES else "four components of a quaternion"
    if len(cells) <= len(names):
        raise RawDataError(file, where, " ".join(cells), f"a time and {what}")
    scalar_first = names == QUATERNION and meta.get("QUATERNION_TYPE", "LAST").upper() == "FIRST"
    order = (names[-1], *names[:-1]) if scalar_first else names
    found = {name: check_number(cell, file, f"{where}, {name}") for name, cell in zip(order, cells[1:])}
    return calendar_date(cells[0], file, f"{where}, time"), [found[name] for name in names]


def _is_euler(meta: Mapping[str, str]) -> bool:
    """Whether the attitudes of a segment are Euler angles."""
    return meta["ATTITUDE_TYPE"].upper().startswith("EULER_ANGLE")


def _xml_angles(state: Element, meta: Mapping[str, str], file: str, where: str) -> list[float]:
    """The Euler angles of a state; in version 1.0 an attribute of rotation1 to rotation3 names the axis."""
    found = {one.tag: (one.text or "").strip() for one in state.iter() if one.tag in ANGLES}
    axes = rotation_sequence(meta.get(EULER), file, where + EULER)
    for name, axis, one in zip(ANGLES, axes, state.iterfind(".//rotationAngles/*")):
        if (named := one.get("angle", f"{axis}_ANGLE").upper()) != f"{axis}_ANGLE":
            raise RawDataError(file, f"{where}, {one.tag}", named, f"{axis}_ANGLE, as {EULER} has it")
        found[name] = (one.text or "").strip()
    if missing := [name for name in ANGLES if name not in found]:
        raise RawDataError(file, where, f"no {missing[0]}", EXPECTED)
    return [check_number(found[name], file, f"{where}, {name}") for name in ANGLES]


def _xml_segments(root: Element, file: str) -> Iterator[Segment]:
    """Metadata and states of each segment of a message in XML form."""
    named = (one for one in root.iter() if one.tag == "aem" or one.get("id") == "CCSDS_AEM_VERS")
    message = next(named, None)
    if message is None:
        raise RawDataError(file, "root element", root.tag, "aem or acm")
    version = _version(message.get("version", "").strip(), file, f"{message.tag}, version")
    every = list(message.iter("segment"))
    for n, segment in enumerate(every, start=1):
        inside = f"segment {n}, " if len(every) > 1 else ""
        meta: dict[str, str] = {}
        for element in segment.iterfind("metadata//*"):
            if not len(element):
                meta.setdefault(element.tag, (element.text or "").strip())
        _check_metadata(meta, version, file, inside, {})
        states: list[State] = []
        for element in segment.iter("attitudeState"):
            where = f"{inside}state {len(states) + 1}"
            cells = {one.tag: (one.text or "").strip() for one in element.iter()}
            needed = ("EPOCH",) if _is_euler(meta) else ("EPOCH", *QUATERNION)
            if missing := [key for key in needed if key not in cells]:
                raise RawDataError(file, where, f"no {missing[0]}", EXPECTED)
            if _is_euler(meta):
                values = _xml_angles(element, meta, file, where)
            else:
                values = [check_number(cells[name], file, f"{where}, {name}") for name in QUATERNION]
            states.append((calendar_date(cells["EPOCH"], file, f"{where}, EPOCH"), values))
        yield inside, meta, states


def _segment(where: str, meta: dict[str, str], states: list[State], file: str, epoch: Epoch) -> AttitudeRows:
    """One segment of a message, whose rotations relate an inertial frame and the head."""
    since, t_s = epoch, np.array([], dtype=float)
    if states:
        since, t_s = tai_seconds([time for time, _ in states], meta["TIME_SYSTEM"], file)
    values = np.array([components for _, components in states], dtype=float)
    sequence = rotation_sequence(meta.get(EULER), file, where + EULER) if _is_euler(meta) else ""
    R_ab = rotations_of(values, sequence, file)
    return _between(meta, t_s + float(since.tai_s - epoch.tai_s), R_ab, file, where)


def _between(
    meta: Mapping[str, str], t_s: Floats, R_ab: Rotation, file: str, where: str = ""
) -> AttitudeRows:
    """Attitudes at t_s (N,) of rotations (N,) from REF_FRAME_B to REF_FRAME_A of `meta`, which is `where` in
    the file; from A to B where ATTITUDE_DIR is B2A.
    """
    frames = [meta[key].upper() for key in ("REF_FRAME_A", "REF_FRAME_B")]
    frames = [EARTH_FIXED if frame.startswith("ITRF") else SAME_FRAME.get(frame, frame) for frame in frames]
    outer = [frame for frame in OUTER if frame in frames]
    if len(outer) != 1 or frames[0] == frames[1]:
        expected = f"one of {', '.join(OUTER)}, and the head"
        raise RawDataError(file, f"{where}REF_FRAME_A and REF_FRAME_B", " and ".join(frames), expected)
    if (direction := meta.get("ATTITUDE_DIR", "A2B").upper()) not in ("A2B", "B2A"):
        raise RawDataError(file, f"{where}ATTITUDE_DIR", direction, "A2B or B2A")
    from_b_to_a = direction == "A2B"
    head_is_b = frames[0] in OUTER
    return AttitudeRows(
        t_s=t_s,
        R_si=_from_outer(R_ab, from_b_to_a != head_is_b, outer[0]),
        is_earth_fixed=outer[0] == EARTH_FIXED,
    )
