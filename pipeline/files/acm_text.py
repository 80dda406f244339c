"""Read the blocks of a CCSDS Attitude Comprehensive Message (ACM 2.0, 504.0-B-2) in keyword = value form.

Of attitudes the quaternions are taken (what may follow, rates, is not used), of covariances those of small
rotations about the axes of the head (COV_TYPE ANGLE: their diagonal). Other blocks are not used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from boresight.geometry.epoch import Epoch
from boresight.geometry.record import Floats, array, record, scalar
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.orbit_file import calendar_date, tai_seconds
from boresight.pipeline.files.text_files import MAX_ROWS, check_number

__all__ = ["AcmAttitudes", "is_acm", "read_acm"]

MARK, VERSION = "CCSDS_ACM_VERS", "2.0"  # first keyword of a message, and its value (CCSDS 504.0-B-2)
BLOCKS = ("META", "ATT", "PHYS", "COV", "MAN", "AD", "USER")  # names that stand before _START and _STOP
SENSOR = ("SENSOR_START", "SENSOR_STOP")  # edges of the sensors inside AD
QUATERNION = ("Q1", "Q2", "Q3", "QC")  # components of a row of attitude, scalar last
ANGLES = ("X", "Y", "Z")  # of the variances in a row


@record(kw_only=True)
class AcmAttitudes:
    """The attitudes of a message."""

    frames: Mapping[str, str] = scalar("REF_FRAME_A and REF_FRAME_B")
    since: Epoch = scalar("zero of `t_s`")
    t_s: Floats = array("N", "TAI seconds since it")
    q: Floats = array("N, 4", "quaternions, scalar last, of the matrix from A to B")
    variance_rad2: Floats | None = array("N, 3", "about the axes of B; None: not stated", default=None)


@dataclass(frozen=True, slots=True)
class _Block:
    """Keywords and lines of numbers of one block."""

    name: str
    line: int
    values: dict[str, str] = field(default_factory=dict)
    rows: list[tuple[int, list[str]]] = field(default_factory=list)


def is_acm(text: str) -> bool:
    """Whether a text without leading space is an ACM in keyword = value form."""
    return text.startswith(MARK)


def read_acm(text: str, file: str) -> AcmAttitudes:
    """The attitudes of a message, all of its ATT blocks after one another; `file` names it in errors.

    Raises `RawDataError` for blocks that are not quaternions, that relate different frames, and for
    covariances of another kind or at other times.
    """
    header, *blocks = _blocks(text, file)
    if (version := header.values.get(MARK)) != VERSION:
        raise RawDataError(file, MARK, version, VERSION)
    meta = next((block.values for block in blocks if block.name == "META"), {})
    attitudes = [block for block in blocks if block.name == "ATT"]
    if not attitudes:
        raise RawDataError(file, "ATT_START", "no attitudes", "a block with ATT_TYPE = QUATERNION")
    frames = [_frames(block, file) for block in attitudes]
    if other := [one for one in frames if one != frames[0]]:
        found = "; ".join(" and ".join(one.values()) for one in (frames[0], other[0]))
        raise RawDataError(file, "REF_FRAME_A and REF_FRAME_B", found, "one head; delete the other blocks")
    parts = [_numbers(block, QUATERNION, meta, file) for block in attitudes]
    since = parts[0][0]
    t_s = np.concatenate([t + float(epoch.tai_s - since.tai_s) for epoch, t, _ in parts])
    return AcmAttitudes(
        frames=frames[0],
        since=since,
        t_s=t_s,
        q=np.concatenate([q for _, _, q in parts]),
        variance_rad2=_variance(blocks, meta, frames[0]["REF_FRAME_B"], (since, t_s), file),
    )


def _blocks(text: str, file: str) -> Iterator[_Block]:
    """The header, then each block in the order of the message."""
    block = _Block("header", 1)
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
                block = _Block(name, number)
            else:
                yield block
                block = _Block("", number)
            continue
        key, equals, value = line.partition("=")
        if equals:
            block.values.setdefault(key.strip(), value.strip())
        elif block.name in ("ATT", "COV"):
            block.rows.append((number, line.split()))
            if len(block.rows) > MAX_ROWS:
                raise RawDataError(file, f"line {number}", f"more than {MAX_ROWS} lines", "fewer")
        elif block.name != "MAN" and not (block.name == "AD" and line in SENSOR):
            raise RawDataError(file, f"line {number}", line, "KEYWORD = value, or a block")
    if block.name:
        raise RawDataError(file, "end of the file", f"inside {block.name}", "META, and ATT_STOP of attitudes")


def _frames(block: _Block, file: str) -> dict[str, str]:
    """REF_FRAME_A and REF_FRAME_B of quaternions."""
    for key in ("REF_FRAME_A", "REF_FRAME_B", "ATT_TYPE"):
        if key not in block.values:
            raise RawDataError(file, f"line {block.line}, {key}", "nothing", "this keyword")
    if (kind := block.values["ATT_TYPE"].upper()) != "QUATERNION":
        expected = "QUATERNION; Euler angles and matrices are not read"
        raise RawDataError(file, f"line {block.line}, ATT_TYPE", kind, expected)
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
    for number, cells in block.rows:
        if len(cells) <= len(names):
            expected = f"a time and {len(names)} numbers or more"
            raise RawDataError(file, f"line {number}", " ".join(cells), expected)
    values = [
        [check_number(cell, file, f"line {number}, {name}") for name, cell in zip(names, cells[1:])]
        for number, cells in block.rows
    ]
    stamps = [(number, cells[0]) for number, cells in block.rows]
    if stamps and all("T" in stamp for _, stamp in stamps):
        dates = [calendar_date(stamp, file, f"line {n}, time") for n, stamp in stamps]
        since, t_s = tai_seconds(dates, meta["TIME_SYSTEM"], file)
    else:
        tzero = calendar_date(meta["EPOCH_TZERO"], file, "EPOCH_TZERO")
        since, (start,) = tai_seconds([tzero], meta["TIME_SYSTEM"], file, "EPOCH_TZERO")
        t_s = start + np.array([check_number(one, file, f"line {n}, time") for n, one in stamps], dtype=float)
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
            raise RawDataError(file, f"line {block.line}, COV_TYPE", kind, f"ANGLE in {head}{remedy}")
    parts = [_numbers(block, ANGLES, meta, file) for block in stated]
    since, t_s = times
    own_s = np.concatenate([t + float(epoch.tai_s - since.tai_s) for epoch, t, _ in parts])
    if len(own_s) != len(t_s) or np.any(np.abs(own_s - t_s) > 1e-6):
        found = f"{len(own_s)} covariances"
        raise RawDataError(file, "COV_START", found, f"one at each of {len(t_s)} attitudes{remedy}")
    variance = np.concatenate([values for _, _, values in parts])
    if not np.all(variance > 0.0):
        raise RawDataError(file, "COV_START", f"{variance.min():g} deg²", "positive variances")
    return np.asarray(np.radians(np.radians(variance)))
