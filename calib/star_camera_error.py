"""What an error of the star camera's model does to the stars of the exposures, and to their attitudes.

Stated directions that are off by du (per unit of the error) turn the attitude that is fitted to them by psi
and leave the rest as residuals. With the information W of each star, all over one exposure,

    psi = -N^-1 sum [u]xᵀ W du,    N = sum [u]xᵀ W [u]x,    d = du + [u]x psi,

and the error has the information sum dᵀ W d, and the right-hand side sum dᵀ W r of the residuals r.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boresight.geometry.attitude_estimate import cross_matrices, sums_over
from boresight.geometry.record import Floats, Texts, array, record, scalar
from boresight.geometry.sightings import StripSightings, information_of_directions
from boresight.geometry.star_camera import StarCamera

__all__ = ["PARTS", "StarEffect", "StarEffects", "star_effects"]

PARTS = ("focal length", "principal point, column", "principal point, row", "radial distortion")
PERCENT = 1e-2


@record(kw_only=True)
class StarEffects:
    """Of each part of the model (`PARTS`) in units: a percent, pixels, pixels, pixels at the corner."""

    exposure_id: Texts = array("K", "exposures")
    psi: Floats = array("K, 3, P", "change of the attitude, axes of s, rad; zero where it is not fixed")
    information: Floats = array("K, P", "on the size of the error")
    right: Floats = array("K, P", "right-hand side")


@record
class StarEffect:
    """One part of the model over all exposures."""

    information: float = scalar("on the size of the error, 1/unit²")
    right: float = scalar("right-hand side, 1/unit")

    @classmethod
    def summed(cls, effects: Sequence[StarEffects], part: int) -> StarEffect:
        """The sum over the exposures of several strips, each counted once."""
        once: dict[str, tuple[float, float]] = {}
        for one in effects:
            numbers = zip(one.information[:, part].tolist(), one.right[:, part].tolist())
            once.update(zip(one.exposure_id.tolist(), numbers))
        total = np.array(list(once.values())).reshape(-1, 2).sum(axis=0)
        return cls(float(total[0]), float(total[1]))


def star_effects(strip: StripSightings, camera: StarCamera) -> StarEffects:
    """What errors of `camera` do to the exposures of a strip, whose attitudes are known."""
    attitudes, exposures = strip.attitudes, strip.exposures
    assert attitudes is not None
    start, counts = attitudes.start, np.diff(attitudes.start)
    u = np.concatenate([np.zeros((0, 3)), *(one.u_s for one in exposures)])
    u_i = np.concatenate([np.zeros((0, 3)), *(one.u_i for one in exposures)])
    covariance = np.concatenate([np.zeros((0, 3, 3)), *(one.cov_s for one in exposures)])
    usable = np.repeat(attitudes.usable, counts) & attitudes.kept
    W = np.zeros((len(u), 3, 3))
    W[usable] = information_of_directions(u[usable], covariance[usable])
    r = u - np.einsum("nab,nb->na", np.repeat(attitudes.R_si, counts, axis=0), u_i)
    du = _changes(u, camera)
    turn = cross_matrices(u)
    turnW = np.swapaxes(turn, 1, 2) @ W
    seen = attitudes.usable & (counts > 0)
    N = sums_over(start, turnW @ turn)
    N[~seen] = np.eye(3)
    psi = -np.linalg.solve(N, sums_over(start, turnW @ du)) * seen[:, None, None]
    d = du + turn @ np.repeat(psi, counts, axis=0)
    Wd = W @ d
    return StarEffects(
        exposure_id=np.array([one.exposure_id for one in exposures], dtype=str),
        psi=psi,
        information=sums_over(start, np.sum(d * Wd, axis=1)),
        right=sums_over(start, np.sum(r[:, :, None] * Wd, axis=1)),
    )


def _changes(u: Floats, camera: StarCamera) -> Floats:
    """Change (N, 3, P) of directions (N, 3) by a unit of each of `PARTS`, of a lens without distortion."""
    pixel = camera.pixel_m / camera.focal_m
    v = u[:, :2] / u[:, 2:]
    corner = 0.5 * np.hypot(camera.width_px, camera.height_px) * pixel
    radius = np.linalg.norm(v, axis=1, keepdims=True)
    dv = np.zeros((len(u), 3, len(PARTS)))
    dv[:, :2, 0] = -PERCENT * v
    dv[:, 0, 1] = dv[:, 1, 2] = pixel
    dv[:, :2, 3] = v * radius**2 * pixel / corner**3
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    return across @ dv * u[:, 2, None, None]
