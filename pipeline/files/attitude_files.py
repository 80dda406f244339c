"""Read attitudes of a star camera: CSV, or a CCSDS Attitude Ephemeris Message (AEM 1.0 and 2.0, KVN and XML)
or Attitude Comprehensive Message (ACM 2.0, KVN and XML).

The result are rotations R_si from GCRS to the star camera, as the file has them; what aberration the head has
left in is put right by `geometry.starlight`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.earth_rotation import AttitudeFrame, EarthRotation, InertialFrame, rotation_to_gcrs
from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.attitude_messages import (
    FRAMES,
    MessageAttitudes,
    read_attitude_message,
    rotations_of,
)
from boresight.pipeline.files.orbit_file import SAME_FRAME, tai_seconds
from boresight.pipeline.files.text_files import check_number, csv_rows, read_message
from boresight.records.record import Floats, RowRecord, array, record, scalar

__all__ = ["COMPONENTS", "COVARIANCES", "SIGMAS", "AttitudeRows", "check_rows", "read_attitudes"]

EARTH_FIXED: AttitudeFrame = "ITRF"
# Names of frames that a file may state; realisations of ITRF differ by centimetres on the ground.
OUTER: tuple[AttitudeFrame, ...] = (*get_args(InertialFrame), EARTH_FIXED)
# Columns of attitude tables: the quaternion, scalar last; 1-sigmas and covariances about x, y, z of the head.
COMPONENTS = ("qx", "qy", "qz", "qw")
# Columns of 1-sigma errors about x, y, z of the head.
SIGMAS = tuple(f"sigma_{axis}_arcsec" for axis in "xyz")
PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")  # of axes, upper triangle row by row
COVARIANCES = tuple(f"cov_{pair}_arcsec2" for pair in PAIRS)  # columns of covariances, same axes
LARGEST_ARCSEC = 36_000.0  # 10 degrees: not a star camera


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
    message = text.lstrip().startswith(("CCSDS_", "COMMENT", "<"))
    for key, value in (("frame", frame), ("rotation", rotation), ("time_scale", time_scale)):
        if message and value is not None:
            expected = "no such key: a message states its own"
            raise RawDataError("dump.toml", f"{key} of {file}", value, expected)
        if not message and value is None and key != "time_scale":
            raise RawDataError("dump.toml", f"{key} of {file}", "nothing", "this key, for a CSV file")
    if frame is None:
        found = read_attitude_message(text, file)
        inertial = set(get_args(InertialFrame))
        if len(kinds := {" and ".join(sorted({*_frames(one, file)} - inertial)) for one in found}) > 1:
            expected = "one head, in all blocks against inertial axes or in all against ITRF"
            raise RawDataError(file, " and ".join(FRAMES), "; ".join(sorted(kinds)), expected)
        rows = AttitudeRows.together([_of(one, file, epoch) for one in found])
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
    times, values, names, invalid = list[str](), list[list[float]](), tuple[str, ...](), 0
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


def _frames(found: MessageAttitudes, file: str) -> list[str]:
    """Frames A and B of a message, of which one is inertial or Earth-fixed and one that of the head."""
    frames = [found.stated.values[key].upper() for key in FRAMES]
    frames = [EARTH_FIXED if frame.startswith("ITRF") else SAME_FRAME.get(frame, frame) for frame in frames]
    if sum(frame in OUTER for frame in frames) != 1:
        field, expected = " and ".join(FRAMES), f"one of {', '.join(OUTER)}, and the head"
        raise RawDataError(file, found.stated.begin + field, " and ".join(frames), expected)
    return frames


def _of(found: MessageAttitudes, file: str, epoch: Epoch) -> AttitudeRows:
    """Attitudes of a message that lead from GCRS, or from ITRS, to the head."""
    stated, frames = found.stated, _frames(found, file)
    (outer,) = (frame for frame in OUTER if frame in frames)
    if (direction := stated.values.get("ATTITUDE_DIR", "A2B").upper()) not in ("A2B", "B2A"):
        raise stated.error("ATTITUDE_DIR", direction, "A2B or B2A", file)
    variance = found.variance_rad2
    return AttitudeRows(
        t_s=found.t_s + float(found.since.tai_s - epoch.tai_s),
        R_si=_from_outer(found.R_ab, (direction == "A2B") != (frames[0] in OUTER), outer),
        covariance_s=None if variance is None else variance[:, :, None] * np.eye(3),
        is_earth_fixed=outer == EARTH_FIXED,
    )
