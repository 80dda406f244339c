"""SPICE kernels of a result: FK (the frames), CK (binary, type 3) with its SCLK, and IK.

With the FK loaded, `pxform(star camera, remote camera, et)` is `R_cs`: NAIF's TK matrix takes vectors of the
new frame to the one it is relative to, and is listed column by column (Frames Required Reading).

The clock counts 2^-20 s of ephemeris time (TDB) since an epoch, so that it needs no leap seconds; instants
are laid on its whole ticks, because ephemeris times are held in doubles that resolve 0.1 µs only, in which an
Earth-pointing satellite turns by 1e-10 rad. Between attitudes SPICE rotates about a fixed axis at a constant
rate. The layout is that of NAIF's DAF and CK Required Reading.
"""

from __future__ import annotations

import struct

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.exports.notes import one_line
from boresight.features.exports.quaternions import continuous_quaternions
from boresight.geometry.constants import DAY_S
from boresight.geometry.epoch import Epoch, ephemeris_time, seconds_from_ephemeris_time
from boresight.geometry.line_camera import LineSensor
from boresight.records.record import Floats, record, scalar

__all__ = ["SpiceFrames", "attitude_kernel", "clock_kernel", "frame_kernel", "instrument_kernel", "on_ticks"]


@record(kw_only=True)
class SpiceFrames:
    """SPICE names and ids of the two cameras. The defaults belong to no real mission.

    Ids of the cameras follow from that of the spacecraft. Construction raises `ValueError` for an invalid
    frame name.
    """

    spacecraft_id: int = scalar("NAIF id of the spacecraft", default=-999)
    star_camera_name: str = scalar("name of that frame", default="BORESIGHT_STAR_CAMERA")
    remote_camera_name: str = scalar("name of that frame", default="BORESIGHT_REMOTE_CAMERA")
    define_star_camera: bool = scalar("False: another kernel defines the star camera's frame", default=True)

    def __post_init__(self) -> None:
        for name in (self.star_camera_name, self.remote_camera_name):
            if not 0 < len(name) <= 32 or name != name.upper() or any(c.isspace() or c == "'" for c in name):
                raise ValueError(f"a SPICE frame name has 1 to 32 upper-case characters, got {name!r}")

    @property
    def star_camera_id(self) -> int:
        """NAIF id of the star camera's frame."""
        return 1000 * self.spacecraft_id - 1

    @property
    def remote_camera_id(self) -> int:
        """NAIF id of the remote-sensing camera's frame."""
        return 1000 * self.spacecraft_id - 2


def frame_kernel(R_cs: Rotation, comment: str, frames: SpiceFrames) -> str:
    """Text of the kernel; `comment` (any number of lines) becomes its heading."""
    star, remote, lines = frames.star_camera_id, frames.remote_camera_id, list[str]()
    if frames.define_star_camera:
        lines = [
            f"FRAME_{frames.star_camera_name} = {star}",
            f"FRAME_{star}_NAME = '{frames.star_camera_name}'",
            f"FRAME_{star}_CLASS = 3",
            f"FRAME_{star}_CLASS_ID = {star}",
            f"FRAME_{star}_CENTER = {frames.spacecraft_id}",
            f"CK_{star}_SCLK = {frames.spacecraft_id}",
            f"CK_{star}_SPK = {frames.spacecraft_id}",
            "",
        ]
    lines += [
        f"FRAME_{frames.remote_camera_name} = {remote}",
        f"FRAME_{remote}_NAME = '{frames.remote_camera_name}'",
        f"FRAME_{remote}_CLASS = 4",
        f"FRAME_{remote}_CLASS_ID = {remote}",
        f"FRAME_{remote}_CENTER = {frames.spacecraft_id}",
        f"TKFRAME_{remote}_RELATIVE = '{frames.star_camera_name}'",
        f"TKFRAME_{remote}_SPEC = 'MATRIX'",
        f"TKFRAME_{remote}_MATRIX = (",
        *_rows(R_cs.as_matrix()),
        "",
    ]
    return _text_kernel("FK", comment, lines)


def _heading(comment: str) -> list[str]:
    """The lines of a comment, none of which begins data in a text kernel."""
    return [one_line(line).replace("\\begin", "begin").rstrip() for line in comment.splitlines()]


def _text_kernel(kind: str, comment: str, data: list[str]) -> str:
    """Text of a kernel: a comment of any number of lines, and assignments, an empty line behind them."""
    return "\n".join([f"KPL/{kind}", "", *_heading(comment), "", "\\begindata", "", *data, "\\begintext", ""])


def _numbers(values: Floats) -> str:
    return " ".join(f"{value: .17e}" for value in values)


def _rows(values: Floats) -> list[str]:
    """Rows of a matrix, and the bracket that closes them."""
    return [*(f"    {_numbers(row)}" for row in values), ")"]


# Length of a tick of the spacecraft clock that the SCLK file defines, s; exact in binary.
TICK_S = 2.0**-20
_RECORD = 128  # doubles of a DAF record
_J2000 = 1  # NAIF's number of the frame, in practice the axes of ICRF
_TYPE_3 = 3  # CK data type: quaternions interpolated linearly (NAIF, CK Required Reading)
_DIRECTORY = 100  # epochs to an entry of the directory


def on_ticks(epoch: Epoch, t_s: Floats) -> tuple[Floats, Floats]:
    """The whole ticks (N,) nearest to instants, TAI seconds, and not outside them: since the epoch's clock
    zero, and as TAI seconds (N,).
    """
    zero = clock_zero(epoch)
    ticks = (ephemeris_time(epoch, t_s) - zero) / TICK_S
    ticks = np.unique(np.clip(np.round(ticks), np.ceil(ticks[0]), np.floor(ticks[-1])))
    return ticks, seconds_from_ephemeris_time(epoch, zero + ticks * TICK_S)


def clock_zero(epoch: Epoch) -> float:
    """Ephemeris time of tick 0: a day before the epoch, whole seconds."""
    return float(epoch.tai_s - DAY_S)


def clock_kernel(epoch: Epoch, frames: SpiceFrames, comment: str) -> str:
    """Text of the SCLK: ticks of 2^-20 s, no drift."""
    clock = -frames.spacecraft_id
    data = [
        "SCLK_KERNEL_ID = ( @2000-01-01 )",
        f"SCLK_DATA_TYPE_{clock} = ( 1 )",
        f"SCLK01_TIME_SYSTEM_{clock} = ( 1 )",
        f"SCLK01_N_FIELDS_{clock} = ( 2 )",
        f"SCLK01_MODULI_{clock} = ( 4294967296 1048576 )",
        f"SCLK01_OFFSETS_{clock} = ( 0 0 )",
        f"SCLK01_OUTPUT_DELIM_{clock} = ( 2 )",
        f"SCLK_PARTITION_START_{clock} = ( 0.0 )",
        f"SCLK_PARTITION_END_{clock} = ( 4.503599627370495E15 )",
        f"SCLK01_COEFFICIENTS_{clock} = ( 0.0 {clock_zero(epoch):.1f} 1.0 )",
        "",
    ]
    return _text_kernel("SCLK", comment, data)


def attitude_kernel(ticks: Floats, R_si: Rotation, frames: SpiceFrames, name: str, comment: str) -> bytes:
    """Contents of the CK: attitudes `R_si` (N,) from GCRS to the star camera at ticks (N,), increasing; with
    the name of the segment and the comment area.

    Raises `ValueError` for fewer than two attitudes.
    """
    n = len(ticks)
    if n < 2 or len(R_si) != n or np.any(np.diff(ticks) <= 0.0):
        raise ValueError(f"a CK needs two or more attitudes in order of time, got {n} and {len(R_si)}")
    # SPICE: scalar first, of the matrix J2000 to instrument
    q = continuous_quaternions(R_si)[:, [3, 0, 1, 2]]
    directory = ticks[_DIRECTORY - 1 : n - 1 : _DIRECTORY]
    data = np.concatenate([q.ravel(), ticks, directory, ticks[:1], [1.0, float(n)]])
    remarks = _comment_records(comment)
    summaries_at = 2 + len(remarks) // 1024
    begin = (summaries_at + 1) * _RECORD + 1
    summary = struct.pack(
        "<2d6i", ticks[0], ticks[-1], frames.star_camera_id, _J2000, _TYPE_3, 0, begin, begin + len(data) - 1
    )
    summaries = struct.pack("<3d", 0.0, 0.0, 1.0) + summary
    names = one_line(name)[:40].encode("ascii", "replace").ljust(40)
    records = [
        _file_record(summaries_at, begin + len(data)),
        remarks,
        summaries.ljust(1024, b"\0"),
        names.ljust(1024),
        data.astype("<f8").tobytes(),
    ]
    return b"".join(record.ljust(-(-len(record) // 1024) * 1024, b"\0") for record in records)


def instrument_kernel(camera: LineSensor, frames: SpiceFrames, comment: str) -> str:
    """Text of the IK: fields of view of the whole camera (its id) and of CCD k (id - 1 - k), polygons."""
    name, number = frames.remote_camera_name, frames.remote_camera_id
    corners = [_corners(camera, ccd) for ccd in range(camera.n_ccds)]
    every = np.concatenate(corners)
    (x0, y0), (x1, y1) = (end((every[:, :2] / every[:, 2:]), axis=0) for end in (np.min, np.max))
    whole = np.array([[x0, y0, 1.0], [x0, y1, 1.0], [x1, y1, 1.0], [x1, y0, 1.0]])
    data = _field_of_view(number, name, name, whole)
    for ccd, polygon in enumerate(corners):
        data += _field_of_view(number - 1 - ccd, f"{name}_CCD{ccd}", name, polygon)
    return _text_kernel("IK", comment, data)


def _corners(camera: LineSensor, ccd: int) -> Floats:
    """Corners (4, 3), frame c, of the one row of pixels of a CCD."""
    ends = camera.directions_from_pixels(ccd, np.array([-0.5, camera.n_px(ccd) - 0.5]))
    across = np.array([0.5 * camera.pixel_rad, 0.0, 0.0])
    return np.array([ends[0] - across, ends[1] - across, ends[1] + across, ends[0] + across])


def _field_of_view(number: int, name: str, frame: str, corners: Floats) -> list[str]:
    return [
        f"NAIF_BODY_NAME += ( '{name}' )",
        f"NAIF_BODY_CODE += ( {number} )",
        f"INS{number}_FOV_CLASS_SPEC = 'CORNERS'",
        f"INS{number}_FOV_FRAME = '{frame}'",
        f"INS{number}_FOV_SHAPE = 'POLYGON'",
        f"INS{number}_BORESIGHT = ( {_numbers(corners.mean(axis=0))} )",
        f"INS{number}_FOV_BOUNDARY = (",
        *_rows(corners),
        "",
    ]


def _comment_records(comment: str) -> bytes:
    """The comment area: lines that end with NUL, 1000 characters to a record, EOT after the last."""
    text = b"".join(line.encode("ascii", "replace") + b"\0" for line in _heading(comment)) + b"\x04"
    return b"".join(text[n : n + 1000].ljust(1024, b"\0") for n in range(0, len(text), 1000))


def _file_record(summaries_at: int, free: int) -> bytes:
    """The first record of a DAF of two doubles and six integers a summary, with one summary record."""
    test = b"FTPSTR:\r:\n:\r\n:\r\x00:\x81:\x10\xce:ENDFTP"
    name = b"boresight".ljust(60)
    record = struct.pack(
        "<8sii60siii8s", b"DAF/CK  ", 2, 6, name, summaries_at, summaries_at, free, b"LTL-IEEE"
    )
    return (record.ljust(699, b"\0") + test).ljust(1024, b"\0")
