"""How much likelier an image is with a proposed attitude than without: the test that an identification has to
pass.

Under the proposal each detection is, with probability 1 - e, one of the M predicted stars with a Gaussian
error, and with probability e something else, anywhere in the image; without it every detection is something
else. The ratio of the two likelihoods, averaged over a few values of e and of the error's size, has mean one
over images without the proposed stars. So (Markov) it passes the value K there with probability 1/K at most,
and with n proposals tried n/K bounds the probability of a false identification; no count of inliers is
chosen. The three detections that made the proposal and fix its attitude do not vote, nor do as many more as
the lens parameters fitted since could have bent.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["log_evidence"]

Array = NDArray[np.float64]

# e, the share of detections that are none of the predicted stars; the error in units of the expected one
_OTHERS = np.array([0.1, 0.3, 0.6, 0.9])[:, None, None]
_ODDS = _OTHERS / (1.0 - _OTHERS)
_LOG_OTHERS, _LOG_STARS = np.log(_OTHERS[:, :, 0]), np.log(1.0 - _OTHERS[:, :, 0])
_NARROWER = np.array([0.25, 0.5, 1.0, 2.0, 4.0])[:, None] ** -2.0


def log_evidence(
    distance: Array, sigma: Array, others: int, predicted: int, area: float, *, voiceless: int = 0
) -> float:
    """Natural logarithm of the likelihood ratio of an image with a proposal to one without.

    Parameters
    ----------
    distance, sigma : (K,), (K,)
        From each of K detections to the predicted star it is paired with, and the expected error along one
        axis.
    others : int
        Detections without a predicted star near them.
    predicted : int
        Number of predicted stars in the image.
    area : float
        Of the image, in squared units of `distance`.
    voiceless : int
        How many of the strongest votes are left out.
    """
    if predicted == 0:
        return -np.inf
    weight = area / (predicted * 2.0 * np.pi * sigma**2)
    half_square = 0.5 * np.minimum(distance / sigma, 37.0) ** 2
    if voiceless:
        spoken = (half_square - np.log(weight)).argsort()[voiceless:]
        weight, half_square = weight.take(spoken), half_square.take(spoken)
    density = weight * _NARROWER * np.exp(-half_square * _NARROWER)
    # log(e + (1 - e) density), the log(1 - e) taken out of the sum
    votes = np.log(_ODDS + density).sum(axis=2) + len(weight) * _LOG_STARS
    total = votes + others * _LOG_OTHERS
    top = float(total.max())
    return top + math.log(np.exp(total - top).sum() / total.size)
