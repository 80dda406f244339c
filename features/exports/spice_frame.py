"""SPICE text frame kernel: the remote-sensing camera as a fixed-offset (TK) frame of the star camera.

With it loaded, `pxform(star camera, remote camera, et)` is `R_cs`. NAIF's TK matrix takes vectors of the new
frame to the one it is relative to, and is listed column by column (Frames Required Reading); the columns of
`R_sc` are the rows of `R_cs`.
"""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from boresight.features.exports.one_line import one_line
from boresight.geometry.record import record, scalar

__all__ = ["SpiceFrames", "frame_kernel", "heading"]


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
    star, remote = frames.star_camera_id, frames.remote_camera_id
    lines = [
        "KPL/FK",
        "",
        *heading(comment),
        "",
        "\\begindata",
        "",
    ]
    if frames.define_star_camera:
        lines += [
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
        *("    " + " ".join(f"{value: .17e}" for value in row) for row in R_cs.as_matrix()),
        ")",
        "",
        "\\begintext",
        "",
    ]
    return "\n".join(lines)


def heading(comment: str) -> list[str]:
    """The lines of a comment, none of which begins data in a text kernel."""
    return [one_line(line).replace("\\begin", "begin").rstrip() for line in comment.splitlines()]
