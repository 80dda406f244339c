"""Marks of strips in figures, tables and the map: a shape and a colour."""

from __future__ import annotations

__all__ = ["COLOURS", "SHAPES", "strip_style"]

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


def strip_style(number: int) -> tuple[str, str]:
    """Shape and CSS class of the colour of a strip, by its number; 24 strips differ in one or the other."""
    shapes = [shape for shape in SHAPES if shape not in ("plus", "cross")]
    return shapes[number % len(shapes)], f"s{number % COLOURS}"
