"""Where and when an image of the sky was taken, and where the catalogue's stars stood as seen from there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.epoch import Epoch
from boresight.geometry.ground_site import Air, lifted_by_air
from boresight.geometry.starlight import apparent_star_directions
from boresight.star_id.identification.triangle_index import StarIndex

__all__ = ["Observer", "star_directions"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Observer:
    """Where and when an image was taken: without it aberration (1e-4 of every angle) goes into the focal
    length, and up to 20 arc-seconds of it into the attitude; on the ground refraction, 3e-4, as well."""

    epoch: Epoch
    t_s: float
    p_i: Array  # (3,) m, GCRS
    v_i: Array  # (3,) m/s, GCRS
    air: Air | None = None  # above a camera on the ground

    @property
    def tai_s(self) -> float:
        """TAI seconds since 2000-01-01T12:00:00, good to a microsecond: for observers of different epochs."""
        return self.epoch.tai_s + self.t_s


def star_directions(index: StarIndex, rows: NDArray[np.int64], observer: Observer | None) -> Array:
    """(N, 3) unit vectors, GCRS axes: as the observer sees the index's stars `rows`, or, without one, as the
    index has them (proper motion to its year)."""
    if observer is None:
        return index.u_i.take(rows, axis=0)
    u_i = apparent_star_directions(
        index.stars.take(rows), observer.epoch, observer.t_s, observer.p_i, observer.v_i
    )
    return u_i if observer.air is None else lifted_by_air(u_i, observer.air)
