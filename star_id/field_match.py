"""Which detections are which stars, once camera and attitude are nearly known: probabilities instead of the
nearest within a radius.

A detection is a predicted star, Gaussian about its place with the covariances of centroid and prediction, or
clutter, uniform over the image. The density of clutter and the probability that a star is detected, by
brightness, are those that the image shows (expectation maximisation). A false detection is then taken for a
star only within the few standard deviations where stars are denser than clutter.
"""

from __future__ import annotations

import numpy as np

from boresight.records.record import Floats, Ints, array, record
from boresight.star_id.beyond_chance import NEVER_SIGMA
from boresight.star_id.common_variance import SMALL_CHANGE
from boresight.star_id.identification.triangle_index import concatenated_ranges

__all__ = ["FieldMatch", "match_field"]

# Predicted stars of like brightness that share one probability of detection: it is then known to 0.1, 0.5 /
# sqrt(24).
_STARS_PER_GROUP = 24


@record(kw_only=True)
class FieldMatch:
    """Pairs of detections and predicted stars, each of either at most once."""

    detections: Ints = array("K", "rows of the detections")
    stars: Ints = array("K", "rows of the predicted stars")


def match_field(
    xy_px: Floats, cov_px: Floats, predicted_px: Floats, cov_predicted_px: Floats, area_px: float
) -> FieldMatch:
    """Probable pairs of detections (N, 2), px, and predicted stars (M, 2), brightest first.

    `cov_px` (N, 2, 2) and `cov_predicted_px` (M, 2, 2) are their covariances, px^2, `area_px` that of the
    image, px^2. Pairs of a probability below one half are left out.
    """
    detection, star = _near(xy_px, cov_px, predicted_px, cov_predicted_px)
    S = (cov_px.take(detection, axis=0) + cov_predicted_px.take(star, axis=0)).reshape(-1, 4)
    (x2, xy, _, y2), (x, y) = S.T, (xy_px.take(detection, axis=0) - predicted_px.take(star, axis=0)).T
    determinant = x2 * y2 - xy * xy
    square = (y2 * x * x - 2.0 * xy * x * y + x2 * y * y) / determinant
    density = np.exp(-0.5 * square) / (2.0 * np.pi * np.sqrt(determinant))
    group = np.arange(len(predicted_px)) // _STARS_PER_GROUP
    size = np.bincount(group)
    detected, clutter = np.full(len(size), 0.5), len(xy_px) / area_px
    of_group = group[star]
    for _ in range(12):  # the matches repeat before
        before = detected
        of_star = detected[of_group] * density
        of_all = clutter + np.bincount(detection, of_star, minlength=len(xy_px))
        probability = of_star / of_all[detection]
        detected = (np.bincount(of_group, probability, minlength=len(size)) + 0.5) / (size + 1.0)
        clutter = max(len(xy_px) - float(probability.sum()), 1.0) / area_px
        if np.abs(detected - before).max(initial=0.0) < SMALL_CHANGE:
            break
    probable = np.flatnonzero(probability > 0.5)  # likelier a match than not
    best_last = probable[np.argsort(probability[probable], kind="stable")]
    row = np.full(len(predicted_px), -1)
    row[star[best_last]] = best_last
    kept = np.sort(row[row >= 0])
    return FieldMatch(detections=detection[kept], stars=star[kept])


def _near(xy: Floats, cov: Floats, predicted: Floats, cov_predicted: Floats) -> tuple[Ints, Ints]:
    """Rows (K,), (K,) of detections and predicted stars within `NEVER_SIGMA` of one another."""
    own = np.sqrt(np.trace(cov_predicted, axis1=1, axis2=2))
    largest = float(np.sqrt(np.trace(cov, axis1=1, axis2=2).max(initial=0.0)))
    reach = NEVER_SIGMA * np.hypot(own, largest)
    along_x, x = xy[:, 0].argsort(kind="stable"), predicted[:, 0]
    star, position = concatenated_ranges(*xy[along_x, 0].searchsorted([x - reach, x + reach]))
    detection = along_x[position]
    near = ((xy[detection] - predicted[star]) ** 2).sum(axis=1) <= reach[star] ** 2
    return detection[near], star[near]
