"""`boresight star-camera-plan`: fields of the sky that calibrate a star camera best."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from boresight.features.sky_images.field_plan import CameraNumbers, SkyPlanRequest, plan_sky
from boresight.features.sky_images.options import CameraFile, Fov, star_settings
from boresight.pipeline.console.arguments import SettingsFile, argument
from boresight.pipeline.console.messages import Answer, wrong_usage

__all__ = ["star_camera_plan_command"]


def star_camera_plan_command(
    image: Path | None = argument(
        "An image of the sky by this camera, any stars; or state --size and --limit-mag.", None
    ),
    camera: CameraFile = None,
    fov: Fov = None,
    *,
    numbers: CameraNumbers,
    request: SkyPlanRequest,
    settings: SettingsFile = None,
) -> Answer:
    """Choose the fields of the sky that calibrate a star camera best, by an image of it or by its numbers.

    Example: boresight star-camera-plan sky.png --fov 18.6 --frames 10 --out plan.csv
    """
    if camera is not None and fov is not None:
        raise wrong_usage("--camera and --fov exclude one another")
    if image is not None and numbers != CameraNumbers():
        raise wrong_usage("an image shows what --size, --limit-mag and the like state: give one or the other")
    request = replace(request, camera_file=camera, fov_deg=fov, numbers=numbers)
    lines, status = plan_sky(image, request, star_settings(settings))
    return Answer(text="\n".join(lines), exit_status=status)
