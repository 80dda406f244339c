"""`boresight targets suggest`: ground targets chosen in ortho-images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer
from pydantic import ValidationError

from boresight.features.targets.ortho_files import HeightModel, open_raster, read_heights
from boresight.features.targets.stac_items import StacQuery, stac_images
from boresight.features.targets.suggestions import SuggestRequest, suggest_in, suggestion_lines, write_targets
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.console.arguments import argument, option
from boresight.pipeline.console.messages import Answer, say, wrong_usage
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.run.settings import read_settings

__all__ = ["targets_suggest_command"]


def targets_suggest_command(
    out: Annotated[Path, typer.Option(help="Folder for chips/ and targets.csv.")],
    orthos: list[Path] | None = argument(
        "GeoTIFF, COG or VRT with a map, or an address; where two overlap: two dates.",
        None,
        metavar="ORTHO",
        parser=dump_folder,
    ),
    stac: Path | None = option(
        "A STAC catalogue or API, for its images.", metavar="PATH", parser=dump_folder
    ),
    dem: list[Path] | None = option("Height model. May be repeated.", parser=dump_folder),
    heights: Literal["ellipsoidal", "egm96", "egm2008"] = option(
        "What the heights of --dem refer to.", "egm96"
    ),
    height_m: float | None = option("Ellipsoidal height of flat ground, in place of --dem."),
    dump: Path | None = option(
        "Only what its strips will show, spread for the best forecast.", metavar="PATH", parser=dump_folder
    ),
    *,
    request: SuggestRequest,
    query: StacQuery,
    offset_m: float | None = option("1-sigma of an offset east, north that all these images share.", min=0.0),
    offset_up_m: float = option("The same of the heights.", 0.0, min=0.0),
    reference: str = option("Id of these images as a ground reference.", "ortho"),
    settings: Path | None = option("TOML file of settings, for --dump."),
) -> Answer:
    """Choose ground targets in ortho-images; write their chips and the list that goes into a dump.

    Example: boresight targets suggest ortho1.tif ortho2.tif --dem dem.tif --dump dump --out targets
    """
    if bool(dem) == (height_m is not None):
        raise wrong_usage("give the heights by --dem or by --height-m, one of them")
    flat = HeightModel((ConstantHeight(height_m or 0.0),), "ellipsoidal")
    model = read_heights(dem, heights) if dem else flat
    if bool(orthos) == (stac is not None):
        raise wrong_usage("give ortho-images or a catalogue by --stac, one of them")
    opened = None if dump is None else open_dump(dump)
    if stac is None:
        images = [open_raster(path, query.band) for path in orthos or ()]
    else:
        images, unused = stac_images(replace(query, source=stac))
        for line in unused:
            say(f"not used: {line}")
    found = suggest_in(images, model, request, opened, read_settings(settings))
    try:
        references = found.references(reference, offset_m, offset_up_m)
    except ValidationError as error:
        raise wrong_usage("--reference is an id, --offset-m and --offset-up-m are at most 10 km") from error
    table = write_targets(found.targets, out, request.size_px, references)
    lines = [*suggestion_lines(found), f"{len(found.targets)} targets -> {table}"]
    if references:
        lines.append(f"references -> {out / 'ground_references.toml'}: add them to dump.toml")
    return Answer(text="\n".join(lines), files=(table,))
