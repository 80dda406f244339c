"""A small map of each dump for the page of several: outlines of strips, targets, residuals, bars of scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from boresight.geometry.record import record, scalar
from boresight.pipeline.report.map_view import MapView, map_view
from boresight.pipeline.report.observations import target_rows
from boresight.pipeline.report.saved import read_saved

__all__ = ["Bar", "SmallMap", "round_bar", "small_maps"]

MOST_MAPS = 12  # on one page: six rows of two on paper
LONGEST_BAR = 260.0  # of a bar, units of a sheet that is 1000 wide


@record
class Bar:
    """A bar of scale."""

    length: float = scalar("units of the sheet")
    words: str = scalar("what it is on the ground")


@record(kw_only=True)
class SmallMap:
    """The map of one dump."""

    name: str = scalar("of the dump")
    page: str = scalar("place of its own page; empty if there is none")
    map: MapView = scalar("its map; residuals are those of its own matrix")
    ground: Bar = scalar("of the map")
    residual: Bar = scalar("of the arrows")


def small_maps(result: Path, names: Sequence[str]) -> tuple[SmallMap, ...]:
    """Maps of the first `MOST_MAPS` dumps that see the ground and whose evidence is kept."""
    found = list[SmallMap]()
    for name in names:
        folder = result / name
        if len(found) == MOST_MAPS or not (folder / "evidence" / "context.json").is_file():
            continue
        saved = read_saved(folder)
        drawn = map_view(saved, target_rows(saved, 0))
        if drawn is not None:
            page = f"{name}/report.html" if (folder / "report.html").is_file() else ""
            ground, residual = round_bar(drawn.metres), round_bar(drawn.residual_metres)
            found.append(SmallMap(name=name, page=page, map=drawn, ground=ground, residual=residual))
    return tuple(found)


def round_bar(metres: float) -> Bar:
    """The longest bar of 1, 2 or 5 times a power of ten metres that is within `LONGEST_BAR` units."""
    power = 10.0 ** math.floor(math.log10(LONGEST_BAR * metres))
    length_m = max(step * power for step in (1.0, 2.0, 5.0) if step * power <= LONGEST_BAR * metres)
    words = f"{length_m / 1000:g} km" if length_m >= 1000.0 else f"{length_m:g} m"
    return Bar(round(length_m / metres, 1), words)
