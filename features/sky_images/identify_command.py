"""`boresight identify`: the stars of single images named."""

from __future__ import annotations

import json
from pathlib import Path

from boresight.features.sky_images import options
from boresight.features.sky_images.identify_images import Request, identify_images, own_name, read_camera
from boresight.features.sky_images.image_time import Whereabouts
from boresight.pipeline.console import messages
from boresight.pipeline.console.arguments import SettingsFile, argument, option
from boresight.pipeline.files.text_tables import csv_line, table_csv

__all__ = ["identify_command"]

# Columns of --csv: keys of an image's record.
FIELDS = (
    "file,identified,ra_deg,dec_deg,roll_deg,fov_x_deg,matches,rms_arcsec,false_alarm_probability,cpu_ms,reason,"
    "pointing_sigma_arcsec,roll_sigma_arcsec,fov_x_sigma_deg,mirrored"
).split(",")


def identify_command(
    images: list[Path] = argument("Star images, or CSV files of `centroids --out`, with --camera or --size."),
    camera: options.CameraFile = None,
    fov: options.Fov = None,
    dark: options.Dark = None,
    size: tuple[int, int] | None = option(
        "Of the images of a CSV file, px, without --camera.", metavar="WIDTH HEIGHT"
    ),
    as_json: bool = option("One JSON object a line on stdout.", False, "--json"),
    as_csv: bool = option("One CSV row a line on stdout.", False, "--csv"),
    as_fits: bool = option(
        "Write NAME.wcs.fits here: a TAN-SIP header and the named stars.", False, "--fits"
    ),
    overlay: Path | None = option("PNG of the image with its stars named."),
    report: Path | None = option("HTML page: detections by kind, PSF, noise, stars, identified or not."),
    times: options.Times = None,
    orbit: options.OrbitFile = None,
    site: options.Site = None,
    sequence: bool = option(
        "Frames in the order of time: each is predicted by the last.", False, "--sequence"
    ),
    interval: float = option("With --sequence: s from frame to frame.", 0.1),
    exposure: float | None = option("With --sequence: exposure time, s; predicts trails of stars."),
    settings: SettingsFile = None,
) -> messages.Answer:
    """Name the stars of single images, with no idea where they look; with --sequence track them.

    Example: boresight identify sky.png --fov 18.6
    """
    if camera is not None and fov is not None:
        raise messages.wrong_usage("--camera and --fov exclude one another")
    if as_json + as_csv + as_fits > 1:
        raise messages.wrong_usage("--json, --csv and --fits exclude one another")
    if as_fits and times is not None:
        raise messages.wrong_usage(
            "--fits and --times exclude one another: a header states places of the catalogue"
        )
    if sequence:
        others = (dark, overlay, report, times, orbit, site)
        if camera is None or as_json or as_fits or any(one is not None for one in others):
            raise messages.wrong_usage(
                "--sequence needs --camera, and takes --interval, --exposure and --csv only"
            )
        return _track(images, camera, interval, exposure, as_csv, settings)
    if as_csv:
        messages.print_data(csv_line(FIELDS))
    named = lines = 0
    request = Request(camera, fov, dark, size, Whereabouts(times, orbit, site), as_fits, overlay)
    if as_fits or report is not None:
        from boresight.features.sky_images import identify_page, wcs_files  # with astropy 0.4 s to load

    for line in identify_images(images, request, options.star_settings(settings)):
        named, lines = named + line.identified, lines + 1
        if as_json:
            messages.print_data(json.dumps(line.record))
        elif as_csv:
            messages.print_data(csv_line([line.record.get(name, "") for name in FIELDS]))
        else:
            messages.tell(line.text)
        if as_fits and line.found is not None:
            path = str(line.record["file"])
            wcs_files.write_wcs(Path(f"{Path(path).stem}.wcs.fits"), path, line.found)
        if report is not None and line.image is not None:
            identify_page.write_sky_page(line, own_name(report, Path(str(line.record["file"])), len(images)))
    (messages.say if as_json or as_csv else messages.tell)(f"identified {named} of {lines} images")
    return messages.Answer(exit_status=messages.DONE if named else messages.DATA_DID_NOT_ALLOW)


def _track(
    images: list[Path],
    camera: Path,
    interval_s: float,
    exposure_s: float | None,
    as_csv: bool,
    settings: Path | None,
) -> messages.Answer:
    """The frames of a sequence, a line each."""
    from boresight.features.sky_images.sequence import LOST, track  # with pandas 0.3 s to load

    known = read_camera(camera)
    assert known is not None  # a file was given
    if not interval_s > 0.0 or (exposure_s is not None and exposure_s < 0.0):
        raise messages.wrong_usage("--interval must be above 0 s, and --exposure not below")
    chosen = options.star_settings(settings)
    found = track(images, camera=known, interval_s=interval_s, exposure_s=exposure_s, settings=chosen)
    table = found.table()
    if as_csv:
        messages.print_data(table_csv(table.assign(file=[str(one) for one in images])))
    for path, row in zip(images, () if as_csv else table.to_dict("records")):
        sigmas = f"{row['pointing_sigma_arcsec']:.2f}, {row['roll_sigma_arcsec']:.1f}"
        place = f"RA {row['ra_deg']:.5f} deg, Dec {row['dec_deg']:+.5f} deg, roll {row['roll_deg']:.4f} deg"
        where = row["reason"] or f"{place} (1 sigma {sigmas} arcsec), {row['stars']} stars"
        messages.tell(f"{path!s}   {row['state']}: {where}")
    (messages.say if as_csv else messages.tell)(found.summary())
    lost = all(state == LOST for state in found.state)
    return messages.Answer(exit_status=messages.DATA_DID_NOT_ALLOW if lost else messages.DONE)
