"""`boresight star-camera-plan`: fields of the sky that calibrate a star camera best."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.sky_images.field_plan import SkyPlanRequest, plan_sky
from boresight.features.sky_images.options import (
    CameraFile,
    Fov,
    star_settings,
)
from boresight.pipeline.console.arguments import SettingsFile
from boresight.pipeline.console.messages import (
    DATA_DID_NOT_ALLOW,
    DONE,
    Answer,
    wrong_usage,
)

__all__ = ["star_camera_plan_command"]


def star_camera_plan_command(
    image: Annotated[Path, typer.Argument(help="An image of the sky by this camera, any stars.")],
    camera: CameraFile = None,
    fov: Fov = None,
    frames: Annotated[int, typer.Option(help="Images that are to be taken.", min=1, max=200)] = 10,
    candidates: Annotated[
        int, typer.Option(help="Random pointings to choose from.", min=1, max=20_000)
    ] = 500,
    utc: Annotated[str | None, typer.Option(help="When: keeps away from the Sun.")] = None,
    sun_deg: Annotated[
        float, typer.Option(help="Least angle between the image's middle and the Sun.", min=0.0, max=180.0)
    ] = 60.0,
    seed: Annotated[int, typer.Option(help="Of the random pointings.", min=0)] = 1,
    out: Annotated[Path | None, typer.Option(help="CSV file of the pointings.")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG: the fields, and what will be known.")] = None,
    settings: SettingsFile = None,
) -> Answer:
    """Choose the fields of the sky that calibrate a star camera best.

    Example: boresight star-camera-plan sky.png --fov 18.6 --frames 10 --out plan.csv
    """
    if camera is not None and fov is not None:
        raise wrong_usage("--camera and --fov exclude one another")
    request = SkyPlanRequest(camera, fov, frames, candidates, utc, sun_deg, seed, out, plot)
    lines, done = plan_sky(image, request, star_settings(settings))
    return Answer(text="\n".join(lines), exit_status=DONE if done else DATA_DID_NOT_ALLOW)
