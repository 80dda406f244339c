"""Read attitudes of a star camera: CSV, or a CCSDS Attitude Ephemeris Message (AEM 1.0 and 2.0, KVN and XML).

The result are rotations R_si from GCRS to the star camera, as the file has them; what aberration the head has
left in is put right by `geometry.attitude_aberration`. The standard's quaternion (504.0-B, scalar last) gives
the matrix from components in A to components in B whose first row holds 2 (q1 q2 + q3 qc); scipy's
`from_quat` of it is the rotation from B to A.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.geometry.inertial_frames import InertialFrame, rotation_to_gcrs
from boresight.geometry.record import Floats, array, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.orbit_file import tai_seconds
from boresight.pipeline.files.text_files import MAX_ROWS, check_number, csv_rows, read_text
from boresight.pipeline.files.xml_files import read_xml

__all__ = ["AttitudeRows", "read_attitudes"]

INERTIAL: tuple[InertialFrame, ...] = get_args(InertialFrame)
COLUMNS = ("utc", "qx", "qy", "qz", "qw")
SIGMAS = tuple(f"sigma_{axis}_arcsec" for axis in "xyz")
PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")
COVARIANCES = tuple(f"cov_{pair}_arcsec2" for pair in PAIRS)
LARGEST_ARCSEC = 36_000.0  # 10 degrees: not a star camera
UNIT_LENGTH = 1e-3  # tolerated error of a quaternion's length: three decimals, as telemetry may have
EXPECTED = "an attitude message that follows CCSDS 504.0-B, or a CSV file"


@record(kw_only=True)
class AttitudeRows:
    """Attitudes as a file has them, rows marked invalid left out."""

    t_s: Floats = array("N", "TAI seconds since the dump's epoch, strictly increasing")
    R_si: Rotation = scalar("(N,) GCRS to star camera, aberration as the head has it")
    covariance_s: Floats | None = array(
        "N, 3, 3", "rad², of a small rotation about the axes of s; None: not stated", default=None
    )
    temperature_c: Floats | None = array("N", "of the head, degrees Celsius; None: not stated", default=None)
    n_invalid: int = scalar("rows marked invalid", default=0)


def read_attitudes(
    path: Path, file: str, epoch: Epoch, frame: InertialFrame | None, rotation: str | None
) -> AttitudeRows:
    """Attitudes of a CSV file or of an AEM, told apart by their first line.

    Parameters
    ----------
    path, file : Path, str
        The file, and its name in errors.
    epoch : Epoch
        Zero of the times.
    frame : str or None
        Inertial axes of a CSV file: "GCRF", "ICRF" or "EME2000". An AEM states its own.
    rotation : str or None
        Sense of a CSV file's quaternions: "head to inertial" or "inertial to head". An AEM states its own.

    Raises
    ------
    RawDataError
        With file, line or field, found and expected.
    """
    start = read_text(path, file).lstrip()
    message = start.startswith(("CCSDS_AEM_VERS", "<"))
    for key, value in (("frame", frame), ("rotation", rotation)):
        if message and value is not None:
            raise RawDataError("dump.toml", f"{key} of {file}", value, "no such key: an AEM states its own")
        if not message and value is None:
            raise RawDataError("dump.toml", f"{key} of {file}", "nothing", "this key, for a CSV file")
    if frame is None:
        segments = _xml_segments(path, file) if start.startswith("<") else _kvn_segments(start, file)
        rows = _from_message(list(segments), file, epoch)
    else:
        rows = _from_csv(path, file, epoch, frame, str(rotation))
    if len(rows.t_s) < 2:
        found = f"{len(rows.t_s)} valid rows, {rows.n_invalid} marked invalid"
        raise RawDataError(file, "rows", found, "at least two valid attitudes")
    if len(bad := np.flatnonzero(np.diff(rows.t_s) <= 0.0)):
        found = f"{rows.t_s[bad[0] + 1] - rows.t_s[bad[0]]:.6f} s after the attitude before it"
        raise RawDataError(file, f"attitude {bad[0] + 2}, time", found, "strictly increasing times")
    return rows


def _from_csv(path: Path, file: str, epoch: Epoch, frame: InertialFrame, rotation: str) -> AttitudeRows:
    optional = (*SIGMAS, *COVARIANCES, "valid", "temperature_c")
    utc: list[str] = []
    values: list[list[float]] = []
    names: tuple[str, ...] = ()
    invalid = 0
    for line, row in csv_rows(path, COLUMNS, optional, file):
        if not names:
            names = tuple(name for name in row if name not in ("utc", "valid"))
            _check_complete(names, file)
        if (valid := row.get("valid", "1").strip()) not in ("0", "1"):
            raise RawDataError(file, f"{line}, valid", valid, "0 or 1")
        if valid == "0":
            invalid += 1
            continue
        utc.append(row["utc"].strip())
        values.append([check_number(row[name], file, f"{line}, {name}") for name in names])
    if not utc:
        raise RawDataError(
            file, "rows", f"none valid, {invalid} marked invalid", "at least two valid attitudes"
        )
    try:
        t_s = epoch.seconds_from_utc(utc)
    except ValueError as error:
        raise RawDataError(file, "utc", str(error), "UTC times that exist") from error
    table = np.array(values, dtype=float).reshape(len(utc), len(names))
    column = {name: table[:, n] for n, name in enumerate(names)}
    q = np.column_stack([column[name] for name in COLUMNS[1:]])
    return AttitudeRows(
        t_s=t_s,
        R_si=_to_gcrs(_rotations(q, file), rotation == "inertial to head", frame),
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
        covariance = sigma[:, :, None] ** 2 * np.eye(3)
        bad = ~np.all((sigma > 0.0) & (sigma <= LARGEST_ARCSEC), axis=1)
        what = "sigma"
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
        what = "covariance"
    else:
        return None
    if bad.any():
        k = int(np.argmax(bad))
        expected = f"positive (definite), sigma at most {LARGEST_ARCSEC:g} arcsec"
        raise RawDataError(file, f"valid row {k + 1}, {what}", covariance[k].tolist(), expected)
    return covariance * ARCSEC**2


def _rotations(q: Floats, file: str) -> Rotation:
    """Rotations of quaternions (N, 4), scalar last, of nearly unit length."""
    length = np.linalg.norm(q, axis=1)
    if len(bad := np.flatnonzero(~(np.abs(length - 1.0) <= UNIT_LENGTH))):
        found = f"{q[bad[0]].tolist()} of length {length[bad[0]]:.6g}"
        raise RawDataError(file, f"attitude {bad[0] + 1}", found, f"length 1 within {UNIT_LENGTH:g}")
    return Rotation.from_quat(q) if len(q) else Rotation.identity(0)


def _to_gcrs(R: Rotation, is_inertial_to_head: bool, frame: InertialFrame) -> Rotation:
    """R_si from rotations between the head and its inertial frame."""
    return (R if is_inertial_to_head else R.inv()) * rotation_to_gcrs(frame).inv()


def _from_message(segments: list[Segment], file: str, epoch: Epoch) -> AttitudeRows:
    if not segments:
        raise RawDataError(file, "segments", "none", EXPECTED)
    parts = [_segment(meta, states, file, epoch) for meta, states in segments]
    return replace(
        parts[0],
        t_s=np.concatenate([part.t_s for part in parts]),
        R_si=Rotation.concatenate([part.R_si for part in parts]),
    )


Segment = tuple[dict[str, str], list[list[str]]]  # metadata, states as time, Q1, Q2, Q3, QC


def _kvn_segments(text: str, file: str) -> Iterator[Segment]:
    """Metadata and states of each segment of a message in KVN form."""
    meta: dict[str, str] = {}
    states: list[list[str]] = []
    part = "header"
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("COMMENT"):
            continue
        if line in ("META_START", "META_STOP", "DATA_START", "DATA_STOP"):
            if line == "META_START":
                meta, states = {}, []
            if line == "DATA_STOP":
                yield meta, states
            part = line
        elif part == "DATA_START":
            states.append(_ordered(line.split(), meta, file, f"line {number}"))
            if len(states) > MAX_ROWS:
                raise RawDataError(file, f"line {number}", f"more than {MAX_ROWS} states", "fewer")
        elif part == "META_START":
            key, equals, value = line.partition("=")
            if not equals:
                raise RawDataError(file, f"line {number}", line, "KEYWORD = value")
            meta[key.strip()] = value.strip()
    if part not in ("DATA_STOP", "header"):
        raise RawDataError(file, "end of the file", f"after {part}", "DATA_STOP")


def _ordered(cells: list[str], meta: dict[str, str], file: str, where: str) -> list[str]:
    """A state line as time, Q1, Q2, Q3, QC; what may follow (rates) is not used."""
    if len(cells) < 5:
        raise RawDataError(file, where, " ".join(cells), "a time and four components of a quaternion")
    first = meta.get("QUATERNION_TYPE", "LAST").upper() == "FIRST"
    q = [*cells[2:5], cells[1]] if first else cells[1:5]
    return [cells[0], *q]


def _xml_segments(path: Path, file: str) -> Iterator[Segment]:
    """Metadata and states of each segment of a message in XML form."""
    root = read_xml(path, file)
    named = (one for one in root.iter() if one.tag == "aem" or one.get("id") == "CCSDS_AEM_VERS")
    message = next(named, None)
    if message is None:
        raise RawDataError(file, "root element", root.tag, "aem")
    for segment in message.iter("segment"):
        meta: dict[str, str] = {}
        states: list[list[str]] = []
        for element in segment.iter():
            if element.tag == "attitudeState":
                cells = {one.tag: (one.text or "").strip() for one in element.iter()}
                if missing := [key for key in ("EPOCH", "Q1", "Q2", "Q3", "QC") if key not in cells]:
                    raise RawDataError(file, f"state {len(states) + 1}", f"no {missing[0]}", EXPECTED)
                states.append([cells[key] for key in ("EPOCH", "Q1", "Q2", "Q3", "QC")])
            elif not len(element):
                meta.setdefault(element.tag, (element.text or "").strip())
        yield meta, states


def _segment(meta: dict[str, str], states: list[list[str]], file: str, epoch: Epoch) -> AttitudeRows:
    """One segment of a message, whose quaternions relate an inertial frame and the head."""
    for key in ("REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE"):
        if key not in meta:
            raise RawDataError(file, key, "nothing", "this keyword")
    if not meta["ATTITUDE_TYPE"].upper().startswith("QUATERNION"):
        raise RawDataError(file, "ATTITUDE_TYPE", meta["ATTITUDE_TYPE"], "QUATERNION")
    frames = [meta[key].upper() for key in ("REF_FRAME_A", "REF_FRAME_B")]
    inertial = [frame for frame in INERTIAL if frame in frames]
    if len(inertial) != 1 or frames[0] == frames[1]:
        expected = f"one of {', '.join(INERTIAL)}, and the head"
        raise RawDataError(file, "REF_FRAME_A and REF_FRAME_B", " and ".join(frames), expected)
    if (direction := meta.get("ATTITUDE_DIR", "A2B").upper()) not in ("A2B", "B2A"):
        raise RawDataError(file, "ATTITUDE_DIR", direction, "A2B or B2A")
    q = [[check_number(cell, file, f"state {k + 1}") for cell in state[1:]] for k, state in enumerate(states)]
    since, t_s = epoch, np.array([], dtype=float)
    if states:
        since, t_s = tai_seconds([state[0] for state in states], meta["TIME_SYSTEM"], file)
    R_ab = _rotations(np.array(q, dtype=float).reshape(-1, 4), file)  # components in B to components in A
    from_b_to_a = direction == "A2B"
    head_is_b = frames[0] in INERTIAL
    return AttitudeRows(
        t_s=t_s + float(since.tai_s - epoch.tai_s),
        R_si=_to_gcrs(R_ab, from_b_to_a != head_is_b, inertial[0]),
    )
