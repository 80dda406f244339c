"""Read CCSDS attitude messages (504.0-B): the Attitude Ephemeris Message (AEM 1.0 and 2.0) and the Attitude
Comprehensive Message (ACM 2.0).

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
from collections.abc import Sequence
from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.ccsds_messages import OUTSIDE, Block, MessageKind, message_blocks
from boresight.pipeline.files.orbit_file import calendar_date, check_time_system, tai_seconds
from boresight.pipeline.files.text_files import MAX_ROWS, check_number
from boresight.records.record import Floats, array, record, scalar

__all__ = ["MessageAttitudes", "read_attitude_message", "rotations_of"]

QUATERNION = ("Q1", "Q2", "Q3", "QC")  # names of a quaternion's components, scalar last
ANGLES = ("ANGLE_1", "ANGLE_2", "ANGLE_3")  # of Euler angles, deg, in the order of their sequence
MATRIX = tuple(f"C{row}{column}" for column in "123" for row in "123")  # of a matrix
# By the keyword of either message that names the kind of attitudes: its values, and the numbers of a row.
TYPES: dict[str, dict[str, tuple[str, ...]]] = {
    "ATTITUDE_TYPE": {"QUATERNION": QUATERNION, "EULER_ANGLE": ANGLES},
    "ATT_TYPE": {"QUATERNION": QUATERNION, "EULER_ANGLES": ANGLES, "DCM": MATRIX},
}
VARIANCES = ("X", "Y", "Z")  # about these axes, of a row of covariances
FRAMES = ("REF_FRAME_A", "REF_FRAME_B")
AEM = MessageKind(
    name="AEM",
    versions=("1.0", "2.0"),
    standard="CCSDS 504.0-B",
    required={"META": (*FRAMES, "TIME_SYSTEM", "ATTITUDE_TYPE")},
    optional={OUTSIDE: (), "DATA": ()},
    rows={"DATA": ("", "attitudeState")},
)
ACM = MessageKind(
    name="ACM",
    versions=("2.0",),
    standard="CCSDS 504.0-B",
    required={"META": ("TIME_SYSTEM", "EPOCH_TZERO"), "ATT": (*FRAMES, "ATT_TYPE")},
    optional={OUTSIDE: ()},
    rows={"ATT": ("att", "attLine"), "COV": ("cov", "covLine")},
    unused=("PHYS", "MAN", "AD", "USER"),
)
# Keywords of CCSDS 504.0-B-1 that 504.0-B-2 has no more, and what it has instead of them.
OF_VERSION_1 = {"ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "LAST"}
EULER = "EULER_ROT_SEQ"  # keyword of the sequence: axes as digits or letters
# Three axes of which no two neighbours are the same.
_SEQUENCE = re.compile(r"([XYZ])(?!\1)([XYZ])(?!\2)[XYZ]")
# Tolerated error of a quaternion's length, and of a matrix' elements: three decimals, as telemetry may have.
UNIT_LENGTH = 1e-3
SAME_INSTANT_S = 1e-6  # of an attitude and its covariance


@record(kw_only=True)
class MessageAttitudes:
    """Attitudes of one block of a message."""

    stated: Block = scalar("its keywords: REF_FRAME_A, REF_FRAME_B and, in version 1.0, ATTITUDE_DIR")
    since: Epoch = scalar("zero of `t_s`")
    t_s: Floats = array("N", "TAI seconds since it")
    R_ab: Rotation = scalar("(N,) components in B to components in A")
    variance_rad2: Floats | None = array("N, 3", "about the axes of B; None: not stated", default=None)


def read_attitude_message(text: str, file: str) -> list[MessageAttitudes]:
    """The attitudes of a message, block by block.

    `file` names it in errors. Raises `RawDataError` for attitudes of another kind, and for covariances of
    another kind or at other times.
    """
    kind, blocks = message_blocks(text, file, AEM, ACM)
    meta, found, covariances = blocks[0], list[MessageAttitudes](), list[tuple[Block, Block]]()
    for block in blocks:
        if block.name == "META":
            meta = block
            if kind is AEM:
                _check_version_2(meta, blocks[0].values[AEM.mark], file)
        elif block.name in ("DATA", "ATT"):
            found.append(_attitudes(block if kind is ACM else meta, meta, block, file))
        elif block.name == "COV":
            covariances.append((meta, block))
    if not found:
        raise RawDataError(file, "attitudes", "none", f"a block with attitudes, as {kind.standard} has it")
    return _with_variances(found, covariances, file) if covariances else found


def _check_version_2(meta: Block, version: str, file: str) -> None:
    """`RawDataError` for a keyword not of version 2.0 that contradicts that."""
    for key, only in OF_VERSION_1.items() if version != AEM.versions[0] else ():
        if (value := meta.values.get(key, only).upper()) != only:
            expected = f"{only}, as in version 2.0, which has no {key}; or {AEM.mark} = 1.0"
            raise meta.error(key, value, expected, file)


def _attitudes(stated: Block, meta: Block, rows: Block, file: str) -> MessageAttitudes:
    """The attitudes of `rows`, of which `stated` and the metadata say what they are."""
    key = next(key for key in TYPES if key in stated.values)
    kind, _, _ = stated.values[key].upper().partition("/")  # rates follow
    if kind not in TYPES[key]:
        expected = f"{', '.join(TYPES[key])}, with or without rates"
        raise stated.error(key, stated.values[key], expected, file)
    names, axes = TYPES[key][kind], ""
    if names == ANGLES:
        axes = _sequence(stated, file)
        _name_angles(rows, axes, file)
    if (scalar_is := stated.values.get("QUATERNION_TYPE", "LAST").upper()) not in ("FIRST", "LAST"):
        raise stated.error("QUATERNION_TYPE", scalar_is, "FIRST or LAST", file)
    first = names == QUATERNION and scalar_is == "FIRST"
    order = (names[-1], *names[:-1]) if first else names
    since, t_s, values = _numbers(rows, order, meta, file)
    values = np.roll(values, -1, axis=1) if first else values
    return MessageAttitudes(stated=stated, since=since, t_s=t_s, R_ab=rotations_of(values, axes, file))


def _sequence(stated: Block, file: str) -> str:
    """The axes of Euler angles, such as "ZXY". `RawDataError` for others."""
    text = stated.values.get(EULER, "")
    axes = text.upper().translate(str.maketrans("123", "XYZ"))
    if not _SEQUENCE.fullmatch(axes):
        raise stated.error(EULER, text or "nothing", "three axes, such as ZXY or 312", file)
    return axes


def _name_angles(rows: Block, axes: str, file: str) -> None:
    """Name the angles of version 1.0 in XML, whose attributes name the axes, as version 2.0 does."""
    for n, row in enumerate(rows.rows):
        angles = row.iterfind(".//rotationAngles/*") if isinstance(row, Element) else ()
        for name, axis, one in zip(ANGLES, axes, angles):
            if (named := one.get("angle", f"{axis}_ANGLE").upper()) != f"{axis}_ANGLE":
                expected = f"{axis}_ANGLE, as {EULER} has it"
                raise RawDataError(file, f"{rows.at(n)}, {one.tag}", named, expected)
            one.tag = name


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


def _numbers(block: Block, names: Sequence[str], meta: Block, file: str) -> tuple[Epoch, Floats, Floats]:
    """Epoch, TAI seconds (N,) since it, and the first numbers (N, M) of each row of a block.

    Times are dates in TIME_SYSTEM or, of an ACM, seconds since EPOCH_TZERO.
    """
    if len(block.rows) > MAX_ROWS:
        raise RawDataError(file, block.at(MAX_ROWS), f"more than {MAX_ROWS} rows", "fewer")
    check_time_system(meta.values["TIME_SYSTEM"], file, meta.fields["TIME_SYSTEM"])
    stamps, values = list[tuple[str, str]](), list[list[float]]()
    for n, line in enumerate(block.lines(names, file)):
        where, (stamp, *cells) = block.at(n), line.split() or [""]
        if len(cells) < len(names):
            expected = f"a time and {len(names)} numbers or more: {', '.join(names)}"
            raise RawDataError(file, where, line, expected)
        stamps.append((f"{where}, time", stamp))
        values.append([check_number(cell, file, f"{where}, {name}") for name, cell in zip(names, cells)])
    tzero, scale = meta.values.get("EPOCH_TZERO"), meta.values["TIME_SYSTEM"]
    since, t_s = Epoch(0), np.array([], dtype=float)
    if tzero is not None and not (stamps and all("T" in stamp for _, stamp in stamps)):
        zero = calendar_date(tzero, file, "EPOCH_TZERO")
        since, (start,) = tai_seconds([zero], scale, file, "EPOCH_TZERO")
        t_s = start + np.array([check_number(one, file, where) for where, one in stamps], dtype=float)
    elif stamps:
        dates = [calendar_date(stamp, file, where) for where, stamp in stamps]
        since, t_s = tai_seconds(dates, scale, file)
    return since, t_s, np.array(values, dtype=float).reshape(-1, len(names))


def _with_variances(
    found: Sequence[MessageAttitudes], stated: Sequence[tuple[Block, Block]], file: str
) -> list[MessageAttitudes]:
    """The attitudes of an ACM with the variances at their times, `stated` in blocks of such metadata."""
    head, since = found[0].stated.values["REF_FRAME_B"], found[0].since
    remedy = "; or no COV block, and noise.white_arcsec in dump.toml"
    for _, block in stated:
        kind = f"{block.values.get('COV_TYPE')} in {block.values.get('COV_REF_FRAME')}"
        if kind.upper() != f"ANGLE in {head}".upper():
            raise block.error("COV_TYPE", kind, f"ANGLE in {head}{remedy}", file)
    parts = [_numbers(block, VARIANCES, meta, file) for meta, block in stated]
    t_s = np.concatenate([one.t_s + float(one.since.tai_s - since.tai_s) for one in found])
    own_s = np.concatenate([t + float(epoch.tai_s - since.tai_s) for epoch, t, _ in parts])
    if len(own_s) != len(t_s) or np.any(np.abs(own_s - t_s) > SAME_INSTANT_S):
        expected = f"one at each of {len(t_s)} attitudes{remedy}"
        raise RawDataError(file, "COV_START", f"{len(own_s)} covariances", expected)
    variance = np.concatenate([values for _, _, values in parts])
    if not np.all(variance > 0.0):
        raise RawDataError(file, "COV_START", f"{variance.min():g} deg²", "positive variances")
    of_blocks = np.split(np.radians(np.radians(variance)), np.cumsum([len(one.t_s) for one in found])[:-1])
    return [replace(one, variance_rad2=own) for one, own in zip(found, of_blocks)]
