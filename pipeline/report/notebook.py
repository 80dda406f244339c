"""What a notebook shows: a calibration with its verdict, matrix and map, and how far a running one is."""

from __future__ import annotations

import html
import sys
from typing import Any

import numpy as np

from boresight.pipeline.run.stage_words import stage_words
from boresight.records.record import Bools, Floats

__all__ = ["calibration_html", "notebook_progress"]

# Colours on which white letters can be read, by the verdict; any other is refuted.
COLOURS = {"consistent": "#1a7f37"} | dict.fromkeys(("consistent, findings", "not checkable"), "#8a5a00")
REFUTED, KEPT, REJECTED = "#b3261e", "#2f81f7", "#e5534b"
MAP_PX, MARGIN_PX = 240.0, 10.0


def calibration_html(
    verdict: str, sentence: str, rows: list[tuple[str, str, Floats]], lon_lat_deg: Floats, kept: Bools
) -> str:
    """The sentence on the verdict's colour, a table of rows about X, Y, Z (name, format, values (3,)), and
    targets at `lon_lat_deg` (N, 2) on a map, if any: which are `kept` (N,).
    """
    colour = COLOURS.get(verdict, REFUTED)
    head = f'<div style="background:{colour};color:#fff;padding:.3em .6em;border-radius:4px">'
    axes = "".join(f"<th>{axis}</th>" for axis in "XYZ")
    body = "".join(
        f"<tr><th>{html.escape(name)}</th>"
        + "".join(f"<td>{value:{form}}</td>" for value in values)
        + "</tr>"
        for name, form, values in rows
    )
    table = f"<table><thead><tr><th></th>{axes}</tr></thead><tbody>{body}</tbody></table>"
    shown = f'<div style="display:flex;flex-wrap:wrap;gap:1em">{table}{_map(lon_lat_deg, kept)}</div>'
    return f"{head}<b>{html.escape(sentence)}</b></div>{shown}"


def _map(lon_lat_deg: Floats, kept: Bools) -> str:
    """Targets, north up: those kept as discs, those rejected as rings; empty without any."""
    if not len(lon_lat_deg):
        return ""
    at = lon_lat_deg * [np.cos(np.radians(lon_lat_deg[:, 1].mean())), -1.0]
    at = at - at.min(axis=0)
    at *= MAP_PX / max(float(at.max()), 1e-9)
    width, height = at.max(axis=0) + 2.0 * MARGIN_PX
    marks = "".join(
        f'<circle cx="{x + MARGIN_PX:.1f}" cy="{y + MARGIN_PX:.1f}" r="3" stroke-width="1.5" '
        + (f'fill="{KEPT}"></circle>' if used else f'fill="none" stroke="{REJECTED}"></circle>')
        for (x, y), used in zip(at.tolist(), kept.tolist())
    )
    words = f"Map of {len(kept)} sightings of targets, {int(kept.sum())} used"
    size = f'width="{width:.0f}" height="{height:.0f}"'
    return f'<svg {size} role="img" aria-label="{words}"><title>{words}</title>{marks}</svg>'


class notebook_progress:
    """A listener to progress that draws a bar in a notebook and does nothing elsewhere."""

    def __init__(self) -> None:
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        self._in_notebook = shell is not None and "IPKernelApp" in shell.config
        self._bar: Any = None

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        """Draw that `done` of `total` tasks of a stage are done."""
        if not self._in_notebook:
            return
        from IPython.display import HTML, display  # present in a notebook

        of = "" if total is None else f' value="{done}" max="{total}"'
        words = html.escape(stage_words(stage))
        drawn = HTML(f"<progress{of}></progress> {words}: {done} of {'?' if total is None else total}")
        if self._bar is None:
            self._bar = display(drawn, display_id=True)
        else:
            self._bar.update(drawn)
