"""What a picture shows: a file of some size may still be an empty plot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from boresight.pipeline.report.panels import OURS, SERIES

FEWEST_PX = 60  # of a line or a few markers; antialiased edges do not count

SERIES_COLOURS = tuple(colour for colour, *_ in SERIES)
__all__ = ["OURS", "SERIES_COLOURS", "pixels_of_colour", "shows_curves"]


def pixels_of_colour(path: Path, colour: str) -> int:
    """Number of pixels of a PNG file that have a colour, to 2 of 255 levels."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        pixels = np.asarray(image.convert("RGB")).astype(int)
    return int((np.abs(pixels - np.round(255.0 * np.array(to_rgb(colour)))).max(axis=2) <= 2).sum())


def shows_curves(path: Path, *colours: str) -> bool:
    """Whether a plot has curves, bars or markers in each of these colours, beside frame and labels."""
    return all(pixels_of_colour(path, colour) >= FEWEST_PX for colour in colours)
