"""The map of a report: scenes side by side on one sheet, in the sheet's units, ready for an SVG element."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from boresight.pipeline.files.table_files import column
from boresight.pipeline.report.check_points import CheckPoint, check_points_on_map
from boresight.pipeline.report.marks import strip_style
from boresight.pipeline.report.observations import TargetCard, data_uri, strip_numbers
from boresight.pipeline.report.saved import Saved
from boresight.records.ledger import State, count_words
from boresight.records.record import Floats, record, scalar

__all__ = ["Layer", "MapView", "SceneView", "SpotView", "map_view"]

WIDTH, BEST_HEIGHT, GAP = 1000.0, 780.0, 12.0  # of the sheet; its best shape, around scenes
CAPTION = 36.0  # room for a line of 12 px where the sheet is only 360 px wide
ARROW = 0.045  # of the sheet's width: length of the arrow that nine of ten residuals fall below
LONGEST = 2.5 * ARROW * WIDTH  # units of the sheet: a gross error must not cross the map


@record(kw_only=True)
class Layer:
    """A strip or the terrain of a scene."""

    strip_id: str = scalar("strip; empty for the terrain", default="")
    shape: str = scalar("mark of the strip", default="")
    colour: str = scalar("CSS class of its colour", default="")
    path: str = scalar("outlines of its CCDs", default="")
    clip: str = scalar("id of the clip path of those outlines", default="")
    picture: str = scalar("data URI; empty if there is none")
    box: tuple[float, float, float, float] = scalar("x, y, width, height of the picture")


@record(kw_only=True)
class SceneView:
    """One scene on the sheet."""

    caption: str = scalar("its strips and place")
    x: float = scalar("left end")
    y: float = scalar("upper end, below the caption")
    terrain: Layer | None = scalar("shaded terrain")
    strips: tuple[Layer, ...] = scalar("strips in order of time")


@record(kw_only=True)
class SpotView:
    """One target on the sheet."""

    row: TargetCard = scalar("its row of the table")
    x: float = scalar("place")
    y: float = scalar("place")
    arrow: str = scalar("path of the residual's arrow; empty if there is none")
    is_cut: bool = scalar("the residual is longer than its arrow")
    number: str = scalar("number of its reason in the legend; empty if used")


@record(kw_only=True)
class MapView:
    """The whole map."""

    height: float = scalar("of the sheet; its width is 1000")
    metres: float = scalar("on the ground for one unit of the sheet")
    residual_metres: float = scalar("of a residual for one unit of its arrow")
    scenes: tuple[SceneView, ...] = scalar("scenes on it")
    spots: tuple[SpotView, ...] = scalar("targets on it, those not used on top")
    causes: tuple[tuple[str, str, int], ...] = scalar("number, reason and count of those not used")
    check_metres: float = scalar("of a check point's error for one unit of its arrow; 0 without any")
    checks: tuple[tuple[float, float, str, str], ...] = scalar("check points: x, y, arrow, words")
    words: str = scalar("description for screen readers")


def map_view(saved: Saved, rows: Sequence[TargetCard]) -> MapView | None:
    """The map, or None where no strip has a footprint."""
    scenes = saved.context["scenes"]
    if not scenes:
        return None
    boxes = np.array([scene["box_m"] for scene in scenes])
    size = np.max(boxes[:, 2:] - boxes[:, :2], axis=0)
    columns, scale = _layout(len(scenes), size)
    cell_w, cell_h = WIDTH / columns, size[1] * scale + CAPTION + GAP
    origins = []
    for n, (west, south, east, north) in enumerate(boxes):
        left = (n % columns) * cell_w + 0.5 * (cell_w - (east - west) * scale)
        top = (n // columns) * cell_h + CAPTION + 0.5 * (size[1] - (north - south)) * scale
        origins.append((left - west * scale, top + north * scale))
    causes = Counter(row.why or row.state for row in rows if row.state in (State.REJECTED, State.UNMATCHED))
    numbers = {cause: str(n) for n, (cause, _) in enumerate(causes.most_common(), start=1)}
    stretch = _stretch(column(saved.ground, "residual_m"))
    points = check_points_on_map(saved)
    own = _stretch(np.array([np.hypot(*point.error_m) for point in points]))

    def spot(row: TargetCard) -> SpotView:
        at = saved.ground.slice(row.row, 1).to_pylist()[0]
        ox, oy = origins[at["scene"]]
        x, y = ox + at["east_m"] * scale, oy - at["north_m"] * scale
        dx, dy = at["residual_east_m"] * stretch, -at["residual_north_m"] * stretch
        unused = row.state in (State.REJECTED, State.UNMATCHED)
        number = numbers.get(row.why or row.state, "") if unused else ""
        arrow, is_cut = _arrow(x, y, dx, dy), bool(np.hypot(dx, dy) > LONGEST)
        return SpotView(row=row, x=round(x, 2), y=round(y, 2), arrow=arrow, is_cut=is_cut, number=number)

    used = sum(1 for row in rows if row.state == "used")
    return MapView(
        height=round(-(-len(scenes) // columns) * cell_h, 1),
        metres=1.0 / scale,
        residual_metres=1.0 / stretch,
        scenes=tuple(_scene(saved, n, origin, scale) for n, origin in enumerate(origins)),
        spots=tuple(map(spot, reversed(rows))),
        causes=tuple((numbers[cause], cause, n) for cause, n in causes.most_common()),
        check_metres=1.0 / own if points else 0.0,
        checks=tuple(_check(point, origins[point.scene], scale, own) for point in points),
        words=f"Map of {count_words(len(strip_numbers(saved)), 'strip')} with "
        f"{count_words(len(rows), 'target')}, {used} used.",
    )


def _stretch(size_m: Floats) -> float:
    """Units of the sheet for a metre of arrow, such that nine of ten are no longer than `ARROW`."""
    usual = size_m[np.isfinite(size_m)]
    return ARROW * WIDTH / max(float(np.quantile(usual, 0.9)) if len(usual) else 1.0, 1e-9)


def _check(
    point: CheckPoint, origin: tuple[float, float], scale: float, stretch: float
) -> tuple[float, float, str, str]:
    x, y = origin[0] + point.place_m[0] * scale, origin[1] - point.place_m[1] * scale
    arrow = _arrow(x, y, point.error_m[0] * stretch, -point.error_m[1] * stretch)
    return round(x, 2), round(y, 2), arrow, point.words


def _layout(n: int, size_m: Any) -> tuple[int, float]:
    """Columns of the sheet and its scale (units per metre) that show `n` scenes largest."""
    best = (1, 0.0)
    for columns in range(1, n + 1):
        rows = -(-n // columns)
        width, height = WIDTH / columns - GAP, BEST_HEIGHT / rows - CAPTION - GAP
        scale = float(min(width / size_m[0], height / size_m[1]))
        if scale > best[1]:
            best = (columns, scale)
    return best if best[1] > 0.0 else (1, float((WIDTH - GAP) / size_m[0]))


def _scene(saved: Saved, number: int, origin: tuple[float, float], scale: float) -> SceneView:
    scene, order = saved.context["scenes"][number], strip_numbers(saved)
    pictures = {
        row["strip_id"]: (data_uri("image/jpeg", row["jpeg"]), _box(row["box_m"], origin, scale))
        for row in saved.map.to_pylist()
        if row["scene"] == number
    }
    outside = _box(scene["box_m"], origin, scale)
    strips = []
    for strip in scene["strips"]:
        shape, colour = strip_style(order[strip["id"]])
        path = "".join(_outline(outline, origin, scale) for outline in strip["outlines_m"])
        picture, box = pictures.get(strip["id"], ("", outside))
        clip = f"clip-{order[strip['id']]}"
        marks = {"shape": shape, "colour": colour, "path": path, "clip": clip}
        strips.append(Layer(strip_id=strip["id"], picture=picture, box=box, **marks))
    names = ", ".join(strip.strip_id for strip in strips[:4]) + (" …" if len(strips) > 4 else "")
    ns, ew = "NS"[scene["lat_deg"] < 0], "EW"[scene["lon_deg"] < 0]
    picture, box = pictures.get("", ("", outside))
    return SceneView(
        caption=f"{names}   {abs(scene['lat_deg']):.2f}° {ns}, {abs(scene['lon_deg']):.2f}° {ew}",
        x=round(outside[0], 1),
        y=round(outside[1], 1),
        terrain=Layer(picture=picture, box=box) if picture else None,
        strips=tuple(strips),
    )


def _box(
    box_m: Sequence[float], origin: tuple[float, float], scale: float
) -> tuple[float, float, float, float]:
    west, south, east, north = box_m
    x, y = origin[0] + west * scale, origin[1] - north * scale
    return round(x, 2), round(y, 2), round((east - west) * scale, 2), round((north - south) * scale, 2)


def _outline(points_m: Sequence[Sequence[float]], origin: tuple[float, float], scale: float) -> str:
    xy = [f"{origin[0] + e * scale:.1f} {origin[1] - n * scale:.1f}" for e, n in points_m]
    return f"M{'L'.join(xy)}Z"


def _arrow(x: float, y: float, dx: float, dy: float) -> str:
    """A line with a head from (x, y); nothing where the length is not known."""
    if not np.isfinite(dx + dy) or dx == dy == 0.0:
        return ""
    shown = min(1.0, LONGEST / float(np.hypot(dx, dy)))
    dx, dy = dx * shown, dy * shown
    (ax, ay), (bx, by) = ((-0.3 * dx - side * dy, -0.3 * dy + side * dx) for side in (0.14, -0.14))
    return f"M{x:.2f} {y:.2f}l{dx:.2f} {dy:.2f}l{ax:.2f} {ay:.2f}m{-ax:.2f} {-ay:.2f}l{bx:.2f} {by:.2f}"
