"""Figures as SVG with colours and fonts of the page: one drawing for light, dark and print.

Lengths are points (1/72 inch); places in a figure count from its upper left corner, to the right and down.
Colours are variables of the page's style sheet. Curves also differ in dash and marker, so they remain
distinct in grey.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from boresight.pipeline.report.marks import SHAPES
from boresight.pipeline.report.observations import SeenCard, data_uri
from boresight.records.record import Floats, record, scalar

__all__ = [
    "AXES",
    "DASHED",
    "FILL",
    "INK",
    "MUTED",
    "PLAIN",
    "WIDTH_IN",
    "Axis",
    "Curve",
    "Drawing",
    "Figure",
    "Panel",
    "Pen",
    "Spot",
    "drawn",
]

INK, MUTED, GRID, FILL = "var(--ink)", "var(--muted)", "var(--rule)", "var(--fill)"
DASHED, DOTTED = "6 3", "1.5 2.5"  # dash and gap of a line, pt
WIDTH_IN = 4.6  # of a figure on the page, inches
MARGINS = (52.0, 14.0, 34.0, 7.0)  # left, right, below, above: room for numbers and labels
NUMBER_PT, LABEL_PT, KEY_PT = 8.5, 9.0, 8.0  # sizes of texts
ROW_PT, SAMPLE_PT, HEAD_PT = 11.0, 20.0, 3.0  # row of a legend, sample of a line in it, head of an arrow
INTERVALS, NARROW_PT = 5, 150.0  # between numbers of an axis: more crowd it; fewer in a panel less wide
SIDE_MARGIN = 0.05  # of the span of values, beyond them on either side
FARTHEST = 9999.0  # a place farther than this is cut off anyway
SMALLEST = 1e-300  # of an axis with equal ratios
CLIP = "CLIP-"  # stands for the figure's name in the ids of its edges
MARKERS = {
    "o": "m-2 0a2 2 0 1 1 4 0a2 2 0 1 1-4 0z",
    ".": "m-.7 0a.7 .7 0 1 1 1.4 0a.7 .7 0 1 1-1.4 0z",
    "s": "m-2-2h4v4h-4z",
    "^": "m0-2.3l2.2 4.3h-4.4z",
    "+": "m-4 0h8m-4-4v8",
    "x": "m-2-2l4 4m0-4l-4 4",
    "_": "m-3 0h6",
}


@record(kw_only=True)
class Pen:
    """How a line or a mark is drawn."""

    colour: str = scalar("of the line", default=INK)
    width: float = scalar("of the line, pt", default=1.0)
    dash: str = scalar("lengths of dash and gap, pt; empty: solid", default="")
    fill: str = scalar("colour of the area; none: not filled", default="none")


PLAIN = Pen()


@record
class Curve:
    """Style of one axis of frame c in every plot."""

    name: str = scalar("X, Y or Z")
    colour: str = scalar("variable of the style sheet")
    dash: str = scalar("lengths of dash and gap, pt; empty: solid")
    marker: str = scalar("key of `MARKERS`")


AXES = (
    Curve("X", "var(--x)", "", "o"),
    Curve("Y", "var(--y)", DASHED, "s"),
    Curve("Z", "var(--z)", DOTTED, "^"),
)


@record
class Drawing:
    """One figure of a page."""

    svg: str = scalar("SVG element for the body of an HTML document")
    caption: str = scalar("text below the figure")
    words: str = scalar("description for screen readers")


@record
class Axis:
    """One axis of a panel, from its left or lower end to the other."""

    label: str = scalar("what it counts; empty: it has no numbers", default="")
    low: float = scalar("value at its begin", default=0.0)
    high: float = scalar("value at its end; may be the smaller one", default=1.0)
    is_log: bool = scalar("whether equal ratios are equally long", default=False)
    is_whole: bool = scalar("whether only whole numbers are values", default=False)

    @staticmethod
    def over(label: str, values: Any, *, is_log: bool = False) -> Axis:
        """An axis that holds all finite values; of one with equal ratios the positive ones."""
        every = np.asarray(values, dtype=float).ravel()
        found = every[np.isfinite(every) & ((every > 0.0) | (not is_log))]
        low, high = (float(found.min()), float(found.max())) if len(found) else (0.1, 1.0)
        if is_log:
            more = max((high / low) ** SIDE_MARGIN, 1.05)
            return Axis(label, low / more, high * more, is_log=True)
        margin = SIDE_MARGIN * (high - low) or 0.5 * abs(high) or 1.0
        return Axis(label, low - margin, high + margin)

    def shares(self, values: Any) -> Floats:
        """How far along the axis values (N,) lie: 0 at its begin, 1 at its end."""
        low, high, at = (np.asarray(one, dtype=float) for one in (self.low, self.high, values))
        if self.is_log:
            low, high, at = (np.log10(np.maximum(one, SMALLEST)) for one in (low, high, at))
        return np.asarray((at - low) / (high - low))

    def numbers(self, most: int) -> tuple[list[float], list[str], str]:
        """Values that have a number, with some `most` intervals between them; the numbers; and the label with
        the factor that all of them have.
        """
        low, high = sorted((self.low, self.high))
        first, last = np.log10([low, high]) if self.is_log else (0.0, 0.0)
        if last - first > 1.0:  # of less the numbers are as on other axes
            steps = (1.0, 2.0, 5.0) if last - first < 0.5 * most else (1.0,)
            apart = int(np.ceil((last - first) / (1.5 * most)))
            every = np.outer(10.0 ** np.arange(np.floor(first), last + 1.0)[::apart], steps).ravel()
            at = every[(every >= low) & (every <= high)]
            return at.tolist(), [f"{value:g}" for value in at], self.label
        finest = max((high - low) / most, float(self.is_whole))
        power = 10.0 ** np.floor(np.log10(finest))
        step = next(n for n in (1.0, 2.0, 2.5, 5.0, 10.0) if n * power >= finest) * power
        at = step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1.0)
        largest = int(np.floor(np.log10(max(abs(low), abs(high)))))
        factor = 0 if -3 < largest < 5 else largest
        decimals = max(0, factor - int(np.floor(np.log10(step) + 1e-9)) + (step == 2.5 * power))
        texts = [f"{value / 10.0**factor + 0.0:.{decimals}f}".replace("-", "−") for value in at]
        return at.tolist(), texts, f"{self.label} (1e{factor})" if factor else self.label


class Figure:
    """Panels on a sheet of the common width; what is drawn first lies below."""

    def __init__(self, height_in: float, above: float = 0.0) -> None:
        """`above` is room over the panels, pt, for a legend or titles."""
        self.width, self.height = 72.0 * WIDTH_IN, 72.0 * height_in
        left, right, below, top = MARGINS
        self.area = left, self.width - right, top + above, self.height - below
        self.parts: list[str] = []
        self.panels: list[Panel] = []

    def panel(
        self, x: Axis, y: Axis, place: Sequence[float] = (0.0, 1.0, 0.0, 1.0), aspect: float = 0.0
    ) -> Panel:
        """A panel at shares of the area: left, right, top, bottom. With `aspect`, the length of a unit of y
        for one of x, the axis that has more room is extended.
        """
        left, right, top, bottom = self.area
        width, height = right - left, bottom - top
        box = (
            left + place[0] * width,
            left + place[1] * width,
            top + place[2] * height,
            top + place[3] * height,
        )
        if aspect:
            wider = abs((box[1] - box[0]) * aspect / (x.high - x.low) * (y.high - y.low) / (box[3] - box[2]))
            x, y = _extended(x, wider), _extended(y, 1.0 / wider)
        self.panels.append(Panel(self, box, x, y))
        return self.panels[-1]

    def cell(self, n: int, rows: int, columns: int, gaps: tuple[float, float]) -> tuple[float, ...]:
        """Place of the panel `n` of rows and columns of them, with gaps beside and below each, pt."""
        left, right, top, bottom = self.area
        at, shares = divmod(n, columns)[::-1], list[float]()
        for number, count, gap, span in zip(at, (columns, rows), gaps, (right - left, bottom - top)):
            step = (span + gap) / count
            shares += [number * step / span, ((number + 1) * step - gap) / span]
        return tuple(shares)

    def text(
        self, x: float, y: float, words: str, size: float, anchor: str = "middle", more: str = ""
    ) -> None:
        """Words whose baseline is at a place."""
        style = f'font-size="{size:g}" text-anchor="{anchor}"{more}'
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" {style}>{html.escape(words)}</text>')

    def path(self, d: str, pen: Pen, more: str = "") -> None:
        """A path, drawn with a pen."""
        dash = f";stroke-dasharray:{pen.dash}" if pen.dash else ""
        style = f"fill:{pen.fill};stroke:{pen.colour};stroke-width:{pen.width:g}{dash}"
        self.parts.append(f'<path d="{d}" style="{style}"{more}/>')


class Panel:
    """A rectangle of a figure with two axes. What is drawn in it is in their units, and cut at its edges."""

    def __init__(self, figure: Figure, box: tuple[float, float, float, float], x: Axis, y: Axis) -> None:
        self.figure, self.box, self.x, self.y = figure, box, x, y
        self.keys: list[tuple[str, str, Pen]] = []  # of the legend: label, marker, pen
        self._cut = f' clip-path="url(#{CLIP}{len(figure.panels)})"'
        if x.label or y.label:
            self._rule()

    def _rule(self) -> None:
        """Grid, numbers and labels."""
        figure, (left, right, top, bottom) = self.figure, self.box
        most = INTERVALS if right - left > NARROW_PT else INTERVALS - 1
        (x, texts_x, label_x), (y, texts_y, label_y) = self.x.numbers(most), self.y.numbers(most)
        across = self.at(x, np.full(len(x), self.y.low))[:, 0].tolist()
        down = self.at(np.full(len(y), self.x.low), y)[:, 1].tolist()
        grid = [f"M{at:.1f} {top:.1f}V{bottom:.1f}" for at in across]
        grid += [f"M{left:.1f} {at:.1f}H{right:.1f}" for at in down]
        figure.path("".join(grid), Pen(colour=GRID, width=0.6))
        figure.path(f"M{left:.1f} {top:.1f}V{bottom:.1f}H{right:.1f}", Pen(colour=MUTED, width=0.8))
        for at, words in zip(across, texts_x if label_x else ()):
            figure.text(at, bottom + 11.0, words, NUMBER_PT)
        for at, words in zip(down, texts_y if label_y else ()):
            figure.text(left - 5.0, at + 3.0, words, NUMBER_PT, "end")
        beside, middle = left - 38.0, 0.5 * (top + bottom)
        figure.text(0.5 * (left + right), bottom + 26.0, label_x, LABEL_PT)
        turned = f' transform="rotate(-90 {beside:.1f} {middle:.1f})"'
        figure.text(beside, middle, label_y, LABEL_PT, more=turned)

    def at(self, x: Any, y: Any) -> Floats:
        """Places (N, 2) in the figure of x and y (N,)."""
        left, right, top, bottom = self.box
        across, down = left + (right - left) * self.x.shares(x), bottom - (bottom - top) * self.y.shares(y)
        return np.clip(np.column_stack([across, down]), -FARTHEST, FARTHEST)

    def line(self, x: Any, y: Any, pen: Pen = PLAIN, label: str = "") -> None:
        """A line through points (N,); in the legend if it has a label."""
        self._pieces([self.at(x, y)], pen)
        self._in_legend(label, "", pen)

    def marks(self, x: Any, y: Any, marker: str, pen: Pen = PLAIN, label: str = "") -> None:
        """A mark, a key of `MARKERS`, at each point (N,)."""
        points = self.at(x, y)
        d = "".join(f"M{_place(point)}{MARKERS[marker]}" for point in points[np.isfinite(points).all(axis=1)])
        self.figure.path(d, pen, self._cut)
        self._in_legend(label, marker, pen)

    def bars(self, x: Any, low: Any, high: Any, pen: Pen = PLAIN) -> None:
        """Vertical bars at x (N,) from `low` to `high` (N,)."""
        self._pieces(np.stack([self.at(x, low), self.at(x, high)], axis=1), pen)

    def level(self, y: float, dash: str = "") -> None:
        """A line across the panel."""
        self.line([self.x.low, self.x.high], [y, y], Pen(colour=MUTED, dash=dash))

    def band(self, low: float, high: float) -> None:
        """The area between two levels."""
        x = np.array([self.x.low, self.x.high])[[0, 1, 1, 0]]
        self.line(x, [low, low, high, high], Pen(colour="none", fill=FILL))

    def words(self, place: Floats, text: str) -> None:
        """A text beside a place (2,)."""
        (x, y), *_ = self.at(place[:1], place[1:]).tolist()
        self.figure.text(x, y + 0.35 * KEY_PT, text, KEY_PT, "start")

    def steps(self, edges: Any, values: Any, pen: Pen, *, is_turned: bool = False) -> None:
        """A histogram: values (N,) between edges (N + 1,) of x, or of y."""
        along, out = np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(values, 2), [0.0]])
        self.line(*((out, along) if is_turned else (along, out)), pen)

    def arrows(self, start: Floats, end: Floats, pen: Pen = PLAIN) -> None:
        """Arrows from points (N, 2) to points (N, 2)."""
        start, end = self.at(*start.T), self.at(*end.T)
        length = np.maximum(np.linalg.norm(end - start, axis=1), 1e-6)[:, None]
        back = np.minimum(0.4 * length, HEAD_PT) / length * (start - end)
        side = 0.5 * back[:, ::-1] * [1.0, -1.0]
        self._pieces(np.stack([start, end, end + back + side, end, end + back - side], axis=1), pen)

    def picture(self, values: Floats, low: float, high: float) -> None:
        """Values (H, W) over the whole panel, `low` black and `high` white."""
        grey = np.round(255.0 * np.clip((values - low) / (high - low), 0.0, 1.0)).astype(np.uint8)
        uri = data_uri("image/png", cv2.imencode(".png", grey)[1].tobytes())
        left, right, top, bottom = self.box
        box = f'x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}"'
        how = 'preserveAspectRatio="none" style="image-rendering:pixelated"'
        self.figure.parts.append(f'<image {box} {how} href="{uri}"/>')

    def title(self, *rows: str) -> None:
        """Words above the panel, the last row next to it."""
        left, right, top, _ = self.box
        for n, words in enumerate(reversed(rows)):
            self.figure.text(0.5 * (left + right), top - 5.0 - ROW_PT * n, words, LABEL_PT)

    def legend(self, *, at_left: bool = False, columns: int = 0) -> None:
        """The labels of what was drawn: in the upper right or left corner, or above in so many columns."""
        left, right, top, _ = self.box
        rows, step = -(-len(self.keys) // max(columns, 1)), (right - left) / max(columns, 1)
        is_start, first = at_left or columns > 0, top - 6.0 - ROW_PT * (rows - 1) if columns else top + 8.0
        for n, (label, marker, pen) in enumerate(self.keys):
            column, row = divmod(n, rows)
            x, y = left + column * step if is_start else right - SAMPLE_PT, first + ROW_PT * row
            mark = f"m{0.5 * SAMPLE_PT:g} 0{MARKERS[marker]}" if marker else f"h{SAMPLE_PT:g}"
            self.figure.path(f"M{x:.1f} {y:.1f}{mark}", replace(pen, fill=pen.fill if marker else "none"))
            beside, anchor = (x + SAMPLE_PT + 4.0, "start") if is_start else (x - 4.0, "end")
            self.figure.text(beside, y + 3.0, label, KEY_PT, anchor)

    def _in_legend(self, label: str, marker: str, pen: Pen) -> None:
        if label:
            self.keys.append((label, marker, pen))

    def _pieces(self, pieces: Any, pen: Pen) -> None:
        """Lines (M, N, 2) in one path."""
        known = [points[np.isfinite(points).all(axis=1)] for points in pieces]
        self.figure.path(
            "".join("M" + "L".join(map(_place, points)) for points in known if len(points)), pen, self._cut
        )


@record(kw_only=True)
class Spot:
    """A mark of a figure that leads to the card of an observation."""

    axes: Panel = scalar("where it is drawn")
    x: float = scalar("in the axes' units")
    y: float = scalar("in the axes' units")
    link: str = scalar("id of the card")
    style: str = scalar("CSS classes: state and colour")
    shape: str = scalar("key of `SHAPES`")

    @classmethod
    def of(cls, row: SeenCard, axes: Panel, x: float, y: float) -> Spot:
        """The mark of a target or star at (x, y)."""
        style = f"{row.key} {row.colour}"
        return cls(axes=axes, x=float(x), y=float(y), link=row.link, style=style, shape=row.shape)


def drawn(figure: Figure, name: str, caption: str, words: str, spots: Sequence[Spot] = ()) -> Drawing:
    """The figure as a `Drawing`. `name` prefixes the SVG ids and must be unique on the page; `spots` are
    drawn above it.
    """
    clips = [
        f'<clipPath id="{CLIP}{n}"><rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}"'
        f' height="{bottom - top:.1f}"/></clipPath>'
        for n, (left, right, top, bottom) in enumerate(panel.box for panel in figure.panels)
    ]
    body = "".join([*clips, *figure.parts]).replace(CLIP, f"{name}-cut-")
    head = f'<svg viewBox="0 0 {figure.width:g} {figure.height:g}" role="img" class="plot"'
    title = f'<title id="{name}-words">{html.escape(words)}</title>'
    marks = "".join(map(_marked, spots))
    return Drawing(f'{head} aria-labelledby="{name}-words">{title}{body}{marks}</svg>', caption, words)


def _marked(spot: Spot) -> str:
    """A mark of a figure; the page's script makes it a link."""
    place = f"translate({_place(spot.axes.at([spot.x], [spot.y])[0])}) scale(0.3)"
    link = f'class="dot {spot.style}" data-link="{spot.link}"'
    return f'<path {link} transform="{place}" d="{SHAPES[spot.shape]}"></path>'


def _place(point: Floats) -> str:
    return f"{point[0]:.2f} {point[1]:.2f}"


def _extended(axis: Axis, times: float) -> Axis:
    """The axis about its middle, so many times as long, if that is longer."""
    middle, half = 0.5 * (axis.low + axis.high), 0.5 * (axis.high - axis.low) * max(times, 1.0)
    return replace(axis, low=middle - half, high=middle + half)
