"""Targets of a strip: searched, measured and tested.

    search plan -> common rotation, if the installation matrix is uncertain by more than some pixels
    each target in each CCD: template at the common rotation -> position (`locate`) -> match or refusal
    matches -> do they agree on one rotation, beyond chance? (`consistency`)

Where the matrix predicts places within a window, these are looked at first; a common rotation is searched if
few targets are there, or if they lie far from their places. A target in the overlap of two CCDs is measured
in both. Every target that is not matched has a refusal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial

import numpy as np

from boresight.gct_match.consistency import consistent_matches
from boresight.gct_match.imaging.views import view_of
from boresight.gct_match.locate import locate
from boresight.gct_match.predict.scene import Scene
from boresight.gct_match.predict.template import Template, chip_points, chip_sides_px, predict_template
from boresight.gct_match.predict.trajectories import displacements
from boresight.gct_match.records import Chip, StripMatches, Target, TargetMatch, not_matched
from boresight.gct_match.search.coarse import read_window
from boresight.gct_match.search.common_rotation import Each, search_common_rotation
from boresight.gct_match.search.search_plan import SearchPlan, plan_search
from boresight.gct_match.search.vote import Vote
from boresight.gct_match.settings import MatchSettings
from boresight.gct_match.texture import expected_sigma_px
from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.pushbroom import Pushbroom
from boresight.records.ledger import Entry, Kind, Reason, State, Subject
from boresight.records.record import Floats, record

__all__ = ["keep_whole", "match_strip"]

Keep = Callable[[TargetMatch], TargetMatch]

_AT_ONCE = 64  # targets that are measured before their pictures are given to `keep`
_SPARE_PX = 8  # of the strip read around a search window: the filters' reach


def keep_whole(match: TargetMatch) -> TargetMatch:
    """The match with its pictures."""
    return match


def match_strip(scene: Scene, *, each: Each = map, keep: Keep = keep_whole) -> StripMatches:
    """Positions of a strip's targets, from an installation matrix wrong by up to `settings.sigmas` sigma.

    Parameters
    ----------
    scene : Scene
        Strip, model, targets with their chips, and settings: see `scene_of`.
    each : callable, optional
        Applies a function to parts of the work that can be done at once; default: one after another.
    keep : callable, optional
        Takes a match and returns what is kept of it, without its pictures for instance; default: all of it.

    Returns
    -------
    StripMatches
        A match or a refusal for every target, and the rotation on which the matches agree.

    Raises
    ------
    ValueError
        If targets and chips differ in order. Errors of `strip.read` are passed on.
    """
    if not scene.targets:
        return _no_matches((), 1.0)
    settings = scene.settings
    plan, refused = _feasible(scene, plan_search(scene))
    searched = sorted({window.target for window in plan.windows})
    uncertain = bool(plan.windows) and max(w.radius_px for w in plan.windows) > 2.0 * settings.margin_px + 2.0
    if not uncertain or _is_predicted(scene):
        prior = np.diag(scene.sigma_installation_rad**2)
        found = _found(scene, searched, np.zeros(3), prior, each, keep)
        if not uncertain or _is_confirmed(found, scene):
            return _matches(found, refused, 1.0)
    vote = search_common_rotation(scene, plan, each)
    found = _found(scene, searched, vote.parameters, vote.covariance, each, keep)
    log_chance = _log_chance(vote, found.matches, settings)
    if log_chance > np.log(settings.probability_chance):
        refused = [*refused, *_no_common_rotation(scene, searched, vote, len(found.matches), log_chance)]
        return _no_matches(tuple(refused), float(np.exp(log_chance)))
    return _matches(found, refused, float(np.exp(log_chance)))


@record
class _Found:
    """What was found of the targets of a strip at their predicted places."""

    matches: list[TargetMatch]  # those that agree with one another
    refused: list[Entry]
    theta: Floats  # (3,) rad, the matches' common rotation


def _found(
    scene: Scene, searched: Sequence[int], theta: Floats, covariance: Floats, each: Each, keep: Keep
) -> _Found:
    """Targets around the places predicted with a common rotation, (3,) rad, of a covariance (3, 3)."""
    found, not_found = _measured(scene, searched, theta, covariance, each, keep)
    matches, inconsistent, theta = consistent_matches(scene, found, theta)
    return _Found(matches, [*not_found, *inconsistent], theta)


def _is_predicted(scene: Scene) -> bool:
    """Whether the installation matrix predicts every place in the strip within the window of a target."""
    camera, (x, y, z) = scene.pushbroom.camera, scene.sigma_installation_rad.tolist()
    ends = [
        camera.directions_from_pixels(ccd, np.array([0.0, scene.strip.shape(ccd)[1] - 1.0]))
        for ccd in scene.strip.ccds
    ]
    turned = z * float(np.abs(np.concatenate(ends)[:, :2]).max())
    variance = (max(x, y) ** 2 + turned**2) / camera.pixel_rad**2
    return bool(_radii_px(scene, np.array([variance]))[0] <= 2 * scene.settings.margin_px)


def _is_confirmed(found: _Found, scene: Scene) -> bool:
    """Whether targets are where they were predicted: more than chance allows, or with those of other strips;
    more than half of those in view; and none so far away that others may lie outside their windows.
    """
    settings = scene.settings
    matched = {match.target_id for match in found.matches}
    missed = {
        refusal.subject.id for refusal in found.refused if refusal.state is not State.OUT_OF_VIEW
    } - matched
    by_chance = len(matched) * np.log(settings.probability_chance_match)
    if not matched or not (scene.is_known or by_chance <= np.log(settings.probability_chance)):
        return False
    farthest = max(float(np.abs(match.xy_px - match.predicted_px).max()) for match in found.matches)
    return len(matched) > len(missed) and farthest <= 0.5 * settings.margin_px


def _matches(found: _Found, refused: Sequence[Entry], chance: float) -> StripMatches:
    return StripMatches(
        matches=tuple(found.matches),
        refused=(*refused, *found.refused),
        theta_vote=found.theta,
        probability_chance=chance,
    )


def _of_target(refusal: Entry, target_id: str, ccd: int = -1) -> Entry:
    return replace(refusal, subject=Subject(Kind.TARGET, ccd=ccd, id=target_id))


def _feasible(scene: Scene, plan: SearchPlan) -> tuple[SearchPlan, list[Entry]]:
    """The plan without targets that cannot be matched, and their refusals."""
    refused, dropped = [], set()
    for n, (target, chip) in enumerate(zip(scene.targets, scene.chips)):
        if target.target_id != chip.target_id:
            raise ValueError(f"chip of {chip.target_id} in the place of that of {target.target_id}")
        refusal = _infeasible(target, chip, plan.sides_px.get(n), scene.settings)
        if refusal is not None:
            dropped.add(n)
            refused.append(_of_target(refusal, target.target_id))
    return replace(plan, windows=tuple(w for w in plan.windows if w.target not in dropped)), refused


def _infeasible(target: Target, chip: Chip, side_px: float | None, settings: MatchSettings) -> Entry | None:
    """Why a chip of `side_px` in the strip (None if outside) cannot be matched; None if it can."""
    if side_px is None:
        return not_matched(Reason.OUTSIDE_REACH)
    if side_px < settings.smallest_template_px:
        return not_matched(Reason.CHIP_TOO_SMALL, side_px, settings.smallest_template_px)
    rows, columns = chip.image.shape
    x, y = chip_points(chip, np.array([target.p_e] * 2))[0]  # of one-element arrays pyproj warns
    beyond = max(-0.5 - x, x - columns + 0.5, -0.5 - y, y - rows + 0.5)
    if not beyond <= 0.0:
        return not_matched(Reason.OUTSIDE_CHIP, beyond, 0.0, (columns, rows))
    per_px = min(chip.image.shape) / side_px  # pixels of the chip to one of the strip
    expected = expected_sigma_px(chip.image.astype(np.float32), chip.valid) / max(per_px, 1e-6)
    if not expected <= settings.sigma_px:
        return not_matched(Reason.TOO_LITTLE_TEXTURE, expected, settings.sigma_px)
    return None


def _log_chance(vote: Vote, matches: Sequence[TargetMatch], settings: MatchSettings) -> float:
    """Log of the probability that the vote and the matches to which it led happen by chance."""
    matched = len({match.target_id for match in matches})
    return vote.log_probability_chance + matched * float(np.log(settings.probability_chance_match))


def _no_common_rotation(
    scene: Scene, searched: Sequence[int], vote: Vote, matched: int, log_chance: float
) -> list[Entry]:
    """Entrys of all targets of a strip whose targets agree on no rotation."""
    more = (float(len(searched)), float(len(vote.supporters)), float(matched))
    chance, limit = float(np.exp(log_chance)), scene.settings.probability_chance
    refusal = not_matched(Reason.NO_COMMON_ROTATION, chance, limit, more)
    return [_of_target(refusal, scene.targets[n].target_id) for n in searched]


def _no_matches(refused: tuple[Entry, ...], chance: float) -> StripMatches:
    return StripMatches(matches=(), refused=refused, theta_vote=np.full(3, np.nan), probability_chance=chance)


def _measured(
    scene: Scene, searched: Sequence[int], theta: Floats, covariance: Floats, each: Each, keep: Keep
) -> tuple[list[TargetMatch], list[Entry]]:
    """Matches and refusals of targets in all CCDs, predicted with a common rotation."""
    model = scene.pushbroom.with_installation(deviation_from_theta(theta) * scene.pushbroom.R_cs)
    places: list[tuple[int, int, Floats, int, float]] = []  # target, CCD, (sample, line), radius, side
    for ccd in scene.strip.ccds:
        lines, samples = scene.strip.shape(ccd)
        xy_px = scene.trajectories.pixels(ccd, theta)
        end_px = np.array([samples, lines]) - 0.5
        here = [n for n in searched if ((xy_px[n] >= -0.5) & (xy_px[n] < end_px)).all()]
        if not here:
            continue
        radii = _search_radii_px(scene, model, here, ccd, xy_px, covariance)
        sides = chip_sides_px((scene.chips[n] for n in here), model, ccd, xy_px[here], scene.surface).tolist()
        places += [(n, ccd, xy_px[n], *of) for n, *of in zip(here, radii, sides)]
    matches, refused = [], []
    initial_px = {ccd: scene.trajectories.pixels(ccd, np.zeros(3)) for ccd in {ccd for _, ccd, *_ in places}}
    for first in range(0, len(places), _AT_ONCE):
        some = places[first : first + _AT_ONCE]
        for (n, ccd, *_), outcome in zip(some, each(partial(_measured_one, scene, model), some)):
            if isinstance(outcome, Entry):
                refused.append(_of_target(outcome, scene.targets[n].target_id, ccd))
            else:
                matches.append(keep(replace(outcome, predicted_px=initial_px[ccd][n])))
    seen = {n for n, *_ in places}
    unseen = [scene.targets[n].target_id for n in searched if n not in seen]
    refused += [_of_target(not_matched(Reason.OUTSIDE_CCDS), name) for name in unseen]
    return matches, refused


def _measured_one(
    scene: Scene, model: Pushbroom, place: tuple[int, int, Floats, int, float]
) -> TargetMatch | Entry:
    """Target n in one CCD, searched within `radius` px of `xy_px` (sample, line), where `model` predicts it,
    with a chip of `side_px`: these are the `place`.
    """
    n, ccd, xy_px, radius, side_px = place
    template = _template(scene, model, n, ccd, xy_px, side_px)
    if isinstance(template, Entry):
        return template
    (h, w), (x0, y0), spare = template.image.shape, template.origin_px, radius + _SPARE_PX
    lines, samples = scene.strip.shape(ccd)
    left, top = max(0, x0 - spare), max(0, y0 - spare)
    right, bottom = min(samples, x0 + w + spare), min(lines, y0 + h + spare)
    picture, valid = read_window(scene.strip, ccd, top, bottom, left, right, scene.settings)
    outcome = locate(
        view_of(template.image, template.valid),
        view_of(picture, valid),
        (x0 - left, y0 - top),
        radius,
        xy_px - template.origin_px,
        scene.settings,
    )
    if isinstance(outcome, Entry):
        return outcome
    of_template = {field.name: getattr(outcome, field.name) for field in fields(outcome)}
    found_px = outcome.xy_px + np.array([left, top])
    return TargetMatch(
        **of_template | {"xy_px": found_px},
        target_id=scene.targets[n].target_id,
        ccd=ccd,
        predicted_px=xy_px,
        expected_px=xy_px,
        residual_px=found_px - xy_px,
        template=template.image,
        place_px=xy_px - template.origin_px,
    )


def _search_radii_px(
    scene: Scene, model: Pushbroom, targets: Sequence[int], ccd: int, xy_px: Floats, covariance: Floats
) -> list[int]:
    """For each target three standard errors of the prediction: that of the common rotation and its own."""
    settings, at = scene.settings, list(targets)
    p_e = np.array([scene.targets[n].p_e for n in at])
    _, design = displacements(model, p_e, np.full(len(at), ccd), xy_px[at])
    radii = _radii_px(scene, np.einsum("nip,pq,niq->ni", design, covariance, design).max(axis=1))
    return np.clip(radii, settings.margin_px, 2 * settings.margin_px).astype(int).tolist()


def _radii_px(scene: Scene, variance_px2: Floats) -> Floats:
    """Three standard errors (N,) of places, px, of which a common rotation causes (N,) px²."""
    settings = scene.settings
    own_px2 = settings.consistency_sigma_px**2 + settings.attitude_sigma_px**2
    return np.ceil(3.0 * np.sqrt(variance_px2 + own_px2)) + 2.0


def _template(
    scene: Scene, model: Pushbroom, n: int, ccd: int, xy_px: Floats, side_px: float
) -> Template | Entry:
    """The predicted template around a target, as large as chip, strip and settings allow."""
    settings, chip = scene.settings, scene.chips[n]
    lines, samples = scene.strip.shape(ccd)
    half = 0.5 * min(float(settings.template_px), side_px)
    x0, y0 = np.maximum(np.round(xy_px - half), 0).astype(int).tolist()
    x1, y1 = int(min(round(xy_px[0] + half), samples)), int(min(round(xy_px[1] + half), lines))
    w, h = x1 - x0, y1 - y0
    if min(w, h) < settings.smallest_template_px:
        return not_matched(Reason.TEMPLATE_CUT, min(w, h), settings.smallest_template_px, (w, h))
    return predict_template(chip, model, ccd, (x0, y0), (h, w), scene.surface, settings)
