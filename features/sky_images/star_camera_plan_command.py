"""`boresight star-camera-plan`: fields of the sky that calibrate a star camera best."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from boresight.features.sky_images.field_plan import LIMIT_SNR, CameraNumbers, SkyPlanRequest, plan_sky
from boresight.features.sky_images.options import CameraFile, Fov, star_settings
from boresight.pipeline.console.arguments import SettingsFile
from boresight.pipeline.console.messages import Answer, wrong_usage

__all__ = ["star_camera_plan_command"]


def star_camera_plan_command(
    image: Annotated[
        Path | None,
        typer.Argument(
            help="An image of the sky by this camera, any stars; or state --size and --limit-mag."
        ),
    ] = None,
    camera: CameraFile = None,
    fov: Fov = None,
    size: Annotated[
        tuple[int, int] | None,
        typer.Option(help="Without image: columns and rows of the detector.", metavar="COLUMNS ROWS"),
    ] = None,
    focal_mm: Annotated[
        float | None, typer.Option(help="Without image, in place of --fov: focal length, mm.", min=1e-3)
    ] = None,
    pixel_um: Annotated[
        float | None, typer.Option(help="With --focal-mm: pitch of the pixels, micrometres.", min=1e-3)
    ] = None,
    limit_mag: Annotated[
        float | None, typer.Option(help=f"Without image: magnitude V of stars of SNR {LIMIT_SNR:g}.")
    ] = None,
    psf_sigma_px: Annotated[
        float, typer.Option(help="Without image: 1-sigma width of the stars, px.", min=0.2, max=20.0)
    ] = 1.0,
    noise_e: Annotated[
        float, typer.Option(help="Without image: noise of a pixel (read noise, sky), electrons.", min=0.1)
    ] = 10.0,
    full_e: Annotated[
        float | None, typer.Option(help="Without image: electrons that fill a pixel.", min=1.0)
    ] = None,
    frames: Annotated[int, typer.Option(help="Images that are to be taken.", min=1, max=200)] = 10,
    candidates: Annotated[
        int, typer.Option(help="Random pointings to choose from.", min=1, max=20_000)
    ] = 500,
    wanted_px: Annotated[
        float | None,
        typer.Option(help="Largest error of the model that is enough: exit status 4 if missed.", min=1e-6),
    ] = None,
    utc: Annotated[str | None, typer.Option(help="When: keeps away from the Sun.")] = None,
    sun_deg: Annotated[
        float, typer.Option(help="Least angle between the image's middle and the Sun.", min=0.0, max=180.0)
    ] = 60.0,
    seed: Annotated[int, typer.Option(help="Of the random pointings.", min=0)] = 1,
    out: Annotated[Path | None, typer.Option(help="CSV file of the pointings.")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG: the fields, and what will be known.")] = None,
    settings: SettingsFile = None,
) -> Answer:
    """Choose the fields of the sky that calibrate a star camera best, by an image of it or by its numbers.

    Example: boresight star-camera-plan sky.png --fov 18.6 --frames 10 --out plan.csv
    """
    if camera is not None and fov is not None:
        raise wrong_usage("--camera and --fov exclude one another")
    full = math.inf if full_e is None else full_e
    numbers = CameraNumbers(size, None, focal_mm, pixel_um, limit_mag, psf_sigma_px, noise_e, full)
    if image is not None and numbers != CameraNumbers():
        raise wrong_usage("an image shows what --size, --limit-mag and the like state: give one or the other")
    request = SkyPlanRequest(
        camera_file=camera,
        fov_deg=fov,
        numbers=numbers,
        frames=frames,
        wanted_px=wanted_px,
        candidates=candidates,
        utc=utc,
        sun_deg=sun_deg,
        seed=seed,
        out=out,
        plot=plot,
    )
    lines, status = plan_sky(image, request, star_settings(settings))
    return Answer(text="\n".join(lines), exit_status=status)
