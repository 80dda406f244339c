"""Names of the stars in a strip of the sky: a vote for the common rotation, with a bound for chance.

The mounting is known to some milliradians, thousands of pixels. A rotation theta of it displaces every star
of the strip alike: in tangents x, y of frame c, to first order,

    x_seen - x_predicted = theta_y - theta_z y          y_seen - y_predicted = -theta_x + theta_z x

whenever the star was seen. Every two pairs of a detection and a catalogue star that agree give such a
rotation; the one under which most detections fall on catalogue stars is tested against chance. A detection
that no catalogue lists (beyond V = 8 most are not in Hipparcos) agrees with a catalogue star by chance only:
the bound treats all as such.

What displaces stars beside the mounting: errors of the star camera's attitudes, which neighbours in time
share, larger about its boresight than across it; distortion, vibration and the measurement, each star's own.
A detection with a displacement of probability density L is the catalogue star, against one of the unlisted
detections of density rho that lies there by chance, with the odds L : rho (`name_stars`).
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from boresight.records.record import Bools, Floats, Ints, array, record, scalar
from boresight.star_id.beyond_chance import LEAST_STARS, NEVER_SIGMA, SELDOM_SIGMA

__all__ = ["Directions", "NamedRows", "NoRotation", "StripField", "name_stars", "vote_for_rotation"]

# Distance of two look vectors on two CCDs, rad, below which they may be one star seen twice.
_TWICE_RAD = 1e-4


@record(kw_only=True)
class Directions:
    """N detections as directions, brightest first, with the camera's attitude when each was seen."""

    u_c: Floats = array("N, 3", "look vectors, frame c")
    R_ci: Floats = array("N, 3, 3", "GCRS to frame c by the mounting to start from")
    brightness: Floats = array("N", "-2.5 log10 of the charge; NaN where it is not known (saturated)")
    attitude_c: Floats = array(
        "N, 3, A",
        "rotation of the attitude about the axes of c by each of A independent errors, 1 sigma, rad",
    )
    variance: Floats = array("N", "of what displaces this detection alone, per axis, rad²")

    def take(self, index: Ints) -> Directions:
        """The detections at indices (M,)."""
        return Directions(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    @property
    def by_rotation(self) -> Floats:
        """Displacement (N, 2, 3) of the tangents by a rotation of the mounting about the axes of c."""
        return _by_rotation(_tangents(self.u_c))

    @property
    def by_attitude(self) -> Floats:
        """Displacement (N, 2, A) of the tangents by each error of the attitudes, rad."""
        return self.by_rotation @ self.attitude_c


@record(kw_only=True)
class StripField:
    """M catalogue stars around the strip, and within which limits they are looked for."""

    u_i: Floats = array("M, 3", "apparent directions, GCRS")
    v_mag: Floats = array("M", "magnitudes")
    limit_rad: Floats = array("3", "largest rotation of the mounting about the axes of c")
    spread: Floats = array("2, 2", "covariance of a star's distance from its place by the rotation, rad²")
    slack_rad: float = scalar("tolerated beyond 4 sigma of `spread`: second order, errors not stated")
    strip_area: float = scalar("solid angle of the strip, sr")

    @property
    def tolerance(self) -> Floats:
        """Matrix (2, 2) that takes the unit circle to the largest distances, an ellipse, rad."""
        values, vectors = np.linalg.eigh(self.spread)
        return vectors * (self.slack_rad + SELDOM_SIGMA * np.sqrt(np.maximum(values, 0.0)))

    @property
    def reach_rad(self) -> Floats:
        """Largest distances (2,) along x and along y."""
        return np.linalg.norm(self.tolerance, axis=1)

    def brightest(self, count: int) -> Ints:
        """Rows (K,) of the brightest stars."""
        return np.argsort(self.v_mag, kind="stable")[:count]


@record
class CommonRotation:
    """The common rotation that most detections agree with."""

    theta_rad: Floats  # (3,) R_ci = exp([theta]) R_ci0
    theta_root: Floats  # (3, 3) L of its covariance L Lᵀ, rad
    stars: int  # catalogue stars that agree
    log10_chance: float  # bound of the probability that so many agree by chance


@record
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
    CommonRotation | NoRotation
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
    within = np.asarray(np.linalg.inv(field.tolerance).T)
    reach = 2.0 * field.reach_rad[1] + field.limit_rad[2] * float(np.ptp(xy[:, 0]) if len(xy) else 0.0)
    for p in range(len(delta)):
        last = int(np.searchsorted(delta[:, 1], delta[p, 1] + reach, side="right"))
        after = np.arange(p + 1, last)
        q = after[(detection[after] != detection[p]) & (star[after] != star[p])]
        for theta in _rotations(xy, delta, p, q, field):
            tests += 1
            agree = _agreeing(xy, delta, theta, within)
            count = min(len(np.unique(detection[agree])), len(np.unique(star[agree])))
            if count > score:
                score, agreeing = count, agree
    chance = _log10_chance(len(few.u_c), len(delta), score, tests, field)
    if score < LEAST_STARS or chance > np.log10(max_chance):
        return NoRotation(score, chance, len(few.u_c))
    whiten = np.linalg.inv(np.linalg.cholesky(field.spread + field.slack_rad**2 / 4.0 * np.eye(2)))
    for _ in range(3):  # the square of the rotation, left out in each, is some pixels at first
        R_ci = Rotation.from_rotvec(best).as_matrix() @ few.R_ci[detection[agreeing]]
        v = np.einsum("nab,nb->na", R_ci, field.u_i[stars[star[agreeing]]])
        step, root = _refined(xy[agreeing], xy[agreeing] - _tangents(v), whiten, field.limit_rad)
        best = (Rotation.from_rotvec(step) * Rotation.from_rotvec(best)).as_rotvec()
    return CommonRotation(best, root, score, chance)


def name_stars(
    seen: Directions,
    field: StripField,
    theta_rad: Floats,
    theta_root: Floats,
    *,
    magnitude_error: float,
    max_name_error: float,
) -> NamedRows:
    """The likeliest catalogue star of each detection under a rotation (3,) of the mounting with the
    covariance L Lᵀ, `theta_root` (3, 3), and the probability that it is another.

    Displacements of all stars have one covariance: the errors of mounting and attitudes that they share, and
    each star's own. The stars that are sure by themselves show the shared errors; with these, all are judged
    again, each by the others. A detection whose brightness is not that of its star within `magnitude_error`
    gets no name.
    """
    R_ci = Rotation.from_rotvec(theta_rad).as_matrix() @ seen.R_ci
    predicted, ahead = _predicted(R_ci, field.u_i)
    miss = _tangents(seen.u_c)[:, None] - predicted
    moved = np.concatenate([seen.by_rotation @ theta_root, seen.by_attitude], axis=2)
    covariance = moved @ np.swapaxes(moved, 1, 2) + seen.variance[:, None, None] * np.eye(2)
    distance = np.einsum("nma,nab,nmb->nm", miss, np.linalg.inv(covariance), miss)
    row, star = np.nonzero(ahead & (distance < NEVER_SIGMA**2))
    density = len(seen.u_c) / field.strip_area
    pairs = _Pairs.of(miss[row, star], moved[row], seen.variance[row], _rivals(seen, row, star), density)
    sure = pairs.probability_wrong(np.zeros(len(row), dtype=bool)) < max_name_error
    wrong = pairs.probability_wrong(sure)
    zero = field.v_mag[star] - seen.brightness[row]
    usual = zero[(wrong < 0.5) & np.isfinite(zero)]
    differs = np.abs(zero - (np.median(usual) if len(usual) else 0.0)) > magnitude_error
    best = np.array([wrong[k] <= wrong[row == row[k]].min() for k in range(len(row))], dtype=bool)
    chosen = np.flatnonzero(best & ~differs)
    return NamedRows(row=row[chosen], star=star[chosen], probability_wrong=wrong[chosen])


@record
class _Pairs:
    """P pairs of a detection and a catalogue star: displacements, and the errors that they have in common."""

    miss: Floats  # (P, 2) tangents of the detection, seen minus predicted
    moved: Floats  # (P, 2, A) displacement by each error in common
    variance: Floats  # (P,) of what displaces one alone, per axis
    rivals: Bools  # (P, P) pairs of which one at most is right; with the diagonal
    density: float  # of the detections, 1/sr

    @classmethod
    def of(cls, miss: Floats, moved: Floats, variance: Floats, rivals: Bools, density: float) -> _Pairs:
        """The pairs, with no more errors in common than displacements."""
        P, _, A = moved.shape
        if A > 2 * P:
            moved = np.linalg.qr(moved.reshape(2 * P, A).T)[1].T.reshape(P, 2, 2 * P)
        return cls(miss, moved, variance, rivals, density)

    def probability_wrong(self, sure: Bools) -> Floats:
        """(P,) that a pair is wrong, given that the pairs `sure`, apart from its rivals, are right."""
        h = self.moved / np.sqrt(self.variance)[:, None, None]
        y = self.miss / np.sqrt(self.variance)[:, None]
        information = np.eye(h.shape[2]) + np.einsum("pia,pib->ab", h[sure], h[sure])
        right = np.einsum("pia,pi->a", h[sure], y[sure])
        odds = np.zeros(len(h))
        for p, H in enumerate(self.moved):
            own = np.flatnonzero(sure & self.rivals[p])
            rest = information - np.einsum("pia,pib->ab", h[own], h[own])
            known = np.linalg.solve(
                rest, np.column_stack([H.T, right - np.einsum("pia,pi->a", h[own], y[own])])
            )
            apart = self.miss[p] - H @ known[:, 2]
            covariance = H @ known[:, :2] + self.variance[p] * np.eye(2)
            half = 0.5 * apart @ np.linalg.solve(covariance, apart)
            odds[p] = np.exp(-half) / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)) * self.density)
        others = self.rivals @ odds - odds
        return np.asarray((1.0 + others) / (1.0 + others + odds))


def _rivals(seen: Directions, row: Ints, star: Ints) -> Bools:
    """(P, P) pairs of which one at most is right: of one detection, and of one star seen at nearly the same
    look vector. In the overlap of two CCDs a star is seen twice, millimetres apart in the focal plane.
    """
    u_c = seen.u_c[row]
    near = np.linalg.norm(u_c[:, None] - u_c[None, :], axis=2) < _TWICE_RAD
    return (row[:, None] == row) | ((star[:, None] == star) & near)


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
    return np.column_stack([y + z * np.abs(xy[:, 1]), x + z * np.abs(xy[:, 0])]) + field.reach_rad


def _rotations(xy: Floats, delta: Floats, p: int, q: Ints, field: StripField) -> Floats:
    """Rotations (T, 3) by which pair p and the pairs q agree, within the limits."""
    apart, differ = xy[q] - xy[p], delta[q] - delta[p]
    weight = float(np.max(field.reach_rad) / field.limit_rad[2]) ** 2
    theta_z = (apart[:, 0] * differ[:, 1] - apart[:, 1] * differ[:, 0]) / ((apart**2).sum(axis=1) + weight)
    turned = np.column_stack([-theta_z * apart[:, 1], theta_z * apart[:, 0]])
    agree = np.linalg.norm((differ - turned) @ np.linalg.inv(field.tolerance).T, axis=1) <= 2.0
    agree &= np.abs(theta_z) <= field.limit_rad[2]
    middle, mean = 0.5 * (xy[q] + xy[p])[agree], 0.5 * (delta[q] + delta[p])[agree]
    z = theta_z[agree]
    return np.column_stack([z * middle[:, 0] - mean[:, 1], mean[:, 0] + z * middle[:, 1], z])


def _agreeing(xy: Floats, delta: Floats, theta: Floats, within: Floats) -> Ints:
    """Pairs whose displacement less that by theta lies within the ellipse that `within` takes to the unit
    circle.
    """
    return np.flatnonzero(np.linalg.norm((delta - _by_rotation(xy) @ theta) @ within, axis=1) <= 1.0)


def _by_rotation(xy: Floats) -> Floats:
    """Change (N, 2, 3) of tangents (N, 2) by a rotation about the axes of c, to first order."""
    zero, one = np.zeros(len(xy)), np.ones(len(xy))
    along_x, along_y = (zero, one, -xy[:, 1]), (-one, zero, xy[:, 0])
    return np.stack([np.column_stack(along_x), np.column_stack(along_y)], axis=1)


def _refined(xy: Floats, delta: Floats, whiten: Floats, limit_rad: Floats) -> tuple[Floats, Floats]:
    """Rotation (3,) nearest to displacements by least squares, and the root (3, 3) of its covariance;
    displacements times `whiten` have unit covariance, and limits are a prior of 1 sigma.
    """
    A = np.concatenate([(whiten @ _by_rotation(xy)).reshape(-1, 3), np.diag(1.0 / limit_rad)])
    y = np.concatenate([(delta @ whiten.T).ravel(), np.zeros(3)])
    root = np.linalg.inv(np.linalg.qr(A)[1])
    return np.linalg.lstsq(A, y, rcond=1e-9)[0], root


def _log10_chance(detections: int, pairs: int, agreeing: int, tests: int, field: StripField) -> float:
    """Bound of the probability that some tested rotation makes so many of the detections agree by chance.

    By chance a detection agrees with a given star of its box with the probability of the tolerance's ellipse
    over the box. Two agree by construction; the rest are independent.
    """
    if agreeing < LEAST_STARS or detections < LEAST_STARS:
        return 0.0

    x, y, _ = field.limit_rad
    box = 4.0 * (y + field.reach_rad[0]) * (x + field.reach_rad[1])
    ellipse = np.pi * abs(np.linalg.det(field.tolerance))
    one = min(1.0, float(pairs / detections * ellipse / box))
    log_tail = float(scipy.stats.binom.logsf(agreeing - 3, detections - 2, one)) / np.log(10.0)
    return min(0.0, np.log10(max(tests, 1)) + log_tail)


def _tangents(u: Floats) -> Floats:
    return u[..., :2] / u[..., 2:]


def _predicted(R_ci: Floats, u_i: Floats) -> tuple[Floats, Bools]:
    """Tangents (N, M, 2) of M directions by N attitudes, and which of them are ahead of the camera."""
    v = np.einsum("nab,mb->nma", R_ci, u_i)
    ahead = v[..., 2] > 0.1
    return v[..., :2] / np.where(ahead, v[..., 2], 1.0)[..., None], ahead
