"""A plain calibration file: which matrix holds for which camera of which satellite, from when to when.

One JSON object; `R_cs` takes star-camera vectors to the remote-sensing camera, `covariance_rad2` is that of a
small rotation about the axes of the remote-sensing camera. Without a limit a date is null.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scipy.spatial.transform import Rotation

from boresight.pipeline import __version__
from boresight.pipeline.files.whole_file import json_text
from boresight.records.record import Floats

__all__ = ["calibration_text"]


def calibration_text(
    R_cs: Rotation,
    covariance: Floats,
    of: Mapping[str, str],
    valid: tuple[str | None, str | None],
    more: Mapping[str, Any],
) -> str:
    """The file's text; `covariance` (3, 3), rad²; `of`: mission, satellite, camera, star_camera; `valid`:
    first and last date, UTC; `more`: further facts, each a key.
    """
    content: dict[str, Any] = {"format": "boresight-calibration", "format_version": 1}
    content |= dict(of) | {"valid_from_utc": valid[0], "valid_to_utc": valid[1]}
    content |= {
        "R_cs": R_cs.as_matrix().tolist(),
        "quaternion_xyzw": R_cs.as_quat(canonical=True).tolist(),
        "covariance_rad2": covariance.tolist(),
    }
    return json_text(content | {"version": __version__} | dict(more)) + "\n"
