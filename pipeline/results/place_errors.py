"""How far places of a strip may lie from the true ones, by the calibration and by what the dump states.

A place is off by the matrix, by the errors of its pass (attitude, position, clock), which all places of the
strip share, by the ground's height, and by what is its own. The matrix has taken up part of the errors of a
pass that was used for it (`calib.taken_up`): there the place has both, and they cancel. With independent
1-sigma errors z of a strip, the matrices theta of all heads and places x,

    theta, true less estimated = -G e(z) + rest,    x, true less computed = M theta + own z,

so that the covariance of the rest is that of theta without the part of z. With several heads a place has the
matrix of each by the share that its rows have in the attitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from boresight.geometry.attitude import AttitudeTrack, interpolation_weights, linear_weights
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.results.ground_moves import common_covariance, ground_moves
from boresight.pipeline.results.reading import SavedResult
from boresight.records.record import Floats, array, record

__all__ = ["PassErrors", "PlaceErrors", "covariance_of_places", "rest_of_common", "variance_of_places"]

RATE_WITHIN_S = 0.5  # before and after, an attitude's rate is taken: longer than a step between star images
KNOTS = 129  # instants of a strip between which errors of smoothed attitudes are taken as linear


@record(kw_only=True)
class PlaceErrors:
    """What moves N places of one strip along the track, and across it to the right."""

    by_common: Floats = array(
        "N, 2, T", "by the matrices of heads, m/rad, and 1-sigma of the Earth's rotation"
    )
    own: Floats = array("N, 2, B", "by independent 1-sigma errors of the strip, m")
    in_matrix: Floats = array("T, B", "what the same errors do to those matrices, rad")
    white: Floats = array("N, 2", "variance of what is each place's own, m²")


@dataclass(frozen=True, kw_only=True, eq=False)
class PassErrors:
    """The errors of a strip's pass and what the matrices have taken up of them."""

    result: SavedResult
    dump: Dump
    track: AttitudeTrack  # of the strip
    sigma_terrain_m: float  # 1-sigma of the heights
    nodes_s: Floats  # (K,) instants: of the exposures, or knots of smoothed attitudes
    root_s: Floats  # (K, 3, A) rotation there about the axes of s by independent 1-sigma errors, rad
    shares: Floats  # (3, 3 H) of the heads' matrices in that of the strip
    in_matrix: Floats  # (3 H + 3, B) as in `PlaceErrors`

    @classmethod
    def of(
        cls, result: SavedResult, dump: Dump, strip: Strip, track: AttitudeTrack, sigma_terrain_m: float
    ) -> PassErrors:
        """Of a strip with its attitudes."""
        (first, last), (begin, end) = dump.span_s(strip), track.span_s
        knots_s: Floats = np.linspace(max(first, begin), min(last, end), KNOTS, dtype=float)
        nodes_s = knots_s if track.is_smoothed else track.t_s
        root_s = track.errors_s(knots_s) if track.is_smoothed else _root_s(track, dump)
        common_s = np.tensordot(_weights(track, nodes_s, knots_s).mean(axis=0), root_s, axes=1)
        C, H = result.R_cs.as_matrix(), len(result.cov_heads) // 3
        shares = [C @ track.shares.get(name, np.zeros((3, 3))) @ C.T for name in result.head_names]
        G = np.zeros((3 * H + 3, 7))  # nothing of the Earth's rotation
        if (taken := result.taken_up.get(strip.strip_id)) is not None and len(taken) == 3 * H:
            G[:-3] = taken
        position, clock = dump.errors.position_m * np.eye(3), np.array([[dump.errors.clock_s]])
        return cls(
            result=result,
            dump=dump,
            track=track,
            sigma_terrain_m=sigma_terrain_m,
            nodes_s=nodes_s,
            root_s=root_s,
            shares=np.hstack(shares) if track.shares and H > 1 else np.eye(3, 3 * H),
            in_matrix=-G @ np.pad(block_diag(common_s, position, clock), ((0, 0), (0, 1))),
        )

    def at(self, t_s: Floats, p_e: Floats) -> PlaceErrors:
        """The errors of places (N, 3), ITRS, seen at instants (N,)."""
        dump, C, errors = self.dump, self.result.R_cs.as_matrix(), self.dump.errors
        orbit = dump.orbit
        moves = ground_moves(orbit, self.result.R_cs * self.track.R_si(t_s), t_s, p_e)
        attitude_s = np.tensordot(_weights(self.track, self.nodes_s, t_s), self.root_s, axes=1)
        if self.track.is_smoothed:
            left = self.track.covariance_s(t_s) - attitude_s @ np.swapaxes(attitude_s, 1, 2)
        else:
            left = np.nan_to_num(self.track.interpolation_sigma_rad(t_s))[:, :, None] ** 2 * np.eye(3)
        by_attitude = moves.by_rotation @ C
        track_e = np.swapaxes(orbit.R_oi(t_s).as_matrix() @ orbit.earth.matrices_ie(t_s), 1, 2)
        own = [
            -by_attitude @ attitude_s,
            errors.position_m * moves.by_position @ track_e,
            errors.clock_s * (moves.by_clock[:, :, None] - by_attitude @ self._rate_s(t_s)[:, :, None]),
            self.sigma_terrain_m * moves.by_height[:, :, None],
        ]
        white = np.maximum(np.einsum("nia,nab,nib->ni", by_attitude, left, by_attitude), 0.0)
        vibration = (errors.vibration_arcsec * ARCSEC) ** 2 * np.sum(moves.by_rotation**2, axis=2)
        return PlaceErrors(
            by_common=np.concatenate([moves.by_rotation @ self.shares, moves.by_earth], axis=2),
            own=np.concatenate(own, axis=2),
            in_matrix=self.in_matrix,
            white=white + vibration,
        )

    def _rate_s(self, t_s: Floats) -> Floats:
        """Rotation rate (N, 3) of the sky in frame s, rad/s."""
        before, after = (np.clip(t, *self.track.span_s) for t in (t_s - RATE_WITHIN_S, t_s + RATE_WITHIN_S))
        turns = (self.track.R_si(after) * self.track.R_si(before).inv()).as_rotvec()
        return np.asarray(turns / (after - before)[:, None])


def _root_s(track: AttitudeTrack, dump: Dump) -> Floats:
    """Rotation (K, 3, 3 K) of the exposures of a track about the axes of s by independent errors, rad."""
    covariance, K = dump.heads[0].noise.coloured_covariance_s(track.t_s), len(track.t_s)
    assert track.cov_s is not None  # `attitude_track` gives it
    covariance[np.arange(K), :, np.arange(K), :] += track.cov_s
    values, vectors = np.linalg.eigh(covariance.reshape(3 * K, 3 * K))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).reshape(K, 3, 3 * K))


def _weights(track: AttitudeTrack, nodes_s: Floats, t_s: Floats) -> Floats:
    """Weights (N, K) of errors at nodes in those at instants (N,)."""
    if track.is_smoothed:
        return np.asarray(linear_weights(nodes_s, t_s).toarray())
    return interpolation_weights(nodes_s, t_s, track.interpolation, track.points)


def rest_of_common(result: SavedResult, dump: Dump, strips: Sequence[Floats]) -> Floats:
    """Covariance (T, T) of the matrices of all heads, rad², and of the Earth's rotation in units of its
    1-sigma, without what the errors of strips, each (T, B), have done to the matrices.
    """
    look2 = (dump.errors.look_px * dump.line_camera.pixel_rad) ** 2
    n, H = len(result.cov_heads), len(result.cov_heads) // 3
    with_earth = common_covariance(result, dump.orbit.earth)
    whole = block_diag(result.cov_heads, with_earth[3:, 3:])
    whole[:n, n:] = np.tile(with_earth[:3, 3:], (H, 1))
    whole[n:, :n] = whole[:n, n:].T
    values, vectors = np.linalg.eigh(whole - sum(one @ one.T for one in strips))
    rest = (vectors * np.maximum(values, 0.0)) @ vectors.T
    rest[:n, :n] += np.tile(look2 * np.eye(3), (H, H))
    return np.asarray(rest)


def covariance_of_places(strips: Sequence[PlaceErrors], result: SavedResult, dump: Dump) -> Floats:
    """Covariance (2, N, N), m², of the errors along and across the track of the N places of all strips."""
    by_common = np.concatenate([one.by_common for one in strips])
    common = rest_of_common(result, dump, [one.in_matrix for one in strips])
    white, first = np.concatenate([one.white for one in strips]), 0
    covariance = [own @ common @ own.T + np.diag(w) for own, w in zip(np.moveaxis(by_common, 1, 0), white.T)]
    for one in strips:
        roots = np.moveaxis(by_common @ one.in_matrix, 1, 0)
        roots[:, first : first + len(one.own)] += np.moveaxis(one.own, 1, 0)
        first += len(one.own)
        covariance = [whole + root @ root.T for whole, root in zip(covariance, roots)]
    return np.array(covariance)


def variance_of_places(one: PlaceErrors, rest: Floats) -> Floats:
    """Variance (N, 2), m², of the errors of places of one strip; `rest` is `rest_of_common`."""
    by_rest = np.einsum("nia,ab,nib->ni", one.by_common, rest, one.by_common, optimize=True)
    return np.asarray(by_rest + np.sum((one.own + one.by_common @ one.in_matrix) ** 2, axis=2) + one.white)
