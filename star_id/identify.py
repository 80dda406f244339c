"""Names for the stars of an image: triangles looked up on the sky, a fourth star to confirm, the whole image
to decide.

Triangles of the brightest detections are looked up by shape. Every proposal found names two stars at each of
its three sides; two proposals that share a side, named alike, are a triangle confirmed by a fourth star, and
the ones confirmed most are tried first. A trial predicts all catalogue stars of the field and asks `verify`
how much likelier that makes the image. What passes is refined, predicted again, and asked once more. No
attitude need be known.

Coordinates are those of the tangent plane of frame s, (x, y) = (u_x, u_y) / u_z.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from star_id.attitude import wahba
from star_id.settings import StarSettings
from star_id.triangles import LONGEST_SIDE, SHORTEST_SIDE, StarIndex, TriangleTable, triangle_shapes
from star_id.verify import log_evidence

__all__ = ["STAGES", "AttitudePrior", "FieldOfView", "Identification", "NotIdentified", "identify"]

Array = NDArray[np.float64]

STAGES = (6, 9, 13, 18, 24)  # brightest detections of which triangles are made, one stage after the other
_TRIALS_A_STAGE = 16
_PROMISING = 3.0  # log evidence of the triangle alone that makes refinement worth its time
_CALIBRATED = 2e-3  # relative error of angles below which a lens counts as known
_TRACKED_STARS = 30  # bright stars that vote on how far a prior attitude is off
_PRIOR_SHARE = 1.6  # predicted stars kept, brightest first, per detection


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """What is known of the camera, as half sizes of the image in the tangent plane and errors to be
    expected."""

    half_x: float
    half_y: float
    equivalent_fov_rad: float
    pixel: float  # size of a pixel in the tangent plane
    scale_error: float  # the focal length is good to this fraction; 0: known
    shape_error: float  # ratios of a triangle's sides are good to this

    @property
    def known(self) -> bool:
        """The camera is calibrated: nothing about its lens is left to be found."""
        return self.scale_error == 0.0 and self.shape_error < _CALIBRATED


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
    stages: tuple[int, ...] = STAGES,
    tried: int = 0,
    prior: AttitudePrior | None = None,
) -> Identification | NotIdentified:
    """Identifies detections `plane` (N, 2), brightest first, distortion removed as far as it is known.

    `stages` are the numbers of brightest detections of which triangles are made, one after the other; `tried`
    proposals were examined elsewhere (other fields of view) and count towards the false-alarm probability.
    """
    n = len(plane)
    if n < 4:
        return NotIdentified(
            f"{n} stars found, 4 are needed; lower the threshold or expose longer", {"stars": float(n)}
        )
    image = _Image(plane, cKDTree(plane), field)
    if prior is not None:
        tracked, tried = _tracked(image, index, prior, settings)
        if tracked is not None:
            return tracked
    table = index.table_for(field.equivalent_fov_rad)
    proposals, best = tried, -np.inf
    limit = np.log(settings.max_false_alarm_probability)
    done = max((size for size in STAGES if size < stages[0]), default=0)
    for size in stages:
        size = min(size, n, settings.max_identification_stars)
        if size <= done:
            break
        queries, rows, triples = _look_up(image, table, size)
        proposals += len(rows)
        for trial in _ranked(triples[queries], table.vertices[rows], fresh=done)[:_TRIALS_A_STAGE]:
            result, log_evidence_found = _try(
                image, index, triples[queries[trial]], table.vertices[rows[trial]]
            )
            best = max(best, log_evidence_found - np.log(proposals))
            if result is not None and np.log(proposals) - log_evidence_found < limit:
                return _answer(result, proposals, log_evidence_found)
        done = size
    return NotIdentified(
        f"{n} stars found, {proposals} triangles agree with the catalogue, none explains the image"
        f" (best log odds {best:.1f}, {-limit:.1f} needed)",
        {"stars": float(n), "proposals": float(proposals), "best_log_odds": float(best)},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    plane: Array
    tree: cKDTree
    field: FieldOfView

    @property
    def area(self) -> float:
        return 4.0 * self.field.half_x * self.field.half_y


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    detections: NDArray[np.int64]
    stars: NDArray[np.int64]
    R: Array
    lens: Array
    rms: float


def _tracked(
    image: _Image, index: StarIndex, prior: AttitudePrior, settings: StarSettings
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
        turn = Rotation.from_rotvec([-dy, dx, 0.0]).as_matrix()  # moves (x, y) by the shift
        guess = _moved(image, index, guess, turn @ guess.R, guess.lens)
    radius = np.sqrt((guess.predicted**2).sum(axis=1))
    sigma = np.sqrt((2.0 * field.pixel) ** 2 + (prior.sigma_rad * radius) ** 2)
    match, evidence = _match(image, guess, sigma, gate=3.0, voiceless=2)
    if match is None or evidence < _PROMISING + np.log(shifts):
        return None, shifts
    for _ in range(1 if field.known else 4):
        R, lens, fitted = _refined(image, index, match)
        guess = _moved(image, index, guess, R, lens)
        match, evidence = _match(image, guess, None, gate=0.0, voiceless=2 + (fitted - 2) // 2)
        if match is None:
            return None, shifts
    if np.log(shifts) - evidence < np.log(settings.max_false_alarm_probability):
        return _answer(match, shifts, evidence), shifts
    return None, shifts


def _look_up(
    image: _Image, table: TriangleTable, size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    field = image.field
    u = _directions(image.plane[:size])
    triples = _TRIPLES[_TRIPLES[:, 2] < size]
    vertices, longest, ratios, right_handed = triangle_shapes(u, triples)
    fits = longest < LONGEST_SIDE * table.fov_rad * (1.0 + field.scale_error)
    fits &= longest * ratios[:, 1] > SHORTEST_SIDE * table.fov_rad * (1.0 - field.scale_error)
    vertices, longest, ratios, right_handed = vertices[fits], longest[fits], ratios[fits], right_handed[fits]
    # a side's own error: half a pixel at both ends, and the camera's relative error
    tolerance = field.shape_error + 1.5 * field.pixel / longest
    scale = (
        field.scale_error
        + float(field.shape_error)
        + 1.5 * field.pixel / np.maximum(longest.min(initial=1.0), 1e-9)
    )
    queries, rows = table.lookup(longest, ratios, right_handed, tolerance, scale)
    return queries, rows, vertices


_TRIPLES = np.array(sorted(combinations(range(max(STAGES)), 3), key=lambda t: t[2]), dtype=np.int64)


def _ranked(detected: NDArray[np.int64], named: NDArray[np.integer], *, fresh: int) -> NDArray[np.int64]:
    """Proposals in the order of how many others name one of their sides alike; old ones are not repeated.

    `detected` (P, 3) detections and `named` (P, 3) stars of each proposal.
    """
    count = len(detected)
    if count == 0:
        return np.empty(0, dtype=np.int64)
    base = int(named.max()) + 1
    first, second = detected[:, _SIDES[:, 0]], detected[:, _SIDES[:, 1]]  # (P, 3) the ends of each side
    p, q = named[:, _SIDES[:, 0]].astype(np.int64), named[:, _SIDES[:, 1]].astype(np.int64)
    ends = np.where(first > second, second * 64 + first, first * 64 + second)
    keys = (ends * base * base + np.where(first > second, q * base + p, p * base + q)).ravel()
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(keys[order]) != 0]))
    counts = np.diff(np.append(starts, len(keys)))
    support = np.empty(len(keys), dtype=np.int64)
    support[order] = np.repeat(counts - 1, counts)
    support = support.reshape(count, 3).sum(axis=1)
    best = np.argsort(detected.sum(axis=1) - 1000 * support, kind="stable")
    return best[detected[best].max(axis=1) >= fresh] if fresh else best


_SIDES = np.array([[0, 1], [0, 2], [1, 2]])


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """An attitude and a lens, the catalogue stars in view with them, and how far they may be off."""

    R: Array
    lens: Array
    rows: NDArray[np.int64]  # (M,) brightest first
    predicted: Array  # (M, 2)
    inside: NDArray[np.bool_]  # (M,)


def _try(image: _Image, index: StarIndex, detected: NDArray, named: NDArray) -> tuple[_Match | None, float]:
    """One proposal: predicted field, evidence, and if that is promising, refinement."""
    field = image.field
    points = image.plane[detected]
    u, v = _directions(points), index.u_i[named]
    lens: Array = np.zeros(4)
    if field.scale_error > 0:
        lens[0] = np.log(_perimeter(u) / _perimeter(v))
        u = _directions(points * np.exp(-lens[0]))
    guess = _guess(image, index, wahba(u, v, np.ones(3)), lens)
    # the triangle fixes the field near it; errors grow with the distance in units of its size
    centre = points.mean(axis=0)
    size2 = ((points - centre) ** 2).sum() / 3.0
    reach2 = ((guess.predicted - centre) ** 2).sum(axis=1)
    sigma = np.sqrt(field.pixel**2 + (0.5 * field.shape_error) ** 2 * reach2) * (
        1.0 + 0.7 * np.sqrt(reach2 / size2)
    )
    match, evidence = _match(image, guess, sigma, gate=3.0, voiceless=3)
    if match is None or evidence < _PROMISING:
        return None, evidence
    for _ in range(1 if field.known else 4):
        R, lens, fitted = _refined(image, index, match)
        guess = _moved(image, index, guess, R, lens)
        match, evidence = _match(image, guess, None, gate=0.0, voiceless=3 + (fitted - 2) // 2)
        if match is None:
            return None, evidence
    return match, evidence


def _guess(image: _Image, index: StarIndex, R: Array, lens: Array) -> _Guess:
    field = image.field
    corner = np.hypot(field.half_x, field.half_y) * (1.03 + 0.5 * field.shape_error)
    radius = np.arctan(corner * np.exp(-lens[0]))
    rows = index.near(R[2], float(radius))
    predicted = _distorted(_plane(index.u_i[rows] @ R.T), lens)
    inside = _inside(predicted, field)
    limit = int(_PRIOR_SHARE * len(image.plane)) + 12
    if np.count_nonzero(inside) > limit:
        end = int(np.searchsorted(np.cumsum(inside), limit)) + 1
        rows, predicted, inside = rows[:end], predicted[:end], inside[:end]
    return _Guess(R, lens, rows, predicted, inside)


def _moved(image: _Image, index: StarIndex, guess: _Guess, R: Array, lens: Array) -> _Guess:
    """The same stars with a slightly different attitude and lens."""
    predicted = _distorted(_plane(index.u_i[guess.rows] @ R.T), lens)
    return _Guess(R, lens, guess.rows, predicted, _inside(predicted, image.field))


def _inside(plane: Array, field: FieldOfView) -> NDArray[np.bool_]:
    x, y = np.abs(plane[:, 0]), np.abs(plane[:, 1])
    return np.asarray((x < field.half_x) & (y < field.half_y))


def _match(
    image: _Image, guess: _Guess, sigma: Array | None, *, gate: float, voiceless: int
) -> tuple[_Match | None, float]:
    """Each predicted star with the nearest detection, each detection with one star, and the evidence of it
    all.

    `sigma` (M,) expected errors and the gate in units of it; None: a pixel, and the matches' own scatter.
    """
    pixel, n = image.field.pixel, len(image.plane)
    seen = int(np.count_nonzero(guess.inside))
    if seen < 3:
        return None, -np.inf
    reach = 5.0 * (pixel if sigma is None else float(sigma.max()))
    distance, detection = image.tree.query(guess.predicted, distance_upper_bound=reach)
    usable = np.flatnonzero(guess.inside & (detection < n))
    relative = distance[usable] / (pixel if sigma is None else sigma[usable])
    worst_first = usable[np.argsort(-relative)]
    star = np.full(n, -1)
    star[detection[worst_first]] = worst_first  # the best comes last and stays
    named = np.flatnonzero(star >= 0)
    chosen = star[named]
    distance = distance[chosen]
    if sigma is None:
        own = np.full(len(chosen), pixel)
        limit: Array | float = 3.0 * _scatter(distance, pixel)
    else:
        own = sigma[chosen]
        limit = gate * own
    evidence = log_evidence(distance, own, n - len(named), seen, image.area, voiceless=voiceless)
    close = distance < limit
    named, chosen, distance = named[close], chosen[close], distance[close]
    if len(chosen) < 4:
        return None, evidence
    rms = float(np.sqrt(0.5 * (distance**2).mean()))
    return _Match(named, guess.rows[chosen], guess.R, guess.lens, rms), evidence


def _scatter(distance: Array, pixel: float) -> float:
    """Robust one-axis size of the distances of true matches, between a seventh of a pixel and three
    pixels."""
    if len(distance) == 0:
        return pixel
    middle = float(np.partition(distance, len(distance) // 2)[len(distance) // 2])
    return min(max(middle / 1.1774, 0.15 * pixel), 3.0 * pixel)


def _refined(image: _Image, index: StarIndex, match: _Match) -> tuple[Array, Array, int]:
    """Attitude, and what the matches allow to be said of an unknown lens; also the number of parameters."""
    measured = image.plane[match.detections]
    u_i = index.u_i[match.stars]
    if image.field.known:
        return wahba(_directions(measured), u_i, np.ones(len(u_i))), match.lens, 3
    n = len(measured)
    free = 2 if n < 16 else 4
    if image.field.scale_error > 0 and n < 8:
        free = 1
    R, lens = match.R, match.lens.copy()
    for _ in range(3):
        ideal = _plane(u_i @ R.T)
        residual = (measured - _distorted(ideal, lens)).ravel()
        A = np.concatenate([_turn_columns(ideal), _lens_columns(ideal)[:, :, :free]], axis=2)
        size = np.sqrt(0.5 * (residual.reshape(n, 2) ** 2).sum(axis=1))
        weight = 1.0 / np.hypot(1.0, size / (2.0 * np.median(size) + 0.05 * image.field.pixel))
        A = (A * weight[:, None, None]).reshape(2 * n, 3 + free)
        step = np.linalg.lstsq(A, residual * np.repeat(weight, 2), rcond=1e-10)[0]
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        lens[:free] += step[3:]
    return R, lens, 3 + free


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


def _answer(match: _Match, proposals: int, evidence: float) -> Identification:
    log_probability = float(min(np.log(max(proposals, 1)) - evidence, 0.0))
    return Identification(
        match.detections,
        match.stars,
        Rotation.from_matrix(match.R),
        match.lens,
        float(np.exp(max(log_probability, -700.0))),
        log_probability,
        proposals,
        match.rms,
    )


def _perimeter(u: Array) -> float:
    """Sum of the chords of a triangle of unit vectors."""
    return float(np.sqrt(((u - u[[1, 2, 0]]) ** 2).sum(axis=1)).sum())


def _directions(plane: Array) -> Array:
    v = np.column_stack([plane, np.ones(len(plane))])
    return np.asarray(v / np.sqrt((v * v).sum(axis=1))[:, None])


def _plane(u: Array) -> Array:
    z = np.where(u[:, 2] > 0.05, u[:, 2], np.nan)
    return np.asarray(u[:, :2] / z[:, None])
