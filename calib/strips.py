"""One pass, linearised: its targets' residuals as theta, the errors that targets share, and white noise.

Each target of a line scanner has its own instant t_j. The star camera's attitude there is interpolated
between the exposures' attitudes (relative to the nominal motion, Lagrange weights w_jk), and the exposures'
errors phi_k stay unknowns: the residual of a target sees theta - sum w_jk phi_k (notes/estimation.md; phi
right-handed, theta with the paper's sign, hence the minus). What else targets of a strip share stands beside
the phi_k, every unknown scaled to unit prior variance: position error, clock offset, distortion, coordinates
of a target seen twice. A star in a strip that scans the sky is a target, too. For all of them, with whitened
residuals r = X_theta theta + X_q q + noise,

    F = X_thetaᵀ X_theta - X_thetaᵀ X_q (I + X_qᵀ X_q)⁻¹ X_qᵀ X_theta,    F theta likewise with r.

Preparing does not need the installation matrix and is done once. Strips with equal numbers of exposures,
targets and unknowns are reduced together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import residual_distortion, unit_numbers
from boresight.calib.error_table import (
    MICRORADIAN,
    SharedUnknowns,
    coordinate_covariance,
    earth_axes,
    of_pass,
)
from boresight.calib.heads import HeadTie, of_heads
from boresight.calib.own_unknowns import condensed
from boresight.calib.pass_attitude import attitude_of, is_smoothed, smoothed_motion
from boresight.calib.settings import CalibrationSettings
from boresight.calib.slow_motion import AT_REST, SlowMotion, has_few_exposures, motion_of
from boresight.geometry.attitude_estimate import cross_matrices, with_attitudes
from boresight.geometry.attitude_noise import LastingError
from boresight.geometry.sightings import ExposureAttitudes, GroundReferences, GroundSightings, StripSightings
from boresight.records.record import Bools, Floats, Ints, Texts, array, record, scalar

__all__ = [
    "LinearStrips",
    "PreparedStrip",
    "StripGroup",
    "group_strips",
    "linearise",
    "prepare_strip",
    "prepare_strips",
    "tangent_axes",
]


@record(kw_only=True)
class PreparedStrip:
    """A strip before the installation matrix is known: K exposures, J targets, N unknowns common to them."""

    strip_id: str = scalar("the strip; of a pass of several (`simultaneous_strips`), the first of them")
    strip: Texts = array("J", "strip of each target")
    ground: GroundSightings = scalar("the J targets")
    attitudes: ExposureAttitudes = scalar("of all exposures; the usable ones are interpolated")
    inside: Bools = array("J", "whether exposures cover the target's instant")
    camera: Ints = array("J", "number of the camera, of those that are calibrated")
    weights: Floats = array(
        "J, U", "by which rotations of the exposures used rotate the attitude; dense or sparse"
    )
    curve: Ints = array("J", "curve of the residual distortion that holds there")
    place: Floats = array("J", "position along that curve, correlation lengths")
    distortion_rad: Floats = array("J", "1-sigma of that curve, per axis")
    modes_rad: Floats = array("J, 3", "change of the look by shift, slope and bend of its CCD, 1-sigma each")
    R_si: Floats = array("J, 3, 3", "attitude interpolated to the target's instant, GCRS to frame s")
    v_s: Floats = array("J, 3", "known directions of the targets, frame s by that attitude")
    number: Ints = array("J", "which pass of those that are eliminated together")
    attitude_s: Floats = array("J, 3, N", "change of v_s by unknowns of the attitude, 1-sigma each, rad")
    coordinates_s: Floats = array(
        "J, 3, 3", "change of v_s by the target's coordinates, Earth axes, 1/m; a star's, GCRS axes, 1/µrad"
    )
    cov_coordinates: Floats = array("J, 3, 3", "covariance of the coordinates, the same axes, m²; µrad²")
    reference_s: Floats = array("J, 3, 3", "change of v_s by true coordinates east, north, up of stated, 1/m")
    earth_s: Floats = array("J, 3, 3", "change of v_s by rotations of the Earth, each of its 1-sigma")
    earth: str = scalar("prediction of Earth orientation; empty: measured")
    late_s: Floats = array("J, 3", "change of v_s by the true instant of the row, rad/s")
    move_i: Floats = array("J, 3, 3", "change of v_s by the satellite's true position, GCRS axes, 1/m")
    move_s: Floats = array("J, 3, 3", "the same by its true position along the track, to the right, down")
    ties: tuple[HeadTie, ...] = scalar("what the rows of several heads tell of their unknowns")
    of_heads: tuple[str, ...] = scalar("unknowns of heads that change the attitude at the targets")
    by_heads_s: Floats = array("J, 3, A", "change of v_s by these")
    carrier: str = scalar("head that carries the strip; empty: the reference head")
    n_phi: int = scalar("how many of these, the first, the rows of heads tell of")
    lasting: tuple[LastingError, ...] = scalar("what the last of these are: constants of the heads")

    @property
    def unit(self) -> Ints:
        """CCD (J,) of each target, numbered over all cameras."""
        return unit_numbers(self.ground.ccd, self.camera)


@record(kw_only=True)
class StripGroup:
    """S prepared strips of equal shape, stacked, with their distortion and coordinate unknowns."""

    place: Ints = array("S", "which strips of the calibration these are")
    inside: Bools = array("S, J", "as in `PreparedStrip`")
    which: Ints = array("S, J", "number of the camera, of those that are calibrated")
    u_c: Floats = array("S, J, 3", "as in `PreparedStrip`")
    cov_c: Floats = array("S, J, 3, 3", "as in `PreparedStrip`")
    v_s: Floats = array("S, J, 3", "as in `PreparedStrip`")
    shared_s: Floats = array("S, J, 3, N", "change of v_s by the strip's own unknowns, 1-sigma each, rad")
    white_s: Floats = array("S, J, 3, 3", "noise by the coordinates of targets seen once, rad²")
    missed: Floats = array("S, J", "variance of the distortion between knots, rad²")
    ties: Floats = array("S, H, A", "rows of other heads: by unknowns of heads, residual; whitened")
    by_ties: Floats = array(
        "S, N, A", "own unknowns by such rows: by those of heads, residual (`own_unknowns`)"
    )
    n_common: int = scalar("unknowns of the calibration beside theta")
    parts: tuple[GroupPart, ...] = scalar("targets by camera")


@record
class GroupPart:
    """The targets of one camera in a group, and the unknowns of the calibration that move any of them."""

    camera: int  # number, of those that are calibrated
    targets: Ints  # (I,) of J
    columns: Ints  # (m,) of the unknowns
    in_c: Floats  # (S, I, 3, m) change of u_c - w by each of them, frame c, rad
    in_s: Floats  # (S, I, 3, m) change of v_s by each of them, rad


@record
class CommonColumns:
    """Change of the residuals of some targets by the common unknowns (theta of C cameras, then those of the
    calibration) that move any of them."""

    rows: Ints  # (2 I,) of 2 J, two a target
    columns: Ints  # (m,) of the 3 C + g common unknowns
    X: Floats  # (S, 2 I, m)


@record
class LinearStrips:
    """S strips of equal shape, linearised about one installation matrix. Rows are whitened, two a target."""

    r: Floats  # (S, 2 J) residuals
    common: tuple[CommonColumns, ...]  # change of r by the common unknowns, each target in one
    n_common: int  # 3 C + g
    X_q: Floats  # (S, 2 J, n) change of r by the strip's own unknowns, units of their prior sigma
    whitener: Floats  # (S, J, 2, 2) takes residuals along the two tangent axes, rad, to rows of r
    across: Floats  # (S, J, 2, 3) takes changes of looks, frame c, to rows of r; zero where not covered
    ties: Floats  # (S, h, A + 1) rows of the other heads by unknowns of heads, the last common ones; residual

    def along(self, x: Floats) -> Floats:
        """(S, 2 J, n) change of r by a change x (3 C + g, n) of the common unknowns."""
        out = np.empty((*self.r.shape, x.shape[1]))
        for part in self.common:
            out[:, part.rows] = part.X @ x[part.columns]
        return out

    def onto(self, rows: Floats) -> Floats:
        """(S, 3 C + g, n) sums of rows (S, 2 J, n) over their derivatives by the common unknowns."""
        out = np.zeros((len(rows), self.n_common, rows.shape[2]))
        for part in self.common:
            out[:, part.columns] += np.swapaxes(part.X, 1, 2) @ rows[:, part.rows]
        return out


# What a prepared strip has from its attitude as it is there.
OF_ATTITUDE = ("inside", "weights", "R_si", "ties", "of_heads", "n_phi", "lasting")


def prepare_strips(
    strips: Sequence[StripSightings], settings: CalibrationSettings, cameras: Sequence[str] = ("",)
) -> list[PreparedStrip]:
    """The strips of `cameras`, with the motion between exposures that all of them show."""
    fitted = with_attitudes(strips, settings.attitudes)
    interpolated, smoothed = (
        [one for one in fitted if is_smoothed(one) is wanted] for wanted in (False, True)
    )
    motion, rates = motion_of(interpolated, settings), smoothed_motion(smoothed, settings)

    def motion_in(strip: StripSightings) -> SlowMotion | Floats:
        if is_smoothed(strip):
            return rates
        return motion if has_few_exposures(strip) else AT_REST

    return [prepare_strip(strip, settings, motion_in(strip), cameras) for strip in fitted]


def prepare_strip(
    strip: StripSightings,
    settings: CalibrationSettings,
    motion: SlowMotion | Floats | None = None,
    cameras: Sequence[str] = ("",),
) -> PreparedStrip:
    """The strip with every target in frame s at its own instant, and the unknowns common to its targets.

    `motion`, or (3,), is what the satellite does between the exposures, as `attitude_of` takes it; None:
    nothing, or what the rows of the strip itself show. The rows of each of `cameras` have a clock. Attitudes
    of exposures are fitted where the strip has none.
    """
    strip = with_attitudes([strip], settings.attitudes)[0]
    if motion is None:
        motion = smoothed_motion([strip], settings) if is_smoothed(strip) else AT_REST
    attitude, ground = attitude_of(strip, settings, motion), strip.ground
    v_s = np.einsum("jab,jb->ja", attitude.R_si, ground.u_i)
    across = np.eye(3) - ground.u_i[:, :, None] * ground.u_i[:, None, :]
    move_i = attitude.R_si @ (-across / ground.range_m[:, None, None])
    by_rotation = -cross_matrices(v_s)
    late = move_i @ ground.v_rel_i[:, :, None] + np.cross(attitude.rate_s, v_s)[:, :, None]
    camera = np.array(
        [cameras.index(name) if cameras[1:] else 0 for name in strip.camera_of_target.tolist()], int
    )
    own = coordinate_covariance(ground.cov_target_i, ground.t_s, ground.u_i, ground.is_star)
    references = ground.referenced()
    models = [settings.of(name) for name in cameras]
    curve, place, distortion_rad, modes_rad = residual_distortion(ground, camera, models)
    return PreparedStrip(
        strip_id=strip.strip_id,
        strip=strip.strip_of_target,
        ground=ground,
        attitudes=strip.fitted,
        camera=camera,
        curve=curve,
        place=place,
        distortion_rad=distortion_rad,
        modes_rad=modes_rad,
        v_s=v_s,
        number=np.zeros(len(v_s), dtype=np.int64),
        attitude_s=by_rotation @ attitude.root_s,
        coordinates_s=np.where(
            ground.is_star[:, None, None],
            MICRORADIAN * attitude.R_si @ across,
            -move_i @ earth_axes(ground.t_s),
        ),
        cov_coordinates=own,
        reference_s=-move_i @ _ground_axes(references, strip.R_oi_targets),
        earth_s=attitude.R_si @ ground.earth_i,
        earth=strip.earth,
        late_s=late[:, :, 0],
        move_i=move_i,
        move_s=move_i @ np.swapaxes(strip.R_oi_targets.as_matrix(), 1, 2),
        by_heads_s=by_rotation @ attitude.by_heads,
        carrier=strip.carrier,
        **{name: getattr(attitude, name) for name in OF_ATTITUDE},
    )


def group_strips(
    strips: list[PreparedStrip], shared: SharedUnknowns, settings: CalibrationSettings
) -> list[StripGroup]:
    """Groups of strips of equal shape, in order of first occurrence, without strips of no covered target."""
    shapes: dict[tuple[int, ...], list[int]] = {}
    columns: dict[int, tuple[Floats, Floats]] = {}
    for place, strip in enumerate(strips):
        if not strip.inside.any():
            continue
        h = sum(len(tie.r) for tie in strip.ties)
        again, white = _coordinates(strip, shared)
        columns[place] = np.concatenate([strip.attitude_s, of_pass(strip, settings), again], axis=2), white
        size = strip.n_phi, columns[place][0].shape[2]
        shapes.setdefault((*size, *strip.camera.tolist(), h), []).append(place)
    return [_group(strips, places, columns, shared) for places in shapes.values()]


def linearise(group: StripGroup, R_cs: Rotation, settings: CalibrationSettings) -> LinearStrips:
    """Whitened residuals and their derivatives about `R_cs`; rows of zeros for targets not covered."""
    C, S = matrix_of_each(R_cs, group.which), len(group.place)
    w = turned(C, group.v_s)  # (S, J, 3)
    tangent = tangent_axes(w)  # (S, J, 2, 3)
    difference = group.u_c - w
    tangent_s = tangent @ C
    white = tangent @ group.cov_c @ np.swapaxes(tangent, 2, 3)
    white = white + tangent_s @ group.white_s @ np.swapaxes(tangent_s, 2, 3)
    white = white + (settings.sigma_vibration_rad**2 + group.missed)[:, :, None, None] * np.eye(2)
    whitener = _inverse_cholesky_2x2(white)
    rows = whitener * group.inside[:, :, None, None]

    def two_rows(part: Floats) -> Floats:
        return np.asarray(part.reshape(S, 2 * part.shape[1], part.shape[-1]))

    r = two_rows(rows @ (tangent @ difference[..., None]))
    X_q = two_rows(rows @ (tangent_s @ group.shared_s))
    told = X_q[:, :, : group.by_ties.shape[1]] @ group.by_ties
    n_theta, common = 3 * (1 if R_cs.single else len(R_cs)), []
    n_common = n_theta + group.n_common
    for part in group.parts:
        at, near, near_s = part.targets, tangent[:, part.targets], tangent_s[:, part.targets]
        changes = [near @ cross_matrices(w[:, at]), near @ part.in_c + near_s @ part.in_s]
        block = CommonColumns(
            rows=(2 * at[:, None] + np.arange(2)).ravel(),
            columns=np.concatenate([3 * part.camera + np.arange(3), n_theta + part.columns]),
            X=two_rows(rows[:, at] @ np.concatenate(changes, axis=3)),
        )
        if n_heads := group.by_ties.shape[2] - 1:  # those of heads are the last common unknowns
            block.X[:, :, -n_heads:] -= told[:, block.rows, :-1]
        common.append(block)
    return LinearStrips(
        r=r[:, :, 0] - told[:, :, -1],
        common=tuple(common),
        n_common=n_common,
        X_q=X_q,
        whitener=whitener,
        across=rows @ tangent,
        ties=group.ties,
    )


def matrix_of_each(R_cs: Rotation, camera: Ints) -> Floats:
    """Matrix (..., 3, 3) of the camera of each target (...); of a single camera (3, 3)."""
    return R_cs.as_matrix() if R_cs.single else R_cs.as_matrix()[camera]


def turned(C: Floats, v_s: Floats) -> Floats:
    """Vectors (..., 3) of frame s in the frame of each target's camera, by `matrix_of_each`."""
    return v_s @ C.T if C.ndim == 2 else (C @ v_s[..., None])[..., 0]


def _group(
    strips: list[PreparedStrip],
    places: list[int],
    columns: dict[int, tuple[Floats, Floats]],
    shared: SharedUnknowns,
) -> StripGroup:
    """The strips of some places; `columns` by their own unknowns, and the noise that is white."""
    members, S = [strips[n] for n in places], len(places)
    shared_s, white = (np.stack(part) for part in zip(*(columns[n] for n in places)))
    v_s = np.stack([strip.v_s for strip in members])
    tangent = tangent_axes(v_s)  # across the known directions, along which nothing changes
    ties = np.stack([_rows_of_ties(strip, shared) for strip in members])
    own = (tangent @ shared_s).reshape(S, -1, shared_s.shape[3])
    own, by_ties, ties = condensed(own, ties, members[0].n_phi)
    which = np.stack([strip.camera for strip in members])
    in_c, in_s = (np.stack(part) for part in zip(*map(shared.columns, members)))
    return StripGroup(
        place=np.array(places),
        inside=np.stack([strip.inside for strip in members]),
        which=which,
        u_c=np.stack([strip.ground.u_c for strip in members]),
        cov_c=np.stack([strip.ground.cov_c for strip in members]),
        v_s=v_s,
        shared_s=np.swapaxes(tangent, 2, 3) @ own.reshape(*tangent.shape[:3], own.shape[2]),
        white_s=white,
        missed=np.stack([shared.missed(strip) for strip in members]),
        ties=ties,
        by_ties=by_ties,
        n_common=in_c.shape[3],
        parts=tuple(_parts(which[0], in_c, in_s, len(shared.of_heads))),
    )


def _parts(which: Ints, in_c: Floats, in_s: Floats, n_heads: int) -> Iterator[GroupPart]:
    """The targets of each camera with the columns (S, J, 3, n) that are not zero for all of them; unknowns
    of heads, the last, are always among them.
    """
    for camera in np.unique(which).tolist():
        at, n = np.flatnonzero(which == camera), in_c.shape[3]
        moved = (in_c[:, at] != 0.0).any(axis=(0, 1, 2)) | (in_s[:, at] != 0.0).any(axis=(0, 1, 2))
        columns = np.flatnonzero(moved | (np.arange(n) >= n - n_heads))
        yield GroupPart(camera, at, columns, in_c[:, at][..., columns], in_s[:, at][..., columns])


def _rows_of_ties(strip: PreparedStrip, shared: SharedUnknowns) -> Floats:
    """Rows (h, n_phi + unknowns of heads + 1) of the other heads in a strip."""
    none = np.zeros((0, strip.n_phi + len(shared.of_heads) + 1))
    told = [(tie, of_heads(tie.unknowns, tie.by_alpha, shared.of_heads)) for tie in strip.ties]
    return np.concatenate([none, *(np.column_stack([tie.by_phi, by_alpha, tie.r]) for tie, by_alpha in told)])


def _ground_axes(references: GroundReferences, R_oi: Rotation) -> Floats:
    """East, north and up (J, 3, 3) of targets, GCRS: those of their references, else those of the orbit."""
    up = -R_oi.inv().apply([0.0, 0.0, 1.0])
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-9)
    level = np.stack([east, np.cross(up, east), up], axis=2)
    return np.where((references.name != "")[:, None, None], references.axes_i, level)


def _coordinates(strip: PreparedStrip, shared: SharedUnknowns) -> tuple[Floats, Floats]:
    """Targets' own coordinates: columns (J, 3, 3 m) of those seen again in this strip alone, whitened, and
    the white noise (J, 3, 3) of the rest, rad².
    """
    move, covariance = strip.coordinates_s, strip.cov_coordinates
    white = move @ covariance @ np.swapaxes(move, 1, 2)
    target_id = strip.ground.target_id
    ids, count = np.unique(target_id, return_counts=True)
    again = [name for name in ids[count > 1].tolist() if name not in shared.targets]
    own = np.zeros((len(move), 3, 3 * len(again)))
    white[np.isin(target_id, [*shared.targets])] = 0.0
    for n, name in enumerate(again):
        rows = target_id == name
        values, vectors = np.linalg.eigh(covariance[rows][0])
        own[rows, :, 3 * n : 3 * n + 3] = move[rows] @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        white[rows] = 0.0
    for field in shared.references:
        left = strip.reference_s * field.sigma_m
        white = white + field.rest(strip)[:, None, None] * (left @ np.swapaxes(left, 1, 2))
    return own, white


def tangent_axes(w: Floats) -> Floats:
    """Two unit vectors (..., 2, 3) across each direction: the camera's x axis as nearly as may be, and w
    x that.
    """
    x = np.zeros_like(w)
    x[..., 0] = 1.0
    x = x - w[..., :1] * w
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(w, x)], axis=-2)


def _inverse_cholesky_2x2(matrix: Floats) -> Floats:
    """L⁻¹ of matrix = L Lᵀ, (..., 2, 2)."""
    a = np.sqrt(matrix[..., 0, 0])
    b = matrix[..., 1, 0] / a
    c = np.sqrt(matrix[..., 1, 1] - b * b)
    out = np.zeros_like(matrix)
    out[..., 0, 0], out[..., 1, 1], out[..., 1, 0] = 1.0 / a, 1.0 / c, -b / (a * c)
    return out
