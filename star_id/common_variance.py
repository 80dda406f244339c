"""A position error that each star has for itself and that its centroid's covariance does not hold: its
variance, common to all stars of an image, as their residuals show it; and what evidence asks for it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from boresight.records.record import Floats

__all__ = [
    "PER_PARAMETER",
    "ROUNDS",
    "SMALL_CHANGE",
    "common_variance",
    "share_by_evidence",
    "zero_of_falling",
]

# Gain of log evidence by a variance common to all stars, a stretch or a smooth distortion for it to be
# stated: one for each size that is estimated (Akaike 1974).
PER_PARAMETER = 1.0
# Most rounds of a search, or of a solution and its common variance in turn, and the relative change that
# ends them (set by hand).
ROUNDS, SMALL_CHANGE = 40, 1e-4


def common_variance(square: Floats, leverage: Floats, own_px2: Floats, before: float) -> float:
    """Variance, px^2 along one axis, of a position error common to all stars, by restricted maximum
    likelihood, from squared residuals (N,), px^2, of stars with variances (N,) of their own.

    At the maximum  sum (2 - h) / v = sum r^2 / v^2,  v the total variance of a star along one axis, r its
    residual, h its `leverage` (N,), computed with the variance `before`. It is zero where the likelihood does
    not ask for it: of stars as good as stated half show some by chance, of which errors would be overstated.
    Near that limit it is a part of its size.
    """

    def excess(variance: float) -> float:
        v = own_px2 + variance
        return float((square / v**2).sum() - ((2.0 - leverage) / v).sum())

    if excess(0.0) <= 0.0:
        return 0.0
    if float((2.0 - leverage).sum()) < SMALL_CHANGE:  # no degree of freedom is left
        return before
    most = max(before, float(own_px2.min()))
    while excess(most) > 0.0:  # from somewhere on it falls as -dof / variance
        most *= 2.0
    least = 0.5 * most
    while excess(least) <= 0.0:
        least *= 0.5
    likeliest = zero_of_falling(excess, least, 2.0 * least)

    def log_likelihood(variance: float) -> float:
        v = own_px2 + variance
        return -0.5 * float((square / v + (2.0 - leverage) * np.log(v)).sum())

    gained = log_likelihood(likeliest) - log_likelihood(0.0)
    return likeliest * share_by_evidence(gained, PER_PARAMETER)


def share_by_evidence(gained: float, limit: float) -> float:
    """Share that a model has in a mean with a simpler one, by the log evidence that it gains: none to half
    a unit below the limit, all from half a unit above it. What is chosen at a limit makes results jump where
    rounding turns the choice."""
    return min(max(gained - limit + 0.5, 0.0), 1.0)


def zero_of_falling(falling: Callable[[float], float], least: float, most: float) -> float:
    """Where a function that falls from `least` to `most` is zero, to ten digits, or the nearer end; by false
    position (Dowell and Jarratt 1971, "Illinois"; `scipy.optimize` takes 0.1 s to load)."""
    (old, of_old), (new, of_new) = (least, falling(least)), (most, falling(most))
    if of_old <= 0.0 or of_new >= 0.0:
        return least if of_old <= 0.0 else most
    while abs(new - old) > 1e-10 * abs(new) and of_new != 0.0:
        place = new - of_new * (new - old) / (of_new - of_old)
        value = falling(place)
        old, of_old = (new, of_new) if (value > 0.0) != (of_new > 0.0) else (old, 0.5 * of_old)
        new, of_new = place, value
    return new
