"""Targets found although the installation matrix is wrong by thousands of pixels: all of them at once.

Whatever the installation matrix is wrong by, it is one small rotation for the whole strip. Each target is
looked for in the part of the strip where that rotation could have put it, on a coarse picture read once;
its best few places are candidates, and the targets vote on the rotation. Targets are taken a few at a time
until the vote is beyond chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.predict.template import chip_side_px, predict_template
from boresight.gct_match.predict.trajectories import Paths, displacements
from boresight.gct_match.records import Chip, StripImage, Target
from boresight.gct_match.search.coarse import read_coarse
from boresight.gct_match.search.edge_search import (
    SearchPicture,
    SearchTemplate,
    best_places,
    search_picture,
    search_template,
)
from boresight.gct_match.search.vote import Candidates, Vote, log_chance_of_ranks, vote
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import Surface

__all__ = ["SearchPlan", "Window", "bootstrap", "plan_search", "pyramid_factor", "vote_tolerance_px"]

Array = NDArray[np.float64]

_NODES = 65  # places along a CCD at which the reach of the search is computed
_SUPPORTERS = 4  # targets that fix a rotation, even if one of them agrees with it by accident


@dataclass(frozen=True, slots=True)
class Window:
    """Where a target's own point may lie in one CCD."""

    target: int  # index into the strip's targets
    ccd: int
    lines: tuple[int, int]
    samples: tuple[int, int]

    @property
    def radius_px(self) -> float:
        return 0.5 * max(self.lines[1] - self.lines[0], self.samples[1] - self.samples[0])


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """What a search will read and hold, known before it starts."""

    windows: tuple[Window, ...]
    sides_px: dict[int, float]  # side of each target's chip in pixels of the strip
    factor: int  # pixels of the strip to one of the coarse picture
    pixels_to_read: int
    coarse_pixels: int


def plan_search(
    strip: StripImage,
    paths: Paths,
    chips: Sequence[Chip],
    surface: Surface,
    sigma_installation_rad: Array,
    settings: MatchSettings,
) -> SearchPlan:
    """Windows of all targets, and the coarsest picture in which their chips still show something."""
    windows = tuple(
        window
        for ccd in strip.ccds
        for window in _windows(ccd, strip.shape(ccd), paths, sigma_installation_rad, settings)
    )
    sides: dict[int, float] = {}
    for window in windows:
        if window.target not in sides:
            middle = _middle(window)
            sides[window.target] = chip_side_px(
                chips[window.target], paths.pushbroom, window.ccd, middle, surface
            )
    if not windows:
        return SearchPlan((), sides, 1, 0, 0)
    side = float(np.median(list(sides.values())))
    radius = max(window.radius_px for window in windows)
    factor = pyramid_factor(side, radius, settings)
    read = sum((b - a) * (d - c) for (a, b), (c, d) in _extents(strip, windows, side).values())
    while read / factor**2 > settings.coarse_pixels:
        factor *= 2
    return SearchPlan(windows, sides, factor, read, read // factor**2)


def pyramid_factor(side_px: float, radius_px: float, settings: MatchSettings) -> int:
    """Pixels to one of the coarsest picture in which a chip is large enough, and the search wide enough."""
    factor = 1
    while (
        side_px / (2 * factor) >= settings.coarse_template_px
        and radius_px / (2 * factor) >= 2 * settings.margin_px
    ):
        factor *= 2
    return factor


def vote_tolerance_px(factor: int, settings: MatchSettings) -> float:
    """How far a target's place on the coarse picture may lie from the common motion."""
    return factor + 2.0 * float(np.hypot(settings.consistency_sigma_px, settings.attitude_sigma_px))


def bootstrap(
    strip: StripImage,
    pushbroom: Pushbroom,
    targets: Sequence[Target],
    chips: Sequence[Chip],
    surface: Surface,
    sigma_installation_rad: Array,
    plan: SearchPlan,
    settings: MatchSettings,
) -> Vote:
    """The common rotation theta (3,), rad, against the installation matrix of `pushbroom`."""
    side = max(plan.sides_px.values())
    pictures = {}
    for ccd, (lines, samples) in _extents(strip, plan.windows, side).items():
        coarse = read_coarse(strip, ccd, lines, samples, plan.factor, settings)
        pictures[ccd] = _Picture(search_picture(coarse.image), coarse.origin_px)
    search = _Search(pushbroom, targets, chips, surface, settings, plan, pictures)
    order = search.in_order_of_texture()
    tolerance_px = vote_tolerance_px(plan.factor, settings)
    looks = _looks(len(order))  # each may end the search: chance has that many chances
    found: list[Candidates] = []
    outcome = Vote(np.zeros(3), np.diag(sigma_installation_rad**2), np.zeros(0, dtype=np.int64), 0.0)
    for first, last in zip([0, *looks], looks):
        found.append(search.candidates(order[first:last], tolerance_px))
        outcome = vote(
            _joined(found), sigma_installation_rad, settings.sigmas, tolerance_px, 0.5 * plan.factor
        )
        log_chance = min(outcome.log_probability_chance + np.log(len(looks)), 0.0)
        outcome = replace(outcome, log_probability_chance=log_chance)
        if log_chance < np.log(settings.probability_chance) and len(outcome.supporters) >= _SUPPORTERS:
            break
    return outcome


class _Search:
    """The strip's pictures and the templates that are looked for in them."""

    def __init__(
        self,
        pushbroom: Pushbroom,
        targets: Sequence[Target],
        chips: Sequence[Chip],
        surface: Surface,
        settings: MatchSettings,
        plan: SearchPlan,
        pictures: dict[int, _Picture],
    ) -> None:
        self.pushbroom, self.targets, self.chips, self.surface = pushbroom, targets, chips, surface
        self.settings, self.plan, self.pictures = settings, plan, pictures
        self.templates = {n: self._template(n) for n in sorted({w.target for w in plan.windows})}

    def in_order_of_texture(self) -> list[int]:
        """Targets with the most independent texture first."""
        texture = {n: float(np.sum(template.own**2)) for n, (template, _) in self.templates.items()}
        return sorted(texture, key=lambda n: -texture[n])

    def candidates(self, targets: Sequence[int], tolerance_px: float) -> Candidates:
        """The best places of some targets over all CCDs that they may lie in."""
        found = [self._places(n) for n in targets]
        owner = np.repeat(targets, [len(xy) for _, xy in found])
        p_e = np.array([target.p_e for target in self.targets])[owner]
        displacement, design = displacements(
            self.pushbroom, p_e, *(np.concatenate(part) for part in zip(*found, strict=True))
        )
        chance = [self._log_chance(n, len(xy), tolerance_px) for n, (_, xy) in zip(targets, found)]
        return Candidates(owner, displacement, design, np.concatenate(chance))

    def _log_chance(self, target: int, count: int, tolerance_px: float) -> Array:
        sides = [
            (w.lines[1] - w.lines[0], w.samples[1] - w.samples[0])
            for w in self.plan.windows
            if w.target == target
        ]
        area = sum(h * w for h, w in sides)
        return log_chance_of_ranks(count, np.pi * tolerance_px**2 / max(area, 1))

    def _template(self, target: int) -> tuple[SearchTemplate, Array]:
        """The template, and where in it the target's point lies, strip pixels from its first one."""
        windows = [w for w in self.plan.windows if w.target == target]
        window = max(windows, key=lambda w: (w.lines[1] - w.lines[0]) * (w.samples[1] - w.samples[0]))
        factor = self.plan.factor
        middle = _middle(window)
        model = _seeing_at(self.pushbroom, self.targets[target].p_e, window.ccd, middle)
        n = 4 * int(np.clip(self.plan.sides_px[target] / (4 * factor), 4, 24))
        origin = np.round(middle - 0.5 * n * factor).astype(int)
        template = predict_template(
            self.chips[target],
            model,
            window.ccd,
            (int(origin[0]), int(origin[1])),
            (n, n),
            self.surface,
            self.settings,
            stride=factor,
        )
        return search_template(np.where(template.valid, template.image, np.nan)), middle - origin

    def _places(self, target: int) -> tuple[NDArray[np.int64], Array]:
        """CCDs (K,) and pixels (K, 2) of a target's best places, best first."""
        template, offset_px = self.templates[target]
        windows = [window for window in self.plan.windows if window.target == target]
        pictures = [self.pictures[window.ccd] for window in windows]
        boxes = [self._box(window, offset_px) for window in windows]
        found = best_places(
            template, [picture.search for picture in pictures], boxes, self.settings.candidates
        )
        origin = np.array([picture.origin_px for picture in pictures]) + offset_px
        ccd = np.array([window.ccd for window in windows])
        return ccd[found.picture], found.xy * float(self.plan.factor) + origin[found.picture]

    def _box(self, window: Window, offset_px: Array) -> tuple[int, int, int, int]:
        """Where in its picture a template's first pixel lies if the target's point lies in a window."""
        shift = offset_px + self.pictures[window.ccd].origin_px
        corners = np.array([window.samples, window.lines]).T - shift
        (x0, y0), (x1, y1) = np.floor(corners / self.plan.factor).astype(int).tolist()
        return x0, y0, x1 + 1, y1 + 1


def _looks(targets: int) -> list[int]:
    """After how many targets to vote: as few as may end the search, then half as many again, up to all."""
    looks = [min(_SUPPORTERS, targets)]
    while looks[-1] < targets:
        looks.append(min(looks[-1] + looks[-1] // 2, targets))
    return looks


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """The part of a CCD that is searched, from `origin_px` (sample, line) on."""

    search: SearchPicture
    origin_px: tuple[int, int]


def _windows(
    ccd: int, shape: tuple[int, int], paths: Paths, sigma_rad: Array, settings: MatchSettings
) -> list[Window]:
    """Where a rotation of so many standard errors may have put each target: the box around what is within
    reach.
    """
    lines, samples = shape
    line, sample = np.clip(paths.lines, 0.0, lines - 1.0), np.linspace(0.0, samples - 1.0, _NODES)
    measured = paths.pushbroom.camera.directions_from_pixels(ccd, sample)
    out = []
    for n, predicted in enumerate(paths.u_c):
        miss = measured[None, :, :2] - predicted[:, None, :2]  # (line, sample, 2)
        far = np.abs(predicted[:, None, :2]).max(axis=2) * sigma_rad[2]
        reach_x = settings.sigmas * np.hypot(sigma_rad[1], far) + 1e-9
        reach_y = settings.sigmas * np.hypot(sigma_rad[0], far) + 1e-9
        step = np.abs(np.diff(predicted[:, 0])).max(), np.abs(np.diff(measured[:, 1])).max()
        inside = (np.abs(miss[:, :, 0]) <= reach_x + step[0]) & (np.abs(miss[:, :, 1]) <= reach_y + step[1])
        if not inside.any():
            continue
        rows, columns = np.nonzero(inside.any(axis=1))[0], np.nonzero(inside.any(axis=0))[0]
        out.append(
            Window(
                n,
                ccd,
                (int(line[max(rows[0] - 1, 0)]), int(line[min(rows[-1] + 1, len(line) - 1)]) + 1),
                (int(sample[max(columns[0] - 1, 0)]), int(sample[min(columns[-1] + 1, _NODES - 1)]) + 1),
            )
        )
    return out


def _extents(
    strip: StripImage, windows: Sequence[Window], side_px: float
) -> dict[int, tuple[tuple[int, int], tuple[int, int]]]:
    """(lines, samples) of each CCD that hold all its windows with half a chip around."""
    spare = int(0.75 * side_px) + 8
    out = {}
    for ccd in sorted({w.ccd for w in windows}):
        mine = [w for w in windows if w.ccd == ccd]
        lines, samples = strip.shape(ccd)
        out[ccd] = (
            (
                max(0, min(w.lines[0] for w in mine) - spare),
                min(lines, max(w.lines[1] for w in mine) + spare),
            ),
            (
                max(0, min(w.samples[0] for w in mine) - spare),
                min(samples, max(w.samples[1] for w in mine) + spare),
            ),
        )
    return out


def _seeing_at(pushbroom: Pushbroom, p_e: Array, ccd: int, xy_px: Array) -> Pushbroom:
    """The strip with its installation matrix turned so that a point is seen at a pixel (turn about z left
    alone).
    """
    measured = pushbroom.camera.directions_from_pixels(ccd, xy_px[:1])[0]
    predicted = pushbroom.directions_c(p_e[None], xy_px[1:])[0]
    axis = np.cross(predicted, measured)
    turn = axis / (np.linalg.norm(axis) + 1e-300) * np.arctan2(np.linalg.norm(axis), predicted @ measured)
    return pushbroom.with_installation(deviation_from_theta(-turn) * pushbroom.R_cs)


def _middle(window: Window) -> Array:
    return np.array([0.5 * sum(window.samples), 0.5 * sum(window.lines)])


def _joined(parts: Sequence[Candidates]) -> Candidates:
    return Candidates(
        np.concatenate([p.owner for p in parts]),
        np.concatenate([p.displacement_px for p in parts]),
        np.concatenate([p.design for p in parts]),
        np.concatenate([p.log_chance for p in parts]),
    )
