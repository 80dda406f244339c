"""Marks of strips in figures, tables and the map, a shape and a colour; and places for labels beside marks,
where none covers another label, a mark or a line.
"""

from __future__ import annotations

import numpy as np

from boresight.records.record import Floats

__all__ = ["COLOURS", "SHAPES", "line_boxes", "mark_boxes", "place_labels", "strip_style"]

COLOURS = 8  # of strips: --s0 to --s7 in style.css
SHAPES = {  # marks of strips, about 20 units wide
    "circle": "M-9 0A9 9 0 1 1 9 0A9 9 0 1 1-9 0Z",
    "square": "M-8-8H8V8H-8Z",
    "triangle": "M0-10.5L10 8H-10Z",
    "diamond": "M0-11.5L11.5 0L0 11.5L-11.5 0Z",
    "down": "M0 10.5L10-8H-10Z",
    "plus": "M-9 0H9M0-9V9",  # of no strip
    "cross": "M-7-7L7 7M-7 7L7-7",  # of a check point
    "hexagon": "M-5-9H5L10 0L5 9H-5L-10 0Z",
}
# Where a label may stand: side of its mark, and how much farther than the gap, in heights of the label; the
# first that is free is taken.
_SIDES = tuple(
    (np.array(side), farther)
    for farther in (0.0, 0.5)
    for side in ((1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1), (0, 1), (0, -1))
)
_DIAGONAL = 0.7  # of that distance, along x and along y, on a diagonal


def strip_style(number: int) -> tuple[str, str]:
    """Shape and CSS class of the colour of a strip, by its number; 24 strips differ in one or the other."""
    shapes = [shape for shape in SHAPES if shape not in ("plus", "cross")]
    return shapes[number % len(shapes)], f"s{number % COLOURS}"


def place_labels(points: Floats, sizes: Floats, gap: float | Floats, frame: Floats, taken: Floats) -> Floats:
    """Centres (N, 2) of labels, the first labels first; NaN where one finds no room.

    Labels of width and height `sizes` (N, 2) stand at a `gap` (N,) from the middles of their marks, `points`
    (N, 2), inside the picture `frame` (4,), smallest x and y, largest x and y, and cover no box of `taken`
    (M, 4). All in units of the picture.
    """
    places = np.full((len(points), 2), np.nan)
    gaps = np.broadcast_to(gap, len(points))
    for n, (point, size) in enumerate(zip(points, sizes)):
        for side, farther in _SIDES:
            away = (gaps[n] + farther * size[1]) * (_DIAGONAL if side.all() else 1.0)
            centre = point + side * (0.5 * size + away)
            box = np.concatenate([centre - 0.5 * size, centre + 0.5 * size])
            inside = (box[:2] >= frame[:2]).all() and (box[2:] <= frame[2:]).all()
            covers = (box[:2] < taken[:, 2:]).all(axis=1) & (box[2:] > taken[:, :2]).all(axis=1)
            if inside and not covers.any():
                places[n] = centre
                taken = np.vstack([taken, box])
                break
    return places


def mark_boxes(points: Floats, half: float | Floats) -> Floats:
    """Squares (N, 4) about points (N, 2), of the given half side or sides (N,)."""
    half = np.broadcast_to(half, len(points))[:, None]
    return np.column_stack([points - half, points + half])


def line_boxes(start: Floats, end: Floats, half: float) -> Floats:
    """Squares (N, 4) that cover straight lines from `start` (M, 2) to `end` (M, 2)."""
    boxes: list[Floats] = [np.zeros((0, 4))]
    for one, other in zip(start, end):
        count = int(np.ceil(np.hypot(*(other - one)) / half)) + 1
        boxes.append(mark_boxes(one + np.linspace(0.0, 1.0, count)[:, None] * (other - one), half))
    return np.vstack(boxes)
