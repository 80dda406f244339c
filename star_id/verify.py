"""How much likelier an image is with a proposed attitude than without: the test that an identification has to
pass.

Under the proposal each detection is, with probability 1 - e, one of the M predicted stars with a Gaussian
error, and with probability e something else, anywhere in the image; without it every detection is something
else. The ratio of the two likelihoods, averaged over a few values of e and of the error's size, has mean one
over images without the proposed stars. So (Markov) it passes the value K there with probability 1/K at most,
and with n proposals tried n/K bounds the probability of a false identification; no count of inliers is
chosen. Detections that made the proposal do not vote, nor do as many more as the parameters fitted since
could have bent to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["log_evidence"]

Array = NDArray[np.float64]

_OTHERS = np.array([0.1, 0.3, 0.6, 0.9])  # e, the share of detections that are none of the predicted stars
_SIZES = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # error in units of the expected one


def log_evidence(distance: Array, sigma: Array, predicted: int, area: float, *, voiceless: int = 0) -> float:
    """Natural logarithm of the likelihood ratio of an image with a proposal to one without.

    Parameters
    ----------
    distance : (N,)
        From each detection to the nearest predicted star no other detection claims; infinite where there is
        none.
    sigma : (N,)
        Expected error of that distance along one axis.
    predicted : int
        Number of predicted stars in the image.
    area : float
        Of the image, in squared units of `distance`.
    voiceless : int
        How many of the strongest detections are left out of the vote.
    """
    if predicted == 0:
        return -np.inf
    s = sigma * _SIZES[:, None]  # (sizes, N)
    with np.errstate(over="ignore"):
        density = area / (predicted * 2.0 * np.pi * s**2) * np.exp(-0.5 * np.minimum(distance / s, 37.0) ** 2)
    others = _OTHERS[:, None, None]
    votes = np.log(others + (1.0 - others) * density)  # (others, sizes, N)
    if voiceless:
        votes = np.sort(votes, axis=2)[:, :, : max(0, votes.shape[2] - voiceless)]
    total = votes.sum(axis=2).ravel()
    top = total.max()
    return float(top + np.log(np.exp(total - top).mean()))
