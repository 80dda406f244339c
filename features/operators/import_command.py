"""`boresight import`: dumps and points of an operator's own files."""

from __future__ import annotations

import csv
import re
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import typer

from boresight.features.operators import grid_command, point_import
from boresight.features.operators.dimap_import import dimap_mission
from boresight.features.operators.imported_mission import ImportedMission, write_imported
from boresight.features.operators.sentinel2_import import AttitudeLevel, sentinel2_mission
from boresight.features.operators.sentinel2_product import BANDS, read_sentinel2
from boresight.pipeline import __version__
from boresight.pipeline.console.arguments import option
from boresight.pipeline.console.completion import among, ccds_of, first_argument, strips_of
from boresight.pipeline.console.messages import Answer, say, wrong_usage
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dimap_metadata import operator_model
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.stated_noise import state_noise
from boresight.pipeline.files.text_files import read_text
from boresight.pipeline.files.whole_file import is_vacant, write_text
from boresight.pipeline.head_noise.of_dump import noise_of_heads
from boresight.pipeline.run.settings import Settings

__all__ = ["import_dimap_command", "import_points_command", "import_sentinel2_command"]

Out = Annotated[Path, typer.Argument(help="Folder of the dump; must not exist or be empty.")]
Points = Annotated[
    Path | None, typer.Option(help="CSV of measured image points (docs/dump-format.md); default: none yet.")
]
ObjectId = Annotated[
    str, typer.Option(help="OBJECT_ID in orbit.oem, such as 2015-028A; default: the mission's name.")
]


def import_sentinel2_command(
    datastrip: grid_command.Datastrip,
    out: Out,
    gipp: grid_command.GippFolder,
    band: list[str] = option(
        "B01 to B12, B8A, all; several times: a camera each.", ..., autocompletion=among(BANDS)
    ),
    attitudes: AttitudeLevel = option(
        "raw: the star trackers; corrected: the operator's attitude; refined: with its refining.", "raw"
    ),
    earth_orientation: grid_command.EarthOrientation = None,
    points: Points = None,
    object_id: ObjectId = "",
) -> Answer:
    """Make a dump of bands of a Sentinel-2 datastrip: trackers, orbit, look tables, line times.

    Example: boresight import sentinel2 S2A_OPER_MTD_L1B_DS.xml b04 --gipp GIPP --band B04 --points gcps.csv
    """
    table = grid_command.earth_orientation_of(earth_orientation)
    names = BANDS if "all" in band else tuple(dict.fromkeys(band))
    bands = [read_sentinel2(datastrip, gipp, name) for name in names]
    mission = sentinel2_mission(bands, _creator("sentinel2"), attitudes=attitudes, earth_orientation=table)
    if attitudes == "raw" and bands[0].gyros is not None and mission.gyro is None:
        say("the gyros do not turn as the operator's corrected attitudes do: not imported")
    return _written(out, mission, points, object_id)


def import_dimap_command(
    product: Annotated[Path, typer.Argument(metavar="FILE", help="Metadata in DIMAP: DIM_* or PHRDIMAP_*.")],
    out: Out,
    points: Points = None,
    object_id: ObjectId = "",
) -> Answer:
    """Make a dump of a strip of Pleiades (DIMAP V1, V2), Pleiades Neo, SPOT 6 or 7 (V2): the operator's
    attitude as a head, orbit, look table, line times.

    Example: boresight import dimap PHRDIMAP.XML pleiades --points gcps.csv
    """
    return _written(out, dimap_mission(operator_model(product), _creator("dimap")), points, object_id)


def _images_of(context: typer.Context, incomplete: str) -> list[str]:
    """Names of the images in ASP's file of points."""
    file = first_argument(context, "file")
    names: tuple[str, ...] = ()
    with suppress(RawDataError, OSError):
        names = point_import.asp_images(Path(file)) if file else ()
    return [name for name in names if name.startswith(incomplete)]


def import_points_command(
    file: Annotated[Path, typer.Argument(help="QGIS .points, ASP .gcp, or a GeoTIFF with GCPs.")],
    out: Annotated[Path, typer.Argument(help="The points.csv to be written.")],
    strip: str = option("Id of the strip in which they are measured.", ..., autocompletion=strips_of),
    ccd: int = option("Its CCD, from 0.", 0, min=0, max=63, autocompletion=ccds_of),
    height_kind: Literal["ellipsoidal", "egm96"] = option("What the heights are above.", "ellipsoidal"),
    image: str | None = option("ASP: the image whose points are taken.", autocompletion=_images_of),
    *,
    errors: point_import.PointErrors,
) -> Answer:
    """Make a points.csv of image points that another program has measured.

    Example: boresight import points b04.points points.csv --strip b04 --height-m 12 --sigma-m 2 2 3
    """
    found = point_import.read_measured_points(file, errors, image)
    text = point_import.points_csv(found, strip, ccd, height_kind)
    write_text(out, text)
    left = f", {found.n_disabled} marked as not to be used" if found.n_disabled else ""
    return Answer(text=f"{len(found.names)} points{left} -> {out}", files=(out,))


def _creator(command: str) -> str:
    return f"boresight {__version__}: import {command}"


def _written(out: Path, mission: ImportedMission, points: Path | None, object_id: str) -> Answer:
    if object_id and not re.fullmatch(r"[0-9]{4}-[0-9]{3}[A-Z]{1,3}", object_id):
        raise wrong_usage(f"--object-id is an international designator such as 2015-028A, not {object_id!r}")
    if not is_vacant(out):
        raise wrong_usage(f"{out} is there already and is not an empty folder")
    text = None if points is None else read_text(points, str(points))
    write_imported(out, mission, text, object_id)
    noise = _noise_of(out, mission)
    if text is None:
        say(f"no measured points: write them to {out / 'points.csv'} before `boresight calibrate`")
    count = 0 if text is None else sum(1 for _ in csv.reader(text.splitlines())) - 1
    heads = ", ".join(f"{head.name} ({len(head.t_s)} attitudes)" for head in mission.heads)
    heads += f", gyro ({len(mission.gyro.t_s)} rows)" if mission.gyro else ""
    summary = f"{mission.mission}: {heads}, {len(mission.strips)} CCDs, {count} points -> {out}"
    return Answer(text="\n".join([summary, *noise]), files=(out / "dump.toml",))


def _noise_of(dump: Path, mission: ImportedMission) -> list[str]:
    """Lines about the noise of the heads, which is estimated and stated where the record allows it."""
    why = "the operator's attitude does not show its own errors"
    if all(head.is_measured for head in mission.heads):
        try:
            found = noise_of_heads(open_dump(dump, sky_alone=True), Settings())
        except DataNotSufficientError as error:
            why = str(error)
        else:
            state_noise(dump, dict(zip(found.names, found.fit.heads)))
            said = "estimated from the record and stated in dump.toml; see `boresight noise`"
            return [f"noise of {' and '.join(found.names)} {said}"]
    say(f"noise of the heads: white noise is ASSUMED in dump.toml ({why}); state it in [star_cameras.noise]")
    return []
