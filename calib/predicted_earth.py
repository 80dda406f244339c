"""Errors of predicted Earth orientation as unknowns: rotations of the Earth about the axes of ITRS, each in
units of its own 1-sigma.

The variance of a prediction grows with a power 2h of the days past the last measured value (IERS Bulletin
A). Values of two days, or of two issues of the table, are correlated as those of the process whose increments
grow by that law (fractional Brownian motion B): the error on day d of a table measured until m is
B(d) - B(m).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from boresight.records.record import Floats

__all__ = ["correlation_of_predictions", "earth_names", "is_earth", "predictions_of", "prior_of_predictions"]

AXES = "xyz"
# Exponents h by axis: IERS Bulletin A states 1-sigma in proportion to D^0.80 for the pole and D^0.75 for UT1.
GROWTH = (0.80, 0.80, 0.75)
PREDICTION = re.compile(r"\d{1,6}/\d{1,6}")  # MJD of the last measured value, of the day


def earth_names(predictions: Sequence[str]) -> tuple[str, ...]:
    """Names of the unknowns of these predictions (`EarthRotation.prediction`), three each."""
    return tuple(f"earth/{one}/{axis}" for one in predictions for axis in AXES)


def is_earth(unknown: str) -> bool:
    """Whether a shared unknown is such a rotation."""
    return unknown.startswith("earth/")


def predictions_of(names: Sequence[str]) -> tuple[str, ...]:
    """The predictions with these names of unknowns. `ValueError` unless there are three names of each."""
    predictions = tuple(dict.fromkeys(name.removeprefix("earth/")[:-2] for name in names))
    if tuple(names) != earth_names(predictions) or not all(map(PREDICTION.fullmatch, predictions)):
        raise ValueError(f"{', '.join(names)}: not three rotations of each prediction of Earth orientation")
    return predictions


def correlation_of_predictions(one: Sequence[str], other: Sequence[str]) -> Floats:
    """Correlation (3 A, 3 B) of the errors of A predictions with those of B others, before any observation.

    `ValueError` for texts that are no predictions.
    """
    (m1, d1), (m2, d2) = (np.array([text.split("/") for text in texts], float).T for texts in (one, other))
    parts = np.zeros((len(one), 3, len(other), 3))
    for axis, h in enumerate(GROWTH):
        cross = _power(d1, m2, h) + _power(m1, d2, h) - _power(d1, d2, h) - _power(m1, m2, h)
        parts[:, axis, :, axis] = 0.5 * cross / np.outer((d1 - m1) ** h, (d2 - m2) ** h)
    return parts.reshape(3 * len(one), 3 * len(other))


def _power(a: Floats, b: Floats, h: float) -> Floats:
    return np.asarray(np.abs(a[:, None] - b) ** (2.0 * h))


def prior_of_predictions(names: Sequence[str]) -> Floats:
    """Prior information (N, N) of N unknowns, three axes of each prediction. `ValueError` for other names."""
    predictions = predictions_of(names)
    if not predictions:
        return np.zeros((0, 0))
    return np.asarray(np.linalg.inv(correlation_of_predictions(predictions, predictions)))
