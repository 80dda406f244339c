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
from boresight.geometry.sightings import StripSightings, information_of_directions
from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Bools, Floats, Ints, Texts, array, record

__all__ = ["PARTS", "StarEffects", "star_effects", "summed"]

# Parts of the star camera's model whose errors are estimated, in the order of the columns.
SYMMETRIC = ("focal length", "principal point, column", "principal point, row", "radial distortion")
PARTS = (*SYMMETRIC, "decentring, column", "decentring, row")
PERCENT = 1e-2  # one hundredth: the unit in which errors of focal length and distortion are stated
INFORMATIVE = 30.0  # chi-square by which a part of the model is taken to be wrong
FARTHEST_RAD = 5e-3  # a star farther from its place is another one
MOST_ROUNDS = 5  # most rounds of fitting the camera's errors and rejecting outliers (set by hand)


@record(kw_only=True)
class StarEffects:
    """Of each part of the model (`PARTS`) in units: a percent, pixels, pixels, and pixels at the corner."""

    exposure_id: Texts = array("K", "exposures")
    psi: Floats = array("K, 3, P", "change of the attitude, axes of s, rad; zero where it is not fixed")
    information: Floats = array("K, P, P", "on the sizes of the errors")
    right: Floats = array("K, P", "right-hand side")


def summed(effects: Sequence[StarEffects]) -> tuple[Floats, Floats]:
    """Information (P, P) and right-hand side (P,) of the exposures of several strips, each counted once."""
    P = len(PARTS)
    once: dict[str, tuple[Floats, Floats]] = {}
    for one in effects:
        once.update(zip(one.exposure_id.tolist(), zip(one.information, one.right)))
    none = (np.zeros((P, P)), np.zeros(P))
    informations, rights = zip(none, *once.values())
    return np.sum(informations, axis=0), np.sum(rights, axis=0)


def star_effects(strips: Sequence[StripSightings], camera: StarCamera, limit: float) -> list[StarEffects]:
    """What errors of `camera` do to the exposures of each strip, whose attitudes are known.

    Stars that were rejected take part as far as the part of the model that explains most brings them back:
    `limit` is that of their test. A wrong lens displaces the stars at the edge by the most, and without them
    its size would be underestimated.
    """
    stars = [_stars(strip, camera) for strip in strips]
    kept = [one.kept for one in stars]
    for _ in range(MOST_ROUNDS):
        found = [_effects(one, now) for one, now in zip(stars, kept)]
        information, right = summed(found)
        own = np.diag(information)
        gain = np.divide(right**2, own, out=np.zeros(len(PARTS)), where=own > 0.0)
        best = int(np.argmax(gain))
        if gain[best] < INFORMATIVE:
            break
        size: Floats = np.where(np.arange(len(PARTS)) == best, right / np.maximum(own, 1e-300), 0.0)
        again = [_within(one, now, size, limit) for one, now in zip(stars, kept)]
        if all(np.array_equal(a, b) for a, b in zip(again, kept)):
            break
        kept = again
    return found


@record
class _Stars:
    """Stars of a strip's exposures."""

    exposure_id: list[str]
    start: Ints  # (K + 1,)
    seen: Bools  # (K,) exposures with an attitude of their own
    kept: Bools  # (N,)
    turn: Floats  # (N, 3, 3) [u]x
    W: Floats  # (N, 3, 3)
    r: Floats  # (N, 3)
    du: Floats  # (N, 3, P)


def _stars(strip: StripSightings, camera: StarCamera) -> _Stars:
    attitudes, exposures = strip.fitted, strip.exposures
    counts = np.diff(attitudes.start)
    u = np.concatenate([np.zeros((0, 3)), *(one.u_s for one in exposures)])
    u_i = np.concatenate([np.zeros((0, 3)), *(one.u_i for one in exposures)])
    covariance = np.concatenate([np.zeros((0, 3, 3)), *(one.cov_s for one in exposures)])
    seen = attitudes.usable & (counts > 0)
    r = u - np.einsum("nab,nb->na", np.repeat(attitudes.R_si, counts, axis=0), u_i)
    near = np.repeat(seen, counts) & (np.linalg.norm(r, axis=1) < FARTHEST_RAD)
    W = np.zeros((len(u), 3, 3))
    W[near] = information_of_directions(u[near], covariance[near])
    return _Stars(
        exposure_id=[one.exposure_id for one in exposures],
        start=attitudes.start,
        seen=seen,
        kept=near & attitudes.kept,
        turn=cross_matrices(u),
        W=W,
        r=r,
        du=_changes(u, camera),
    )


def _effects(stars: _Stars, kept: Bools) -> StarEffects:
    W = stars.W * kept[:, None, None]
    psi = _turned(stars, W, stars.du)
    d = stars.du + stars.turn @ np.repeat(psi, np.diff(stars.start), axis=0)
    Wd = W @ d
    return StarEffects(
        exposure_id=np.array(stars.exposure_id, dtype=str),
        psi=psi,
        information=sums_over(stars.start, np.swapaxes(d, 1, 2) @ Wd),
        right=sums_over(stars.start, np.sum(stars.r[:, :, None] * Wd, axis=1)),
    )


def _turned(stars: _Stars, W: Floats, du: Floats) -> Floats:
    """Change (K, 3, P) of the attitudes fitted to stars whose directions change by du (N, 3, P)."""
    turnW = np.swapaxes(stars.turn, 1, 2) @ W
    N = sums_over(stars.start, turnW @ stars.turn)
    seen = stars.seen & (np.linalg.det(N) > 0.0)
    N[~seen] = np.eye(3)
    psi = -np.linalg.solve(N, sums_over(stars.start, turnW @ du)) * seen[:, None, None]
    return np.asarray(psi)


def _within(stars: _Stars, kept: Bools, size: Floats, limit: float) -> Bools:
    """Stars (N,) that pass the test of their residual once errors of `size` (P,) are taken out."""
    left = (stars.r - stars.du @ size)[:, :, None]
    psi = _turned(stars, stars.W * kept[:, None, None], left)
    e = (left + stars.turn @ np.repeat(psi, np.diff(stars.start), axis=0))[:, :, 0]
    squared = np.einsum("na,nab,nb->n", e, stars.W, e)
    return np.asarray((squared < limit) & (np.einsum("naa->n", stars.W) > 0.0))


def _changes(u: Floats, camera: StarCamera) -> Floats:
    """Change (N, 3, P) of directions (N, 3) by a unit of each of `PARTS`, of a lens without distortion."""
    pixel = camera.pixel_m / camera.focal_m
    v = u[:, :2] / u[:, 2:]
    corner = 0.5 * np.hypot(camera.width_px, camera.height_px) * pixel
    radius = np.linalg.norm(v, axis=1, keepdims=True)
    dv = np.zeros((len(u), 3, len(PARTS)))
    dv[:, :2, 0] = -PERCENT * v
    dv[:, 0, 1] = dv[:, 1, 2] = pixel
    dv[:, :2, 3] = -v * radius**2 * pixel / corner**3
    # The image is inverted, so that even terms, r² t + 2 (t.v) v for a decentring t, keep their sign.
    sideways = radius[:, :, None] ** 2 * np.eye(2) + 2.0 * v[:, :, None] * v[:, None]
    dv[:, :2, 4:] = sideways * pixel / corner**2
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    return across @ dv * u[:, 2, None, None]
