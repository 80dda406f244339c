"""`boresight star-camera-calibrate`: a star camera calibrated from images of the sky."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from boresight.features.sky_images.image_time import Whereabouts
from boresight.features.sky_images.options import CameraFile, Fov, OrbitFile, Site, Times, star_settings
from boresight.features.sky_images.star_camera_report import CameraRequest, calibrate_from_images
from boresight.pipeline.console.arguments import SettingsFile, argument
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, Answer, wrong_usage
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.files.object_store import dump_folder

__all__ = ["star_camera_calibrate_command"]


def star_camera_calibrate_command(
    sources: list[Path] = argument(
        "Star images, or folders with a dump.toml: their exposures.", metavar="SOURCES...", parser=dump_folder
    ),
    camera: CameraFile = None,
    fov: Fov = None,
    *,
    request: CameraRequest,
    times: Times = None,
    orbit: OrbitFile = None,
    site: Site = None,
    settings: SettingsFile = None,
) -> Answer:
    """Calibrate a star camera from images of the sky: focal length, principal point, distortion.

    Example: boresight star-camera-calibrate sky*.png --fov 18.6 --out star_camera.toml
    """
    if camera is not None and fov is not None:
        raise wrong_usage("--camera and --fov exclude one another")
    known = Whereabouts(times, orbit, site)
    request = replace(request, camera_file=camera, fov_deg=fov, known=known)
    with progress_bars() as told:
        lines, done = calibrate_from_images(sources, request, star_settings(settings), told)
    return Answer(text="\n".join(lines), exit_status=DONE if done else DATA_DID_NOT_ALLOW)
