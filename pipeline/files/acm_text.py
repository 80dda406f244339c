"""Read the blocks of a CCSDS Attitude Comprehensive Message (ACM 2.0, 504.0-B-2), KVN or XML.

Of attitudes quaternions, Euler angles and matrices are taken (what may follow, rates, is not used), of
covariances those of small rotations about the axes of the head (COV_TYPE ANGLE: their diagonal). Other blocks
are not used.

A rotation relates frames A and B; here it takes components in B to components in A. The standard's
quaternion (scalar last) gives the matrix from A to B whose first row holds 2 (q1 q2 + q3 qc), so that
scipy's `from_quat` of it is that rotation. Euler angles, in the order of their sequence, turn the axes of A
into those of B. A matrix takes components in A to components in B and is listed column by column.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import field
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.orbit_file import calendar_date, tai_seconds
from boresight.pipeline.files.text_files import MAX_ROWS, check_number
from boresight.records.record import Floats, array, record, scalar

__all__ = [
    "ANGLES",
    "EULER",
    "MATRIX",
    "QUATERNION",
    "AcmAttitudes",
    "is_acm",
    "read_acm",
    "rotation_sequence",
    "rotations_of",
]

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


MARK, VERSION = "CCSDS_ACM_VERS", "2.0"  # first keyword of a message, and its value (CCSDS 504.0-B-2)
BLOCKS = ("META", "ATT", "PHYS", "COV", "MAN", "AD", "USER")  # names that stand before _START and _STOP
SENSOR = ("SENSOR_START", "SENSOR_STOP")  # edges of the sensors inside AD
# Values of ATT_TYPE, and the numbers of a row.
KINDS = {"QUATERNION": QUATERNION, "EULER_ANGLES": ANGLES, "DCM": MATRIX}
VARIANCES = ("X", "Y", "Z")  # about these axes, of a row
XML_LINES = {"ATT": "attLine", "COV": "covLine"}  # elements of rows, by their blocks


@record(kw_only=True)
class AcmAttitudes:
    """The attitudes of a message."""

    frames: Mapping[str, str] = scalar("REF_FRAME_A and REF_FRAME_B")
    since: Epoch = scalar("zero of `t_s`")
    t_s: Floats = array("N", "TAI seconds since it")
    R_ab: Rotation = scalar("(N,) components in B to components in A")
    variance_rad2: Floats | None = array("N, 3", "about the axes of B; None: not stated", default=None)


@record(by_value=True)
class _Block:
    """Keywords and lines of numbers of one block."""

    name: str
    where: str  # in errors: "line 12" or "att 1"
    values: dict[str, str] = field(default_factory=dict)
    rows: list[tuple[str, list[str]]] = field(default_factory=list)  # where, and the words


def is_acm(message: str | Element | None) -> bool:
    """Whether a text without leading space, or the root of an XML message, is an ACM."""
    if isinstance(message, str):
        return message.startswith(MARK)
    return message is not None and {one.tag for one in message.iter()} & {"acm", "aem"} == {"acm"}


def read_acm(message: str | Element, file: str) -> AcmAttitudes:
    """The attitudes of a message, all of its ATT blocks after one another; `file` names it in errors.

    Raises `RawDataError` for blocks of another kind, that relate different frames, and for covariances of
    another kind or at other times.
    """
    of_form = _blocks(message, file) if isinstance(message, str) else _xml_blocks(message, file)
    header, *blocks = of_form
    if (version := header.values.get(MARK)) != VERSION:
        raise RawDataError(file, MARK, version, VERSION)
    meta = next((block.values for block in blocks if block.name == "META"), {})
    attitudes = [block for block in blocks if block.name == "ATT"]
    if not attitudes:
        raise RawDataError(file, "ATT_START", "no attitudes", f"a block with ATT_TYPE = {' or '.join(KINDS)}")
    frames = [_frames(block, file) for block in attitudes]
    if other := [one for one in frames if one != frames[0]]:
        found = "; ".join(" and ".join(one.values()) for one in (frames[0], other[0]))
        raise RawDataError(file, "REF_FRAME_A and REF_FRAME_B", found, "one head; delete the other blocks")
    parts = [_numbers(block, KINDS[block.values["ATT_TYPE"].upper()], meta, file) for block in attitudes]
    since = parts[0][0]
    t_s = np.concatenate([t + float(epoch.tai_s - since.tai_s) for epoch, t, _ in parts])
    return AcmAttitudes(
        frames=frames[0],
        since=since,
        t_s=t_s,
        R_ab=Rotation.concatenate(
            [rotations_of(one, _sequence(block, file), file) for block, (_, _, one) in zip(attitudes, parts)]
        ),
        variance_rad2=_variance(blocks, meta, frames[0]["REF_FRAME_B"], (since, t_s), file),
    )


def _blocks(text: str, file: str) -> Iterator[_Block]:
    """The header, then each block in the order of the message."""
    block = _Block("header", "line 1")
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("COMMENT"):
            continue
        name, _, edge = line.rpartition("_")
        if edge in ("START", "STOP") and name in BLOCKS:
            inside = block.name in BLOCKS
            if inside == (edge == "START") or (inside and block.name != name):
                expected = f"{block.name}_STOP" if inside else "a _START"
                raise RawDataError(file, f"line {number}", line, f"{expected} before it")
            if edge == "START":
                if block.name == "header":
                    yield block
                block = _Block(name, f"line {number}")
            else:
                yield block
                block = _Block("", f"line {number}")
            continue
        key, equals, value = line.partition("=")
        if equals:
            block.values.setdefault(key.strip(), value.strip())
        elif block.name in ("ATT", "COV"):
            block.rows.append((f"line {number}", line.split()))
            if len(block.rows) > MAX_ROWS:
                raise RawDataError(file, f"line {number}", f"more than {MAX_ROWS} lines", "fewer")
        elif block.name != "MAN" and not (block.name == "AD" and line in SENSOR):
            raise RawDataError(file, f"line {number}", line, "KEYWORD = value, or a block")
    if block.name:
        raise RawDataError(file, "end of the file", f"inside {block.name}", "META, and ATT_STOP of attitudes")


def _xml_blocks(root: Element, file: str) -> Iterator[_Block]:
    """The header, then each block of a message in XML form, in its order."""
    message = next(root.iter("acm"))
    yield _Block("header", "acm", {MARK: message.get("version", "").strip()})
    for metadata in message.iterfind("body/segment/metadata"):
        yield _Block("META", "metadata", {one.tag: (one.text or "").strip() for one in metadata})
    for name, row in XML_LINES.items():
        for n, element in enumerate(message.iterfind(f"body/segment/data/{name.lower()}"), start=1):
            where = f"{name.lower()} {n}"
            block = _Block(name, where, {one.tag: (one.text or "").strip() for one in element})
            lines = element.findall(row)
            if len(lines) > MAX_ROWS:
                raise RawDataError(file, where, f"more than {MAX_ROWS} lines", "fewer")
            block.rows.extend(
                (f"{where}, {row} {k}", (one.text or "").split()) for k, one in enumerate(lines, start=1)
            )
            yield block


def _sequence(block: _Block, file: str) -> str:
    """Axes of the Euler angles of a block; empty for other rotations."""
    if block.values["ATT_TYPE"].upper() != "EULER_ANGLES":
        return ""
    return rotation_sequence(block.values.get(EULER), file, f"{block.where}, {EULER}")


def _frames(block: _Block, file: str) -> dict[str, str]:
    """REF_FRAME_A and REF_FRAME_B of attitudes that can be read."""
    for key in ("REF_FRAME_A", "REF_FRAME_B", "ATT_TYPE"):
        if key not in block.values:
            raise RawDataError(file, f"{block.where}, {key}", "nothing", "this keyword")
    if (kind := block.values["ATT_TYPE"].upper()) not in KINDS:
        raise RawDataError(file, f"{block.where}, ATT_TYPE", kind, ", ".join(KINDS))
    return {key: block.values[key] for key in ("REF_FRAME_A", "REF_FRAME_B")}


def _numbers(
    block: _Block, names: tuple[str, ...], meta: Mapping[str, str], file: str
) -> tuple[Epoch, Floats, Floats]:
    """Epoch, TAI seconds (N,) since it, and the first numbers (N, M) of each line of a block.

    Times are dates in TIME_SYSTEM, or seconds since EPOCH_TZERO.
    """
    for key in ("TIME_SYSTEM", "EPOCH_TZERO"):
        if key not in meta:
            raise RawDataError(file, key, "nothing", "this keyword")
    for where, cells in block.rows:
        if len(cells) <= len(names):
            expected = f"a time and {len(names)} numbers or more"
            raise RawDataError(file, where, " ".join(cells), expected)
    values = [
        [check_number(cell, file, f"{where}, {name}") for name, cell in zip(names, cells[1:])]
        for where, cells in block.rows
    ]
    stamps = [(where, cells[0]) for where, cells in block.rows]
    if stamps and all("T" in stamp for _, stamp in stamps):
        dates = [calendar_date(stamp, file, f"{where}, time") for where, stamp in stamps]
        since, t_s = tai_seconds(dates, meta["TIME_SYSTEM"], file)
    else:
        tzero = calendar_date(meta["EPOCH_TZERO"], file, "EPOCH_TZERO")
        since, (start,) = tai_seconds([tzero], meta["TIME_SYSTEM"], file, "EPOCH_TZERO")
        since_tzero = [check_number(one, file, f"{where}, time") for where, one in stamps]
        t_s = start + np.array(since_tzero, dtype=float)
    return since, t_s, np.array(values, dtype=float).reshape(-1, len(names))


def _variance(
    blocks: list[_Block], meta: Mapping[str, str], head: str, times: tuple[Epoch, Floats], file: str
) -> Floats | None:
    """Variances (N, 3), rad², about the axes of the head at the times of its attitudes."""
    stated = [block for block in blocks if block.name == "COV"]
    if not stated:
        return None
    remedy = "; or no COV block, and noise.white_arcsec in dump.toml"
    for block in stated:
        kind = f"{block.values.get('COV_TYPE')} in {block.values.get('COV_REF_FRAME')}"
        if kind.upper() != f"ANGLE in {head}".upper():
            raise RawDataError(file, f"{block.where}, COV_TYPE", kind, f"ANGLE in {head}{remedy}")
    parts = [_numbers(block, VARIANCES, meta, file) for block in stated]
    since, t_s = times
    own_s = np.concatenate([t + float(epoch.tai_s - since.tai_s) for epoch, t, _ in parts])
    if len(own_s) != len(t_s) or np.any(np.abs(own_s - t_s) > 1e-6):
        found = f"{len(own_s)} covariances"
        raise RawDataError(file, "COV_START", found, f"one at each of {len(t_s)} attitudes{remedy}")
    variance = np.concatenate([values for _, _, values in parts])
    if not np.all(variance > 0.0):
        raise RawDataError(file, "COV_START", f"{variance.min():g} deg²", "positive variances")
    return np.asarray(np.radians(np.radians(variance)))
