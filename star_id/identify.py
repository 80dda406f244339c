"""Names for the stars of an image: triangles looked up on the sky, their neighbours to vote, the whole image
to decide.

Triangles of the brightest detections are looked up by shape (`proposals`), and the few that the neighbouring
index stars speak for are tried. A trial predicts all catalogue stars of the field, improves attitude and lens
by those it finds, and asks `verify` how much likelier that makes the image. No attitude need be known.

Coordinates are those of the tangent plane of frame s, (x, y) = (u_x, u_y) / u_z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from star_id.attitude import wahba
from star_id.plane import FieldOfView, PlaneImage, directions_of_plane, plane_of_directions
from star_id.proposals import MOST_DETECTIONS, propose
from star_id.settings import StarSettings
from star_id.triangles import StarIndex
from star_id.verify import log_evidence

__all__ = ["STAGES", "AttitudePrior", "Identification", "NotIdentified", "identify"]

Array = NDArray[np.float64]

# (table, brightest detections): stages one after the other; table 1 holds wider triangles of brighter stars
STAGES = ((0, 6), (0, 9), (0, 13), (0, 18), (1, 9), (0, MOST_DETECTIONS), (1, 18))
_TRACKED_STARS = 30  # bright stars that vote on how far a prior attitude is off
_PRIOR_SHARE = 1.6  # predicted stars kept, brightest first, per detection


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
    stages: tuple[tuple[int, int], ...] = STAGES,
    tried: int = 0,
    prior: AttitudePrior | None = None,
) -> Identification | NotIdentified:
    """Identifies detections `plane` (N, 2), brightest first, distortion removed as far as it is known.

    `stages` are a run of STAGES; `tried` proposals were examined elsewhere (earlier stages, other fields of
    view) and count towards the false-alarm probability.
    """
    n = len(plane)
    if n < 4:
        return NotIdentified(
            f"{n} stars found, 4 are needed; lower the threshold or expose longer", {"stars": float(n)}
        )
    image = PlaneImage(plane, cKDTree(plane, compact_nodes=False, balanced_tree=False), field)
    if prior is not None:
        tracked, tried = _tracked(image, index, prior, settings)
        if tracked is not None:
            return tracked
    tables = index.tables_for(field.equivalent_fov_rad)
    examined, best = tried, -np.inf
    limit = np.log(settings.max_false_alarm_probability)
    for number, brightest in stages:
        done = max((b for t, b in STAGES if t == number and b < brightest), default=0)
        size = min(brightest, n, settings.max_identification_stars)
        if size <= done or number >= len(tables):
            continue
        proposals = propose(image, tables[number], index.u_i, done, size)
        examined += proposals.examined
        for triangle, R, log_scale in zip(proposals.detections, proposals.R, proposals.log_scale):
            trial = _try(image, index, plane[triangle], R, float(log_scale))
            if trial is None:
                continue
            best = max(best, trial.evidence - np.log(examined))
            if np.log(examined) - trial.evidence < limit:
                return _answer(trial, examined)
    return NotIdentified(
        f"{n} stars found, {examined} triangles agree with the catalogue, none explains the image"
        f" (best log odds {best:.1f}, {-limit:.1f} needed)",
        {"stars": float(n), "proposals": float(examined), "best_log_odds": float(best)},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """What became of a proposal."""

    match: _Match
    R_si: Rotation
    lens: Array
    evidence: float  # logarithm of the likelihood ratio


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """Detections and catalogue stars that belong together."""

    detections: NDArray[np.int64]
    stars: NDArray[np.int64]
    rms: float


def _tracked(
    image: PlaneImage, index: StarIndex, prior: AttitudePrior, settings: StarSettings
) -> tuple[Identification | None, int]:
    """The field that the prior attitude predicts, shifted to where most bright stars agree; and shifts
    tried."""
    field = image.field
    reach = 4.0 * prior.sigma_rad * (1.0 + field.half_x**2 + field.half_y**2)
    guess = _guess(image, index, prior.R_si.as_matrix(), np.zeros(4))
    shifts = 1
    if reach > 4.0 * field.pixel:
        bright = guess.predicted[:_TRACKED_STARS]
        pairs = (image.plane[None, :_TRACKED_STARS] - bright[:, None]).reshape(-1, 2)
        offset = pairs[(np.abs(pairs) < reach).all(axis=1)]
        cell = max(4.0 * field.pixel, 0.5 * prior.sigma_rad)
        cells = int(np.ceil(2.0 * reach / cell))
        shifts = cells * cells
        if len(offset) == 0:
            return None, shifts
        bins = ((offset + reach) / cell).astype(np.int64) @ np.array([cells, 1])
        votes = np.bincount(bins)
        dx, dy = offset[bins == int(votes.argmax())].mean(axis=0)
        turn = Rotation.from_rotvec([-dy, dx, 0.0])  # moves (x, y) by the shift
        guess = _moved(index, guess.rows, turn * prior.R_si, guess.lens)
    radius = np.sqrt((guess.predicted**2).sum(axis=1))
    sigma = np.sqrt((2.0 * field.pixel) ** 2 + (prior.sigma_rad * radius) ** 2)
    trial = _improved(image, index, guess, sigma, chosen=2)
    if trial is None or np.log(shifts) - trial.evidence >= np.log(settings.max_false_alarm_probability):
        return None, shifts
    return _answer(trial, shifts), shifts


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """An attitude and a lens, and catalogue stars as they are seen with them."""

    R: Array
    lens: Array
    rows: NDArray[np.int64]  # (M,) brightest first, all that may be in view
    predicted: Array  # (M, 2)


def _try(image: PlaneImage, index: StarIndex, corners: Array, R: Array, log_scale: float) -> _Trial | None:
    """One proposal, from the triangle of `corners` (3, 2)."""
    field = image.field
    guess = _guess(image, index, R, np.array([log_scale, 0.0, 0.0, 0.0]))
    # the triangle fixes the field near it; errors grow with the distance in units of its size
    centre = corners.mean(axis=0)
    size2 = ((corners - centre) ** 2).sum() / 3.0
    reach2 = ((guess.predicted - centre) ** 2).sum(axis=1)
    sigma = np.sqrt(field.pixel**2 + (0.5 * field.shape_error) ** 2 * reach2) * (
        1.0 + 0.7 * np.sqrt(reach2 / size2)
    )
    return _improved(image, index, guess, sigma, chosen=3)


def _improved(
    image: PlaneImage, index: StarIndex, guess: _Guess, sigma: Array, *, chosen: int
) -> _Trial | None:
    """The guess, each star of it good to `sigma` (M,), improved by the detections that it predicts; None if
    they are fewer than four.

    The guess was made to fit `chosen` detections: they do not vote.
    """
    pixel = image.field.pixel
    pairs = _paired(image, guess, sigma)
    match = _kept(guess, pairs, 3.0 * pairs.sigma)
    for _ in range(0 if image.field.known else 3):  # what a lens bends comes near step by step
        if match is None:
            return None
        R_si, lens, _ = _refined(image, index, guess, match)
        guess = _moved(index, guess.rows, R_si, lens)
        pairs = _paired(image, guess, np.full(len(guess.rows), pixel))
        match = _kept(guess, pairs, 3.0 * _scatter(pairs.distance, pixel))
    if match is None:
        return None
    R_si, lens, fitted = _refined(image, index, guess, match)
    guess = _moved(index, guess.rows[pairs.places], R_si, lens)
    pairs = pairs.again(image, guess)
    match = _kept(guess, pairs, 3.0 * _scatter(pairs.distance, pixel))
    if match is None:
        return None
    unpaired, voiceless = len(image.plane) - len(pairs.detections), chosen + (fitted - 2) // 2
    evidence = log_evidence(
        pairs.distance, pairs.sigma, unpaired, pairs.predicted, image.area, voiceless=voiceless
    )
    return _Trial(match, R_si, lens, evidence)


def _guess(image: PlaneImage, index: StarIndex, R: Array, lens: Array) -> _Guess:
    field = image.field
    corner = np.hypot(field.half_x, field.half_y) * (1.03 + 0.5 * field.shape_error)
    radius = np.arctan(corner * np.exp(-lens[0]))
    rows = index.near(R[2], float(radius))
    predicted = _distorted(plane_of_directions(index.u_i[rows] @ R.T), lens)
    seen = np.cumsum(_inside(predicted, field))
    limit = int(_PRIOR_SHARE * len(image.plane)) + 12
    if seen[-1:] > limit:
        end = int(np.searchsorted(seen, limit)) + 1
        rows, predicted = rows[:end], predicted[:end]
    return _Guess(R, lens, rows, predicted)


def _moved(index: StarIndex, rows: NDArray[np.int64], R_si: Rotation, lens: Array) -> _Guess:
    """The same stars with a slightly different attitude and lens."""
    R = R_si.as_matrix()
    return _Guess(R, lens, rows, _distorted(plane_of_directions(index.u_i[rows] @ R.T), lens))


def _inside(plane: Array, field: FieldOfView) -> NDArray[np.bool_]:
    x, y = np.abs(plane[:, 0]), np.abs(plane[:, 1])
    return np.asarray((x < field.half_x) & (y < field.half_y))


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Predicted stars and the detections near them, each at most once."""

    detections: NDArray[np.int64]  # (K,)
    places: NDArray[np.int64]  # (K,) rows of the guess
    distance: Array  # (K,)
    sigma: Array  # (K,) expected along one axis
    predicted: int  # stars asked for

    def again(self, image: PlaneImage, guess: _Guess) -> _Pairs:
        """The same pairs after `guess`, which holds their stars alone, has moved, good to a pixel."""
        distance = np.sqrt(((image.plane[self.detections] - guess.predicted) ** 2).sum(axis=1))
        sigma = np.full(len(distance), image.field.pixel)
        return _Pairs(self.detections, np.arange(len(distance)), distance, sigma, self.predicted)


def _paired(image: PlaneImage, guess: _Guess, sigma: Array) -> _Pairs:
    """Each star predicted inside with the nearest detection within five `sigma` (M,), each detection with the
    star that it fits best."""
    n = len(image.plane)
    inside = np.flatnonzero(_inside(guess.predicted, image.field))
    own = sigma[inside]
    reach = 5.0 * float(own.max(initial=0.0))
    distance, detection = image.tree.query(guess.predicted[inside], distance_upper_bound=reach)
    near = np.flatnonzero(detection < n)
    worst_first = near[np.argsort(-(distance[near] / own[near]))]
    star = np.full(n, -1)
    star[detection[worst_first]] = worst_first  # the best comes last and stays
    detections = np.flatnonzero(star >= 0)
    chosen = star[detections]
    return _Pairs(detections, inside[chosen], distance[chosen], own[chosen], len(inside))


def _kept(guess: _Guess, pairs: _Pairs, limit: Array | float) -> _Match | None:
    """The pairs no farther apart than `limit`, four at least."""
    close = pairs.distance < limit
    if np.count_nonzero(close) < 4:
        return None
    rms = float(np.sqrt(0.5 * (pairs.distance[close] ** 2).mean()))
    return _Match(pairs.detections[close], guess.rows[pairs.places[close]], rms)


def _scatter(distance: Array, pixel: float) -> float:
    """Robust one-axis size of the distances of true matches, between a seventh of a pixel and three
    pixels."""
    if len(distance) == 0:
        return pixel
    middle = float(np.partition(distance, len(distance) // 2)[len(distance) // 2])
    return min(max(middle / 1.1774, 0.15 * pixel), 3.0 * pixel)


def _refined(
    image: PlaneImage, index: StarIndex, guess: _Guess, match: _Match
) -> tuple[Rotation, Array, int]:
    """Attitude, and what the matches allow to be said of an unknown lens; also the number of parameters."""
    measured = image.plane[match.detections]
    u_i = index.u_i[match.stars]
    if image.field.known:
        return wahba(directions_of_plane(measured), u_i, np.ones(len(u_i))), guess.lens, 3
    n = len(measured)
    free = 2 if n < 16 else 4
    if image.field.scale_error > 0 and n < 8:
        free = 1
    R, lens = guess.R, guess.lens.copy()
    for _ in range(3):
        ideal = plane_of_directions(u_i @ R.T)
        residual = (measured - _distorted(ideal, lens)).ravel()
        A = np.concatenate([_turn_columns(ideal), _lens_columns(ideal)[:, :, :free]], axis=2)
        size = np.sqrt(0.5 * (residual.reshape(n, 2) ** 2).sum(axis=1))
        weight = 1.0 / np.hypot(1.0, size / (2.0 * np.median(size) + 0.05 * image.field.pixel))
        A = (A * weight[:, None, None]).reshape(2 * n, 3 + free)
        step = np.linalg.lstsq(A, residual * np.repeat(weight, 2), rcond=1e-10)[0]
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        lens[:free] += step[3:]
    return Rotation.from_matrix(R), lens, 3 + free


def _turn_columns(t: Array) -> Array:
    """d(tangent coordinates) / d(right-handed turn about the axes of s), (N, 2, 3)."""
    x, y = t.T
    columns = np.empty((len(t), 2, 3))
    columns[:, 0, 0], columns[:, 0, 1], columns[:, 0, 2] = -x * y, 1.0 + x * x, -y
    columns[:, 1, 0], columns[:, 1, 1], columns[:, 1, 2] = -(1.0 + y * y), x * y, x
    return columns


def _lens_columns(t: Array) -> Array:
    """d(distorted) / d(log scale, k1, p1, p2), (N, 2, 4)."""
    x, y = t.T
    r2 = x * x + y * y
    return np.stack(
        [
            t,
            t * r2[:, None],
            np.column_stack([r2 + 2 * x * x, 2 * x * y]),
            np.column_stack([2 * x * y, r2 + 2 * y * y]),
        ],
        axis=2,
    )


def _distorted(t: Array, lens: Array) -> Array:
    if not lens.any():
        return t
    return np.asarray((t + _lens_columns(t)[:, :, 1:] @ lens[1:]) * np.exp(lens[0]))


def _answer(trial: _Trial, proposals: int) -> Identification:
    log_probability = float(min(np.log(max(proposals, 1)) - trial.evidence, 0.0))
    return Identification(
        trial.match.detections,
        trial.match.stars,
        trial.R_si,
        trial.lens,
        float(np.exp(max(log_probability, -700.0))),
        log_probability,
        proposals,
        trial.match.rms,
    )
