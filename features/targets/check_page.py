"""The page of `boresight dump check`: errors, what would not be used, and a map of footprints and targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from boresight.features.targets.dump_check import DumpCheck, grouped_faults
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.report.drawing import Axis, Drawing, Figure, drawn
from boresight.pipeline.report.page_template import template

__all__ = ["write_check_page"]

# Most strips of which a map is drawn; maps side by side.
MOST_MAPS, COLUMNS = 12, 2
GAPS_PT = 55.0, 55.0  # between maps


def write_check_page(found: DumpCheck, path: Path) -> None:
    """Write the HTML page of a check of a dump, readable without a network."""
    drawing = _map(found) if found.footprints else None
    text = template("check.html.j2").render(check=found, faults=grouped_faults(found.faults), map=drawing)
    write_text(path, text)


def _map(found: DumpCheck) -> Drawing:
    """A map for each of the first strips: its outline and the targets that it sees or misses by least."""
    shown = dict(list(found.footprints.items())[:MOST_MAPS])
    rows = -(-len(shown) // COLUMNS)
    figure = Figure(2.2 * rows, above=15.0)
    for n, (strip_id, outline) in enumerate(shown.items()):
        seen = [one.lon_lat_deg for one in found.targets if strip_id in one.seen_by]
        missed = [one.lon_lat_deg for one in found.targets if one.nearest == strip_id]
        every = np.vstack([outline, *(np.reshape(places, (-1, 2)) for places in (seen, missed))])
        across, down = (
            Axis.over(name, values) for name, values in zip(("longitude, °", "latitude, °"), every.T)
        )
        flattened = 1.0 / np.cos(np.radians(outline[:, 1].mean()))
        axes = figure.panel(across, down, figure.cell(n, rows, COLUMNS, GAPS_PT), aspect=flattened)
        axes.line(*np.vstack([outline, outline[:1]]).T)
        axes.title(strip_id)
        for places, marker in ((seen, "o"), (missed, "x")):
            if places:
                lon, lat = np.array(places).T
                axes.marks(lon, lat, marker)
    in_view = sum(bool(one.seen_by) for one in found.targets)
    counts = f"{len(shown)} of {len(found.footprints)} strips by the pre-launch matrix"
    text = f"{counts}, longitude and latitude in degrees; {in_view} of {len(found.targets)} targets in view."
    text += " Circles: in view; crosses: not, at the strip that they miss by least."
    return drawn(figure, "footprints", text, f"Maps of footprints and targets. {text}")
