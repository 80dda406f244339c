"""`boresight dimap` and `boresight sentinel2`: the model of a strip against the operator's location grid, and
pixels of a strip in DIMAP to places.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.operators.dimap_grid import dimap_grid_differences, places_of_pixels
from boresight.features.operators.sentinel2_grid import read_grid_rows, sentinel2_grid_differences
from boresight.features.operators.sentinel2_product import BANDS, read_sentinel2
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.pipeline.console.arguments import option
from boresight.pipeline.console.completion import among
from boresight.pipeline.console.messages import DONE, LIMIT_MISSED, Answer, print_data, say
from boresight.pipeline.files.dimap_metadata import operator_model
from boresight.pipeline.files.orbit_and_earth import read_earth_orientation

__all__ = [
    "Datastrip",
    "EarthOrientation",
    "GippFolder",
    "dimap_command",
    "earth_orientation_of",
    "sentinel2_command",
]

FEW, FARTHEST = 0.01, 5.0  # share of rows beyond the limit, and how far, that are rounding (set by hand)
Datastrip = Annotated[Path, typer.Argument(help="S2?_OPER_MTD_L1B_DS_*.xml of a L1B datastrip.")]
GippFolder = Annotated[
    Path, typer.Option(help="Folder or tar archive of the SPAMOD and VIEDIR files that it names.")
]
EarthOrientation = Annotated[
    Path | None, typer.Option(help="CSV of mjd_utc, ut1_utc_s, x_arcsec, y_arcsec; else its bulletin.")
]
Limit = Annotated[float, typer.Option(help="Largest distance from the grid that agrees, m.", min=0.0)]


def _agreement(lines: list[str], largest_m: float, limit_m: float, beyond: int = 0, rows: int = 0) -> Answer:
    """The answer of a check: its verdict is the last line and the exit status. Of a grid whose writer rounds,
    a few of its `rows` may be `beyond` the limit, none by more than `FARTHEST` times.
    """
    few = beyond <= FEW * rows and largest_m <= FARTHEST * limit_m
    agrees = largest_m <= limit_m or few
    told = "agrees with" if agrees else "does not agree with"
    but = f" but for {beyond} of its {rows} rows" if agrees and beyond else ""
    verdict = f"the model {told} the grid{but}: largest {largest_m:.5f} m, limit {limit_m:g} m"
    return Answer(
        text="\n".join([*lines, verdict]),
        content={"agrees": agrees, "largest_m": largest_m, "limit_m": limit_m},
        exit_status=DONE if agrees else LIMIT_MISSED,
    )


def earth_orientation_of(file: Path | None) -> EarthOrientationTable | None:
    """The table of a file, where one is given."""
    return None if file is None else read_earth_orientation(file, str(file))


def dimap_command(
    product: Annotated[Path, typer.Argument(metavar="FILE", help="Pleiades metadata: DIM or PHRDIMAP XML.")],
    pixels: Path | None = option("CSV file with the columns ccd, sample, line."),
    height_m: float = option("Ellipsoidal height of the ground for --pixels.", 0.0),
    grid: Path | None = option("Operator's location grid, GRID_*.tif, to compare."),
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
    return _agreement(lines, max(largest for _, _, largest in found), limit_m)


MOST_ROWS = 20  # of a grid that are listed


def sentinel2_command(
    datastrip: Datastrip,
    gipp: GippFolder,
    band: Annotated[str, typer.Option(help="B01 to B12, B8A.", autocompletion=among(BANDS))],
    grid: Path = option("Its location grid: CSV of detector, line, sample, lon, lat, alt.", ...),
    earth_orientation: EarthOrientation = None,
    limit_m: Limit = 0.02,
) -> Answer:
    """Check the model of a Sentinel-2 datastrip against the operator's location grid.

    Example: boresight sentinel2 S2A_OPER_MTD_L1B_DS.xml --gipp GIPP --band B04 --grid grid_B04.csv
    """
    strip, rows = read_sentinel2(datastrip, gipp, band), read_grid_rows(grid)
    off_m = sentinel2_grid_differences(strip, rows, earth_orientation_of(earth_orientation))
    lines = []
    for detector in sorted({row.detector for row in rows}):
        own = off_m[[row.detector == detector for row in rows]]
        rms = float((own**2).mean() ** 0.5)
        lines.append(
            f"detector {detector:02d}   {len(own)} rows   rms {rms:.5f} m   largest {own.max():.5f} m"
        )
    beyond = [n for n in range(len(rows)) if not off_m[n] <= limit_m]
    lines += [
        f"line {n + 2} of the grid: detector {rows[n].detector}, line {rows[n].line:g}, "
        f"sample {rows[n].sample:g}: {off_m[n]:.5f} m"
        for n in beyond[:MOST_ROWS]
    ]
    lines += [f"and {len(beyond) - MOST_ROWS} rows more"] if len(beyond) > MOST_ROWS else []
    return _agreement(lines, float(off_m.max()), limit_m, len(beyond), len(rows))
