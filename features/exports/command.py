"""Commands for those who look at a result and hand it on: report, export, geolocate."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.console.arguments import DumpOption
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, Answer, print_data, say, talks, tell
from boresight.pipeline.files.whole_file import write_text, write_whole

__all__ = ["RequireArcsec", "RequireMetres", "add_report_commands"]

Result = Annotated[Path, typer.Argument(help="Folder that `calibrate` wrote.")]
StaleOption = Annotated[
    bool, typer.Option(help="Go on past the end of the Earth-orientation table, with a warning.")
]
RequireArcsec = Annotated[
    float | None, typer.Option(help="Largest 1-sigma about each axis that is enough, arc-seconds.", min=0.0)
]
RequireMetres = Annotated[
    float | None, typer.Option(help="Largest 1-sigma that is enough, metres on the ground.", min=0.0)
]


def add_report_commands(app: typer.Typer) -> None:
    """Plug the commands into the program."""
    app.command()(talks(report))
    app.command()(talks(export))
    app.command()(talks(geolocate))


def report(
    result: Result,
    matches: Annotated[
        int, typer.Option(help="Show the pictures of at most so many targets that were used.", min=0)
    ] = 200,
    pdf: Annotated[bool, typer.Option("--pdf", help="Print the page to report.pdf, too (Chromium).")] = False,
    require_arcsec: RequireArcsec = None,
    require_m: RequireMetres = None,
) -> Answer:
    """Draw one HTML page about a result, from what was saved, readable without a network.

    Example: boresight report demo-result --pdf --require-arcsec 1
    """
    from boresight.pipeline.report.dumps_page import write_dumps_report
    from boresight.pipeline.report.page import write_report
    from boresight.pipeline.report.pdf import print_page
    from boresight.pipeline.results.folder import dumps_in
    from boresight.pipeline.results.reading import read_result
    from boresight.pipeline.results.requirement import (
        Requirement,
        requirement_lines,
        saved_requirement,
        write_requirement,
    )

    write_requirement(result, Requirement(require_arcsec, require_m))
    path = write_dumps_report(result) if dumps_in(result) else write_report(result, most_matches=matches)
    lines = [f"{path.stat().st_size / 1e6:.1f} MB -> {path}"]
    if pdf:
        printed = print_page(path)
        lines.append(f"{printed.stat().st_size / 1e6:.1f} MB -> {printed}")
    lines += requirement_lines(saved_requirement(result), read_result(result).installation)
    return Answer(text="\n".join(lines))


def export(
    result: Result,
    formats: Annotated[
        list[str],
        typer.Option(
            "--format",
            help="spice, spice-ck, aem, acm, operator, dimap, json, csv, csm-isd, rpc, vrt, kml, asp,"
            " geojson, envi, qgis or fits; several with commas. May be repeated.",
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for the files; default: RESULT/exports.")] = None,
    dump: DumpOption = None,
    strip: Annotated[list[str] | None, typer.Option(help="Only this strip. May be repeated.")] = None,
    product: Annotated[Path | None, typer.Option(help="dimap: the operator's file.")] = None,
    object_id: Annotated[
        str, typer.Option(help="aem, acm: OBJECT_ID, such as 2015-028A; default: the mission's name.")
    ] = "",
    allow_stale_eop: StaleOption = False,
    spice_spacecraft: Annotated[int, typer.Option(help="SPICE: id of the spacecraft.")] = -999,
    spice_star_camera: Annotated[
        str, typer.Option(help="SPICE: name of the star camera's frame.")
    ] = "BORESIGHT_STAR_CAMERA",
    spice_remote_camera: Annotated[
        str, typer.Option(help="SPICE: name of the remote-sensing camera's frame.")
    ] = "BORESIGHT_REMOTE_CAMERA",
    spice_known_star_camera: Annotated[
        bool, typer.Option(help="SPICE: the star camera's frame is defined by other kernels.")
    ] = False,
) -> Answer:
    """Write a result in formats that other tools read.

    Example: boresight export result --format geojson,qgis
    """
    from boresight.features.exports.formats import FORMATS, OF_STRIPS, ExportRequest, Remark, strips_left_out
    from boresight.features.exports.formats import export as made
    from boresight.features.exports.spice_frame import SpiceFrames

    names = [name.strip() for several in formats for name in several.split(",")]
    if unknown := [name for name in names if name not in FORMATS]:
        raise typer.BadParameter(f"there is no format {unknown[0]!r}, only {', '.join(FORMATS)}")
    try:
        frames = SpiceFrames(
            spacecraft_id=spice_spacecraft,
            star_camera_id=spice_spacecraft * 1000 - 1,
            star_camera_name=spice_star_camera,
            remote_camera_id=spice_spacecraft * 1000 - 2,
            remote_camera_name=spice_remote_camera,
            define_star_camera=not spice_known_star_camera,
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S")
    request = ExportRequest(
        result=result,
        dump=dump,
        strips=tuple(strip or ()),
        frames=frames,
        creation_utc=now,
        product=product,
        object_id=object_id,
        allow_stale_eop=allow_stale_eop,
    )
    folder = out if out is not None else result / "exports"
    folder.mkdir(parents=True, exist_ok=True)
    for remark in strips_left_out(request) if set(names) & set(OF_STRIPS) else ():
        say(remark.text)
    empty = []
    for name in names:
        count = 0
        for one in made(name, request):
            if isinstance(one, Remark):
                say(f"{name}: {one.text}")
                continue
            count += 1
            file, content = one
            raw = content.encode("utf-8") if isinstance(content, str) else content
            write_whole(folder / file, lambda path, raw=raw: path.write_bytes(raw))
            tell(f"{name:8s} {len(raw):10d} bytes -> {folder / file}")
        empty += [] if count else [name]
    if empty:
        say(f"nothing to write as {', '.join(empty)}")
        return Answer(exit_status=DATA_DID_NOT_ALLOW)
    return Answer()


def geolocate(
    result: Result,
    strip: Annotated[str, typer.Option(help="Id of the strip.")],
    pixels: Annotated[Path, typer.Option(help="CSV file with the columns ccd, sample, line.")],
    dump: DumpOption = None,
    out: Annotated[Path | None, typer.Option(help="CSV file to write; default: standard output.")] = None,
    height_m: Annotated[
        float | None, typer.Option(help="Take this ellipsoidal height instead of the terrain model.")
    ] = None,
    allow_stale_eop: StaleOption = False,
) -> None:
    """Image points of a strip to latitude, longitude and height, with 1-sigma along and across the track.

    Example: boresight geolocate result --strip S01 --pixels pixels.csv
    """
    from boresight.features.geolocate.positions import geolocate as places_of
    from boresight.features.geolocate.positions import places_csv, read_pixels
    from boresight.geometry.terrain import ConstantHeight
    from boresight.pipeline.files.dump import surface_of
    from boresight.pipeline.results.strip_model import open_calibrated, strip_model

    calibrated = open_calibrated(result, dump, allow_stale_eop=allow_stale_eop)
    model = strip_model(calibrated, strip)
    read = read_pixels(pixels, calibrated)
    surface = ConstantHeight(height_m) if height_m is not None else surface_of(calibrated.dump.terrain)
    places = places_of(calibrated, model, read, surface)
    text = "".join(places_csv(read, places))
    if out is None:
        print_data(text)
    else:
        write_text(out, text)
        known = int((places.sigma_along_m == places.sigma_along_m).sum())
        tell(f"{known} of {len(read.line)} image points have a place -> {out}")
