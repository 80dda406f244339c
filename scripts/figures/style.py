"""Two versions of a drawing, for light and for dark pages: `draw(NAME, paint)` writes NAME-light.svg and
NAME-dark.svg, with transparent ground and text as outlines, into docs/images or, with `python FIGURE.py
FOLDER`, into that folder.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

# Where pictures go: the folder that is named, or that of the pages.
IMAGES = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "docs" / "images"


@dataclass(frozen=True)
class Ink:
    """Colours of one version; they differ in brightness too, so that a grey print can be read."""

    text: str
    faint: str
    star: str  # what belongs to the star camera
    ground: str  # what belongs to the remote-sensing camera
    fill: str


LIGHT = Ink(text="#1b1f24", faint="#8a929b", star="#1f5fb0", ground="#c2570c", fill="#e6eaef")
DARK = Ink(text="#e8eaed", faint="#8f98a3", star="#8ab8ff", ground="#ffb27a", fill="#343a42")


def draw(name: str, paint: Callable[[Ink], Figure]) -> None:
    """Paint and write both versions."""
    for version, ink in (("light", LIGHT), ("dark", DARK)):
        settings = {
            "svg.fonttype": "path",
            "svg.hashsalt": name,
            "font.size": 11,
            "text.color": ink.text,
            "axes.labelcolor": ink.text,
            "axes.edgecolor": ink.faint,
            "xtick.color": ink.text,
            "ytick.color": ink.text,
        }
        with plt.rc_context(settings):
            figure = paint(ink)
            path = IMAGES / f"{name}-{version}.svg"
            figure.savefig(path, transparent=True, bbox_inches="tight", metadata={"Date": None})
            plt.close(figure)
        print(path, path.stat().st_size, "bytes")
