"""Names of the stars in a strip of the sky: a vote for the common rotation, with a bound for chance.

The mounting is known to some milliradians, thousands of pixels. A rotation theta of it displaces every star
of the strip alike: in tangents x, y of frame c, to first order,

    x_seen - x_predicted = theta_y - theta_z y          y_seen - y_predicted = -theta_x + theta_z x

whenever the star was seen. Every two pairs of a detection and a catalogue star that agree give such a
rotation; the one under which most detections fall on catalogue stars is tested against chance. A detection
that no catalogue lists (beyond V = 8 most are not in Hipparcos) agrees with a catalogue star by chance only:
the bound treats all as such.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.record import Bools, Floats, Ints, array, record, scalar

__all__ = ["Directions", "NamedRows", "NoRotation", "StripField", "name_stars", "vote_for_rotation"]

_SAME_SIDE = 1e-9
_REFINEMENTS = 3  # of the rotation, whose square is some pixels
_LEAST = 3  # stars that agree: two always do


@record(kw_only=True)
class Directions:
    """N detections as directions, brightest first, with the camera's attitude when each was seen."""

    u_c: Floats = array("N, 3", "look vectors, frame c")
    R_ci: Floats = array("N, 3, 3", "GCRS to frame c by the mounting to start from")
    brightness: Floats = array("N", "-2.5 log10 of the charge; NaN where it is not known (saturated)")

    def take(self, index: Ints) -> Directions:
        """The detections at indices (M,)."""
        return Directions(u_c=self.u_c[index], R_ci=self.R_ci[index], brightness=self.brightness[index])


@record(kw_only=True)
class StripField:
    """M catalogue stars around the strip, and within which limits they are looked for."""

    u_i: Floats = array("M, 3", "apparent directions, GCRS")
    v_mag: Floats = array("M", "magnitudes")
    limit_rad: Floats = array("3", "largest rotation of the mounting about the axes of c")
    tolerance_rad: float = scalar("largest distance of a star from its place by the common rotation")
    strip_area: float = scalar("solid angle of the strip, sr")

    def brightest(self, count: int) -> Ints:
        """Rows (K,) of the brightest stars."""
        return np.argsort(self.v_mag, kind="stable")[:count]


@dataclass(frozen=True, slots=True, eq=False)
class CommonRotation:
    """The common rotation that most detections agree with."""

    theta_rad: Floats  # (3,) R_ci = exp([theta]) R_ci0
    stars: int  # catalogue stars that agree
    log10_chance: float  # bound of the probability that so many agree by chance


@dataclass(frozen=True, slots=True, eq=False)
class NoRotation:
    """No rotation is more than chance."""

    stars: int  # that the best one had
    log10_chance: float
    detections: int


@record(kw_only=True)
class NamedRows:
    """Detections with names. Row n of every array is the same star."""

    row: Ints = array("N", "of the detection")
    star: Ints = array("N", "of the catalogue star")
    probability_wrong: Floats = array("N", "of the name")


def vote_for_rotation(
    seen: Directions, field: StripField, brightest: int, max_chance: float
) -> CommonRotation | NoRotation:
    """The rotation of the mounting under which most of the brightest detections are catalogue stars.

    Returns
    -------
    Vote | NoRotation
        `NoRotation` unless the bound of the probability of chance is below `max_chance`.
    """
    few = seen.take(np.arange(min(brightest, len(seen.u_c))))
    stars = field.brightest(brightest)
    xy, delta, detection, star = _pairs(few, field.u_i[stars], field)
    best, score, tests = np.zeros(3), 0, 0
    agreeing: Ints = np.zeros(0, dtype=np.int64)
    order = np.argsort(delta[:, 1], kind="stable")
    xy, delta = xy[order], delta[order]
    detection, star = detection[order], star[order]
    reach = 2.0 * field.tolerance_rad + field.limit_rad[2] * float(np.ptp(xy[:, 0]) if len(xy) else 0.0)
    for p in range(len(delta)):
        last = int(np.searchsorted(delta[:, 1], delta[p, 1] + reach, side="right"))
        after = np.arange(p + 1, last)
        q = after[(detection[after] != detection[p]) & (star[after] != star[p])]
        for theta in _rotations(xy, delta, p, q, field):
            tests += 1
            agree = _agreeing(xy, delta, theta, field.tolerance_rad)
            count = min(len(np.unique(detection[agree])), len(np.unique(star[agree])))
            if count > score:
                score, agreeing = count, agree
    chance = _log10_chance(len(few.u_c), len(delta), score, tests, field)
    if score < _LEAST or chance > np.log10(max_chance):
        return NoRotation(score, chance, len(few.u_c))
    for _ in range(_REFINEMENTS):
        R_ci = Rotation.from_rotvec(best).as_matrix() @ few.R_ci[detection[agreeing]]
        v = np.einsum("nab,nb->na", R_ci, field.u_i[stars[star[agreeing]]])
        step = _refined(xy[agreeing], xy[agreeing] - _tangents(v))
        best = (Rotation.from_rotvec(step) * Rotation.from_rotvec(best)).as_rotvec()
    return CommonRotation(best, score, chance)


def name_stars(
    seen: Directions, field: StripField, theta_rad: Floats, gate_rad: float, magnitude_error: float
) -> NamedRows:
    """Detections that lie within `gate_rad` of one catalogue star, and of one alone, under a rotation
    (3,) of the mounting.

    A detection whose brightness is not that of its star within `magnitude_error` gets no name.
    """
    R_ci = Rotation.from_rotvec(theta_rad).as_matrix() @ seen.R_ci
    xy = _tangents(seen.u_c)
    predicted, ahead = _predicted(R_ci, field.u_i)
    miss = xy[:, None] - predicted
    distance = np.where(ahead, np.hypot(miss[..., 0], miss[..., 1]), np.inf)
    near = distance < gate_rad
    row, star = np.nonzero(near & (near.sum(axis=1) == 1)[:, None])
    nearest = (
        distance[row, star] <= np.where(near[:, star], distance[:, star], np.inf).min(axis=0) + _SAME_SIDE
    )
    twice = _on_one_detector(seen, row, star)
    row, star = row[nearest | twice], star[nearest | twice]
    zero = field.v_mag[star] - seen.brightness[row]
    alike = np.isnan(zero) | (
        np.abs(zero - np.nanmedian(zero) if np.isfinite(zero).any() else 0.0) <= magnitude_error
    )
    row, star = row[alike], star[alike]
    others = (len(seen.u_c) - 1) * np.pi * gate_rad**2 / field.strip_area
    wrong = np.full(len(row), -np.expm1(-others))
    return NamedRows(row=row, star=star, probability_wrong=wrong)


def _on_one_detector(seen: Directions, row: Ints, star: Ints) -> Bools:
    """(K,) whether no other detection of the same star was made at nearly the same look vector."""
    alone = np.ones(len(row), dtype=bool)
    for k in range(len(row)):
        same = np.flatnonzero((star == star[k]) & (row != row[k]))
        if len(same):
            apart = np.linalg.norm(seen.u_c[row[same]] - seen.u_c[row[k]], axis=1)
            alone[k] = apart.min() > 1e-4  # the other CCD's overlap is millimetres away in the focal plane
    return alone


def _pairs(seen: Directions, u_i: Floats, field: StripField) -> tuple[Floats, Floats, Ints, Ints]:
    """Every pair of a detection and a star within the limits: tangents of the detection (P, 2), seen minus
    predicted (P, 2), row of detection and star (P,).
    """
    xy = _tangents(seen.u_c)
    predicted, ahead = _predicted(seen.R_ci, u_i)
    delta = xy[:, None] - predicted
    limit = _box(xy, field)
    detection, star = np.nonzero(ahead & (np.abs(delta) <= limit[:, None]).all(axis=2))
    return xy[detection], delta[detection, star], detection, star


def _box(xy: Floats, field: StripField) -> Floats:
    """(N, 2) largest displacement of detections at tangents (N, 2)."""
    x, y, z = field.limit_rad
    return np.column_stack([y + z * np.abs(xy[:, 1]), x + z * np.abs(xy[:, 0])]) + field.tolerance_rad


def _rotations(xy: Floats, delta: Floats, p: int, q: Ints, field: StripField) -> Floats:
    """Rotations (T, 3) by which pair p and the pairs q agree, within the limits."""
    apart, differ = xy[q] - xy[p], delta[q] - delta[p]
    weight = (field.tolerance_rad / field.limit_rad[2]) ** 2
    theta_z = (apart[:, 0] * differ[:, 1] - apart[:, 1] * differ[:, 0]) / ((apart**2).sum(axis=1) + weight)
    turned = np.column_stack([-theta_z * apart[:, 1], theta_z * apart[:, 0]])
    agree = (np.abs(differ - turned) <= 2.0 * field.tolerance_rad).all(axis=1)
    agree &= np.abs(theta_z) <= field.limit_rad[2]
    middle, mean = 0.5 * (xy[q] + xy[p])[agree], 0.5 * (delta[q] + delta[p])[agree]
    z = theta_z[agree]
    return np.column_stack([z * middle[:, 0] - mean[:, 1], mean[:, 0] + z * middle[:, 1], z])


def _agreeing(xy: Floats, delta: Floats, theta: Floats, tolerance: float) -> Ints:
    shift = np.column_stack([theta[1] - theta[2] * xy[:, 1], -theta[0] + theta[2] * xy[:, 0]])
    return np.flatnonzero(np.hypot(*(delta - shift).T) <= tolerance)


def _refined(xy: Floats, delta: Floats) -> Floats:
    """Rotation (3,) nearest to displacements by least squares."""
    n = len(xy)
    zero, one = np.zeros(n), np.ones(n)
    A = np.concatenate([np.column_stack([zero, one, -xy[:, 1]]), np.column_stack([-one, zero, xy[:, 0]])])
    return np.linalg.lstsq(A, np.concatenate([delta[:, 0], delta[:, 1]]), rcond=1e-9)[0]


def _log10_chance(detections: int, pairs: int, agreeing: int, tests: int, field: StripField) -> float:
    """Bound of the probability that some tested rotation makes so many of the detections agree by chance.

    By chance a detection agrees with a given star of its box with the probability of the tolerance's disc
    over the box. Two agree by construction; the rest are independent.
    """
    if agreeing < _LEAST or detections < _LEAST:
        return 0.0
    from scipy.stats import binom  # 0.2 s to load

    x, y, _ = field.limit_rad
    box = 4.0 * (x + field.tolerance_rad) * (y + field.tolerance_rad)
    one = min(1.0, pairs / detections * np.pi * field.tolerance_rad**2 / box)
    log_tail = float(binom.logsf(agreeing - 3, detections - 2, one)) / np.log(10.0)
    return min(0.0, np.log10(max(tests, 1)) + log_tail)


def _tangents(u: Floats) -> Floats:
    return u[..., :2] / u[..., 2:]


def _predicted(R_ci: Floats, u_i: Floats) -> tuple[Floats, Bools]:
    """Tangents (N, M, 2) of M directions by N attitudes, and which of them are ahead of the camera."""
    v = np.einsum("nab,mb->nma", R_ci, u_i)
    ahead = v[..., 2] > 0.1
    return v[..., :2] / np.where(ahead, v[..., 2], 1.0)[..., None], ahead
