"""Arguments and options of the commands about images of the sky."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.star_id.settings import StarSettings

__all__ = ["CameraFile", "Dark", "Fov", "OrbitFile", "Site", "Times", "star_settings"]

CameraFile = Annotated[Path | None, typer.Option(help="star_camera.toml of the camera, if it is known.")]
Fov = Annotated[
    float | None, typer.Option("--fov", "--fov-deg", help="Width of the field of view in degrees, if known.")
]
Dark = Annotated[Path | None, typer.Option(help="Dark frame of the same camera and exposure.")]
Times = Annotated[
    Path | None,
    typer.Option(
        help="CSV file (file, utc_mid) of the images' times: the Earth's aberration is taken out of them."
    ),
]
OrbitFile = Annotated[
    Path | None, typer.Option(help="OEM of the satellite, with --times: its aberration is taken out as well.")
]
Site = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        help="Latitude, longitude (deg) and height (m) of a camera on the ground, with --times: refraction is"
        " taken out as well.",
        metavar="LAT LON HEIGHT",
    ),
]


def star_settings(file: Path | None) -> StarSettings:
    """The section `stars` of a settings file. The schemas of all stages take 0.1 s to load."""
    if file is None:
        return StarSettings()
    from boresight.pipeline.run.settings import read_settings

    return read_settings(file).stars
