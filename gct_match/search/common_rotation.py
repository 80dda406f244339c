"""Common rotation of a strip whose installation matrix is wrong by up to thousands of pixels.

The error of the installation matrix is one small rotation for the whole strip.

    strip -> coarse edge pictures, read once
    target -> template on the coarse grid -> its best positions in the search windows: candidates
    candidates of a few targets -> vote on the rotation; more targets, until the vote is beyond chance
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from boresight.gct_match.predict.scene import Scene
from boresight.gct_match.predict.template import predict_template
from boresight.gct_match.predict.trajectories import displacements
from boresight.gct_match.search import edge_search
from boresight.gct_match.search.coarse import read_coarse
from boresight.gct_match.search.search_plan import Box, SearchPlan, Window, extents
from boresight.gct_match.search.vote import Candidates, Vote, log_chance_of_ranks, vote
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.line_camera import StripImage
from boresight.geometry.pushbroom import Pushbroom
from boresight.records.record import Floats, Ints, record

__all__ = ["Each", "search_common_rotation", "vote_tolerance_px"]

Each = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]  # as `map`, perhaps by many at once
_SUPPORTERS = 4  # targets that determine a rotation even if one of them agrees by accident


@record
class _Picture:
    """A part of a CCD that is searched, from `origin_px` (sample, line) on."""

    search: edge_search.SearchPicture
    origin_px: tuple[int, int]


@record
class _Template:
    """A target's template on the coarse grid, and its search windows."""

    search: edge_search.SearchTemplate
    point_px: Floats  # (2,) target's surveyed point, strip pixels from the template's first one
    windows: tuple[Window, ...]


def vote_tolerance_px(factor: int, settings: MatchSettings) -> float:
    """Largest distance, px, of a supporting candidate from the common motion, on a picture of `factor`."""
    return factor + 2.0 * float(np.hypot(settings.consistency_sigma_px, settings.attitude_sigma_px))


def search_common_rotation(scene: Scene, plan: SearchPlan, each: Each = map) -> Vote:
    """The rotation theta (3,), rad, on which most targets agree: R_cs = exp[[theta]] R_cs0.

    Its covariance, the supporting targets and the probability of so good an agreement by chance come with it.
    `each` reads the parts of the strip.
    """
    settings, sigma = scene.settings, scene.sigma_installation_rad
    pictures = _coarse_pictures(scene, plan, each)
    windows = defaultdict[int, list[Window]](list)
    for window in plan.windows:
        windows[window.target].append(window)
    templates = {n: _template(scene, plan, n, tuple(windows[n])) for n in sorted(windows)}
    texture = {n: float(np.sum(template.search.own**2)) for n, template in templates.items()}
    order = sorted(texture, key=lambda n: -texture[n])
    tolerance_px = vote_tolerance_px(plan.factor, settings)
    sizes = _vote_sizes(len(order))
    found: list[Candidates] = []
    for first, last in zip([0, *sizes], sizes):
        chosen = {n: templates[n] for n in order[first:last]}
        found.append(_candidates(scene, plan.factor, chosen, pictures, tolerance_px))
        outcome = vote(_joined(found), sigma, settings.sigmas, tolerance_px, 0.5 * plan.factor)
        # each vote may end the search: chance has as many opportunities
        log_chance = min(outcome.log_probability_chance + np.log(len(sizes)), 0.0)
        outcome = replace(outcome, log_probability_chance=log_chance)
        if log_chance < np.log(settings.probability_chance) and len(outcome.supporters) >= _SUPPORTERS:
            break
    return outcome


def _coarse_pictures(scene: Scene, plan: SearchPlan, each: Each) -> dict[tuple[int, int], _Picture]:
    """The searched parts of the CCDs, each read once, by target and CCD."""
    boxes = extents(scene.strip, plan.windows, max(plan.sides_px.values()))
    parts = list(dict.fromkeys(boxes))
    read = dict(zip(parts, each(partial(_picture, scene.strip, plan.factor, scene.settings), parts)))
    return {(w.target, w.ccd): read[box] for w, box in zip(plan.windows, boxes)}


def _picture(strip: StripImage, factor: int, settings: MatchSettings, box: Box) -> _Picture:
    coarse = read_coarse(strip, *box, factor, settings)
    return _Picture(edge_search.search_picture(coarse.image), coarse.origin_px)


def _template(scene: Scene, plan: SearchPlan, target: int, windows: tuple[Window, ...]) -> _Template:
    """A target's template as seen in the middle of its largest window."""
    largest = max(windows, key=lambda w: w.area_px2)
    factor, middle, ccd = plan.factor, largest.middle_px, largest.ccd
    model = _seeing_at(scene.pushbroom, scene.targets[target].p_e, ccd, middle)
    side = 4 * int(np.clip(plan.sides_px[target] / (4 * factor), 4, 24))
    origin = np.round(middle - 0.5 * side * factor).astype(int)
    x, y = origin.tolist()
    template = predict_template(
        scene.chips[target], model, ccd, (x, y), (side, side), scene.surface, scene.settings, stride=factor
    )
    image = np.where(template.valid, template.image, np.nan)
    return _Template(edge_search.search_template(image), middle - origin, windows)


def _candidates(
    scene: Scene,
    factor: int,
    templates: dict[int, _Template],
    pictures: dict[tuple[int, int], _Picture],
    tolerance_px: float,
) -> Candidates:
    """Candidate positions of some targets over all CCDs in which they may lie."""
    ccds, positions, owners, chances = [], [], [], []
    for target, template in templates.items():
        ccd, xy_px = _best_positions(template, pictures, factor, scene.settings.candidates)
        area = sum(w.area_px2 for w in template.windows)
        ccds.append(ccd)
        positions.append(xy_px)
        owners.append(np.full(len(xy_px), target))
        chances.append(log_chance_of_ranks(len(xy_px), np.pi * tolerance_px**2 / max(area, 1)))
    owner = np.concatenate(owners)
    p_e = np.array([target.p_e for target in scene.targets])[owner]
    displacement, design = displacements(
        scene.pushbroom, p_e, np.concatenate(ccds), np.concatenate(positions)
    )
    return Candidates(owner, displacement, design, np.concatenate(chances))


def _best_positions(
    template: _Template, pictures: dict[tuple[int, int], _Picture], factor: int, count: int
) -> tuple[Ints, Floats]:
    """CCDs (K,) and pixels (K, 2) of a target's surveyed point at its best positions, best first."""
    shown = [pictures[w.target, w.ccd] for w in template.windows]
    shifts = np.array([p.origin_px for p in shown]) + template.point_px
    boxes = [_box(w, shift, factor) for w, shift in zip(template.windows, shifts)]
    found = edge_search.best_positions(template.search, [p.search for p in shown], boxes, count)
    ccd = np.array([w.ccd for w in template.windows])
    return ccd[found.picture], found.xy * float(factor) + shifts[found.picture]


def _box(window: Window, shift_px: Floats, factor: int) -> tuple[int, int, int, int]:
    """Pixels of the coarse picture where the template's first pixel lies if its point lies in the window."""
    corners = np.array([window.samples, window.lines]).T - shift_px
    (x0, y0), (x1, y1) = np.floor(corners / factor).astype(int).tolist()
    return x0, y0, x1 + 1, y1 + 1


def _vote_sizes(targets: int) -> list[int]:
    """Numbers of targets after which to vote: the fewest that may decide, then half as many more, to all."""
    sizes = [min(_SUPPORTERS, targets)]
    while sizes[-1] < targets:
        sizes.append(min(sizes[-1] + sizes[-1] // 2, targets))
    return sizes


def _seeing_at(pushbroom: Pushbroom, p_e: Floats, ccd: int, xy_px: Floats) -> Pushbroom:
    """The model with its installation matrix rotated, about an axis normal to the view, so that a point is
    seen at a pixel.
    """
    measured = pushbroom.camera.directions_from_pixels(ccd, xy_px[:1])[0]
    predicted = pushbroom.directions_c(p_e[None], pushbroom.rows.rows_of_lines(ccd, xy_px[1:]))[0]
    axis = np.cross(predicted, measured)
    angle = np.arctan2(np.linalg.norm(axis), predicted @ measured)
    theta = -axis / (np.linalg.norm(axis) + 1e-300) * angle
    return pushbroom.with_installation(deviation_from_theta(theta) * pushbroom.R_cs)


def _joined(parts: Sequence[Candidates]) -> Candidates:
    return Candidates(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Candidates)))
