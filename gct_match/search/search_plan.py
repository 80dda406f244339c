"""Search plan: where in each CCD a target may lie, and how coarse a picture the search takes.

Both follow from the uncertainty of the installation matrix, before any pixel of the strip is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.predict.scene import Scene
from boresight.gct_match.predict.template import chip_sides_px
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.line_camera import StripImage
from boresight.records.record import Floats, Ints, record, scalar

__all__ = ["Box", "SearchPlan", "Window", "extents", "plan_search", "pyramid_factor"]

Range = tuple[int, int]  # first, and one past the last

Box = tuple[int, Range, Range]  # CCD, lines, samples

_GRID = 64  # px: blocks of all coarse pictures end there
_NODES = 65  # samples along a CCD at which the search range is computed


@record
class Window:
    """Where a target's surveyed point may lie in one CCD."""

    target: int = scalar("index into the strip's targets")
    ccd: int = scalar("CCD")
    lines: Range = scalar("first line, and one past the last")
    samples: Range = scalar("first sample, and one past the last")

    @property
    def radius_px(self) -> float:
        """Half of the longer side."""
        return 0.5 * max(self.lines[1] - self.lines[0], self.samples[1] - self.samples[0])

    @property
    def area_px2(self) -> int:
        """Lines times samples."""
        return (self.lines[1] - self.lines[0]) * (self.samples[1] - self.samples[0])

    @property
    def middle_px(self) -> Floats:
        """(2,) (sample, line) of its middle."""
        return np.array([0.5 * sum(self.samples), 0.5 * sum(self.lines)])


@record
class SearchPlan:
    """What a search reads and holds in memory, known before it starts."""

    windows: tuple[Window, ...] = scalar("search windows of all targets in all CCDs")
    sides_px: dict[int, float] = scalar("side of each target's chip in pixels of the strip")
    factor: int = scalar("pixels of the strip to one of the coarse picture, along a side")


def plan_search(scene: Scene) -> SearchPlan:
    """Search windows of all targets, and the coarsest picture in which their chips still show edges."""
    strip, settings = scene.strip, scene.settings
    windows: tuple[Window, ...] = ()
    sides: dict[int, float] = {}
    for ccd in strip.ccds:
        windows += (here := tuple(_windows(scene, ccd)))
        if new := [w for w in here if w.target not in sides]:
            chips, middles = (scene.chips[w.target] for w in new), np.array([w.middle_px for w in new])
            found = chip_sides_px(chips, scene.pushbroom, ccd, middles, scene.surface)
            sides |= {w.target: side for w, side in zip(new, found.tolist())}
    usable = [side for side in sides.values() if side >= settings.smallest_template_px]
    if not usable:
        return SearchPlan(windows, sides, 1)
    side = float(np.median(usable))
    factor = pyramid_factor(side, max(w.radius_px for w in windows), settings)
    read = sum(map(_area, set(extents(strip, windows, side))))
    while read / factor**2 > settings.coarse_pixels:
        factor *= 2
    return SearchPlan(windows, sides, factor)


def pyramid_factor(side_px: float, radius_px: float, settings: MatchSettings) -> int:
    """Pixels to one of the coarsest picture in which a chip of `side_px` is large enough and the search over
    ±`radius_px` wide enough; a power of two.
    """
    factor = 1
    while (
        side_px / (2 * factor) >= settings.coarse_template_px
        and radius_px / (2 * factor) >= 2 * settings.margin_px
    ):
        factor *= 2
    return factor


def extents(strip: StripImage, windows: Sequence[Window], side_px: float) -> list[Box]:
    """What to read for each window, with half a chip of `side_px` around it: a box for all windows of a CCD,
    or one for each where these have fewer pixels.
    """
    spare = int(0.75 * side_px) + 8
    out: dict[int, Box] = {}
    for ccd in sorted({w.ccd for w in windows}):
        here = [w for w in windows if w.ccd == ccd]
        whole = _box_around(here, strip.shape(ccd), spare)
        own = [_on_grid(_box_around([w], strip.shape(ccd), spare), whole) for w in here]
        in_parts = sum(map(_area, own)) < _area(whole)
        out |= {id(w): box if in_parts else whole for w, box in zip(here, own)}
    return [out[id(w)] for w in windows]


def _box_around(windows: Sequence[Window], shape: tuple[int, int], spare: int) -> Box:
    lines, samples = shape
    first = windows[0].ccd
    return (
        first,
        _around([w.lines for w in windows], spare, lines),
        _around([w.samples for w in windows], spare, samples),
    )


def _on_grid(box: Box, whole: Box) -> Box:
    """The box begun earlier, by whole blocks of `_GRID` px from the beginning of a box around it."""
    ccd, *ranges = box
    lines, samples = (
        (begin + (first - begin) // _GRID * _GRID, last)
        for (first, last), (begin, _) in zip(ranges, whole[1:])
    )
    return ccd, lines, samples


def _area(box: Box) -> int:
    _, (first, last), (left, right) = box
    return (last - first) * (right - left)


def _around(ranges: Sequence[Range], spare: int, length: int) -> Range:
    """The range 0..length cut to what holds all ranges with `spare` around them."""
    return max(0, min(a for a, _ in ranges) - spare), min(length, max(b for _, b in ranges) + spare)


def _windows(scene: Scene, ccd: int) -> list[Window]:
    """Windows in one CCD: boxes around the pixels that a rotation within `sigmas` standard errors reaches."""
    lines, samples = scene.strip.shape(ccd)
    trajectories, sigma = scene.trajectories, scene.sigma_installation_rad
    own = scene.pushbroom.rows.lines_of_rows(ccd, trajectories.rows)
    line, sample = np.clip(own, 0.0, lines - 1.0), np.linspace(0.0, samples - 1.0, _NODES)
    measured = scene.pushbroom.camera.directions_from_pixels(ccd, sample)
    out = []
    for n, predicted in enumerate(trajectories.u_c):
        off = np.abs(measured[None, :, :2] - predicted[:, None, :2])  # (line, sample, 2)
        about_z = np.abs(predicted[:, None, :2]).max(axis=2) * sigma[2]
        reach_x = scene.settings.sigmas * np.hypot(sigma[1], about_z) + 1e-9
        reach_y = scene.settings.sigmas * np.hypot(sigma[0], about_z) + 1e-9
        step = np.abs(np.diff(predicted[:, 0])).max(), np.abs(np.diff(measured[:, 1])).max()
        inside = (off[:, :, 0] <= reach_x + step[0]) & (off[:, :, 1] <= reach_y + step[1])
        if not inside.any():
            continue
        rows, columns = np.nonzero(inside.any(axis=1))[0], np.nonzero(inside.any(axis=0))[0]
        first, last = _nodes_around(rows, len(own))
        if own[last] >= -0.5 and own[first] <= lines - 0.5:  # a CCD may begin later than others
            out.append(Window(n, ccd, _bounds(line, rows), _bounds(sample, columns)))
    return out


def _bounds(nodes: NDArray[Any], inside: Ints) -> Range:
    """Range between the nodes before the first and after the last one inside."""
    first, last = _nodes_around(inside, len(nodes))
    return int(nodes[first]), int(nodes[last]) + 1


def _nodes_around(inside: Ints, count: int) -> Range:
    """Index of the node before the first and of the one after the last inside, of `count` nodes."""
    return max(int(inside[0]) - 1, 0), min(int(inside[-1]) + 1, count - 1)
