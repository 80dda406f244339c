"""Matplotlib figures as SVG with colours and fonts of the page: one drawing for light, dark and print.

Figures are drawn in placeholder colours that are then replaced by CSS variables. Curves also differ in dash
and marker, so they remain distinct in grey.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.transforms import ScaledTranslation, Transform

from boresight.geometry.record import Floats, record, scalar
from boresight.pipeline.report.marks import SHAPES
from boresight.pipeline.report.observations import SeenCard

__all__ = [
    "AXES",
    "FILL",
    "GRID",
    "INK",
    "MUTED",
    "WIDTH_IN",
    "Curve",
    "Drawing",
    "Ruled",
    "Spot",
    "axes_of",
    "drawn",
    "dress_axes",
    "new_figure",
    "rule_axes",
]

# Colours that stand for variables of the style sheet while a figure is drawn; of no meaning themselves.
INK, MUTED, GRID, FILL = "#010203", "#040506", "#070809", "#0a0b0c"
_X, _Y, _Z = "#0d0e0f", "#101112", "#131415"
# Variable of the page's style sheet by its mark.
_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--rule)",
    FILL: "var(--fill)",
    _X: "var(--x)",
    _Y: "var(--y)",
    _Z: "var(--z)",
}
# Width of a figure on the page, inches.
WIDTH_IN = 4.6
MARGINS_IN = (0.72, 0.2, 0.47, 0.1)  # left, right, bottom, top: room for ticks and labels
LABELS_IN = (0.53, 0.28)  # of axes with these margins: y label left of them, x label below
NUMBERS_PT = 7.0  # points (1/72 inch) from an axis to its numbers
MOST_INTERVALS = 5  # between ticks: more crowd a figure of this width


@record
class Curve:
    """Style of one axis of frame c in every plot."""

    name: str = scalar("X, Y or Z")
    colour: str = scalar("placeholder colour")
    dash: str = scalar("matplotlib line style")
    marker: str = scalar("matplotlib marker")


# Axes of frame c: label, colour, dash, marker.
AXES = (Curve("X", _X, "-", "o"), Curve("Y", _Y, "--", "s"), Curve("Z", _Z, ":", "^"))


@record
class Drawing:
    """One figure of a page."""

    svg: str = scalar("SVG element for the body of an HTML document")
    caption: str = scalar("text below the figure")
    words: str = scalar("description for screen readers")


@record(kw_only=True)
class Spot:
    """A mark of a figure that leads to the card of an observation."""

    axes: Axes = scalar("where it is drawn")
    x: float = scalar("in the axes' units")
    y: float = scalar("in the axes' units")
    link: str = scalar("id of the card")
    style: str = scalar("CSS classes: state and colour")
    shape: str = scalar("key of `SHAPES`")

    @classmethod
    def of(cls, row: SeenCard, axes: Axes, x: float, y: float) -> Spot:
        """The mark of a target or star at (x, y)."""
        style = f"{row.key} {row.colour}"
        return cls(axes=axes, x=float(x), y=float(y), link=row.link, style=style, shape=row.shape)


def new_figure(height_in: float, legend_in: float = 0.0) -> Figure:
    """An empty figure of the common width, `WIDTH_IN`, with `legend_in` of its height above the axes. Its
    margins are fixed: a layout computed from the labels takes two more drawings of everything.
    """
    figure = Figure(figsize=(WIDTH_IN, height_in))
    FigureCanvasSVG(figure)
    figure.patch.set_visible(False)
    left, right, bottom, top = MARGINS_IN
    figure.subplots_adjust(
        left=left / WIDTH_IN,
        right=1.0 - right / WIDTH_IN,
        bottom=bottom / height_in,
        top=1.0 - (top + legend_in) / height_in,
        hspace=0.12,
    )
    return figure


class Ruled(Axes):
    """Axes with a grid line and a number at each major tick, drawn without Matplotlib's ticks: these are five
    artists each, and take a third of the time of a report. An axis without a label has no numbers.
    """

    def draw(self, renderer: RendererBase) -> None:
        """Grid, numbers and labels below all else."""
        x, y = self.xaxis, self.yaxis
        self._rule(renderer, x, self.get_xaxis_transform(), self.get_xaxis_text1_transform(NUMBERS_PT))
        self._rule(renderer, y, self.get_yaxis_transform(), self.get_yaxis_text1_transform(NUMBERS_PT))
        super().draw(renderer)

    def _rule(
        self, renderer: RendererBase, axis: Axis, ends: Transform, text: tuple[Transform, Any, Any]
    ) -> None:
        low, high = sorted(axis.get_view_interval())
        at = [float(value) for value in axis.get_majorticklocs() if low <= value <= high]
        gaps: Floats = np.tile([0.0, 1.0, np.nan], len(at))
        line = [np.repeat(at, 3), gaps] if axis is self.xaxis else [gaps, np.repeat(at, 3)]
        Line2D(*line, color=GRID, linewidth=0.6, transform=ends).draw(renderer)
        if not (label := axis.get_label_text()):
            return
        form, (place, va, ha) = axis.get_major_formatter(), text
        number = Text(fontsize=8.5, color=INK, transform=place, va=va, ha=ha, figure=self.figure)
        for value, words in zip(at, form.format_ticks(at)):
            number.set(position=(value, 0.0) if axis is self.xaxis else (0.0, value), text=words)
            number.draw(renderer)
        common = form.get_offset()  # to be added to all numbers, or their factor
        axis.label.set_text(f"{label} ({common})" if common else label)
        axis.label.draw(renderer)


def axes_of(figure: Figure, x_label: str, y_label: str) -> Axes:
    """The single axes of a figure, ruled, with labels and placeholder colours."""
    axes = figure.add_subplot(axes_class=Ruled)
    rule_axes(axes, x_label, y_label)
    return axes


def rule_axes(axes: Axes, x_label: str, y_label: str) -> None:
    """Give `Ruled` axes (grid and numbers without ticks) their labels, placed in the margins, and the colours
    that the page replaces.
    """
    _dress(axes, x_label, y_label)
    left, below = LABELS_IN
    inches = axes.figure.dpi_scale_trans
    axes.yaxis.set_label_coords(0.0, 0.5, axes.transAxes + ScaledTranslation(-left, 0.0, inches))
    axes.xaxis.set_label_coords(0.5, 0.0, axes.transAxes + ScaledTranslation(0.0, -below, inches))
    axes.xaxis.set_visible(False)
    axes.yaxis.set_visible(False)


def dress_axes(axes: Axes, x_label: str, y_label: str) -> None:
    """Labels, grid and placeholder colours of axes with Matplotlib's own ticks."""
    _dress(axes, x_label, y_label)
    axes.tick_params(which="both", color=MUTED, labelcolor=INK, labelsize=8.5)
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)


def _dress(axes: Axes, x_label: str, y_label: str) -> None:
    axes.patch.set_visible(False)
    axes.set_xlabel(x_label, color=INK, fontsize=9)
    axes.set_ylabel(y_label, color=INK, fontsize=9)
    axes.locator_params(nbins=MOST_INTERVALS)
    for side, spine in axes.spines.items():
        spine.set_color(MUTED)
        spine.set_visible(side in ("left", "bottom"))


def drawn(figure: Figure, name: str, caption: str, words: str, spots: Sequence[Spot] = ()) -> Drawing:
    """The figure as a `Drawing`. `name` prefixes the SVG ids and must be unique on the page; `spots` are
    drawn above it.
    """
    out = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    svg = _for_html(out.getvalue(), name, words)
    if spots:
        svg = svg.replace("</svg>", "".join(_marked(figure, spot) for spot in spots) + "</svg>")
    return Drawing(svg, caption, words)


def _marked(figure: Figure, spot: Spot) -> str:
    """A mark in points from the upper left corner of the figure; the page's script makes it a link."""
    x, y = spot.axes.transData.transform((spot.x, spot.y)) * (72.0 / figure.dpi)
    place = f"translate({x:.2f} {72.0 * figure.get_figheight() - y:.2f}) scale(0.3)"
    shape = SHAPES[spot.shape]
    return f'<path class="dot {spot.style}" data-link="{spot.link}" transform="{place}" d="{shape}"></path>'


def _for_html(svg: str, name: str, words: str) -> str:
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'font: ([\d.]+)px [^;"]*', r"font-size: \1px", svg)
    for mark, variable in _VARIABLES.items():
        svg = svg.replace(mark, variable)
    box = re.search(r'viewBox="([^"]*)"', svg)
    assert box is not None
    title = f'<title id="{name}-words">{html.escape(words)}</title>'
    head = f'<svg viewBox="{box.group(1)}" role="img" aria-labelledby="{name}-words" class="plot">{title}'
    return head + _only_own_ids(svg[svg.index(">") + 1 :], name)


def _only_own_ids(body: str, name: str) -> str:
    """The SVG body with referenced ids prefixed by `name` and all other ids removed."""
    wanted = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', body))
    body = re.sub(r' id="([^"]*)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in wanted else "", body)
    return re.sub(r'(url\(#|href="#)([^)"]+)', rf"\g<1>{name}-\g<2>", body)
