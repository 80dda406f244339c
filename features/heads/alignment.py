"""Alignment between two star cameras (heads) from their attitudes alone: no ground, no remote-sensing camera.

Where both have an attitude at one instant, the rotation from one to the other is their alignment R_sh and the
errors of both. Means over blocks longer than the errors' correlation time are fitted, by generalised least
squares with the noise of `head_noise`, with a constant rotation about the axes of the reference head's
frame s and, for each term asked for, a rotation in proportion to it: time, cosine and sine of the position in
the orbit, temperature. An offset between the heads' clocks is one more unknown: it turns one against the
other by rate times offset, which differs from a constant only as far as the satellite's rate changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.orbit import argument_of_latitude
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.head_noise.of_dump import HeadNoise, head_track, noise_of_tracks
from boresight.pipeline.head_noise.tracks import HeadTrack, carried_to, common_instants
from boresight.pipeline.run.settings import Settings
from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = ["AlignmentTerm", "HeadAlignment", "HeadsAlone", "align_heads", "heads_alone"]

# Most blocks of time into which the differences of two heads are averaged; bounds the time of the fit.
MOST_BLOCKS = 300
LEAST_ORBIT = 0.25  # of an orbit that a record must span for a term of the position in it


@record(kw_only=True)
class AlignmentTerm:
    """Rotation in proportion to a quantity."""

    name: str = scalar("what it is in proportion to, with its unit")
    value: Floats = array("3", "rad a unit, about the axes of s")
    sigma: Floats = array("3", "1-sigma")


@record(kw_only=True)
class HeadAlignment:
    """Alignment of a head with the reference head."""

    head: str = scalar("name of the head")
    R_sh: Rotation = scalar("its frame h to frame s")
    covariance_s: Floats = array("3, 3", "rad², of a small rotation about the axes of s")
    angle_rad: float = scalar("between the lines of sight (z) of both")
    sigma_angle_rad: float = scalar("1-sigma")
    terms: tuple[AlignmentTerm, ...] = scalar("changes that were asked for")
    time_offset_s: float = scalar("by which the head's times are late")
    sigma_time_offset_s: float = scalar("1-sigma; infinite where the rate does not change")
    n_rows: int = scalar("instants with both attitudes")
    block_t_s: Floats = array("B", "middle of each block")
    block_s: Floats = array("B, 3", "mean rotation of each block against R_sh, rad, axes of s")
    block_sigma: Floats = array("B, 3", "its 1-sigma by the noise model")


@record(kw_only=True)
class HeadsAlone:
    """Alignments of the heads of a dump with its reference head."""

    reference: str = scalar("name of the reference head")
    noise: HeadNoise = scalar("their noise")
    alignments: tuple[HeadAlignment, ...] = scalar("of each further head")
    stated: tuple[Rotation, ...] = scalar("R_sh of the same heads by the pre-launch matrices")


def heads_alone(dump: Dump, settings: Settings) -> HeadsAlone:
    """Alignment of the further heads of a dump with its reference head.

    `DataNotSufficientError` for a single head, and for heads without attitudes at common instants.
    """
    if len(dump.heads) < 2:
        raise DataNotSufficientError(
            "the dump has one star camera, an alignment needs two ([[star_cameras]])"
        )
    tracks = [head_track(dump, head, settings) for head in dump.heads]
    noise = noise_of_tracks(dump, [track for track, _ in tracks])
    reference, alignments = tracks[0][0], []
    for n, (track, temperature) in enumerate(tracks[1:], start=1):
        pair = noise.fit.heads[0], noise.fit.heads[n]
        try:
            found = align_heads(reference, track, pair, _terms(dump, track, temperature), noise.fit.mean_s)
        except ValueError as error:
            raise DataNotSufficientError(str(error)) from error
        alignments.append(found)
    return HeadsAlone(
        reference=reference.name,
        noise=noise,
        alignments=tuple(alignments),
        stated=tuple(dump.R_cs0.inv() * head.R_cs0 for head in dump.heads[1:]),
    )


def align_heads(
    reference: HeadTrack,
    other: HeadTrack,
    noise: tuple[AttitudeNoise, AttitudeNoise],
    terms: Mapping[str, Floats],
    constant_s: float,
) -> HeadAlignment:
    """Alignment of `other` with `reference`; `ValueError` for fewer than three common instants.

    `noise` is that of each, about its own axes; `terms` has by name a quantity (K,) at the instants of
    `other`; over `constant_s` seconds the constant part of the noise is one error.
    """
    first, rows = common_instants(reference, other)
    if len(rows) < 3:
        raise ValueError(
            f"{len(rows)} instants with attitudes of {reference.name} and {other.name}, 3 are needed"
        )
    t_s = other.t_s[rows]
    here = carried_to(reference, first, t_s, other.R_oi[rows])
    R_sh_each = here * other.R_hi[rows].inv()
    R_sh = R_sh_each[len(rows) // 2]
    for _ in range(3):
        R_sh = Rotation.from_rotvec(np.median((R_sh_each * R_sh.inv()).as_rotvec(), axis=0)) * R_sh
    rho = (R_sh_each * R_sh.inv()).as_rotvec()
    blocks, step = _blocks(t_s, max(10.0 * float(np.max([one.correlation_time_s for one in noise])), 1.0))
    y, when, count = _mean(rho, blocks), _mean(t_s[:, None], blocks)[:, 0], np.bincount(blocks)
    rate = _mean(_rates(t_s, here), blocks)
    quantities = {name: _mean(values[rows][:, None], blocks)[:, 0] for name, values in terms.items()}
    X = _design(rate, quantities)
    C = _covariance(noise, R_sh, when, count, step, constant_s)
    solve = cho_factor(C)
    normal = X.T @ cho_solve(solve, X)
    x, covariance = _solved(normal, X.T @ cho_solve(solve, y.ravel()))
    R_best = Rotation.from_rotvec(x[:3]) * R_sh
    sigma = np.sqrt(np.diag(covariance))
    angle, by_rotation = _angle(R_best)
    found = tuple(
        AlignmentTerm(name=name, value=x[4 + 3 * n : 7 + 3 * n], sigma=sigma[4 + 3 * n : 7 + 3 * n])
        for n, name in enumerate(quantities)
    )
    return HeadAlignment(
        head=other.name,
        R_sh=R_best,
        covariance_s=covariance[:3, :3],
        angle_rad=angle,
        sigma_angle_rad=float(np.sqrt(by_rotation @ covariance[:3, :3] @ by_rotation)),
        terms=found,
        time_offset_s=float(x[3]),
        sigma_time_offset_s=float(sigma[3]),
        n_rows=len(rows),
        block_t_s=when,
        block_s=y - x[:3],
        block_sigma=np.sqrt(np.diag(C)).reshape(-1, 3),
    )


def _blocks(t_s: Floats, least_s: float) -> tuple[Ints, float]:
    """Number (K,) of the block of each instant, and the usual step."""
    step = float(np.median(np.diff(t_s)))
    span = float(t_s[-1] - t_s[0]) + step
    length = max(min(least_s, span / 5.0), span / MOST_BLOCKS, step)
    _, blocks = np.unique(np.floor((t_s - t_s[0]) / length + 1e-9).astype(np.int64), return_inverse=True)
    return blocks, step


def _mean(values: Floats, blocks: Ints) -> Floats:
    total = np.zeros((int(blocks.max()) + 1, values.shape[1]))
    np.add.at(total, blocks, values)
    return total / np.bincount(blocks)[:, None]


def _rates(t_s: Floats, R_si: Rotation) -> Floats:
    """Rotation rate of frame s (K, 3), rad/s, axes of s, over about a second."""
    hop = max(round(1.0 / float(np.median(np.diff(t_s)))), 1)
    hop = min(hop, len(t_s) - 1)
    rate = (R_si[hop:] * R_si[:-hop].inv()).as_rotvec() / (t_s[hop:] - t_s[:-hop])[:, None]
    return np.concatenate([rate, np.repeat(rate[-1:], hop, axis=0)])


def _design(rate: Floats, quantities: Mapping[str, Floats]) -> Floats:
    """Derivatives (3 B, 4 + 3 terms) of the blocks: constant, time offset, and terms less their mean."""
    B = len(rate)
    columns = [np.tile(np.eye(3), (B, 1)), (rate - rate.mean(axis=0)).reshape(3 * B, 1)]
    for values in quantities.values():
        columns.append(((values - values.mean())[:, None, None] * np.eye(3)).reshape(3 * B, 3))
    return np.concatenate(columns, axis=1)


def _covariance(
    noise: tuple[AttitudeNoise, AttitudeNoise],
    R_sh: Rotation,
    when: Floats,
    count: Ints,
    step: float,
    constant_s: float,
) -> Floats:
    """(3 B, 3 B) covariance of the blocks' means, rad²."""
    B = len(when)
    C = np.zeros((B, 3, B, 3))
    piece = np.floor((when - when[0]) / constant_s)
    same = (piece[:, None] == piece[None, :]).astype(float)
    for one, R in zip(noise, (Rotation.identity(), R_sh)):
        A = R.as_matrix()
        decay = np.exp(-step / one.correlation_time_s)
        series = (1.0 + decay) / (1.0 - decay)  # of a mean over many correlation times
        white = (one.white_rad**2 + one.correlated_rad**2 * series) / count[:, None]
        each = np.einsum("xa,ba,ya->bxy", A, white, A)
        C[np.arange(B), :, np.arange(B), :] += each
        C += np.einsum("bc,xy->bxcy", same, (A * one.constant_rad**2) @ A.T)
        waves = replace(one, R_sn=R).waves_s(when)
        C += np.einsum("bxn,cyn->bxcy", waves, waves)
    return C.reshape(3 * B, 3 * B) + 1e-24 * np.eye(3 * B)


def _solved(normal: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Unknowns and covariance; what the data do not tell is zero with an infinite variance."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(scale[:, None] * normal * scale)
    seen = (values > 1e-10) & np.isfinite(scale).all()
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T
    hidden = (np.abs(vectors[:, ~seen]) > 1e-3).any(axis=1)
    covariance = scale[:, None] * inverse * scale
    covariance[hidden, hidden] = np.inf
    return scale * (inverse @ (scale * right)), covariance


def _angle(R_sh: Rotation) -> tuple[float, Floats]:
    """Angle between the lines of sight, and its derivative by a small rotation about the axes of s."""
    x, y, z = R_sh.as_matrix()[:, 2]
    across = np.hypot(x, y)
    return float(np.arctan2(across, z)), np.array([-y, x, 0.0]) / across


def _terms(dump: Dump, track: HeadTrack, temperature: Floats | None) -> dict[str, Floats]:
    """Quantities that an alignment may change with, where the record spans enough of them."""
    terms = {"hour": track.t_s / 3600.0}
    latitude = np.unwrap(argument_of_latitude(*dump.orbit.states_i(track.t_s)))
    if np.ptp(latitude) > 2.0 * np.pi * LEAST_ORBIT:
        terms |= {
            "cos(argument of latitude)": np.cos(latitude),
            "sin(argument of latitude)": np.sin(latitude),
        }
    if temperature is not None and np.ptp(temperature) > 0.1:
        terms["degree Celsius"] = temperature
    return terms
