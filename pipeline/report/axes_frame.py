"""Frames of axes as SVG: grid, ticks, their labels and the two axis lines.

Matplotlib says where ticks lie and how they are labelled. Its objects that draw them take two thirds of the
time of a figure, so that they are switched off (`Axes.set_axis_off`) and the same is written as text.
Lengths are in points from the figure's upper left corner.
"""

from __future__ import annotations

import html
from collections.abc import Iterator

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.figure import Figure

from boresight.geometry.record import record, scalar

__all__ = ["LABEL_PT", "NAME_PT", "FrameColours", "frame_svg"]

LABEL_PT, NAME_PT = 8.5, 9.0  # font sizes of ticks' labels and of an axis's name
GRID_WIDTH, LINE_WIDTH = 0.6, 0.8
GAP = 3.5  # between tick and label
NAME_GAP = 4.0  # between labels and name
TICKS = {"major": 3.5, "minor": 2.0}  # their lengths
ASCENT, DESCENT = 0.76, 0.24  # of the font, parts of its size
WIDTHS = {".": 0.318, "−": 0.838, "+": 0.838}  # of characters, parts of the font's size; of a digit: 0.636
SLACK = 1e-3  # of the axis's length: ticks at its very ends


@record
class FrameColours:
    """Colours of a frame."""

    line: str = scalar("axis lines and ticks")
    grid: str = scalar("grid")
    text: str = scalar("labels and names")


@record
class _Tick:
    at: float = scalar("place along the axis, from 0 at the left or lower end of the axes to 1")
    label: str = scalar("text; may be empty")


def frame_svg(figure: Figure, axes: Axes, colours: FrameColours) -> tuple[str, str]:
    """What lies below the content of a figure's axes (grid, ticks, texts), and what above it (axis lines).

    The figure has been drawn: axes of equal aspect have their final place.
    """
    to_pt, height = 72.0 / figure.dpi, 72.0 * figure.get_figheight()
    box = axes.get_window_extent()
    left, right, low, high = box.x0 * to_pt, box.x1 * to_pt, height - box.y0 * to_pt, height - box.y1 * to_pt
    grid, marks, texts = "", "", []
    widest = 0.0
    for which, length in TICKS.items():
        for tick in _ticks(axes.xaxis, which):
            x = left + tick.at * (right - left)
            grid += f"M{x:.2f} {low:.2f}V{high:.2f}" if which == "major" else ""
            marks += f"M{x:.2f} {low:.2f}v{length}"
            texts += _text(tick.label, x, low + length + GAP + ASCENT * LABEL_PT, "middle")
        for tick in _ticks(axes.yaxis, which):
            y = low + tick.at * (high - low)
            grid += f"M{left:.2f} {y:.2f}H{right:.2f}" if which == "major" else ""
            marks += f"M{left:.2f} {y:.2f}h{-length}"
            texts += _text(tick.label, left - length - GAP, y + 0.5 * ASCENT * LABEL_PT, "end")
            widest = max(widest, _width(tick.label))
    below = low + TICKS["major"] + (GAP + LABEL_PT if _labelled(axes.xaxis) else 0.0) + NAME_GAP
    beside = left - TICKS["major"] - (GAP + widest if widest else 0.0) - NAME_GAP
    offset_x, offset_y = (axis.get_major_formatter().get_offset() for axis in (axes.xaxis, axes.yaxis))
    texts += _text(offset_x, right, below + ASCENT * LABEL_PT, "end")
    texts += _text(offset_y, left, high - GAP, "start")
    names = _text(axes.get_xlabel(), 0.5 * (left + right), below + ASCENT * NAME_PT, "middle")
    names += _text(axes.get_ylabel(), beside - DESCENT * NAME_PT, 0.5 * (low + high), "middle", turned=True)
    family = html.escape(", ".join(f"'{name}'" for name in matplotlib.rcParams["font.sans-serif"]), False)
    written = "".join(
        f'<g style="font-family: {family}; font-size: {size}px; fill: {colours.text}">{"".join(lines)}</g>'
        for size, lines in ((LABEL_PT, texts), (NAME_PT, names))
    )
    return (
        _path(grid, colours.grid, GRID_WIDTH) + _path(marks, colours.line, LINE_WIDTH) + written,
        _path(f"M{left:.2f} {high:.2f}V{low:.2f}H{right:.2f}", colours.line, LINE_WIDTH),
    )


def _ticks(axis: Axis, which: str) -> Iterator[_Tick]:
    """The major or minor ticks within the axis, without labels where they are switched off."""
    major = which == "major"
    places = np.asarray(axis.get_majorticklocs() if major else axis.get_minorticklocs(), dtype=float)
    formatter = axis.get_major_formatter() if major else axis.get_minor_formatter()
    labels = formatter.format_ticks(places.tolist()) if _labelled(axis) else [""] * len(places)
    first, last = axis.get_transform().transform(np.asarray(axis.get_view_interval(), dtype=float))
    at = (axis.get_transform().transform(places) - first) / (last - first)
    for place, label in zip(at.tolist(), labels):
        if -SLACK <= place <= 1.0 + SLACK:
            yield _Tick(place, label)


def _labelled(axis: Axis) -> bool:
    side = "labelbottom" if isinstance(axis, XAxis) else "labelleft"
    return bool(axis.get_tick_params().get(side, True))


def _width(text: str) -> float:
    return LABEL_PT * sum(WIDTHS.get(letter, 0.636) for letter in text)


def _text(text: str, x: float, y: float, anchor: str, *, turned: bool = False) -> list[str]:
    """A line of text with its base line from, through or to (x, y); nothing without a text."""
    place = f'x="{x:.2f}" y="{y:.2f}"' + (f' transform="rotate(-90 {x:.2f} {y:.2f})"' if turned else "")
    return [f'<text style="text-anchor: {anchor}" {place}>{html.escape(text)}</text>'] if text else []


def _path(d: str, colour: str, width: float) -> str:
    return f'<path d="{d}" style="fill: none; stroke: {colour}; stroke-width: {width}"/>' if d else ""
