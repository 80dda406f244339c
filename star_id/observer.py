"""Place and time of an image of the sky, and the directions of catalogue stars as observed from there."""

from __future__ import annotations

from boresight.geometry.epoch import Epoch
from boresight.geometry.ground_site import Air, refract_by_air
from boresight.geometry.record import Floats, Ints, array, record, scalar
from boresight.geometry.starlight import apparent_star_directions
from boresight.star_id.identification.triangle_index import StarIndex

__all__ = ["Observer", "star_directions"]


@record
class Observer:
    """Place, velocity and time of an image, by which aberration and refraction are taken into account.

    If they are ignored, aberration changes the fitted focal length by 1e-4 and the attitude by up to 20
    arc-seconds; refraction, for a camera on the ground, changes angles by 3e-4.
    """

    epoch: Epoch = scalar("TAI second from which `t_s` counts")
    t_s: float = scalar("middle of the exposure, s after the epoch")
    p_i: Floats = array("3", "position, GCRS, m")
    v_i: Floats = array("3", "velocity, GCRS, m/s")
    air: Air | None = scalar("atmosphere above a camera on the ground; None in space", default=None)

    @property
    def tai_s(self) -> float:
        """TAI seconds since 2000-01-01T12:00:00, to a microsecond; compares observers of different epochs."""
        return self.epoch.tai_s + self.t_s


def star_directions(index: StarIndex, rows: Ints, observer: Observer | None) -> Floats:
    """Unit vectors (N, 3), GCRS axes, of the index's stars `rows` (N,): apparent for an observer, otherwise
    catalogue directions with proper motion to the index's epoch."""
    if observer is None:
        return index.u_i.take(rows, axis=0)
    u_i = apparent_star_directions(
        index.stars.take(rows), observer.epoch, observer.t_s, observer.p_i, observer.v_i
    )
    return u_i if observer.air is None else refract_by_air(u_i, observer.air)
