"""Likelihood ratio of an image with and without a hypothesis: the acceptance test of an identification.

Under the hypothesis each detection is, with probability 1 - e, one of the M predicted stars with a Gaussian
position error, and with probability e clutter, anywhere in the image; without it every detection is clutter.
The ratio of the two likelihoods, averaged over a few values of e and of the error's size, has mean one over
images that do not show the predicted stars. By Markov's inequality it exceeds K there with probability 1/K at
most, so n/K bounds the probability of a false identification after n proposals; no number of inliers has to
be chosen. The three detections that made the proposal and fix its attitude are excluded, and as many more as
the distortion parameters fitted since could have moved onto stars.
"""

from __future__ import annotations

import math

import numpy as np

from boresight.records.record import Floats

__all__ = ["log_likelihood_ratio"]

# Shares e of false detections over which the likelihood of a hypothesis is averaged with equal weight:
# nothing is known of them.
_CLUTTER = np.array([0.1, 0.3, 0.6, 0.9])[:, None]
# Natural logarithms of e and of 1 - e, and the odds, false over true.
_LOG_CLUTTER, _LOG_STARS = np.log(_CLUTTER), np.log1p(-_CLUTTER)
_ODDS = np.exp(_LOG_CLUTTER - _LOG_STARS)
# Inverse squares of the factors of stated errors over which the likelihood is averaged with equal weight: a
# lens may be known better or worse than stated.
_INVERSE_VARIANCE = 4.0 ** -np.arange(-2.0, 3.0)[:, None]


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
