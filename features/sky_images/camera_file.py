"""The star camera of a `star_camera.toml` outside a dump."""

from __future__ import annotations

from pathlib import Path

from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.files.dump_schema import StarCameraFile
from boresight.pipeline.files.star_side import single_camera_of
from boresight.pipeline.files.text_files import read_toml

__all__ = ["camera_in"]


def camera_in(file: Path) -> StarCamera:
    """The camera that a file describes. `RawDataError` names file and field where it is not complete."""
    return single_camera_of(read_toml(file, StarCameraFile, str(file)), str(file))
