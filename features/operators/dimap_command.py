"""`boresight dimap`: pixels of a strip in DIMAP to places, or its model against the operator's
location grid.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.operators.dimap_grid import dimap_grid_differences, places_of_pixels
from boresight.features.operators.grid_agreement import Limit, agreement
from boresight.pipeline.console.messages import Answer, print_data, say
from boresight.pipeline.files.dimap_metadata import operator_model

__all__ = ["dimap_command"]


def dimap_command(
    product: Annotated[Path, typer.Argument(metavar="FILE", help="Pleiades metadata: DIM or PHRDIMAP XML.")],
    pixels: Annotated[Path | None, typer.Option(help="CSV file with the columns ccd, sample, line.")] = None,
    height_m: Annotated[float, typer.Option(help="Ellipsoidal height of the ground for --pixels.")] = 0.0,
    grid: Annotated[
        Path | None, typer.Option(help="Operator's location grid, GRID_*.tif, to compare.")
    ] = None,
    limit_m: Limit = 0.01,
) -> Answer:
    """Geolocate pixels of a Pleiades strip, or check its model against the operator's location grid.

    Example: boresight dimap PHRDIMAP.XML --grid GRID.tif
    """
    strip = operator_model(product)
    say(f"{strip.dataset}: {strip.width_px} x {strip.height_px} px")
    if pixels is not None:
        print_data("".join(places_of_pixels(strip, pixels, height_m)))
    if grid is None:
        return Answer()
    found = dimap_grid_differences(strip, grid)
    lines = [f"altitude {h:7.1f} m   rms {rms:.5f} m   largest {largest:.5f} m" for h, rms, largest in found]
    return agreement(lines, max(largest for _, _, largest in found), limit_m)
