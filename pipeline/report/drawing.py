"""Matplotlib figures as SVG that takes its colours and fonts from the page: one drawing for light, dark and
paper.

Colours are drawn as marks that no figure uses by chance and are replaced by CSS variables afterwards. Curves
differ in dash and marker too, so that they can be told apart in grey.
"""

from __future__ import annotations

import html
import io
import re
from dataclasses import dataclass

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

__all__ = ["AXES", "FILL", "GRID", "INK", "MUTED", "Curve", "Drawing", "axes_of", "drawn", "new_figure"]

INK, MUTED, GRID, FILL = "#010203", "#040506", "#070809", "#0a0b0c"
_X, _Y, _Z = "#0d0e0f", "#101112", "#131415"
_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--rule)",
    FILL: "var(--fill)",
    _X: "var(--x)",
    _Y: "var(--y)",
    _Z: "var(--z)",
}
WIDTH_IN = 4.6


@dataclass(frozen=True, slots=True)
class Curve:
    """How one axis of frame c is drawn everywhere."""

    name: str
    colour: str
    dash: str
    marker: str


AXES = (Curve("X", _X, "-", "o"), Curve("Y", _Y, "--", "s"), Curve("Z", _Z, ":", "^"))


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure of the page: SVG for the body of an HTML document, caption, and what it shows in words."""

    svg: str
    caption: str
    words: str


def new_figure(height_in: float) -> Figure:
    """An empty figure as wide as all others."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_visible(False)
    return figure


def axes_of(figure: Figure, x_label: str, y_label: str) -> Axes:
    """The figure's one set of axes, dressed."""
    axes = figure.add_subplot()
    axes.patch.set_visible(False)
    axes.set_xlabel(x_label, color=INK, fontsize=9)
    axes.set_ylabel(y_label, color=INK, fontsize=9)
    axes.tick_params(which="both", color=MUTED, labelcolor=INK, labelsize=8.5)
    for side, spine in axes.spines.items():
        spine.set_color(MUTED)
        spine.set_visible(side in ("left", "bottom"))
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


def drawn(figure: Figure, name: str, caption: str, words: str) -> Drawing:
    """The finished drawing. `name` must be the page's only figure of that name."""
    out = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return Drawing(_for_html(out.getvalue(), name, words), caption, words)


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
    """Ids that something refers to, made the page's only ones of that name; the others go."""
    wanted = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', body))
    body = re.sub(r' id="([^"]*)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in wanted else "", body)
    return re.sub(r'(url\(#|href="#)([^)"]+)', rf"\g<1>{name}-\g<2>", body)
