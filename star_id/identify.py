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

from star_id.attitude import wahba
from star_id.plane import FieldOfView, PlaneImage, directions_of_plane, plane_of_directions
from star_id.proposals import MOST_DETECTIONS, propose
from star_id.ranges import least_of_each
from star_id.settings import StarSettings
from star_id.triangles import StarIndex
from star_id.verify import log_evidence

__all__ = ["STAGES", "AttitudePrior", "Identification", "NotIdentified", "identify"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# (table, from, to): triangles of the brightest detections, less those of the stage before; table 1 holds
# wider triangles of brighter stars, which are rarer, but less often hidden among false stars
STAGES = ((0, 0, 8), (1, 0, 10), (0, 8, 14), (0, 14, MOST_DETECTIONS), (1, 10, 18))
_TRACKED_STARS = 30  # bright stars that vote on how far a prior attitude is off
_SURE = 0.05  # of the detections' spacing: a star predicted so well is nearest to its own detection
_APART = 3.0  # pixels: a star nearer to a brighter one is not seen apart from it
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

    match: _Match
    R_si: Rotation
    lens: Array
    evidence: float  # logarithm of the likelihood ratio


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """Detections and catalogue stars that belong together."""

    detections: NDArray[np.int64]
    stars: NDArray[np.int64]
    distance: Array  # tangent plane


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
        guess = _seen(index, guess.rows, (turn * prior.R_si).as_matrix(), guess.lens)
    sigma = np.hypot(2.0 * field.pixel, prior.sigma_rad * np.abs(guess.predicted))
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
    predicted: Complex  # (M,)


def _try(image: PlaneImage, index: StarIndex, corners: Complex, R: Array, log_scale: float) -> _Trial | None:
    """One proposal, from the triangle of `corners` (3,)."""
    field = image.field
    guess = _guess(image, index, R, np.array([log_scale, 0.0, 0.0, 0.0]))
    # the triangle fixes the field near it; errors grow with the distance in units of its size
    a, b, c = corners.tolist()
    centre = (a + b + c) / 3.0
    size = math.hypot(abs(a - centre), abs(b - centre), abs(c - centre)) / math.sqrt(3.0)
    reach = np.abs(guess.predicted - centre)
    sigma = np.sqrt(field.pixel**2 + (0.5 * field.shape_error * reach) ** 2) * (1.0 + 0.7 / size * reach)
    return _improved(image, index, guess, sigma, chosen=3)


def _improved(
    image: PlaneImage, index: StarIndex, guess: _Guess, sigma: Array, *, chosen: int
) -> _Trial | None:
    """The guess, each star of it good to `sigma` (M,), improved by the detections that it predicts; None if
    they are fewer than four.

    The guess was made to fit `chosen` detections: they do not vote.
    """
    field = image.field
    near = _near(image, guess, sigma)
    pairs = _paired(image, guess, near, sigma)
    match = _kept(guess, pairs, 3.0 * pairs.sigma)
    sure = field.known and sigma.max() < _SURE * math.sqrt(image.area / len(image.plane))
    for _ in range(1 if field.known else 4):  # what a lens bends comes near step by step
        if match is None:
            return None
        R_si, lens, fitted = _refined(image, index, guess, match)
        guess = _seen(index, guess.rows, R_si.as_matrix(), lens)
        sigma = np.full(len(guess.rows), field.pixel)
        if not sure:
            near = _near(image, guess, sigma)
        pairs = _paired(image, guess, near, sigma)
        match = _kept(guess, pairs, max(3.0 * _scatter(pairs.distance, field.pixel), field.pixel))
    if match is None:
        return None
    unpaired, voiceless = len(image.plane) - len(pairs.detections), chosen + (fitted - 2) // 2
    evidence = log_evidence(
        pairs.distance, pairs.sigma, unpaired, pairs.predicted, image.area, voiceless=voiceless
    )
    return _Trial(match, R_si, lens, evidence)


def _guess(image: PlaneImage, index: StarIndex, R: Array, lens: Array) -> _Guess:
    field = image.field
    corner = math.hypot(field.half_x, field.half_y) * (1.03 + 0.5 * field.shape_error)
    rows = index.near(R[2], math.atan(corner * math.exp(-lens[0])))
    apart = index.to_brighter_rad.take(rows) > _APART * field.pixel
    return _seen(index, rows.take(apart.nonzero()[0]), R, lens)


def _seen(index: StarIndex, rows: NDArray[np.int64], R: Array, lens: Array) -> _Guess:
    """The index's stars `rows` as they are seen with an attitude and a lens."""
    return _Guess(R, lens, rows, _distorted(plane_of_directions(index.u_i.take(rows, axis=0) @ R.T), lens))


def _most_stars(image: PlaneImage) -> int:
    """Catalogue stars, brightest first, that an image with so many detections is asked for."""
    return int(_PRIOR_SHARE * len(image.plane)) + 12


def _inside(plane: Complex, field: FieldOfView) -> NDArray[np.bool_]:
    return np.asarray((np.abs(plane.real) < field.half_x) & (np.abs(plane.imag) < field.half_y))


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """Stars predicted inside and the detections that they may be: all pairs near one another."""

    places: NDArray[np.int64]  # (K,) rows of the guess
    detections: NDArray[np.int64]  # (K,)
    predicted: int  # stars asked for


def _near(image: PlaneImage, guess: _Guess, sigma: Array) -> _Near:
    """Pairs within five `sigma` (M,)."""
    inside = _inside(guess.predicted, image.field).nonzero()[0][: _most_stars(image)]
    star, detection = image.within(guess.predicted.take(inside), 5.0 * sigma.take(inside))
    return _Near(inside.take(star), detection, len(inside))


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Predicted stars and the detections near them, each at most once."""

    detections: NDArray[np.int64]  # (K,)
    places: NDArray[np.int64]  # (K,) rows of the guess
    distance: Array  # (K,)
    sigma: Array  # (K,) expected along one axis
    predicted: int  # stars asked for


def _paired(image: PlaneImage, guess: _Guess, near: _Near, sigma: Array) -> _Pairs:
    """Of what is near one another: each star with the nearest detection, each detection with the star that it
    fits best, in units of the star's own `sigma` (M,)."""
    distance = np.abs(guess.predicted.take(near.places) - image.plane.take(near.detections))
    nearest = least_of_each(near.places, distance, len(guess.rows))
    star, detection, distance = (
        near.places.take(nearest),
        near.detections.take(nearest),
        distance.take(nearest),
    )
    own = sigma.take(star)
    best = least_of_each(detection, distance / own, len(image.plane))
    return _Pairs(detection.take(best), star.take(best), distance.take(best), own.take(best), near.predicted)


def _kept(guess: _Guess, pairs: _Pairs, limit: Array | float) -> _Match | None:
    """The pairs no farther apart than `limit`, four at least."""
    close = (pairs.distance < limit).nonzero()[0]
    if len(close) < 4:
        return None
    stars = guess.rows.take(pairs.places.take(close))
    return _Match(pairs.detections.take(close), stars, pairs.distance.take(close))


def _scatter(distance: Array, pixel: float) -> float:
    """Robust one-axis size of the distances of true matches, between a seventh of a pixel and three
    pixels."""
    if len(distance) == 0:
        return pixel
    middle = float(distance[distance.argsort()[len(distance) // 2]])
    return min(max(middle / 1.1774, 0.15 * pixel), 3.0 * pixel)


def _refined(
    image: PlaneImage, index: StarIndex, guess: _Guess, match: _Match
) -> tuple[Rotation, Array, int]:
    """Attitude, and what the matches allow to be said of an unknown lens; also the number of parameters."""
    measured = image.plane.take(match.detections)
    u_i = index.u_i.take(match.stars, axis=0)
    if image.field.known:
        return wahba(directions_of_plane(measured), u_i, np.ones(len(u_i))), guess.lens, 3
    n = len(measured)
    free = 2 if n < 16 else 4
    if image.field.scale_error > 0 and n < 8:
        free = 1
    R, lens = guess.R, guess.lens.copy()
    for _ in range(3):
        ideal = plane_of_directions(u_i @ R.T)
        residual = measured - _distorted(ideal, lens)
        size = np.abs(residual) / math.sqrt(2.0)
        weight = 1.0 / np.hypot(1.0, size / (2.0 * np.median(size) + 0.05 * image.field.pixel))
        A = np.column_stack([*_turn_columns(ideal), *_lens_columns(ideal)[:free]]) * weight[:, None]
        b = residual * weight
        step = np.linalg.lstsq(np.vstack([A.real, A.imag]), np.append(b.real, b.imag), rcond=1e-10)[0]
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        lens[:free] += step[3:]
    return Rotation.from_matrix(R), lens, 3 + free


def _turn_columns(t: Complex) -> tuple[Complex, Complex, Complex]:
    """d(tangent coordinates) / d(right-handed turn about the axes of s), (N,) each."""
    return -1j - t.imag * t, 1.0 + t.real * t, 1j * t


def _lens_columns(t: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """d(distorted) / d(log scale, k1, p1, p2), (N,) each."""
    r2 = np.abs(t) ** 2
    return t, r2 * t, r2 + 2.0 * t.real * t, 1j * r2 + 2.0 * t.imag * t


def _distorted(t: Complex, lens: Array) -> Complex:
    if not lens.any():
        return t
    scale, k1, p1, p2 = lens
    _, radial, along, across = _lens_columns(t)
    return np.asarray((t + k1 * radial + p1 * along + p2 * across) * math.exp(scale))


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
