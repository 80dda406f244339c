"""The page of `boresight dump check`: errors, what would not be used, and a map of footprints and targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.report.drawing import INK, MUTED, Drawing, axes_of, drawn, new_figure
from boresight.pipeline.report.page import template
from boresight.pipeline.stages.check import DumpCheck

__all__ = ["write_check_page"]


def write_check_page(found: DumpCheck, path: Path) -> None:
    """Write the page, readable without a network."""
    drawing = _map(found) if found.footprints else None
    text = template("check.html.j2").render(check=found, map=drawing)
    write_whole(path, lambda target: target.write_text(text, encoding="utf-8"))


def _map(found: DumpCheck) -> Drawing:
    """Footprints and targets, longitude against latitude, equal scale at the middle latitude."""
    figure = new_figure(5.2)
    axes = axes_of(figure, "longitude, degrees", "latitude, degrees")
    for strip_id, outline in found.footprints.items():
        closed = np.vstack([outline, outline[:1]])
        axes.plot(*closed.T, color=INK, lw=1.0)
        axes.annotate(strip_id, outline.max(axis=0), color=INK, fontsize=8)
    for seen, marker, label in ((True, "o", "in view"), (False, "x", "not in view")):
        places = np.array([one.lon_lat_deg for one in found.targets if bool(one.seen_by) == seen])
        if len(places):
            axes.plot(*places.T, marker, color=INK if seen else MUTED, ms=4, mfc="none", label=label)
    middle = np.mean(np.vstack(list(found.footprints.values()))[:, 1])
    axes.set_aspect(1.0 / np.cos(np.radians(middle)), adjustable="datalim")
    axes.ticklabel_format(useOffset=False)
    if found.targets:
        axes.legend(frameon=False, fontsize=8, labelcolor=INK)
    in_view = sum(bool(one.seen_by) for one in found.targets)
    counts = f"{len(found.footprints)} strips by the pre-launch matrix"
    text = f"{counts}; {in_view} of {len(found.targets)} targets in view."
    return drawn(figure, "footprints", text, f"Map of footprints and targets. {text}")
