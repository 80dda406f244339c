"""`boresight export`: a result in formats that other tools read."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated

import typer

from boresight.features.exports.formats import (
    FORMATS,
    OF_STRIPS,
    ExportRequest,
    Remark,
    export,
    strips_left_out,
)
from boresight.features.exports.spice_export import SpiceFrames
from boresight.pipeline.console.arguments import CameraOption, DumpOption, ResultArgument, StaleEop, option
from boresight.pipeline.console.completion import among, strips_of
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, Answer, say, tell

__all__ = ["export_command"]


def export_command(
    result: ResultArgument,
    formats: Annotated[
        list[str],
        typer.Option(
            "--format",
            help=f"{', '.join(FORMATS)}; several with commas. May be repeated.",
            autocompletion=among(FORMATS, several=True),
        ),
    ],
    out: Path | None = option("Folder for the files; default: RESULT/exports."),
    dump: DumpOption = None,
    camera: CameraOption = "",
    strip: list[str] | None = option("Only this strip. May be repeated.", autocompletion=strips_of),
    product: Path | None = option("dimap, gipp: the operator's file."),
    valid_from: str = option("First date of the matrix's use, UTC, such as 2026-03-01.", ""),
    valid_to: str = option("Last date of its use; both are written where a format has them.", ""),
    object_id: str = option("aem, acm: OBJECT_ID, such as 2015-028A; default: the mission's name.", ""),
    allow_stale_eop: StaleEop = False,
    spice_spacecraft: int = option("SPICE: id of the spacecraft.", -999),
    spice_star_camera: str = option("SPICE: name of the star camera's frame.", "BORESIGHT_STAR_CAMERA"),
    spice_remote_camera: str = option(
        "SPICE: name of the remote-sensing camera's frame.", "BORESIGHT_REMOTE_CAMERA"
    ),
    spice_known_star_camera: bool = option(
        "SPICE: the star camera's frame is defined by other kernels.", False
    ),
) -> Answer:
    """Write a result in formats that other tools read.

    dimap is tried with products of Pléiades; those of Pléiades Neo and SPOT 6/7 (DIMAP V2) are not tried.

    Example: boresight export result --format geojson,qgis
    """
    names = [name.strip() for several in formats for name in several.split(",")]
    if unknown := [name for name in names if name not in FORMATS]:
        raise typer.BadParameter(f"there is no format {unknown[0]!r}, only {', '.join(FORMATS)}")
    try:
        frames = SpiceFrames(
            spacecraft_id=spice_spacecraft,
            star_camera_name=spice_star_camera,
            remote_camera_name=spice_remote_camera,
            define_star_camera=not spice_known_star_camera,
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S")
    request = ExportRequest(
        result=result,
        dump=dump,
        camera=camera,
        strips=tuple(strip or ()),
        frames=frames,
        creation_utc=now,
        product=product,
        valid_utc=(_date(valid_from), _date(valid_to)),
        object_id=object_id,
        allow_stale_eop=allow_stale_eop,
    )
    folder = out if out is not None else result / "exports" / camera
    for remark in strips_left_out(request) if set(names) & set(OF_STRIPS) else ():
        say(remark.text)
    if empty := [name for name in names if not _written(name, request, folder)]:
        say(f"nothing to write as {', '.join(empty)}")
    return Answer(exit_status=DATA_DID_NOT_ALLOW if len(empty) == len(names) else DONE)


def _date(text: str) -> str:
    """A date as GIPP files have it; empty for none."""
    try:
        return datetime.datetime.fromisoformat(text).strftime("%Y-%m-%dT%H:%M:%S.0Z") if text else ""
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is no date, ISO 8601: {error}") from error


def _written(name: str, request: ExportRequest, folder: Path) -> int:
    """How many files of a format were written."""
    count = 0
    for one in export(name, request, folder):
        if isinstance(one, Remark):
            say(f"{name}: {one.text}")
        else:
            count += 1
            tell(f"{name:8s} {one.stat().st_size:10d} bytes -> {one}")
    return count
