"""An attitude and distortion hypothesis: which stars it predicts where, which detections match them, its
refinement by these matches, and how likely they make it.

The distortion of an uncalibrated camera is four numbers, log scale s, k1, p1 and p2: a star at the ideal
tangent-plane point t is measured at e^s (t + k1 r^2 t + decentring terms).

A hypothesis is accepted by the ratio of the likelihoods of an image with and without it. Under it each
detection is, with probability 1 - e, one of the M predicted stars with a Gaussian position error, and with
probability e clutter, anywhere in the image; without it every detection is clutter. The ratio of the two
likelihoods, averaged over a few values of e and of the error's size, has mean one over images that do not
show the predicted stars. By Markov's inequality it exceeds K there with probability 1/K at most, so n/K
bounds the probability of a false identification after n proposals; no number of inliers has to be chosen. The
three detections that made the proposal and fix its attitude are excluded, and as many more as the distortion
parameters fitted since could have moved onto stars.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dposv

from boresight.geometry.attitude_estimate import wahba_matrices
from boresight.records.record import Floats, Ints, record
from boresight.star_id.beyond_chance import MEDIAN_CHI2
from boresight.star_id.identification.tangent_plane import (
    Complex,
    PlaneDetections,
    directions_of_tangents,
    tangents_of_directions,
)
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.image_attitude import rotation_matrix

__all__ = [
    "RESOLVED_PX",
    "STARS_PER_DETECTION",
    "AcceptedPairs",
    "AttitudeHypothesis",
    "OneToOnePairs",
    "log_likelihood_ratio",
    "match_within",
    "nearby_pairs",
    "one_to_one_pairs",
    "predict_field",
    "predict_stars",
    "refine",
    "robust_sigma",
]

# Distance, px, within which a star is not detected beside a brighter one: some two widths of a usual PSF.
RESOLVED_PX = 3.0
# Predicted stars, brightest first, that are held against each detection: room for stars that are missed, or
# misjudged in brightness.
STARS_PER_DETECTION = 1.6
# Shares e of false detections over which the likelihood of a hypothesis is averaged with equal weight:
# nothing is known of them.
_CLUTTER = np.array([0.1, 0.3, 0.6, 0.9])[:, None]
# Natural logarithms of e and of 1 - e, and the odds, false over true.
_LOG_CLUTTER, _LOG_STARS = np.log(_CLUTTER), np.log1p(-_CLUTTER)
_ODDS = np.exp(_LOG_CLUTTER - _LOG_STARS)
# Inverse squares of the factors of stated errors over which the likelihood is averaged with equal weight: a
# lens may be known better or worse than stated.
_INVERSE_VARIANCE = 4.0 ** -np.arange(-2.0, 3.0)[:, None]


@record
class AttitudeHypothesis:
    """An attitude, a distortion, and the catalogue stars that they predict in the image."""

    R: Floats  # (3, 3) R_si
    distortion: Floats  # (4,) log scale, k1, p1, p2
    rows: Ints  # (M,) rows of the index, brightest first
    predicted: Complex  # (M,) tangent-plane points, distorted


@record
class NearbyPairs:
    """All pairs of a predicted star and a detection near it."""

    stars: Ints  # (K,) rows of the hypothesis
    detections: Ints  # (K,)
    n_predicted: int  # predicted stars that were searched for


@record
class OneToOnePairs:
    """Pairs in which each predicted star and each detection occurs at most once."""

    detections: Ints  # (K,)
    stars: Ints  # (K,) rows of the hypothesis
    distance: Floats  # (K,) tangent plane
    sigma: Floats  # (K,) expected distance along one axis
    n_predicted: int  # predicted stars that were searched for


@record
class AcceptedPairs:
    """Accepted pairs of detections and catalogue stars."""

    detections: Ints  # (K,)
    stars: Ints  # (K,) rows of the index
    distance: Floats  # (K,) tangent plane


def predict_field(
    image: PlaneDetections, index: StarIndex, R: Floats, distortion: Floats
) -> AttitudeHypothesis:
    """Hypothesis with the index stars that may lie in the image and be detected, for attitude `R` (3, 3) and
    `distortion` (4,)."""
    field = image.field
    corner = math.hypot(field.half_x, field.half_y) * (1.03 + 0.5 * field.shape_error)
    # around the image, of a field twice as sparse as the mean
    enough = 2.0 * _most_predicted(image) * math.pi * corner**2 / image.area
    rows = index.near(R[2], math.atan(corner * math.exp(-distortion[0])), enough)
    resolved = index.to_brighter_rad.take(rows) > RESOLVED_PX * field.pixel
    return predict_stars(index, rows.take(resolved.nonzero()[0]), R, distortion)


def predict_stars(index: StarIndex, rows: Ints, R: Floats, distortion: Floats) -> AttitudeHypothesis:
    """Hypothesis with the index stars `rows` (M,)."""
    ideal = tangents_of_directions(index.u_i.take(rows, axis=0) @ R.T)
    if not any(distortion.tolist()):  # a calibrated camera
        return AttitudeHypothesis(R, distortion, rows, ideal)
    return AttitudeHypothesis(
        R, distortion, rows, _distorted(ideal, _distortion_derivatives(ideal), distortion)
    )


def nearby_pairs(image: PlaneDetections, hypothesis: AttitudeHypothesis, sigma: Floats) -> NearbyPairs:
    """Pairs within five `sigma` (M,), of the brightest predicted stars that so many detections can show."""
    inside = image.field.contains(hypothesis.predicted).nonzero()[0][: _most_predicted(image)]
    star, detection = image.within(hypothesis.predicted.take(inside), 5.0 * sigma.take(inside))
    return NearbyPairs(inside.take(star), detection, len(inside))


def _most_predicted(image: PlaneDetections) -> int:
    return int(STARS_PER_DETECTION * len(image.points)) + 12


def one_to_one_pairs(
    image: PlaneDetections, hypothesis: AttitudeHypothesis, near: NearbyPairs, sigma: Floats
) -> OneToOnePairs:
    """For each star the nearest detection, and for each of these the star at the least distance in `sigma`
    (M,)."""
    distance = np.abs(hypothesis.predicted.take(near.stars) - image.points.take(near.detections))
    nearest = _row_of_least(near.stars, distance, len(hypothesis.rows))
    star, detection = near.stars.take(nearest), near.detections.take(nearest)
    distance, own = distance.take(nearest), sigma.take(star)
    best = _row_of_least(detection, distance / own, len(image.points))
    return OneToOnePairs(
        detection.take(best), star.take(best), distance.take(best), own.take(best), near.n_predicted
    )


def match_within(
    hypothesis: AttitudeHypothesis, pairs: OneToOnePairs, limit: Floats | float
) -> AcceptedPairs | None:
    """The pairs closer than `limit`, scalar or (K,); None if there are fewer than four."""
    close = (pairs.distance < limit).nonzero()[0]
    if len(close) < 4:
        return None
    stars = hypothesis.rows.take(pairs.stars.take(close))
    return AcceptedPairs(pairs.detections.take(close), stars, pairs.distance.take(close))


def robust_sigma(distance: Floats, pixel: float) -> float:
    """One-axis standard deviation from the median of distances (K,), limited to 0.15 to 3 pixels; all in the
    unit in which `pixel` is the size of a pixel.
    """
    if len(distance) == 0:
        return pixel
    median = float(np.sort(distance)[len(distance) // 2])
    return min(max(median / math.sqrt(MEDIAN_CHI2), 0.15 * pixel), 3.0 * pixel)


def refine(
    image: PlaneDetections, index: StarIndex, hypothesis: AttitudeHypothesis, match: AcceptedPairs
) -> tuple[Floats, Floats, int]:
    """R_si (3, 3), distortion (4,), number of fitted parameters, from the matched stars with equal weights.

    An uncalibrated camera gets as many distortion parameters as the number of stars allows: scale, k1, p1,
    p2.
    """
    measured = image.points.take(match.detections)
    u_i = index.u_i.take(match.stars, axis=0)
    if image.field.is_calibrated:
        R_si = wahba_matrices((directions_of_tangents(measured).T @ u_i)[None])
        return R_si[0], hypothesis.distortion, 3
    n = len(measured)
    free = 2 if n < 16 else 4
    if image.field.scale_error > 0 and n < 8:
        free = 1
    R, distortion = hypothesis.R, hypothesis.distortion.copy()
    for _ in range(3):
        ideal = tangents_of_directions(u_i @ R.T)
        by_distortion = _distortion_derivatives(ideal)
        residual = measured - _distorted(ideal, by_distortion, distortion)
        size = np.abs(residual) / math.sqrt(2.0)
        ordered = np.sort(size)
        median = 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])
        weight = 1.0 / np.hypot(1.0, size / (2.0 * median + 0.05 * image.field.pixel))
        A = (np.array([*_rotation_derivatives(ideal), *by_distortion[:free], residual]) * weight).view(float)
        products = A @ A.T
        _, step, undetermined = dposv(products[:-1, :-1], products[:-1, -1])
        if undetermined:
            break
        R = rotation_matrix(step[:3].tolist()) @ R
        distortion[:free] += step[3:]
    return R, distortion, 3 + free


def _rotation_derivatives(t: Complex) -> tuple[Complex, Complex, Complex]:
    """d(tangent-plane point) / d(right-handed rotation about the axes of s), (N,) each."""
    return -1j - t.imag * t, 1.0 + t.real * t, 1j * t


def _distortion_derivatives(t: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """d(distorted point) / d(log scale, k1, p1, p2), (N,) each."""
    r2 = np.abs(t) ** 2
    return t, r2 * t, r2 + 2.0 * t.real * t, 1j * r2 + 2.0 * t.imag * t


def _distorted(t: Complex, derivatives: tuple[Complex, ...], distortion: Floats) -> Complex:
    """Distorted points (N,) of ideal ones, with the derivatives there."""
    log_scale, k1, p1, p2 = distortion.tolist()
    _, radial, along_x, along_y = derivatives
    return np.asarray((t + k1 * radial + p1 * along_x + p2 * along_y) * math.exp(log_scale))


def _row_of_least(group: Ints, value: Floats, groups: int) -> Ints:
    """The row of the least `value` (N,) in each non-empty `group` (N,) of 0 to `groups` - 1, in order."""
    greatest_first = (-value).argsort(kind="stable")
    least = np.full(groups, -1)
    least[group.take(greatest_first)] = greatest_first  # later assignments overwrite: the least remains
    return least[least >= 0]


def log_likelihood_ratio(
    distance: Floats, sigma: Floats, n_clutter: int, n_predicted: int, area: float, *, n_excluded: int = 0
) -> float:
    """Natural logarithm of the likelihood ratio of an image with a hypothesis to one without.

    `distance` (K,) is that of paired detections from their predicted stars, `sigma` (K,) its expected size
    along one axis, `area` the image's, in the same units. Of all detections `n_clutter` are not paired;
    `n_predicted` stars are predicted in the image. The `n_excluded` best pairs, which formed the hypothesis,
    do not count.
    """
    if n_predicted == 0:
        return -np.inf
    weight = area / (n_predicted * 2.0 * np.pi * sigma**2)
    half_square = 0.5 * np.minimum(distance / sigma, 37.0) ** 2
    if n_excluded:
        counted = (half_square - np.log(weight)).argsort(kind="stable")[n_excluded:]
        weight, half_square = weight.take(counted), half_square.take(counted)
    density = weight * _INVERSE_VARIANCE * np.exp(-half_square * _INVERSE_VARIANCE)
    # log(e + (1 - e) density), with log(1 - e) taken out of the sum
    of_pairs = np.log(_ODDS[:, None] + density).sum(axis=2) + len(weight) * _LOG_STARS
    total = of_pairs + n_clutter * _LOG_CLUTTER
    largest = float(total.max())
    return largest + math.log(np.exp(total - largest).sum() / total.size)
