"""`boresight sentinel2`: the model of a datastrip against the operator's location grid."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.operators.grid_agreement import Limit, agreement
from boresight.features.operators.sentinel2_grid import read_grid_rows, sentinel2_grid_differences
from boresight.features.operators.sentinel2_product import BANDS, read_sentinel2
from boresight.pipeline.console.completion import among
from boresight.pipeline.console.messages import Answer
from boresight.pipeline.files.orbit_and_earth import read_earth_orientation

__all__ = ["sentinel2_command"]

MOST_ROWS = 20  # of a grid that are listed


def sentinel2_command(
    datastrip: Annotated[Path, typer.Argument(help="S2?_OPER_MTD_L1B_DS_*.xml of a L1B datastrip.")],
    gipp: Annotated[
        Path, typer.Option(help="Folder or tar archive of the SPAMOD and VIEDIR files that it names.")
    ],
    band: Annotated[str, typer.Option(help="B01 to B12, B8A.", autocompletion=among(BANDS))],
    grid: Annotated[
        Path, typer.Option(help="Its location grid: CSV of detector, line, sample, lon, lat, alt.")
    ],
    earth_orientation: Annotated[
        Path | None,
        typer.Option(help="CSV of mjd_utc, ut1_utc_s, x_arcsec, y_arcsec; else its bulletin."),
    ] = None,
    limit_m: Limit = 0.02,
) -> Answer:
    """Check the model of a Sentinel-2 datastrip against the operator's location grid.

    Example: boresight sentinel2 S2A_OPER_MTD_L1B_DS.xml --gipp GIPP --band B04 --grid grid_B04.csv
    """
    table = None
    if earth_orientation is not None:
        table = read_earth_orientation(earth_orientation, str(earth_orientation))
    strip, rows = read_sentinel2(datastrip, gipp, band), read_grid_rows(grid)
    off_m = sentinel2_grid_differences(strip, rows, table)
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
    return agreement(lines, float(off_m.max()), limit_m, len(beyond), len(rows))
