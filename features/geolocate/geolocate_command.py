"""`boresight geolocate`: image points of a strip to places on the ground."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.geolocate.positions import ground_places, places_csv, read_pixels
from boresight.pipeline.console.arguments import CameraOption, DumpOption, ResultArgument, StaleEop, option
from boresight.pipeline.console.completion import strips_of
from boresight.pipeline.console.messages import print_data, tell
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.results.strip_model import open_calibrated, strip_model

__all__ = ["geolocate_command"]


def geolocate_command(
    result: ResultArgument,
    strip: Annotated[str, typer.Option(help="Id of the strip.", autocompletion=strips_of)],
    pixels: Annotated[Path, typer.Option(help="CSV file with the columns ccd, sample, line.")],
    dump: DumpOption = None,
    camera: CameraOption = "",
    out: Path | None = option("CSV file to write; default: standard output."),
    height_m: float | None = option("Take this ellipsoidal height instead of the terrain model."),
    allow_stale_eop: StaleEop = False,
) -> None:
    """Image points of a strip to latitude, longitude and height, with 1-sigma along and across the track.

    Example: boresight geolocate result --strip S01 --pixels pixels.csv
    """
    calibrated = open_calibrated(result, dump, camera=camera, allow_stale_eop=allow_stale_eop)
    model = strip_model(calibrated, strip)
    read = read_pixels(pixels, calibrated)
    surface = surface_of(calibrated.dump.terrain, height_m)
    places = ground_places(calibrated, model, read, surface)
    text = "".join(places_csv(read, places))
    if out is None:
        print_data(text)
    else:
        write_text(out, text)
        known = int((places.sigma_along_m == places.sigma_along_m).sum())
        tell(f"{known} of {len(read.line)} image points have a place -> {out}")
