"""One strip, linearised: its targets' residuals as theta, the errors that targets share, and white noise.

Each target of a line scanner has its own instant t_j. The star camera's attitude there is interpolated
between the exposures' attitudes (relative to the nominal motion, Lagrange weights w_jk), and the exposures'
errors phi_k stay unknowns: the residual of a target sees theta - sum w_jk phi_k (docs/estimation.md; phi
right-handed, theta with the paper's sign, hence the minus). What else targets of a strip share stands
beside the phi_k, every unknown scaled to unit prior variance: position error, clock offset, distortion,
coordinates of a target seen twice. For all of them, with whitened residuals r = X_theta theta + X_q q +
noise,

    F = X_thetaᵀ X_theta - X_thetaᵀ X_q (I + X_qᵀ X_q)⁻¹ X_qᵀ X_theta,    F theta likewise with r.

A prior of zero makes a column of zeros: the error is off. Preparing does not need the installation matrix
and is done once. Strips with equal numbers of exposures, targets and unknowns are reduced together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import Knot, correlation, knot_weights, knots_touched
from boresight.calib.settings import CalibrationSettings
from boresight.calib.shared_unknowns import SeenTargets, SharedUnknowns, turning_axes
from boresight.geometry.attitude import lagrange_weights
from boresight.geometry.attitude_estimate import cross_matrices, with_attitudes
from boresight.geometry.sightings import ExposureAttitudes, GroundSightings, StripSightings

__all__ = ["LinearStrips", "PreparedStrip", "StripGroup", "group_strips", "linearise", "prepare_strip"]

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedStrip:
    """A strip before the installation matrix is known. J targets, n unknowns that its targets share."""

    strip_id: str
    attitudes: ExposureAttitudes  # of all exposures
    used: Flags  # (K,) exposures that carry targets' attitudes
    inside: Flags  # (J,) targets whose instant the exposures cover
    target_id: NDArray[np.str_]  # (J,)
    ccd: NDArray[np.int64]  # (J,)
    sample: Array  # (J,) px along the CCD
    u_c: Array  # (J, 3) measured look vectors
    cov_c: Array  # (J, 3, 3) of their placing, rad²
    v_s: Array  # (J, 3) the targets' known directions as the star camera's attitude puts them into frame s
    shared_s: Array  # (J, 3, n) change of v_s by each shared unknown in units of its prior sigma
    unknowns: tuple[str, ...]  # (n,) names of the columns of shared_s
    coordinates_s: Array  # (J, 3, 3) 1/m, change of v_s by its coordinates, axes turning with the Earth
    cov_coordinates: Array  # (J, 3, 3) m², the same axes

    def seen(self) -> SeenTargets:
        """What other strips may share with this one."""
        return SeenTargets(self.target_id, self.ccd, self.sample, self.cov_coordinates)


@dataclass(frozen=True, slots=True, eq=False)
class StripGroup:
    """S prepared strips of equal shape, one after another, with the knots of the distortion."""

    place: NDArray[np.int64]  # (S,) which strips of the calibration these are
    inside: Flags  # (S, J)
    u_c: Array  # (S, J, 3)
    cov_c: Array  # (S, J, 3, 3)
    v_s: Array  # (S, J, 3)
    shared_s: Array  # (S, J, 3, n + 3 m) with the coordinates of m targets seen twice in the strip
    white_s: Array  # (S, J, 3, 3) rad², coordinates of targets seen once
    targets_s: Array  # (S, J, 3, 3 t) 1/m, coordinates of targets that other strips see, too
    camera: Array  # (S, J, g/2) rad, change of the look vector along x (or y) by each of the knots
    own: Array  # (S, J, m) the same for the strip's own distortion, whitened
    missed: Array  # (S, J) rad², variance of the distortion that straight lines between knots miss


@dataclass(frozen=True, slots=True, eq=False)
class LinearStrips:
    """S strips of equal shape, linearised about one installation matrix. Rows are whitened, two a target."""

    r: Array  # (S, 2 J)
    X_theta: Array  # (S, 2 J, 3) change of r by theta
    X_shared: Array  # (S, 2 J, g) change of r by what strips share: the distortion's knots, targets
    X_q: Array  # (S, 2 J, n) change of r by the strip's own unknowns, units of their prior sigma
    whitener: Array  # (S, J, 2, 2) takes residuals along the two tangent axes to rows of r
    measured: Array  # (S, J, 2, 2) part of the whitened noise that the image measurement makes


def prepare_strip(strip: StripSightings, settings: CalibrationSettings) -> PreparedStrip:
    """Bring every target into frame s at its own instant, by the exposures' attitudes, which are fitted where
    the strip has none.
    """
    attitudes = with_attitudes([strip], settings.attitudes)[0].attitudes
    assert attitudes is not None
    ground = strip.ground
    used = attitudes.usable
    times = np.array([exposure.t_s for exposure in strip.exposures])
    inside, weights = _weights(times[used], ground.t_s)
    J, K = len(ground.t_s), int(used.sum())
    R_si = _interpolated(
        attitudes.R_si[used], strip.R_oi_exposures, used, strip.R_oi_targets, weights, inside
    )
    v_s = np.einsum("jab,jb->ja", R_si, ground.u_i)
    covariance = attitudes.covariance_s[used] + settings.sigma_vibration_exposure_rad**2 * np.eye(3)
    turn = -cross_matrices(v_s)[:, None] @ np.linalg.cholesky(covariance)[None]  # (J, K, 3, 3)
    phi = (weights[:, :, None, None] * turn).transpose(0, 2, 1, 3).reshape(J, 3, 3 * K)
    move_s = R_si @ _direction_by_position(ground)  # (J, 3, 3) per metre
    position = move_s * settings.sigma_position_m
    rate_s = _turning_rate(times[used], attitudes.R_si[used])
    clock = (move_s @ ground.v_rel_i[:, :, None] + np.cross(rate_s, v_s)[:, :, None]) * settings.sigma_clock_s
    R_ie = turning_axes(ground.t_s)
    names = [f"phi/{k}/{axis}" for k in range(K) for axis in "xyz"] + [f"position/{axis}" for axis in "xyz"]
    return PreparedStrip(
        strip.strip_id,
        attitudes,
        used,
        inside,
        ground.target_id,
        ground.ccd,
        ground.xy_px[:, 0],
        ground.u_c,
        ground.cov_c,
        v_s,
        np.concatenate([phi, position, clock], axis=2),
        (*names, "clock"),
        -move_s @ R_ie,
        np.swapaxes(R_ie, 1, 2) @ ground.cov_target_i @ R_ie * settings.use_target_sigma,
    )


def group_strips(
    strips: list[PreparedStrip], shared: SharedUnknowns, settings: CalibrationSettings
) -> list[StripGroup]:
    """Strips of equal shape put together, in the order in which their shapes first come.

    A strip none of whose targets the exposures cover is in no group.
    """
    shapes: dict[tuple[int, int, int], list[int]] = {}
    for place, strip in enumerate(strips):
        if not strip.inside.any():
            continue
        n = 2 * len(_own_knots(strip, settings)) + 3 * len(_seen_again(strip, shared))
        shapes.setdefault((int(strip.used.sum()), len(strip.ccd), n), []).append(place)
    return [_group(strips, np.array(places), shared, settings) for places in shapes.values()]


def linearise(
    group: StripGroup, R_cs: Rotation, settings: CalibrationSettings, scale_c: float = 1.0
) -> LinearStrips:
    """Whitened residuals and their derivatives about `R_cs`; `scale_c` scales the sigma of the placings.

    Targets that the exposures do not cover have rows of zeros.
    """
    C = R_cs.as_matrix()
    S = len(group.place)
    w = group.v_s @ C.T  # (S, J, 3)
    tangent = _tangent_axes(w)  # (S, J, 2, 3)
    difference = group.u_c - w
    placing = tangent @ group.cov_c @ np.swapaxes(tangent, 2, 3)
    turned = tangent @ C
    white = scale_c**2 * placing + turned @ group.white_s @ np.swapaxes(turned, 2, 3)
    white = white + (settings.sigma_vibration_rad**2 + group.missed)[:, :, None, None] * np.eye(2)
    whitener = _inverse_cholesky_2x2(white)
    rows = whitener * group.inside[:, :, None, None]
    own = _along_axes(tangent, group.own)
    parts = (
        rows @ (tangent @ difference[..., None]),
        rows @ (tangent @ cross_matrices(w)),
        rows @ np.concatenate([_along_axes(tangent, group.camera), turned @ group.targets_s], axis=3),
        rows @ np.concatenate([turned @ group.shared_s, own], axis=3),
    )
    r, X_theta, X_shared, X_q = (part.reshape(S, 2 * w.shape[1], part.shape[-1]) for part in parts)
    measured = whitener @ placing @ np.swapaxes(whitener, 2, 3)
    return LinearStrips(r[:, :, 0], X_theta, X_shared, X_q, whitener, measured)


def _group(
    strips: list[PreparedStrip],
    place: NDArray[np.int64],
    shared: SharedUnknowns,
    settings: CalibrationSettings,
) -> StripGroup:
    members = [strips[n] for n in place]
    camera, own, missed = zip(*(_distortion(strip, shared.knots, settings) for strip in members))
    across, again, white = zip(*(_coordinates(strip, shared) for strip in members))
    fields = ("inside", "u_c", "cov_c", "v_s")
    return StripGroup(
        place=place,
        shared_s=np.stack(
            [np.concatenate([strip.shared_s, two], axis=2) for strip, two in zip(members, again)]
        ),
        white_s=np.stack(white),
        targets_s=np.stack(across),
        camera=np.stack(camera),
        own=np.stack(own),
        missed=np.stack(missed),
        **{name: np.stack([getattr(strip, name) for strip in members]) for name in fields},
    )


def _weights(times: Array, t_s: Array) -> tuple[Flags, Array]:
    """Which instants the exposures cover, and the weights (J, K) of the exposures there, zero where not
    covered.

    One exposure alone covers half a second around it, by the nominal motion.
    """
    if len(times) == 0:
        return np.zeros(len(t_s), dtype=bool), np.zeros((len(t_s), 0))
    if len(times) == 1:
        inside = np.abs(t_s - times[0]) <= 0.5
        return inside, inside[:, None].astype(float)
    before, after = 0.5 * (times[1] - times[0]), 0.5 * (times[-1] - times[-2])
    inside = (t_s >= times[0] - before) & (t_s <= times[-1] + after)
    weights = np.zeros((len(t_s), len(times)))
    weights[inside] = lagrange_weights(times, t_s[inside], points=min(4, len(times)))
    return inside, weights


def _interpolated(
    R_si: Array, R_oi_exposures: Rotation, used: Flags, R_oi_targets: Rotation, weights: Array, inside: Flags
) -> Array:
    """Attitudes (J, 3, 3) at the targets' instants; the unit matrix where the exposures do not cover them."""
    R_si_targets = np.tile(np.eye(3), (len(weights), 1, 1))
    if not inside.any():
        return R_si_targets
    D = Rotation.from_matrix(R_si) * R_oi_exposures[used].inv()
    middle = D[len(D) // 2]
    turned = Rotation.from_rotvec(weights[inside] @ (D * middle.inv()).as_rotvec())
    R_si_targets[inside] = (turned * middle * R_oi_targets[inside]).as_matrix()
    return R_si_targets


def _turning_rate(times: Array, R_si: Array) -> Array:
    """Mean rate (3,) at which frame s sees the sky turn about it, rad/s; zero for one exposure alone."""
    if len(times) < 2:
        return np.zeros(3)
    turn = Rotation.from_matrix(R_si[-1] @ R_si[0].T).as_rotvec()
    return np.asarray(turn / (times[-1] - times[0]))


def _direction_by_position(ground: GroundSightings) -> Array:
    """d u_i / d p_i = -(I - u uᵀ) / range, (J, 3, 3) 1/m: the satellite is not where it was said to be."""
    u = ground.u_i
    return -(np.eye(3) - u[:, :, None] * u[:, None, :]) / ground.range_m[:, None, None]


def _seen_again(strip: PreparedStrip, shared: SharedUnknowns) -> list[str]:
    """Targets that this strip alone sees, more than once: of the same points, on two CCDs."""
    ids, count = np.unique(strip.target_id, return_counts=True)
    return [str(name) for name in ids[count > 1] if str(name) not in shared.targets]


def _coordinates(strip: PreparedStrip, shared: SharedUnknowns) -> tuple[Array, Array, Array]:
    """Targets' own coordinates: columns (J, 3, 3 t) of the shared ones, (J, 3, 3 m) of those seen again in
    this strip, whitened, and the white noise (J, 3, 3) of the rest, rad².
    """
    move, covariance = strip.coordinates_s, strip.cov_coordinates
    white = move @ covariance @ np.swapaxes(move, 1, 2)
    again = _seen_again(strip, shared)
    across = np.zeros((len(move), 3, 3 * len(shared.targets)))
    own = np.zeros((len(move), 3, 3 * len(again)))
    for row in np.flatnonzero(np.isin(strip.target_id, [*shared.targets])):
        place = 3 * shared.targets.index(str(strip.target_id[row]))
        across[row, :, place : place + 3] = move[row]
        white[row] = 0.0
    for n, name in enumerate(again):
        rows = strip.target_id == name
        values, vectors = np.linalg.eigh(covariance[rows][0])
        own[rows, :, 3 * n : 3 * n + 3] = move[rows] @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        white[rows] = 0.0
    return across, own, white


def _own_knots(strip: PreparedStrip, settings: CalibrationSettings) -> tuple[Knot, ...]:
    if settings.distortion_scope == "camera" or settings.sigma_distortion_rad == 0.0:
        return ()
    return knots_touched(strip.ccd, strip.sample, settings.distortion_length_px)


def _distortion(
    strip: PreparedStrip, camera_knots: tuple[Knot, ...], settings: CalibrationSettings
) -> tuple[Array, Array, Array]:
    """Weights of the camera's knots (J, g/2), whitened weights of the strip's own (J, m), white variance
    (J,), rad².
    """
    sigma, length = settings.sigma_distortion_rad, settings.distortion_length_px
    J, knots = len(strip.ccd), _own_knots(strip, settings)
    camera: Array = np.zeros((J, len(camera_knots)))
    own: Array = np.zeros((J, len(knots)))
    missed: Array = np.full(J, sigma**2)
    if camera_knots:
        camera = knot_weights(strip.ccd, strip.sample, camera_knots, length)
        missed = sigma**2 * (1.0 - np.einsum("jk,kl,jl->j", camera, correlation(camera_knots), camera))
    if knots:
        own = knot_weights(strip.ccd, strip.sample, knots, length) @ np.linalg.cholesky(correlation(knots))
        missed = sigma**2 * (1.0 - np.einsum("jk,jk->j", own, own))
    return sigma * camera, sigma * own, missed


def _along_axes(tangent: Array, weights: Array) -> Array:
    """Columns (S, J, 2, 2 K) of curves along x and along y of frame c."""
    x, y = (tangent[:, :, :, axis, None] * weights[:, :, None, :] for axis in (0, 1))
    return np.concatenate([x, y], axis=3)


def _tangent_axes(w: Array) -> Array:
    """Two unit vectors (..., 2, 3) across each direction: the camera's x axis as nearly as may be, and w
    x that.
    """
    x = np.zeros_like(w)
    x[..., 0] = 1.0
    x = x - w[..., :1] * w
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(w, x)], axis=-2)


def _inverse_cholesky_2x2(matrix: Array) -> Array:
    """L⁻¹ of matrix = L Lᵀ, (..., 2, 2)."""
    a = np.sqrt(matrix[..., 0, 0])
    b = matrix[..., 1, 0] / a
    c = np.sqrt(matrix[..., 1, 1] - b * b)
    out = np.zeros_like(matrix)
    out[..., 0, 0], out[..., 1, 1], out[..., 1, 0] = 1.0 / a, 1.0 / c, -b / (a * c)
    return out
