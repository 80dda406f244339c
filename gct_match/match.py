"""A strip's targets: found, placed and judged.

    within reach?  ->  bootstrap, if the installation matrix is not known to some pixels  ->  each target
    in each CCD: template at the common rotation -> correlation in a small window -> least-squares places
    of the best peaks -> refusal, or a match  ->  do the matches agree on one rotation, beyond chance?

A target in the overlap of two CCDs is placed in both. Whatever is refused is listed with its reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.views import view_of
from boresight.gct_match.locate import locate
from boresight.gct_match.predict.template import Template, chip_side_px, predict_template
from boresight.gct_match.predict.trajectories import Paths, displacements, target_paths
from boresight.gct_match.records import (
    Chip,
    Evidence,
    Reason,
    Refusal,
    StripImage,
    StripMatches,
    Target,
    TargetMatch,
)
from boresight.gct_match.search.bootstrap import SearchPlan, bootstrap, plan_search
from boresight.gct_match.search.coarse import read_window
from boresight.gct_match.search.vote import Vote
from boresight.gct_match.settings import MatchSettings
from boresight.gct_match.texture import expected_sigma_px
from boresight.geometry.installation import deviation_from_theta, theta_from_deviation
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import Surface

__all__ = ["match_strip"]

Array = NDArray[np.float64]

_GATE = 4.0  # standard errors by which a match may miss where the others put it


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A strip and everything known about it."""

    strip: StripImage
    pushbroom: Pushbroom
    targets: Sequence[Target]
    chips: Sequence[Chip]
    surface: Surface
    settings: MatchSettings
    paths: Paths


def match_strip(
    strip: StripImage,
    pushbroom: Pushbroom,
    targets: Sequence[Target],
    chips: Sequence[Chip],
    surface: Surface,
    sigma_installation_rad: Array,
    settings: MatchSettings,
) -> StripMatches:
    """Place all targets of a strip whose installation matrix is wrong by up to `settings.sigmas` standard
    errors.

    Parameters
    ----------
    pushbroom : Pushbroom
        The rigorous model at the present installation matrix.
    targets, chips : sequences of one length and order
        Chip n shows the ground around target n.
    surface : Surface
        Ellipsoidal heights of the ground between the targets.
    sigma_installation_rad : (3,) array
        1-sigma of the rotation by which the installation matrix may be wrong, about the axes of frame c.

    Raises
    ------
    ValueError
        If targets and chips do not belong together. Errors of `strip.read` are passed on.
    """
    if [t.target_id for t in targets] != [c.target_id for c in chips]:
        raise ValueError(
            f"{len(targets)} targets and {len(chips)} chips do not belong to one another in order"
        )
    sigma = np.asarray(sigma_installation_rad, dtype=float)
    if not targets or not strip.ccds:
        return _nothing((), 1.0, 0)
    lines = max(strip.shape(ccd)[0] for ccd in strip.ccds)
    pushbroom = pushbroom.tabulated(-0.5, lines - 0.5)
    paths = target_paths(pushbroom, np.array([t.p_e for t in targets]), lines)
    scene = _Scene(strip, pushbroom, targets, chips, surface, settings, paths)
    plan = plan_search(strip, paths, chips, surface, sigma, settings)
    plan, refused = _worth_a_search(scene, plan)
    within = sorted({window.target for window in plan.windows})
    theta: Array = np.zeros(3)
    covariance: Array = np.diag(sigma**2)
    outcome, read = None, 0
    if plan.windows and max(window.radius_px for window in plan.windows) > 2.0 * settings.margin_px + 2.0:
        outcome = bootstrap(strip, pushbroom, targets, chips, surface, sigma, plan, settings)
        theta, covariance, read = outcome.parameters, outcome.covariance, plan.pixels_to_read
    found, more, pixels = _fine(scene, within, theta, covariance)
    matches, inconsistent, theta, covariance = _consistent(scene, found, theta, sigma)
    log_chance = 0.0 if outcome is None else _log_chance(outcome, matches, settings)
    if outcome is not None and log_chance > np.log(settings.probability_chance):
        return _no_vote(scene, within, refused, outcome, len(matches), log_chance, read + pixels)
    refused = [*refused, *more, *inconsistent]
    return StripMatches(
        matches=tuple(matches),
        refused=tuple(refused),
        theta_vote=theta,
        cov_theta_vote=covariance,
        probability_chance=float(np.exp(log_chance)),
        pixels_read=read + pixels,
    )


def _worth_a_search(scene: _Scene, plan: SearchPlan) -> tuple[SearchPlan, list[Refusal]]:
    """The plan without targets that nothing could place, and those, with the reason."""
    refused, bland = [], set()
    within = {window.target for window in plan.windows}
    for n, target in enumerate(scene.targets):
        if n not in within:
            refused.append(Refusal(Reason.OUTSIDE_REACH, target_id=target.target_id))
            continue
        chip, limit = scene.chips[n], scene.settings.sigma_px
        per_px = min(chip.image.shape) / max(plan.sides_px[n], 1.0)  # pixels of the chip in one of the strip
        expected = expected_sigma_px(chip.image.astype(np.float32), chip.valid) / max(per_px, 1e-6)
        if not expected <= limit:
            bland.add(n)
            refused.append(Refusal(Reason.TOO_LITTLE_TEXTURE, expected, limit, target_id=target.target_id))
    return replace(plan, windows=tuple(w for w in plan.windows if w.target not in bland)), refused


def _log_chance(outcome: Vote, matches: Sequence[TargetMatch], settings: MatchSettings) -> float:
    """Log of the chance of the vote and of the places that were found because of it."""
    placed = len({match.target_id for match in matches})
    return outcome.log_probability_chance + placed * float(np.log(settings.chance_of_a_place))


def _no_vote(
    scene: _Scene,
    within: Sequence[int],
    refused: Sequence[Refusal],
    outcome: Vote,
    placed: int,
    log_chance: float,
    read: int,
) -> StripMatches:
    """A strip whose targets agree on nothing."""
    chance, allowed = np.exp(log_chance), scene.settings.probability_chance
    more = (float(len(within)), float(len(outcome.supporters)), float(placed))
    refusal = Refusal(Reason.NO_COMMON_ROTATION, float(chance), allowed, more)
    every = [*refused, *(replace(refusal, target_id=scene.targets[n].target_id) for n in within)]
    return _nothing(tuple(every), float(chance), read)


def _nothing(refused: tuple[Refusal, ...], chance: float, read: int) -> StripMatches:
    nan = np.full(3, np.nan)
    return StripMatches(
        matches=(),
        refused=refused,
        theta_vote=nan,
        cov_theta_vote=np.diag(nan) + np.nan,
        probability_chance=chance,
        pixels_read=read,
    )


def _fine(
    scene: _Scene, within: Sequence[int], theta: Array, covariance: Array
) -> tuple[list[tuple[int, TargetMatch]], list[Refusal], int]:
    """All targets in all CCDs, near where the common rotation puts them."""
    model = scene.pushbroom.with_installation(deviation_from_theta(theta) * scene.pushbroom.R_cs)
    seen: set[int] = set()
    found, refused, pixels = [], [], 0
    for ccd in scene.strip.ccds:
        lines, samples = scene.strip.shape(ccd)
        now, before = scene.paths.pixels(ccd, theta), scene.paths.pixels(ccd, np.zeros(3))
        sample, line = now.T
        inside = (sample >= -0.5) & (sample < samples - 0.5) & (line >= -0.5) & (line < lines - 0.5)
        for n in within:
            if not inside[n]:
                continue
            seen.add(n)
            outcome, read = _one(scene, model, n, ccd, now[n], before[n], covariance)
            pixels += read
            if isinstance(outcome, Refusal):
                refused.append(outcome)
            else:
                found.append((n, outcome))
    refused += [
        Refusal(Reason.OUTSIDE_CCDS, target_id=scene.targets[n].target_id) for n in within if n not in seen
    ]
    return found, refused, pixels


def _one(
    scene: _Scene, model: Pushbroom, n: int, ccd: int, xy_px: Array, before_px: Array, covariance: Array
) -> tuple[TargetMatch | Refusal, int]:
    """One target in one CCD, predicted at `xy_px`; and how many pixels were read."""
    settings, name = scene.settings, scene.targets[n].target_id
    _, design = displacements(model, scene.targets[n].p_e[None], np.array([ccd]), xy_px[None])
    alone_px2 = settings.consistency_sigma_px**2 + settings.attitude_sigma_px**2
    spread = design[0] @ covariance @ design[0].T + alone_px2 * np.eye(2)
    radius = int(
        np.clip(
            np.ceil(3.0 * np.sqrt(np.diag(spread).max())) + 2.0, settings.margin_px, 2 * settings.margin_px
        )
    )
    template = _template(scene, model, n, ccd, xy_px, radius)
    if isinstance(template, Refusal):
        return template, 0
    h, w = template.image.shape
    x0, y0 = template.origin_px
    lines, samples = scene.strip.shape(ccd)
    left, top = max(0, x0 - radius - 8), max(0, y0 - radius - 8)
    right, bottom = min(samples, x0 + w + radius + 8), min(lines, y0 + h + radius + 8)
    picture, valid = read_window(scene.strip, ccd, top, bottom, left, right, settings)
    reference = xy_px - template.origin_px
    placed = locate(
        view_of(template.image, template.valid),
        view_of(picture, valid),
        (x0 - left, y0 - top),
        radius,
        reference,
        settings,
    )
    if isinstance(placed, Refusal):
        return replace(placed, target_id=name, ccd=ccd), picture.size
    found = placed.xy_px + np.array([left, top])
    match = TargetMatch(
        target_id=name,
        ccd=ccd,
        xy_px=found,
        cov_px=placed.cov_px,
        correlation=placed.correlation,
        probability_wrong=placed.probability_wrong,
        model="affine" if placed.affine.any() else "translation",
        predicted_px=before_px,
        residual_px=found - xy_px,
        evidence=Evidence(
            template.image,
            placed.found,
            placed.residual,
            placed.surface,
            np.array(template.origin_px, dtype=float),
        ),
    )
    return match, picture.size


def _template(
    scene: _Scene, model: Pushbroom, n: int, ccd: int, xy_px: Array, radius: int
) -> Template | Refusal:
    """The predicted template around a target, as large as chip, strip and settings allow."""
    settings, name = scene.settings, scene.targets[n].target_id
    lines, samples = scene.strip.shape(ccd)
    side = chip_side_px(scene.chips[n], model, ccd, xy_px, scene.surface)
    half = 0.5 * min(float(settings.template_px), side)
    x0, y0 = np.maximum(np.round(xy_px - half), 0).astype(int)
    x1 = int(min(round(xy_px[0] + half), samples))
    y1 = int(min(round(xy_px[1] + half), lines))
    if min(x1 - x0, y1 - y0) < settings.smallest_template_px:
        needed, shape = settings.smallest_template_px, (float(x1 - x0), float(y1 - y0))
        return Refusal(Reason.TEMPLATE_CUT, min(shape), needed, shape, name, ccd)
    return predict_template(
        scene.chips[n], model, ccd, (int(x0), int(y0)), (y1 - y0, x1 - x0), scene.surface, settings
    )


def _consistent(
    scene: _Scene, found: list[tuple[int, TargetMatch]], theta: Array, sigma_rad: Array
) -> tuple[list[TargetMatch], list[Refusal], Array, Array]:
    """Matches of which each agrees with what the others predict; the rotation and its covariance.

    The worst is refused first, until all agree; two that contradict one another are both kept.
    """
    if not found:
        return [], [], theta, np.diag(sigma_rad**2)
    p_e = np.array([scene.targets[n].p_e for n, _ in found])
    ccd = np.array([m.ccd for _, m in found])
    xy = np.array([m.xy_px for _, m in found])
    model = scene.pushbroom.with_installation(deviation_from_theta(theta) * scene.pushbroom.R_cs)
    d, design = displacements(model, p_e, ccd, xy)
    scatter = _scatter(scene, np.array([m.cov_px for _, m in found]), xy[:, 1])
    keep, refused = np.arange(len(found)), []
    while True:
        miss, distance = _from_the_others(d[keep], design[keep], scatter[np.ix_(keep, keep)], sigma_rad)
        worst = int(np.argmax(distance))
        if distance[worst] <= _GATE or len(keep) <= 2:
            break
        match = found[keep[worst]][1]
        by, off = float(distance[worst]), (float(miss[worst][0]), float(miss[worst][1]))
        refused.append(Refusal(Reason.INCONSISTENT, by, _GATE, off, match.target_id, match.ccd))
        keep = np.delete(keep, worst)
    p, covariance = _common_rotation(d[keep], design[keep], scatter[np.ix_(keep, keep)], sigma_rad)
    total = deviation_from_theta(p) * deviation_from_theta(theta)
    matches = [replace(found[k][1], residual_px=d[k] - design[k] @ p) for k in keep]
    return matches, refused, theta_from_deviation(total), covariance


def _scatter(scene: _Scene, cov_px: Array, line: Array) -> Array:
    """(N, N, 2, 2) covariance of places about the common rotation: each one's own, and the attitude's error,
    which those share that were seen between the same star exposures.
    """
    settings = scene.settings
    t_s = scene.pushbroom.instants(line)
    alike = np.maximum(1.0 - np.abs(t_s[:, None] - t_s) / settings.attitude_step_s, 0.0)
    out = np.asarray(settings.attitude_sigma_px**2 * alike[:, :, None, None] * np.eye(2))
    every = np.arange(len(line))
    out[every, every] += cov_px + settings.consistency_sigma_px**2 * np.eye(2)
    return out


def _from_the_others(d: Array, design: Array, scatter: Array, sigma_rad: Array) -> tuple[Array, Array]:
    """How far each displacement (N, 2) lies from what the others predict (N, 2), px, and in standard errors
    (N,).

    With S the covariance of all displacements, the rotation's own included, and Q its inverse, the others
    leave of displacement n  e_n = Q_nn^-1 (Q d)_n,  with covariance Q_nn^-1.
    """
    n = len(d)
    prior = np.einsum("nap,p,mbp->nmab", design, sigma_rad**2, design)
    Q = np.linalg.inv(_flat(scatter + prior)).reshape(n, 2, n, 2)
    pull = np.einsum("namb,mb->na", Q, d)
    own = np.einsum("nanb->nab", Q)
    miss = np.linalg.solve(own, pull[:, :, None])[:, :, 0]
    return miss, np.sqrt(np.einsum("na,na->n", miss, pull))


def _common_rotation(d: Array, design: Array, scatter: Array, sigma_rad: Array) -> tuple[Array, Array]:
    """The rotation (3,), rad, that explains the displacements best, and its covariance."""
    D = design.reshape(-1, 3)
    weighted = np.linalg.solve(_flat(scatter), D)
    covariance = np.linalg.inv(D.T @ weighted + np.diag(sigma_rad**-2.0))
    return covariance @ (weighted.T @ d.ravel()), covariance


def _flat(blocks: Array) -> Array:
    """(N, N, 2, 2) as one matrix (2 N, 2 N)."""
    n = len(blocks)
    return blocks.transpose(0, 2, 1, 3).reshape(2 * n, 2 * n)
