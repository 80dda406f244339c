"""Which detection is which predicted star: all that lie near one another, of these each at most once, and of
these the ones that are close enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boresight.star_id.identification.hypothesis import Guess
from boresight.star_id.identification.ranges import least_of_each
from boresight.star_id.identification.tangent_plane import PlaneImage

__all__ = ["Match", "Near", "Pairs", "kept", "near_pairs", "paired", "scatter"]

Array = NDArray[np.float64]

_PRIOR_SHARE = 1.6  # predicted stars kept, brightest first, per detection


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """Stars predicted inside and the detections that they may be: all pairs near one another."""

    places: NDArray[np.int64]  # (K,) rows of the guess
    detections: NDArray[np.int64]  # (K,)
    predicted: int  # stars asked for


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Predicted stars and the detections near them, each at most once."""

    detections: NDArray[np.int64]  # (K,)
    places: NDArray[np.int64]  # (K,) rows of the guess
    distance: Array  # (K,)
    sigma: Array  # (K,) expected along one axis
    predicted: int  # stars asked for


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Detections and catalogue stars that belong together."""

    detections: NDArray[np.int64]
    stars: NDArray[np.int64]
    distance: Array  # tangent plane


def near_pairs(image: PlaneImage, guess: Guess, sigma: Array) -> Near:
    """Pairs within five `sigma` (M,), of the brightest stars that an image with so many detections is asked
    for."""
    asked = int(_PRIOR_SHARE * len(image.plane)) + 12
    inside = image.field.contains(guess.predicted).nonzero()[0][:asked]
    star, detection = image.within(guess.predicted.take(inside), 5.0 * sigma.take(inside))
    return Near(inside.take(star), detection, len(inside))


def paired(image: PlaneImage, guess: Guess, near: Near, sigma: Array) -> Pairs:
    """Of what is near one another: each star with the nearest detection, each detection with the star that it
    fits best, in units of the star's own `sigma` (M,)."""
    distance = np.abs(guess.predicted.take(near.places) - image.plane.take(near.detections))
    nearest = least_of_each(near.places, distance, len(guess.rows))
    star, detection, distance = (
        near.places.take(nearest),
        near.detections.take(nearest),
        distance.take(nearest),
    )
    own = sigma.take(star)
    best = least_of_each(detection, distance / own, len(image.plane))
    return Pairs(detection.take(best), star.take(best), distance.take(best), own.take(best), near.predicted)


def kept(guess: Guess, pairs: Pairs, limit: Array | float) -> Match | None:
    """The pairs no farther apart than `limit`, four at least."""
    close = (pairs.distance < limit).nonzero()[0]
    if len(close) < 4:
        return None
    stars = guess.rows.take(pairs.places.take(close))
    return Match(pairs.detections.take(close), stars, pairs.distance.take(close))


def scatter(distance: Array, pixel: float) -> float:
    """Robust one-axis size of the distances of true matches, between a seventh of a pixel and three
    pixels."""
    if len(distance) == 0:
        return pixel
    middle = float(distance[distance.argsort()[len(distance) // 2]])
    return min(max(middle / 1.1774, 0.15 * pixel), 3.0 * pixel)
