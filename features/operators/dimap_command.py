"""`boresight dimap`: pixels of a strip in DIMAP to places, or its model against the operator's grid."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.operators.dimap_grid import grid_differences, places_of_pixels
from boresight.pipeline.console.messages import print_data, say, tell
from boresight.pipeline.files.dimap_metadata import operator_model

__all__ = ["dimap"]


def dimap(
    product: Annotated[Path, typer.Argument(metavar="FILE", help="Pleiades metadata: DIM or PHRDIMAP XML.")],
    pixels: Annotated[Path | None, typer.Option(help="CSV file with the columns ccd, sample, line.")] = None,
    height_m: Annotated[float, typer.Option(help="Ellipsoidal height of the ground for --pixels.")] = 0.0,
    grid: Annotated[
        Path | None, typer.Option(help="Operator's location grid, GRID_*.tif, to compare.")
    ] = None,
) -> None:
    """Geolocate pixels of a Pleiades strip, or compare its model with the operator's location grid.

    Example: boresight dimap PHRDIMAP.XML --grid GRID.tif
    """
    strip = operator_model(product)
    say(f"{strip.dataset}: {strip.width_px} x {strip.height_px} px")
    if pixels is not None:
        print_data("".join(places_of_pixels(strip, pixels, height_m)))
    if grid is not None:
        for altitude, rms, largest in grid_differences(strip, grid):
            tell(f"altitude {altitude:7.1f} m   rms {rms:.5f} m   largest {largest:.5f} m")
