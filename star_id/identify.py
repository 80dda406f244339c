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

__all__ = ["STAGES", "FieldOfView", "Identification", "NotIdentified", "identify"]

Array = NDArray[np.float64]

STAGES = (6, 9, 13, 18, 24)  # brightest detections of which triangles are made, one stage after the other
_TRIALS_A_STAGE = 16
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
    table = index.table_for(field.equivalent_fov_rad)
    proposals, best = tried, -np.inf
    limit = np.log(settings.max_false_alarm_probability)
    done = max((size for size in STAGES if size < stages[0]), default=0)
    for size in stages:
        size = min(size, n, settings.max_identification_stars)
        if size <= done:
            break
        queries, rows, triples = _look_up(image, table, size, settings)
        proposals += len(rows)
        for trial in _ranked(triples[queries], table.vertices[rows], fresh=done)[:_TRIALS_A_STAGE]:
            result, log_evidence_found = _try(
                image, index, triples[queries[trial]], table.vertices[rows[trial]], settings
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
    distance: Array
    rms: float


def _look_up(
    image: _Image, table: TriangleTable, size: int, settings: StarSettings
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
    """Proposals in the order of how many others name one of their sides alike; old ones alone are not
    repeated.

    `detected` (P, 3) detections and `named` (P, 3) stars of each proposal.
    """
    count = len(detected)
    if count == 0:
        return np.empty(0, dtype=np.int64)
    support = np.zeros(count, dtype=np.int64)
    base = int(named.max()) + 1
    for a, b in ((0, 1), (0, 2), (1, 2)):
        first, second = detected[:, a], detected[:, b]
        swap = first > second
        d = np.where(swap, second * 64 + first, first * 64 + second)
        p, q = named[:, a].astype(np.int64), named[:, b].astype(np.int64)
        key_side = d * base * base + np.where(swap, q * base + p, p * base + q)
        if a == 0 and b == 1:
            keys = [key_side]
        else:
            keys.append(key_side)
    _, inverse, counts = np.unique(np.concatenate(keys), return_inverse=True, return_counts=True)
    support = (counts[inverse] - 1).reshape(3, count).sum(axis=0)
    order = np.lexsort((detected.sum(axis=1), -support))
    return order[detected[order].max(axis=1) >= fresh] if fresh else order


def _try(
    image: _Image, index: StarIndex, detected: NDArray, named: NDArray, settings: StarSettings
) -> tuple[_Match | None, float]:
    """One proposal: predicted field, evidence, and if that is promising, refinement."""
    field = image.field
    u = _directions(image.plane[detected])
    v = index.u_i[named]
    lens: Array = np.zeros(4)
    if field.scale_error > 0:
        ratio = np.linalg.norm(u - np.roll(u, 1, axis=0), axis=1).sum()
        lens[0] = np.log(ratio / np.linalg.norm(v - np.roll(v, 1, axis=0), axis=1).sum())
        u = _directions(image.plane[detected] * np.exp(-lens[0]))
    R = wahba(u, v, np.ones(len(u)))
    centre = image.plane[detected].mean(axis=0)
    size = np.sqrt(((image.plane[detected] - centre) ** 2).sum(axis=1).mean())
    match, evidence = _match(image, index, R, lens, centre, size, first=True, voiceless=3)
    if evidence < 3.0 or match is None:
        return None, evidence
    for k in range(4):
        R, lens, fitted = _refined(image, index, match, level=k)
        spoken = 3 + (fitted + 1) // 2
        match, evidence = _match(image, index, R, lens, centre, size, first=False, voiceless=spoken)
        if match is None:
            return None, evidence
    return match, evidence


def _match(
    image: _Image,
    index: StarIndex,
    R: Array,
    lens: Array,
    centre: Array,
    size: float,
    *,
    first: bool,
    voiceless: int,
) -> tuple[_Match | None, float]:
    """Stars predicted with an attitude, each paired with the nearest detection, and the evidence of it
    all."""
    field = image.field
    margin = 1.0 + 0.5 * field.scale_error
    radius = np.arctan(np.hypot(field.half_x, field.half_y) * margin * np.exp(-lens[0]))
    rows = index.near(R[2], radius)
    ideal = _plane(index.u_i[rows] @ R.T)
    predicted = _distorted(ideal, lens)
    inside = (np.abs(predicted) < [field.half_x, field.half_y]).all(axis=1)
    keep = np.flatnonzero(inside)[: int(_PRIOR_SHARE * len(image.plane)) + 12]
    rows, predicted = rows[keep], predicted[keep]
    if len(rows) < 3:
        return None, -np.inf
    if first:  # the triangle fixes the field near it; errors grow with the distance in units of its size
        reach = np.sqrt(((predicted - centre) ** 2).sum(axis=1))
        sigma = np.hypot(field.pixel, field.shape_error * 0.5 * reach) * (1.0 + 0.7 * reach / size)
    else:
        sigma = np.full(len(rows), 1.0 * field.pixel)
    distance, detection = image.tree.query(predicted, distance_upper_bound=float(5.0 * sigma.max()))
    relative = distance / sigma
    order = np.argsort(relative, kind="stable")
    order = order[np.isfinite(distance[order])]
    _, unique = np.unique(detection[order], return_index=True)
    chosen = order[unique]
    n = len(image.plane)
    far, spread = np.full(n, np.inf), np.full(n, float(sigma.mean()))
    far[detection[chosen]], spread[detection[chosen]] = distance[chosen], sigma[chosen]
    evidence = log_evidence(far, spread, len(rows), image.area, voiceless=voiceless)
    gate = (
        3.0 * sigma[chosen] if first else np.full(len(chosen), 3.0 * _scatter(distance[chosen], field.pixel))
    )
    close = distance[chosen] < gate
    chosen = chosen[close]
    if len(chosen) < 4:
        return None, evidence
    rms = float(np.sqrt(0.5 * (distance[chosen] ** 2).mean()))
    return _Match(detection[chosen].astype(np.int64), rows[chosen], R, lens, distance[chosen], rms), evidence


def _scatter(distance: Array, pixel: float) -> float:
    """Robust one-axis size of the distances of true matches, between a tenth of a pixel and three pixels."""
    if len(distance) == 0:
        return pixel
    return float(np.clip(np.median(distance) / 1.1774, 0.15 * pixel, 3.0 * pixel))


def _refined(image: _Image, index: StarIndex, match: _Match, *, level: int) -> tuple[Array, Array, int]:
    """Attitude, and what the matches allow to be said of an unknown lens; also the number of parameters."""
    measured = image.plane[match.detections]
    u_i = index.u_i[match.stars]
    n = len(measured)
    lens = match.lens.copy()
    free = 0
    if image.field.scale_error > 0 or image.field.shape_error > 2e-3:
        free = 1 if n < 8 else 2 if n < 16 else 4
    if image.field.scale_error == 0 and free:
        free = max(free, 2)
    R = match.R
    for _ in range(3):
        ideal_s = u_i @ R.T
        ideal = _plane(ideal_s)
        residual = (measured - _distorted(ideal, lens)).ravel()
        A = np.concatenate([_turn_columns(ideal), _lens_columns(ideal)[:, :, :free]], axis=2).reshape(
            2 * n, -1
        )
        size = np.sqrt(0.5 * (residual.reshape(n, 2) ** 2).sum(axis=1))
        weight = np.repeat(1.0 / (1.0 + (size / (2.0 * np.median(size) + 0.05 * image.field.pixel)) ** 2), 2)
        step = np.linalg.lstsq(A * weight[:, None] ** 0.5, residual * weight**0.5, rcond=1e-10)[0]
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


def _directions(plane: Array) -> Array:
    v = np.column_stack([plane, np.ones(len(plane))])
    return np.asarray(v / np.sqrt((v * v).sum(axis=1))[:, None])


def _plane(u: Array) -> Array:
    z = np.where(u[:, 2] > 0.05, u[:, 2], np.nan)
    return np.asarray(u[:, :2] / z[:, None])
