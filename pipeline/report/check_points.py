"""Check points in a report: what `boresight validate` found, kept beside the result and drawn on the map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from boresight.pipeline.files.record_tables import plain
from boresight.pipeline.files.whole_file import write_json
from boresight.pipeline.report.ground_accuracy import accuracy_rows
from boresight.pipeline.report.ground_map import local_plane
from boresight.pipeline.report.saved import Saved
from boresight.pipeline.results.folder import VALIDATION
from boresight.pipeline.results.validate import TruthErrors
from boresight.records.record import record, scalar

__all__ = ["CheckPoint", "check_points_on_map", "write_validation"]


@record(kw_only=True)
class CheckPoint:
    """One check point with the error of its computed place."""

    scene: int = scalar("number of the map's scene")
    place_m: tuple[float, float] = scalar("true place in the scene's plane, m east and north")
    error_m: tuple[float, float] = scalar("computed minus true, m east and north")
    words: str = scalar("hover text")


def write_validation(result: Path, found: TruthErrors) -> Path:
    """Write `validation.json` into the folder of a result; its path."""
    after = found.after
    accuracy = accuracy_rows(after.strip_id, np.column_stack([after.along_m, after.across_m]))
    path = result / VALIDATION
    write_json(path, plain(found) | {"accuracy": accuracy})
    return path


def check_points_on_map(saved: Saved) -> tuple[CheckPoint, ...]:
    """The check points that lie in strips of the map; none where the result was not validated."""
    scenes = saved.context["scenes"]
    scene_of = {strip["id"]: n for n, scene in enumerate(scenes) for strip in scene["strips"]}
    after: dict[str, Any] = saved.validation.get("after", {})
    found = []
    for n, strip_id in enumerate(after.get("strip_id", ())):
        if strip_id not in scene_of:
            continue
        scene, lon, lat = scenes[scene_of[strip_id]], after["lon_deg"][n], after["lat_deg"][n]
        place = local_plane(scene["lat_deg"], scene["lon_deg"]).transform(lon, lat)
        along, across = after["along_m"][n], after["across_m"][n]
        found.append(
            CheckPoint(
                scene=scene_of[strip_id],
                place_m=place,
                error_m=(after["east_m"][n], after["north_m"][n]),
                words=f"check point {after['point_id'][n]}, strip {strip_id}: error "
                f"{np.hypot(along, across):.2f} m, {along:+.2f} m along, {across:+.2f} m across the track",
            )
        )
    return tuple(found)
