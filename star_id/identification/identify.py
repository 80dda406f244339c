"""Names for the stars of an image: triangles looked up on the sky, their neighbours to vote, the whole image
to decide.

Triangles of the brightest detections are looked up by shape (`proposals`), and the few that the neighbouring
index stars speak for are tried. A trial predicts all catalogue stars of the field, improves attitude and lens
by those it finds, and asks `verify` how much likelier that makes the image. No attitude need be known.

Coordinates are those of the tangent plane of frame s, x + iy = (u_x + i u_y) / u_z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.star_id.identification.hypothesis import Guess, guess_at, refined, seen_with
from boresight.star_id.identification.likelihood import log_evidence
from boresight.star_id.identification.pairing import Match, kept, near_pairs, paired, scatter
from boresight.star_id.identification.proposals import MOST_DETECTIONS, propose
from boresight.star_id.identification.tangent_plane import FieldOfView, PlaneImage
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.settings import StarSettings

__all__ = ["STAGES", "AttitudePrior", "Identification", "NotIdentified", "identify"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# (table, from, to): triangles of the brightest detections, less those of the stage before; table 1 holds
# wider triangles of brighter stars, which are rarer, but less often hidden among false stars
STAGES = ((0, 0, 8), (1, 0, 10), (0, 8, 14), (0, 14, MOST_DETECTIONS), (1, 10, 18))
_TRACKED_STARS = 30  # bright stars that vote on how far a prior attitude is off
_SURE = 0.05  # of the detections' spacing: a star predicted so well is nearest to its own detection


@dataclass(frozen=True, slots=True, eq=False)
class AttitudePrior:
    """Where the camera is believed to look, each axis good to `sigma_rad`: the last image's attitude and a
    rate."""

    R_si: Rotation
    sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Named stars of an image. Row n of `detections`, `stars` belong together."""

    detections: NDArray[np.int64]  # (M,) rows of the detections handed over
    stars: NDArray[np.int64]  # (M,) rows of the index's stars
    R_si: Rotation
    lens: Array  # (4,) log scale, k1, p1, p2: measured = (1 + s)(t + distortion); zero for a known camera
    false_alarm_probability: float  # bound, over all proposals tried
    log_false_alarm_probability: float
    proposals: int
    rms: float  # residual of the matched stars per axis, tangent plane


@dataclass(frozen=True, slots=True)
class NotIdentified:
    """Why no name was given; `numbers` holds what the sentence counts."""

    reason: str
    numbers: dict[str, float]


def identify(
    plane: Array,
    field: FieldOfView,
    index: StarIndex,
    settings: StarSettings,
    *,
    stages: tuple[tuple[int, int, int], ...] = STAGES,
    tried: int = 0,
    prior: AttitudePrior | None = None,
) -> Identification | NotIdentified:
    """Identifies detections `plane` (N, 2), x and y of the tangent plane, brightest first, distortion removed
    as far as it is known.

    `stages` are such as STAGES; `tried` proposals were examined elsewhere (earlier stages, other fields of
    view) and count towards the false-alarm probability.
    """
    n = len(plane)
    if n < 4:
        return NotIdentified(
            f"{n} stars found, 4 are needed; lower the threshold or expose longer", {"stars": float(n)}
        )
    image = PlaneImage.of(plane, field)
    if prior is not None:
        tracked, tried = _tracked(image, index, prior, settings)
        if tracked is not None:
            return tracked
    tables = index.tables_for(field.equivalent_fov_rad)
    examined, best = tried, -math.inf
    limit = math.log(settings.max_false_alarm_probability)
    for number, done, brightest in stages:
        size = min(brightest, n, settings.max_identification_stars)
        if size <= done or number >= len(tables):
            continue
        proposals = propose(image, tables[number], index.u_i, done, size)
        examined += proposals.examined
        for triangle, R, log_scale in zip(proposals.detections, proposals.R, proposals.log_scale):
            trial = _try(image, index, image.plane[triangle], R, float(log_scale))
            if trial is None:
                continue
            best = max(best, trial.evidence - math.log(examined))
            if math.log(examined) - trial.evidence < limit:
                return _answer(trial, examined)
    return NotIdentified(
        f"{n} stars found, {examined} triangles agree with the catalogue, none explains the image"
        f" (best log odds {best:.1f}, {-limit:.1f} needed)",
        {"stars": float(n), "proposals": float(examined), "best_log_odds": float(best)},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """What became of a proposal."""

    match: Match
    R_si: Rotation
    lens: Array
    evidence: float  # logarithm of the likelihood ratio


def _tracked(
    image: PlaneImage, index: StarIndex, prior: AttitudePrior, settings: StarSettings
) -> tuple[Identification | None, int]:
    """The field that the prior attitude predicts, shifted to where most bright stars agree; and shifts
    tried."""
    field = image.field
    reach = 4.0 * prior.sigma_rad * (1.0 + field.half_x**2 + field.half_y**2)
    guess = guess_at(image, index, prior.R_si.as_matrix(), np.zeros(4))
    shifts = 1
    if reach > 4.0 * field.pixel:
        bright = guess.predicted[:_TRACKED_STARS]
        pairs = (image.plane[None, :_TRACKED_STARS] - bright[:, None]).ravel()
        offset = pairs[(np.abs(pairs.real) < reach) & (np.abs(pairs.imag) < reach)]
        cell = max(4.0 * field.pixel, 0.5 * prior.sigma_rad)
        cells = int(np.ceil(2.0 * reach / cell))
        shifts = cells * cells
        if len(offset) == 0:
            return None, shifts
        column, row = (((part + reach) / cell).astype(np.int64) for part in (offset.real, offset.imag))
        bins = column * cells + row
        shift = offset[bins == np.bincount(bins).argmax()].mean()
        turn = Rotation.from_rotvec([-shift.imag, shift.real, 0.0])  # moves stars by the shift
        guess = seen_with(index, guess.rows, (turn * prior.R_si).as_matrix(), guess.lens)
    sigma = np.hypot(2.0 * field.pixel, prior.sigma_rad * np.abs(guess.predicted))
    trial = _improved(image, index, guess, sigma, chosen=2)
    if trial is None or np.log(shifts) - trial.evidence >= np.log(settings.max_false_alarm_probability):
        return None, shifts
    return _answer(trial, shifts), shifts


def _try(image: PlaneImage, index: StarIndex, corners: Complex, R: Array, log_scale: float) -> _Trial | None:
    """One proposal, from the triangle of `corners` (3,)."""
    field = image.field
    guess = guess_at(image, index, R, np.array([log_scale, 0.0, 0.0, 0.0]))
    # the triangle fixes the field near it; errors grow with the distance in units of its size
    a, b, c = corners.tolist()
    centre = (a + b + c) / 3.0
    size = math.hypot(abs(a - centre), abs(b - centre), abs(c - centre)) / math.sqrt(3.0)
    reach = np.abs(guess.predicted - centre)
    sigma = np.sqrt(field.pixel**2 + (0.5 * field.shape_error * reach) ** 2) * (1.0 + 0.7 / size * reach)
    return _improved(image, index, guess, sigma, chosen=3)


def _improved(
    image: PlaneImage, index: StarIndex, guess: Guess, sigma: Array, *, chosen: int
) -> _Trial | None:
    """The guess, each star of it good to `sigma` (M,), improved by the detections that it predicts; None if
    they are fewer than four.

    The guess was made to fit `chosen` detections: they do not vote.
    """
    field = image.field
    near = near_pairs(image, guess, sigma)
    pairs = paired(image, guess, near, sigma)
    match = kept(guess, pairs, 3.0 * pairs.sigma)
    sure = field.known and sigma.max(initial=0.0) < _SURE * math.sqrt(image.area / len(image.plane))
    for _ in range(1 if field.known else 4):  # what a lens bends comes near step by step
        if match is None:
            return None
        R_si, lens, fitted = refined(image, index, guess, match.detections, match.stars)
        guess = seen_with(index, guess.rows, R_si.as_matrix(), lens)
        sigma = np.full(len(guess.rows), field.pixel)
        if not sure:
            near = near_pairs(image, guess, sigma)
        pairs = paired(image, guess, near, sigma)
        match = kept(guess, pairs, max(3.0 * scatter(pairs.distance, field.pixel), field.pixel))
    if match is None:
        return None
    unpaired, voiceless = len(image.plane) - len(pairs.detections), chosen + (fitted - 2) // 2
    evidence = log_evidence(
        pairs.distance, pairs.sigma, unpaired, pairs.predicted, image.area, voiceless=voiceless
    )
    return _Trial(match, R_si, lens, evidence)


def _answer(trial: _Trial, proposals: int) -> Identification:
    log_probability = min(math.log(max(proposals, 1)) - trial.evidence, 0.0)
    return Identification(
        trial.match.detections,
        trial.match.stars,
        trial.R_si,
        trial.lens,
        math.exp(max(log_probability, -700.0)),
        log_probability,
        proposals,
        math.sqrt(0.5 * (trial.match.distance @ trial.match.distance) / len(trial.match.distance)),
    )
