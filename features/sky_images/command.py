"""Commands for those who only have a star camera: identify, centroids, star-camera-plan and -calibrate."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from boresight.pipeline.console.arguments import SettingsFile
from boresight.pipeline.console.limit_options import JunitFile, held
from boresight.pipeline.console.messages import (
    DATA_DID_NOT_ALLOW,
    DONE,
    Answer,
    print_data,
    say,
    talks,
    tell,
    wrong_usage,
)
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.files.object_store import dump_folder

if TYPE_CHECKING:
    from boresight.star_id.settings import StarSettings

__all__ = ["add_star_commands"]

FIELDS = (
    "file,identified,ra_deg,dec_deg,roll_deg,fov_x_deg,matches,rms_arcsec,false_alarm_probability,cpu_ms,reason,"
    "pointing_sigma_arcsec,roll_sigma_arcsec,fov_x_sigma_deg,mirrored"
).split(",")

Images = Annotated[list[Path], typer.Argument(help="Star images: PNG, TIFF, FITS, JPEG or BMP.")]
ImagesOrLists = Annotated[
    list[Path], typer.Argument(help="Star images, or CSV files of `centroids --out`, with --camera.")
]
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


def add_star_commands(app: typer.Typer) -> None:
    """Plug the commands into the program."""
    app.command()(talks(identify))
    app.command()(talks(centroids))
    app.command("star-camera-plan")(talks(star_camera_plan))
    app.command("star-camera-calibrate")(talks(star_camera_calibrate))


def identify(
    images: ImagesOrLists,
    camera: CameraFile = None,
    fov: Fov = None,
    dark: Dark = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line on stdout.")] = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="One CSV row a line on stdout.")] = False,
    as_fits: Annotated[
        bool, typer.Option("--fits", help="Write NAME.wcs.fits here: a TAN-SIP header and the named stars.")
    ] = False,
    overlay: Annotated[Path | None, typer.Option(help="PNG of the image with its stars named.")] = None,
    report: Annotated[
        Path | None, typer.Option(help="HTML page: detections by kind, PSF, noise, stars, identified or not.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Parquet file for the stars that were named.")] = None,
    times: Times = None,
    orbit: OrbitFile = None,
    site: Site = None,
    settings: SettingsFile = None,
) -> Answer:
    """Name the stars of single images, with no idea where they look.

    Example: boresight identify sky.png --fov 18.6
    """
    from boresight.features.sky_images.identify_images import Request, identify_images, own_name
    from boresight.features.sky_images.wcs_files import write_wcs
    from boresight.features.sky_images.whereabouts import Whereabouts

    if camera is not None and fov is not None:
        raise wrong_usage("--camera and --fov exclude one another")
    if as_json + as_csv + as_fits > 1:
        raise wrong_usage("--json, --csv and --fits exclude one another")
    if as_fits and times is not None:
        raise wrong_usage("--fits and --times exclude one another: a header states places of the catalogue")
    if as_csv:
        print_data(_csv_line(FIELDS))
    named = lines = 0
    request = Request(camera, fov, dark, Whereabouts(times, orbit, site), as_fits, out, overlay)
    for line in identify_images(images, request, _star_settings(settings)):
        named, lines = named + line.identified, lines + 1
        if as_json:
            print_data(json.dumps(line.record))
        elif as_csv:
            print_data(_csv_line([line.record.get(name, "") for name in FIELDS]))
        else:
            tell(line.text)
        if as_fits and line.found is not None:
            path = str(line.record["file"])
            write_wcs(Path(f"{Path(path).stem}.wcs.fits"), path, line.found)
        if report is not None and line.image is not None:
            from boresight.features.sky_images.identify_page import write_sky_page  # with jinja 0.2 s to load

            write_sky_page(line, own_name(report, Path(str(line.record["file"])), len(images)))
    (say if as_json or as_csv else tell)(
        f"identified {named} of {lines} images" + (f" -> {out}" if out else "")
    )
    return Answer(exit_status=DONE if named else DATA_DID_NOT_ALLOW)


def centroids(
    images: Images,
    truth: Annotated[
        Path | None, typer.Option(help="CSV with columns x_px, y_px, flux_dn (and file, for several images).")
    ] = None,
    psf_sigma_px: Annotated[float | None, typer.Option(help="True width of the PSF, if known.")] = None,
    gain: Annotated[float | None, typer.Option(help="Electrons per DN, if known.")] = None,
    method: Annotated[
        Literal["fit", "window"] | None, typer.Option(help="A fit of the PSF, or first moments in a window.")
    ] = None,
    dark: Dark = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for all centroids with their errors.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="PNG of error against SNR and bias against phase.")
    ] = None,
    max_x_bound: Annotated[
        float | None, typer.Option(help="Limit: rms error over the Cramér-Rao bound, at most.", min=0.0)
    ] = None,
    min_complete: Annotated[
        float | None, typer.Option(help="Limit: share of the true stars found, at least.", min=0.0, max=1.0)
    ] = None,
    from_snr: Annotated[
        float, typer.Option(help="The limits count stars of this signal-to-noise ratio and more.", min=0.0)
    ] = 10.0,
    junit: JunitFile = None,
    settings: SettingsFile = None,
) -> Answer:
    """Find the stars of images and place them; with a truth, say how well: completeness, error, bound,
    bias. Exit status 4 if a limit is missed.

    Example: boresight centroids sky.png --truth stars.csv --max-x-bound 1.1 --min-complete 0.99
    """
    from boresight.features.sky_images.centroid_report import score_images
    from boresight.pipeline.results.limits import centroid_limits

    begun_s = time.perf_counter()
    if truth is None and not (max_x_bound is None and min_complete is None and junit is None):
        raise wrong_usage("--max-x-bound, --min-complete and --junit need --truth")
    if plot is not None and truth is None:
        raise wrong_usage("--plot needs --truth")
    stars = _star_settings(settings)
    if method is not None:
        stars = replace(stars, centroid_method=method)
    score = score_images(
        images, truth, stars, psf_sigma_px=psf_sigma_px, gain=gain, dark=dark, out=out, plot=plot, say=tell
    )
    if score is None:
        return Answer()
    return held("centroids", centroid_limits(score, max_x_bound, min_complete, from_snr), junit, begun_s)


def star_camera_plan(
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
    from boresight.features.sky_images.field_plan import SkyPlanRequest, plan_sky

    if camera is not None and fov is not None:
        raise wrong_usage("--camera and --fov exclude one another")
    request = SkyPlanRequest(camera, fov, frames, candidates, utc, sun_deg, seed, out, plot)
    lines, done = plan_sky(image, request, _star_settings(settings))
    return Answer(text="\n".join(lines), exit_status=DONE if done else DATA_DID_NOT_ALLOW)


def star_camera_calibrate(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCES...",
            parser=dump_folder,
            help="Star images, or folders with a dump.toml: their exposures.",
        ),
    ],
    camera: CameraFile = None,
    fov: Fov = None,
    out: Annotated[Path, typer.Option(help="The calibrated star_camera.toml.")] = Path("star_camera.toml"),
    report: Annotated[
        Path | None, typer.Option(help="JSON file: covariance, OpenCV form, residual map, stars used.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG of the residual map.")] = None,
    times: Times = None,
    orbit: OrbitFile = None,
    site: Site = None,
    drift: Annotated[
        bool, typer.Option("--drift", help="Fit a drift of the focal length with time as well.")
    ] = False,
    settings: SettingsFile = None,
) -> Answer:
    """Calibrate a star camera from images of the sky: focal length, principal point, distortion.

    Example: boresight star-camera-calibrate sky*.png --fov 18.6 --out star_camera.toml
    """
    from boresight.features.sky_images.star_camera_report import CameraRequest, calibrate_from_images
    from boresight.features.sky_images.whereabouts import Whereabouts

    if camera is not None and fov is not None:
        raise wrong_usage("--camera and --fov exclude one another")
    request = CameraRequest(
        camera_file=camera,
        fov_deg=fov,
        known=Whereabouts(times, orbit, site),
        drift=drift,
        out=out,
        report=report,
        plot=plot,
    )
    with progress_bars() as told:
        lines, done = calibrate_from_images(sources, request, _star_settings(settings), told)
    return Answer(text="\n".join(lines), exit_status=DONE if done else DATA_DID_NOT_ALLOW)


def _star_settings(file: Path | None) -> StarSettings:
    """The section `stars` of a settings file. The schemas of all stages take 0.1 s to load."""
    if file is None:
        from boresight.star_id.settings import StarSettings

        return StarSettings()
    from boresight.pipeline.run.settings import read_settings

    return read_settings(file).stars


def _csv_line(values: Iterable[Any]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(values)
    return line.getvalue()
