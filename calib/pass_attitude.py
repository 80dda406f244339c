"""Attitude of a pass at its targets' instants: what it is, the root of its joint covariance, and what other
inputs change it.

Of a single head whose attitudes come from stars, the attitude relative to the nominal motion is interpolated
between the exposures, by Lagrange polynomials; their errors phi_k stay unknowns, and so does the motion that
the interpolation misses. Of heads that solve attitudes, of several, and with a gyro, the rows of all are
smoothed (`geometry.attitude_smoother`). There the unknowns are the independent parts of what is left unknown,
and the constant errors of the heads; the rows tell something of these and of the alignments. Where no strip
has rows enough to show the motion, it is the stated one between the smoothed attitudes of the rows. An error
that comes back with a period is a constant of the pass to the rows, to a target what it is at its time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from boresight.calib.heads import HeadTie, lasting_of_head, unknowns_of_head
from boresight.calib.settings import CalibrationSettings
from boresight.calib.slow_motion import FEWEST_SHOW, SlowMotion, missed_covariance, stated_motion
from boresight.geometry import attitude
from boresight.geometry.attitude_noise import LastingError
from boresight.geometry.attitude_smoother import HeadRows, SmoothedAttitude, most_likely_motion
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import StripSightings
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["PassAttitude", "attitude_of", "is_smoothed", "smoothed_motion"]

NEGLIGIBLE_MOTION_RAD = 0.01 * ARCSEC  # a tenth of the vibration of the paper's Table 1
RATE_OVER_S = 30.0  # around the middle of a pass, over which it has one rate
IN_STEPS_OF = 12  # unknowns of a pass: passes of equal numbers are reduced together


@record(kw_only=True)
class PassAttitude:
    """Attitude at the instants of J targets, from U exposures."""

    inside: Bools = array("J", "whether the exposures cover the instant")
    R_si: Floats = array("J, 3, 3", "GCRS to frame s; the identity where they do not")
    rate_s: Floats = array("3", "mean rotation rate of the sky in frame s, rad/s")
    root_s: Floats = array("J, 3, P", "rotation about the axes of s by unknowns of unit variance, rad")
    n_phi: int = scalar("how many of them, the first, the rows of heads tell of")
    lasting: tuple[LastingError, ...] = scalar("what the last of these are: constants of the heads")
    weights: Floats = array("J, U", "by which a rotation of the exposures rotates it; dense or sparse")
    of_heads: tuple[str, ...] = scalar("unknowns of the heads that change it")
    by_heads: Floats = array("J, 3, A", "rotation about the axes of s by these")
    ties: tuple[HeadTie, ...] = scalar("what the rows tell of these and of the first unknowns")


def is_smoothed(strip: StripSightings) -> bool:
    """Whether the attitudes of a strip are smoothed: of several heads, with a gyro, or solved by the head."""
    solved = bool(strip.exposures) and not any(len(one.hip) for one in strip.exposures)
    return strip.interpolation == "lagrange" and (bool(strip.others) or strip.gyro is not None or solved)


def smoothed_motion(strips: Sequence[StripSightings], settings: CalibrationSettings) -> SlowMotion | Floats:
    """Density (3,) of the random walk of the rates of strips whose attitudes are smoothed; the stated model
    where neither a gyro nor three rows of a head show it.
    """
    every = [([*_rows_of(strip, settings).values()], strip.gyro) for strip in strips]
    rows = [one for one in every if len(one[0][0].t_s)]
    few = [gyro is None and max(len(head.t_s) for head in heads) < FEWEST_SHOW for heads, gyro in rows]
    if all(few) and settings.sigma_motion_rad > 0.0:
        return stated_motion(settings)
    return most_likely_motion(*zip(*rows), stated=_stated_walk(settings)) if rows else np.ones(3)


def _stated_walk(settings: CalibrationSettings) -> float:
    return 3.0 * settings.sigma_motion_rad**2 / settings.motion_time_s**3


def attitude_of(
    strip: StripSightings, settings: CalibrationSettings, motion: SlowMotion | Floats
) -> PassAttitude:
    """The attitude at the targets of a strip with fitted attitudes; `motion` is what the satellite does
    between the exposures: a model, or the density (3,) of the random walk of its rates.
    """
    if is_smoothed(strip):
        return _smoothed(strip, settings, motion)
    assert isinstance(motion, SlowMotion)
    return _interpolated(strip, settings, motion)


def _interpolated(strip: StripSightings, settings: CalibrationSettings, motion: SlowMotion) -> PassAttitude:
    times, R_si, R_oi, own_s = strip.usable()
    nodes = attitude.InterpolationNodes.of_exposures(times, R_si, R_oi)
    t_s, K = strip.ground.t_s, len(nodes.t_s)
    inside = _covered(nodes.t_s, t_s)
    weights = _weights(nodes.t_s, t_s, inside, strip.interpolation)
    R_si_targets = np.tile(np.eye(3), (len(t_s), 1, 1))
    if inside.any():
        D = nodes.R_si * nodes.R_oi.inv()
        middle = D[len(D) // 2]
        turned = Rotation.from_rotvec(weights[inside] @ (D * middle.inv()).as_rotvec())
        R_si_targets[inside] = (turned * middle * strip.R_oi_targets[inside]).as_matrix()
    noise, constant, lasting = strip.noise.within(*_ends(nodes.t_s), strip.carrier)
    covariance = noise.coloured_covariance_s(nodes.t_s)
    each = np.arange(K)
    own_s = nodes.covariance(own_s)
    covariance[each, :, each, :] += own_s + settings.sigma_vibration_exposure_rad**2 * np.eye(3)
    root = np.linalg.cholesky(covariance.reshape(3 * K, 3 * K)).reshape(K, 3, 3 * K)
    moved = _by_motion(motion, nodes.t_s, t_s, weights, inside)
    return PassAttitude(
        inside=inside,
        R_si=R_si_targets,
        rate_s=_rotation_rate(nodes.t_s, nodes.R_si),
        root_s=np.concatenate(
            [np.tensordot(weights, root, axes=1), inside[:, None, None] * constant, moved], axis=2
        ),
        n_phi=3 * K + len(lasting),
        lasting=lasting,
        weights=weights @ nodes.share,
        of_heads=unknowns_of_head("", strip.noise),
        by_heads=inside[:, None, None] * lasting_of_head("", strip.noise, t_s),
        ties=(),
    )


def _smoothed(
    strip: StripSightings, settings: CalibrationSettings, motion: SlowMotion | Floats
) -> PassAttitude:
    rows, t_s = _rows_of(strip, settings), strip.ground.t_s
    times, J = rows[strip.carrier].t_s, len(t_s)
    inside = _covered(times, t_s)
    R_si, root = np.tile(np.eye(3), (J, 1, 1)), np.zeros((J, 3, 0))
    by_constants: Floats = np.zeros((J, 3, 3 * len(rows)))
    told: Floats = np.zeros((0, 1 + 3 * len(rows)))
    dof = 0
    parts = [head.noise.within(*_ends(times), name) for name, head in rows.items()]
    if inside.any():
        within = [replace(head, noise=rest) for head, (rest, *_) in zip(rows.values(), parts)]
        walk = np.full(3, _stated_walk(settings)) if isinstance(motion, SlowMotion) else motion
        found = SmoothedAttitude.of(within, walk, strip.gyro)
        R_si[inside] = (found.R_so(t_s[inside]) * strip.R_oi_targets[inside]).as_matrix()
        if isinstance(motion, SlowMotion) and len(times) > 1:
            weights = _weights(times, t_s, inside, strip.interpolation)
            moved = _by_motion(motion, times, t_s, weights, inside)
            of_rows = np.tensordot(weights, found.root_s(times), axes=1)
            part = np.concatenate([of_rows, moved], axis=2)[inside]
        else:
            part = found.root_s(t_s[inside])
        root = np.zeros((J, 3, -(-part.shape[2] // IN_STEPS_OF) * IN_STEPS_OF))
        root[inside, :, : part.shape[2]] = part
        by_constants[inside] = found.by_constants(t_s[inside])
        rest, dof = np.eye(1, told.shape[1]) * np.sqrt(found.chi2), found.dof
        told = np.concatenate([found.constants, rest])
    r, T = told[:, 0], told[:, 1:]
    constant = block_diag(*(columns for _, columns, _ in parts))
    lasting = tuple(one for *_, errors in parts for one in errors)
    noises = [(name, head.noise) for name, head in rows.items()]
    middle = np.full(1, 0.5 * sum(_ends(times)))

    def by_unknowns(of_constants: Floats, t: Floats) -> Floats:
        own = enumerate(noises)
        parts = [of_constants[..., 3 * n : 3 * n + 3] @ lasting_of_head(*one, t) for n, one in own]
        return np.concatenate(parts, axis=-1)

    tie = HeadTie(
        unknowns=tuple(name for one in noises for name in unknowns_of_head(*one)),
        r=r,
        by_phi=np.column_stack([np.zeros((len(r), root.shape[2])), T @ constant]),
        by_alpha=by_unknowns(T[None], middle)[0],
        dof=dof,
    )
    return PassAttitude(
        inside=inside,
        R_si=R_si,
        rate_s=_rotation_rate(times, rows[strip.carrier].R_so * strip.usable()[2]),
        root_s=np.concatenate([root, by_constants @ constant], axis=2),
        n_phi=root.shape[2] + constant.shape[1],
        lasting=lasting,
        weights=attitude.linear_weights(times, t_s, inside),
        of_heads=tie.unknowns,
        by_heads=by_unknowns(by_constants, t_s),
        ties=(tie,) if len(rows) > 1 and inside.any() else (),
    )


def _ends(times: Floats) -> tuple[float, float]:
    return (float(times[0]), float(times[-1])) if len(times) else (0.0, 0.0)


def _rows_of(strip: StripSightings, settings: CalibrationSettings) -> dict[str, HeadRows]:
    """Rows of the head that carries a strip, and of all others that have some between them, by head."""
    times, R_si, R_oi, covariance_s = strip.usable()
    vibration = settings.sigma_vibration_exposure_rad**2 * np.eye(3)
    own = HeadRows(
        t_s=times, R_so=R_si * R_oi.inv(), covariance_s=covariance_s + vibration, noise=strip.noise
    )
    rows = {strip.carrier: own}
    for other in strip.others if len(times) else ():
        if (here := (other.t_s >= times[0]) & (other.t_s <= times[-1])).any():
            A = other.R_sh.as_matrix()
            rows[other.head] = HeadRows(
                t_s=other.t_s[here],
                R_so=other.R_sh * other.R_hi[here] * other.R_oi[here].inv(),
                covariance_s=A @ other.covariance_h[here] @ A.T + vibration,
                noise=other.noise_s,
            )
    return rows


def _covered(times: Floats, t_s: Floats) -> Bools:
    """Which instants (J,) the exposures cover, half a step beyond the first and the last of them; one alone
    covers half a second around it.
    """
    if len(times) < 2:
        return np.abs(t_s - times[0]) <= 0.5 if len(times) else np.zeros(len(t_s), dtype=bool)
    before, after = 0.5 * (times[1] - times[0]), 0.5 * (times[-1] - times[-2])
    return (t_s >= times[0] - before) & (t_s <= times[-1] + after)


def _weights(times: Floats, t_s: Floats, inside: Bools, interpolation: attitude.Interpolation) -> Floats:
    """Weights (J, K) of the exposures; zero where they do not cover. One alone follows the nominal motion."""
    weights = np.zeros((len(t_s), len(times)))
    if len(times) == 1:
        weights[inside] = 1.0
    elif len(times):
        weights[inside] = attitude.interpolation_weights(times, t_s[inside], interpolation)
    return weights


def _rotation_rate(times: Floats, R_si: Rotation) -> Floats:
    """Mean rotation rate (3,) of the sky in frame s, rad/s; zero for one exposure alone."""
    if len(times) < 2:
        return np.zeros(3)
    near = np.flatnonzero(np.abs(times - 0.5 * (times[0] + times[-1])) <= RATE_OVER_S)
    first, last = (near[0], near[-1]) if len(near) > 1 else (0, len(times) - 1)
    return np.asarray((R_si[last] * R_si[first].inv()).as_rotvec() / (times[last] - times[first]))


def _by_motion(motion: SlowMotion, nodes: Floats, t_s: Floats, weights: Floats, inside: Bools) -> Floats:
    """Square root (J, 3, 3 M) of the covariance of the motion that the interpolation misses."""
    root = np.zeros((len(t_s), 0))
    if len(motion.time_s) and len(nodes) > 1 and inside.any():
        values, vectors = np.linalg.eigh(missed_covariance(motion, t_s[inside], nodes, weights[inside]))
        large = values > NEGLIGIBLE_MOTION_RAD**2
        root = np.zeros((len(t_s), int(large.sum())))
        root[inside] = vectors[:, large] * np.sqrt(values[large])
    return np.einsum("ab,jm->jamb", np.eye(3), root).reshape(len(t_s), 3, -1)
