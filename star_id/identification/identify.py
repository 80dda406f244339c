"""Star identification without a known attitude: triangles propose attitudes, the whole image decides.

Triangles of the brightest detections are looked up by shape (`proposals`). Each of the likelier ones becomes
a hypothesis: all catalogue stars of the field are predicted, attitude and distortion are refined by the
detections that match (`hypothesis`), and the likelihood ratio of the image with and without it decides
(`likelihood`).
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.identification.hypothesis import (
    AcceptedPairs,
    AttitudeHypothesis,
    OneToOnePairs,
    log_likelihood_ratio,
    match_within,
    nearby_pairs,
    one_to_one_pairs,
    predict_field,
    predict_stars,
    refine,
    robust_sigma,
)
from boresight.star_id.identification.proposals import MOST_DETECTIONS, propose
from boresight.star_id.identification.tangent_plane import Complex, FieldOfView, PlaneDetections
from boresight.star_id.identification.triangle_index import STARS_PER_FIELD, StarIndex
from boresight.star_id.image_attitude import rotation_from_matrix
from boresight.star_id.settings import StarSettings

__all__ = [
    "DENSER",
    "FEW_DETECTIONS",
    "SOME_DETECTIONS",
    "USUAL",
    "WIDER",
    "Identification",
    "NotIdentified",
    "identify_stars",
    "stages_of",
]

# Tables of the index: the usual one; that of larger triangles of brighter stars, fewer but more robust to
# false detections; that of smaller triangles of more stars, should many be missing.
USUAL, WIDER, DENSER = range(3)


def stages_of(table: int, *ends: int, begin: int = 0) -> tuple[tuple[int, int, int], ...]:
    """Stages (table, from, to), one up to each of `ends` (brightest detections): each tries triangles of the
    brightest `to` detections that are not all among the brightest `from`."""
    return tuple((table, below, end) for below, end in pairwise((begin, *ends)))


# Brightest detections whose triangles, 20, are tried first; then those of as many as the index has stars in a
# field, last all (set by hand).
FEW_DETECTIONS = 6
# The same of an unknown camera's further passes.
SOME_DETECTIONS = 2 * FEW_DETECTIONS
# Stages of identification in their order.
_STAGES = (
    *stages_of(USUAL, FEW_DETECTIONS),
    *stages_of(WIDER, FEW_DETECTIONS),
    *stages_of(USUAL, STARS_PER_FIELD, begin=FEW_DETECTIONS),
    *stages_of(WIDER, STARS_PER_FIELD, begin=FEW_DETECTIONS),
    *stages_of(USUAL, MOST_DETECTIONS, begin=STARS_PER_FIELD),
    *stages_of(DENSER, STARS_PER_FIELD, MOST_DETECTIONS),
)
# Natural logarithm of the likelihood over that of chance, below which a proposal is not refined: where
# errors are as expected a right one has less with probability exp(-4) at most, and an image has many right
# ones.
_HOPELESS = -4.0
# Brightest detections by which a proposal is tried before all are, once one was wrong: most others are, too,
# and these tell so (set by hand).
_BRIGHT = 100
# Error of predictions over the mean distance of detections, below which each star's nearest detection is
# its own: another is nearer in pi * 0.05^2, 1 %, of the cases.
_UNAMBIGUOUS = 0.05


@record(kw_only=True)
class Identification:
    """Identified stars of an image. Row n of `detections` and `stars` belong together."""

    detections: Ints = array("M", "rows of the detections handed over")
    stars: Ints = array("M", "rows of the index's stars")
    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    distortion: Floats = array("4", "log scale, k1, p1, p2, tangent plane; zero for a calibrated camera")
    false_alarm_probability: float = scalar("upper bound, over all proposals tried")
    log_false_alarm_probability: float = scalar("its natural logarithm")
    proposals: int = scalar("triangles that agreed with the catalogue")


@record
class NotIdentified:
    """Outcome of an image that could not be identified; false in a condition."""

    reason: str = scalar("what was found, what is needed and what may help, in words")
    n_stars: int = scalar("detections or identified stars that there were", default=0)
    proposals: int = scalar("triangles that agreed with the catalogue", default=0)
    best_log_odds: float = scalar("largest log likelihood ratio less log(proposals)", default=-math.inf)

    def __bool__(self) -> Literal[False]:
        return False


def identify_stars(
    xy: Floats,
    field: FieldOfView,
    index: StarIndex,
    settings: StarSettings,
    *,
    stages: tuple[tuple[int, int, int], ...] = _STAGES,
    tried: int = 0,
) -> Identification | NotIdentified:
    """Catalogue stars and attitude of detections given in the tangent plane.

    Parameters
    ----------
    xy : (N, 2) array
        Tangent-plane coordinates (u_x, u_y) / u_z in frame s, brightest first, distortion removed as far as
        it is known (`star_id.sight.tangent_coordinates`).
    field : FieldOfView
        Size of the image and the errors to expect of the camera's model.
    index : StarIndex
        Stars and triangle tables for that field of view (`build_index`).
    settings : StarSettings
        `max_false_alarm_probability` and `max_identification_stars` are used.
    stages : tuple of (table, from, to)
        Order of the search, as in `_STAGES`.
    tried : int
        Proposals examined elsewhere (earlier stages, other fields of view); they count in the false-alarm
        probability.

    Returns
    -------
    Identification or NotIdentified

    Raises
    ------
    ValueError
        If a coordinate is not finite.
    """
    n = len(xy)
    if n < 4:
        return NotIdentified(f"{n} stars found, 4 are needed; lower the threshold or expose longer", n)
    image = PlaneDetections.from_xy(xy, field)
    tables = index.tables_for(field.equivalent_fov_rad)
    examined, best, tried_by = tried, -math.inf, [image]
    limit = math.log(settings.max_false_alarm_probability)
    for number, done, brightest in stages:
        size = min(brightest, n, settings.max_identification_stars)
        if size <= done or (table := tables[number]) is None:
            continue
        # where many stars are missing, so are the neighbours that proposals are judged by
        proposals = propose(image, table, index.u_i, done, size, unlikely_too=number == DENSER)
        examined += proposals.examined
        for triangle, R, log_scale in zip(proposals.detections, proposals.R, proposals.log_scale):
            corners = image.points[triangle]
            for seen in tried_by:
                trial = _try_proposal(seen, index, corners, R, float(log_scale))
                if trial is None or trial.log_ratio <= _HOPELESS:
                    break
            if trial is not None:
                best = max(best, trial.log_ratio - math.log(examined))
                if math.log(examined) - trial.log_ratio < limit:
                    return _identification(image, index, trial, examined)
            if n > _BRIGHT and len(tried_by) == 1:
                tried_by = [PlaneDetections.from_xy(xy[:_BRIGHT], field), image]
    return NotIdentified(
        f"{n} stars found, {examined} triangles agree with the catalogue, none explains the image"
        f" (best log odds {best:.1f}, {-limit:.1f} needed)",
        n,
        examined,
        best,
    )


@record
class _Trial:
    """A refined hypothesis with its matches and its log likelihood ratio."""

    match: AcceptedPairs
    R_si: Floats  # (3, 3)
    distortion: Floats
    log_ratio: float


def _try_proposal(
    image: PlaneDetections, index: StarIndex, corners: Complex, R: Floats, log_scale: float
) -> _Trial | None:
    """Trial of one proposal, made from the triangle of detections at `corners` (3,)."""
    field = image.field
    hypothesis = predict_field(image, index, R, np.array([log_scale, 0.0, 0.0, 0.0]))
    # the triangle fixes the field near it; errors grow with the distance in units of its size
    a, b, c = corners.tolist()
    centre = (a + b + c) / 3.0
    size = math.hypot(abs(a - centre), abs(b - centre), abs(c - centre)) / math.sqrt(3.0)
    reach = np.abs(hypothesis.predicted - centre)
    sigma = np.sqrt(field.pixel**2 + (0.5 * field.shape_error * reach) ** 2) * (1.0 + 0.7 / size * reach)
    return _refined_trial(image, index, hypothesis, sigma)


def _refined_trial(
    image: PlaneDetections, index: StarIndex, hypothesis: AttitudeHypothesis, sigma: Floats
) -> _Trial | None:
    """The hypothesis refined by the detections that match it; None if they are fewer than four.

    Its predictions are good to `sigma` (M,); the three detections that it was made to fit do not count in
    the likelihood ratio. One that explains the image far worse than chance is not refined.
    """
    field = image.field
    near = nearby_pairs(image, hypothesis, sigma)
    pairs = one_to_one_pairs(image, hypothesis, near, sigma)
    match = match_within(hypothesis, pairs, 3.0 * pairs.sigma)
    if match is None:
        return None
    if not field.is_calibrated and (log_ratio := _log_ratio(image, pairs, 3)) < _HOPELESS:
        return _Trial(match, hypothesis.R, hypothesis.distortion, log_ratio)
    spacing = math.sqrt(image.area / len(image.points))
    unambiguous = field.is_calibrated and sigma.max(initial=0.0) < _UNAMBIGUOUS * spacing
    for _ in range(1 if field.is_calibrated else 4):  # each fit of the distortion lets further stars match
        R_si, distortion, fitted = refine(image, index, hypothesis, match)
        hypothesis = predict_stars(index, hypothesis.rows, R_si, distortion)
        sigma = np.full(len(hypothesis.rows), field.pixel)
        if not unambiguous:
            near = nearby_pairs(image, hypothesis, sigma)
        pairs = one_to_one_pairs(image, hypothesis, near, sigma)
        limit = max(3.0 * robust_sigma(pairs.distance, field.pixel), field.pixel)
        before, match = match, match_within(hypothesis, pairs, limit)
        if match is None:
            return None
        if np.array_equal([match.stars, match.detections], [before.stars, before.detections]):
            break
    return _Trial(match, R_si, distortion, _log_ratio(image, pairs, 3 + (fitted - 2) // 2))


def _settled(image: PlaneDetections, index: StarIndex, trial: _Trial) -> _Trial:
    """The trial of a calibrated camera refined by its own matches, where these are pixels off: a triangle in
    a corner finds the stars near it, and takes others for those far from it.
    """
    error, pixel = robust_sigma(trial.match.distance, image.field.pixel), image.field.pixel
    if not image.field.is_calibrated or error < pixel:
        return trial
    hypothesis = predict_field(image, index, trial.R_si, trial.distortion)
    for _ in range(8):  # matching and fitting again
        R_si, distortion, _ = refine(image, index, hypothesis, trial.match)
        hypothesis = predict_stars(index, hypothesis.rows, R_si, distortion)
        sigma = np.full(len(hypothesis.rows), error)
        pairs = one_to_one_pairs(image, hypothesis, nearby_pairs(image, hypothesis, sigma), sigma)
        match = match_within(hypothesis, pairs, max(3.0 * robust_sigma(pairs.distance, pixel), pixel))
        if match is None:
            break
        trial = _Trial(match, R_si, distortion, trial.log_ratio)
        if (error := robust_sigma(match.distance, pixel)) < pixel:
            break
    return trial


def _log_ratio(image: PlaneDetections, pairs: OneToOnePairs, excluded: int) -> float:
    """Log likelihood ratio of the image with and without the hypothesis that made these pairs."""
    clutter = len(image.points) - len(pairs.detections)
    return log_likelihood_ratio(
        pairs.distance, pairs.sigma, clutter, pairs.n_predicted, image.area, n_excluded=excluded
    )


def _identification(
    image: PlaneDetections, index: StarIndex, trial: _Trial, proposals: int
) -> Identification:
    trial = _settled(image, index, trial)
    log_probability = min(math.log(max(proposals, 1)) - trial.log_ratio, 0.0)
    return Identification(
        detections=trial.match.detections,
        stars=trial.match.stars,
        R_si=rotation_from_matrix(trial.R_si),
        distortion=trial.distortion,
        false_alarm_probability=math.exp(max(log_probability, -700.0)),
        log_false_alarm_probability=log_probability,
        proposals=proposals,
    )
