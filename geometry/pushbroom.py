"""The rigorous model of a pushbroom strip: pixel of a CCD <-> direction in space <-> point on the ground.

A row of the strip has one instant: orbit, Earth rotation and attitude are those of the middle of its
exposure. A line counts in the raw image of one CCD, which may begin at a later row than the strip; `RowClock`
alone knows at which. Directions are apparent ones from the moving satellite (`geometry.groundlight`). Frames:
i = GCRS, e = ITRS, s = star camera, c = remote-sensing camera; image points are (sample, line) in a CCD's raw
image. All functions take arrays of points; for many points orbit and attitude are interpolated from a table
over the rows (`geometry.row_table`).

From ground to pixel (`pixels_from_ground`) the row is found by the secant method on the distance of the
point across the detector: a few points start from a scan of all rows, the others from a plane fitted to
those. From pixel to ground (`ground_points`) the apparent direction becomes a straight ray, the tangent of
the light path at the expected height, which is intersected with the surface; rays whose intersection is too
far from that height are computed again at the height found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import Attitude, AttitudeTrack
from boresight.geometry.constants import WGS84
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.groundlight import (
    LightEffects,
    OrbitLike,
    apparent_directions_e,
    emission_points_e,
    emission_rays_e,
)
from boresight.geometry.line_camera import LineSensor
from boresight.geometry.orbit import orbital_frame
from boresight.geometry.row_table import RowTable, tabulated
from boresight.geometry.terrain import ConstantHeight, Surface, intersect
from boresight.geometry.terrain_rays import bilinear
from boresight.records.record import Bools, Floats, Ints, check_numbers, record, scalar

__all__ = ["Pushbroom", "RowClock", "outline_deg"]


# Largest errors of positions (m), velocities (m/s) and elements of rotation matrices that are interpolated in
# the table over the rows: 1e-7 of a pixel of 1 m; 1e-13 rad from 530 km are 5e-8 m (set by hand).
_POSITION_M = 1e-7
_VELOCITY_M_S = 1e-6
_ROTATION = 1e-13
# Of the fifteen columns of the table: position, velocity, rotation matrix.
_TOLERANCE = np.repeat([_POSITION_M, _VELOCITY_M_S, _ROTATION], [3, 3, 9])
_CHUNK = 32_768  # points at a time: their arrays stay in the cache
_MANY = 1_500  # number of points from which a table over the rows saves time
_MARGIN_ROWS = 256.0  # error of a predicted line that the table still covers
_FEW = 16  # points found by a scan, from which the lines of the others are predicted
_SCAN = 65  # lines of the scan
_MIN_STEP_PX = 1e-2  # a slope from a shorter step would be noise
_CONVERGED_PX = 1e-7  # step, px, at which that line has converged: far below any measurement
_CURVATURE_M = 2e-5  # curvature of a light path that its tangent may neglect
_CURVATURE_LIGHT_TIME = 3e-13  # 1/m: deviation of the path over a height difference d is this times d^2
_CURVATURE_AIR = 3e-8  # 1/m, times tan z sec^2 z: refractivity of 2.8e-4 with a scale height of 8 km
_LATTICE = (65, 33)  # lines and samples at which the height of the ground is computed first
_OUTLINE = 9  # points of each long side of the outline of a strip
_LATTICE_M = 20.0  # for less relief the mean height is used


@record
class RowClock:
    """Time labels of the rows of a strip, and the lines that the CCDs' own images have for them.

    Row n has the label `t_first_row_s + n row_period_s`; line m of CCD k is row m + `first_row[k]`, which
    need not be whole. Raises `ValueError` unless the period is positive.
    """

    t_first_row_s: float = scalar("time label of row 0, TAI seconds since the epoch")
    row_period_s: float = scalar("from row to row")
    first_row: Mapping[int, float] = scalar(
        "row of the strip at which line 0 of a CCD's image lies; 0 for a CCD that is not named",
        default_factory=dict,
    )

    def __post_init__(self) -> None:
        check_numbers(self, any_value=("t_first_row_s",))

    def instant(self, row: ArrayLike) -> Floats:
        """Time labels of (fractional) rows, elementwise, TAI seconds since the epoch."""
        return self.t_first_row_s + np.asarray(row, dtype=float) * self.row_period_s

    def row(self, t_s: ArrayLike) -> Floats:
        """Fractional rows of time labels, elementwise: inverse of `instant`."""
        return (np.asarray(t_s, dtype=float) - self.t_first_row_s) / self.row_period_s

    def rows_of_lines(self, ccd: int | Ints, line: ArrayLike) -> Floats:
        """Rows of the strip (N,) at which lines (N,) of a CCD, or of CCDs (N,), lie."""
        return np.asarray(line, dtype=float) + self._first(ccd)

    def lines_of_rows(self, ccd: int | Ints, row: ArrayLike) -> Floats:
        """Lines (N,) in the image of a CCD, or of CCDs (N,), of rows (N,): inverse of `rows_of_lines`."""
        return np.asarray(row, dtype=float) - self._first(ccd)

    def _first(self, ccd: int | Ints) -> Floats:
        if not self.first_row:
            return np.zeros(())
        ccds, which = np.unique(ccd, return_inverse=True)
        first = np.array([self.first_row.get(k, 0.0) for k in ccds.tolist()])
        return first[which].reshape(np.shape(ccd))


@record
class _States:
    """Satellite and camera at N instants, in axes e of each instant; stored by component for speed."""

    packed: Floats  # (15, N): position, m; velocity in the inertial frame, m/s; R_ec row by row

    @property
    def p_e(self) -> Floats:
        """(N, 3), m."""
        return self.packed[0:3].T

    @property
    def v_e(self) -> Floats:
        """(N, 3), m/s."""
        return self.packed[3:6].T

    def to_e(self, u_c: Floats) -> Floats:
        """Vectors (N, 3) of frame c in axes e."""
        x, y, z = u_c.T
        R = self.packed[6:]
        return np.array([R[k] * x + R[k + 1] * y + R[k + 2] * z for k in (0, 3, 6)]).T

    def to_c(self, u_e: Floats) -> Floats:
        """Vectors (N, 3) of axes e in frame c."""
        x, y, z = u_e.T
        R = self.packed[6:]
        return np.array([R[k] * x + R[k + 3] * y + R[k + 6] * z for k in (0, 1, 2)]).T

    def take(self, index: Ints) -> _States:
        return _States(self.packed[:, index])


@record
class _HeightsOverImage:
    """Approximate heights of the ground at pixels, bilinear between evenly spaced ones."""

    samples: Floats  # (C,)
    rows: Floats  # (R,)
    heights_m: NDArray[np.float32]  # (R, C); one height is that of all pixels
    otherwise_m: float  # for a pixel that is NaN

    def at(self, sample: Floats, row: Floats) -> Floats:
        """Heights (N,), m, at pixels (N,)."""
        if self.heights_m.size == 1:
            return np.full(len(row), self.otherwise_m)
        down, right = (
            (a - axis[0]) * ((len(axis) - 1) / (axis[-1] - axis[0]))
            for a, axis in ((row, self.rows), (sample, self.samples))
        )
        return np.nan_to_num(bilinear(self.heights_m, right, down), nan=self.otherwise_m)


@record(kw_only=True)
class Pushbroom:
    """One strip of a pushbroom camera on a satellite."""

    camera: LineSensor = scalar("directions of the samples in frame c")
    rows: RowClock = scalar("time labels of the rows, and the CCDs' lines")
    orbit: OrbitLike = scalar("positions and velocities of the satellite")
    earth: EarthRotation = scalar("rotation between ITRS and GCRS")
    attitude: Attitude = scalar("GCRS to star camera against time")
    R_cs: Rotation = scalar("installation matrix, star camera to remote-sensing camera")
    effects: LightEffects = scalar("effects on light that are modelled")
    table: RowTable | None = scalar("states tabulated over the rows, made by `tabulated`", default=None)

    def with_installation(self, R_cs: Rotation) -> Pushbroom:
        """The strip with another installation matrix; a table over its rows is transformed, not
        recomputed.
        """
        M = (self.R_cs * R_cs.inv()).as_matrix()  # R_ec R_cs = R_ec' R_cs'

        def transformed(packed: Floats) -> Floats:
            R_ec = np.einsum("ijn,jk->ikn", packed[6:].reshape(3, 3, -1), M)
            return np.concatenate([packed[:6], R_ec.reshape(9, -1)])

        return replace(self, R_cs=R_cs, table=self.table and self.table.mapped(transformed))

    def tabulated(self, first_row: float, last_row: float) -> Pushbroom:
        """The strip with its states tabulated between two rows; saves time before many small calls."""
        breaks: ArrayLike = ()
        if isinstance(self.attitude, AttitudeTrack):
            breaks = self.rows.row(self.attitude.breaks_s - self._delay_s)
        table = tabulated(self._exact_states, first_row, last_row, _TOLERANCE, breaks)
        return replace(self, table=table)

    def instants(self, row: ArrayLike) -> Floats:
        """Middle of the exposure of rows of the strip (N,), TAI seconds since the epoch."""
        return self.rows.instant(row) + self._delay_s

    def instants_of_lines(self, ccd: int | Ints, line: ArrayLike) -> Floats:
        """Middle of the exposure of lines (N,) of a CCD, or of CCDs (N,), TAI seconds since the epoch."""
        return self.instants(self.rows.rows_of_lines(ccd, line))

    @property
    def _delay_s(self) -> float:
        return self.camera.delay_to_middle_s(self.rows.row_period_s)

    def look_i(self, ccd: int, sample: ArrayLike, line: ArrayLike) -> tuple[Floats, Floats]:
        """Apparent directions u_i (N, 3), GCRS, of pixels (N,) of one CCD, and their instants (N,)."""
        sample, line = _pixels(sample, line)
        t_s = self.instants_of_lines(ccd, line)
        u_s = self.R_cs.inv().apply(self.camera.directions_from_pixels(ccd, sample))
        return self.attitude.R_si(t_s).inv().apply(u_s), t_s

    def directions_c(self, p_e: Floats, row: ArrayLike) -> Floats:
        """Apparent directions (N, 3), frame c, of ground points (N, 3), frame e, m, at rows (N,)."""
        return self._apparent_c(p_e, self._states(np.asarray(row, dtype=float)))[0]

    def ground_points(self, ccd: int, sample: ArrayLike, line: ArrayLike, surface: Surface) -> Floats:
        """Ground points (N, 3), frame e, m, of a `surface` seen by pixels of one CCD, image points (N,) in
        its raw image, broadcast together; NaN where the line of sight does not intersect the surface.

        Raises `ValueError` if orbit, attitude or Earth rotation do not cover a line.
        """
        sample, line = _pixels(sample, line)
        row = self.rows.rows_of_lines(ccd, line)
        model = self._for_many(row)
        expected = model._expected_heights(ccd, sample, row, surface)
        p_e = np.empty((len(row), 3))
        for part in _chunks(len(row)):
            height = expected.at(sample[part], row[part])
            p_e[part] = model._intersections(ccd, sample[part], row[part], surface, height)
        return p_e

    def pixels_from_ground(self, ccd: int, p_e: ArrayLike) -> tuple[Floats, Floats]:
        """Samples (N,) and lines (N,) at which ground points (N, 3), frame e, m, appear on a CCD, to 1e-6 px.

        They may lie beyond the detector's ends (compare with `camera.n_px`). NaN for a point that is not seen
        while orbit and attitude are known, or is beyond the horizon. Raises `ValueError` if `p_e` is not (N,
        3), or orbit, attitude and Earth rotation have no interval in common.
        """
        p = np.asarray(p_e, dtype=float)
        if p.ndim != 2 or p.shape[1] != 3:
            raise ValueError(f"p_e must have shape (N, 3), got {p.shape}")
        sample, row = np.full(len(p), np.nan), np.full(len(p), np.nan)
        good = np.flatnonzero(np.isfinite(p).all(axis=1))
        if len(good) == 0:
            return sample, row
        few = good[:: max(1, len(good) // _FEW)]
        sample[few], row[few] = self._pixels_by_scan(ccd, p[few])
        rest = np.setdiff1d(good, few)
        if len(rest):
            start = np.clip(_predicted_rows(p[few], row[few], p[rest]), *self.known_rows())
            model = self._for_many(np.concatenate([start, row[few]]), margin=_MARGIN_ROWS)
            for part in _chunks(len(rest)):
                into = rest[part]
                sample[into], row[into] = model._pixels_by_secant(ccd, p[into], start[part])
            missing = rest[np.isnan(row[rest])]
            sample[missing], row[missing] = self._pixels_by_scan(ccd, p[missing])
        return sample, self.rows.lines_of_rows(ccd, row)

    def directions_and_jacobian(
        self, ccd: Ints, xy_px: Floats, *, height_m: float = 0.0
    ) -> tuple[Floats, Floats]:
        """Look directions u_c (N, 3) of pixels (sample, line) (N, 2) of CCDs (N,), and their derivatives
        d u_c / d(sample, line) (N, 3, 2), rad/px.

        Along the line it is the motion, in frame c, of the ground that the pixel looks at (orbit, Earth
        rotation and attitude together), for ground at `height_m` above the ellipsoid. A covariance C (2, 2)
        px² of an image point gives that of its direction: `J C J^T` (3, 3) rad².
        """
        u_c, jacobian = np.empty((len(xy_px), 3)), np.empty((len(xy_px), 3, 2))
        row = self.rows.rows_of_lines(ccd, xy_px[:, 1])
        for n in np.unique(ccd).tolist():
            here = ccd == n
            u_c[here] = self.camera.directions_from_pixels(n, xy_px[here, 0])
            jacobian[here, :, 0] = self.camera.sample_jacobian(n, xy_px[here, 0])
        states = self._states(row)
        seen = states.to_e(u_c), states.p_e, states.v_e
        ground = emission_points_e(*seen, self.earth.omega_e, self.effects, height_m)
        both = self.directions_c(np.tile(ground, (2, 1)), np.concatenate([row - 0.5, row + 0.5]))
        jacobian[:, :, 1] = both[: len(row)] - both[len(row) :]
        return u_c, jacobian

    def _pixels_by_scan(self, ccd: int, p_e: Floats) -> tuple[Floats, Floats]:
        """Pixels (N,) of ground points (N, 3): nearest row of a coarse scan, refined by the secant
        method.
        """
        at: Floats = np.linspace(*self.known_rows(), _SCAN, dtype=np.float64)
        states = self._states(at)
        start = np.full(len(p_e), np.nan)
        for part in _chunks(len(p_e), _CHUNK // _SCAN):
            points = np.repeat(p_e[part], _SCAN, axis=0)
            there = states.take(np.tile(np.arange(_SCAN), len(points) // _SCAN))
            u_c, seen = self._apparent_c(points, there)
            _, across = self.camera.samples_from_directions(ccd, u_c)
            across = np.where(seen & np.isfinite(across), np.abs(across), np.inf).reshape(-1, _SCAN)
            start[part] = np.where(np.isfinite(across.min(axis=1)), at[across.argmin(axis=1)], np.nan)
        sample, row = np.full(len(p_e), np.nan), np.full(len(p_e), np.nan)
        rows = np.flatnonzero(np.isfinite(start))
        if len(rows):
            sample[rows], row[rows] = self._pixels_by_secant(ccd, p_e[rows], start[rows])
        return sample, row

    def _pixels_by_secant(self, ccd: int, p_e: Floats, start: Floats) -> tuple[Floats, Floats]:
        """Pixels (N,) by the secant method from rows `start` (N,); NaN where it does not converge."""
        first, last = self.known_rows()
        old = np.clip(start, first, last)
        _, across_old, _ = self._pixels_at(ccd, p_e, old)
        row = np.clip(old + np.where(old < 0.5 * (first + last), 1.0, -1.0), first, last)
        slope = np.full(len(p_e), np.nan)  # d(across) / d(row), about one pixel per row
        for _ in range(12):
            sample, across, seen = self._pixels_at(ccd, p_e, row)
            moved = np.abs(row - old) > _MIN_STEP_PX
            slope[moved] = (across[moved] - across_old[moved]) / (row[moved] - old[moved])
            old, across_old = row, across
            with np.errstate(divide="ignore", invalid="ignore"):
                step = -across / slope
            row = np.clip(row + step, first, last)
            if np.nanmax(np.abs(row - old), initial=0.0) < _CONVERGED_PX:
                break
        found = seen & (np.abs(step) < _CONVERGED_PX)  # at an end of the span `row` stops without solution
        return np.where(found, sample, np.nan), np.where(found, row, np.nan)

    def _pixels_at(self, ccd: int, p_e: Floats, row: Floats) -> tuple[Floats, Floats, Bools]:
        """At given rows: nearest sample (N,) of each point, its distance across, px, whether it is seen."""
        known = np.isfinite(row)
        if not known.all():
            row = np.where(known, row, self.known_rows()[0] if self.table is None else self.table.edges[0])
        states = self._states(row)
        u_c, above_horizon = self._apparent_c(p_e, states)
        sample, across = self.camera.samples_from_directions(ccd, u_c)
        return sample, np.where(known, across, np.nan), known & above_horizon & np.isfinite(across)

    def _apparent_c(self, p_e: Floats, states: _States) -> tuple[Floats, Bools]:
        """Apparent directions (N, 3), frame c, of ground points, and whether the satellite is above
        their horizon.
        """
        u_e, _ = apparent_directions_e(p_e, states.p_e, states.v_e, self.earth.omega_e, self.effects)
        above = np.einsum("ni,ni->n", states.p_e - p_e, p_e) > 0.0
        return states.to_c(u_e), above

    def known_rows(self) -> tuple[float, float]:
        """First and last row at which orbit, attitude and Earth rotation are known; `ValueError` if none."""
        spans = self.attitude.span_s, self.orbit.span_s, (self.earth.t_start_s, self.earth.t_stop_s)
        delay = self.camera.delay_to_middle_s(self.rows.row_period_s)
        first, last = max(span[0] for span in spans) - delay, min(span[1] for span in spans) - delay
        if not last > first:
            raise ValueError("orbit, attitude and Earth rotation have no interval in common")
        ends = self.rows.row(np.array([first, last]))
        slack = 1e-6 / self.rows.row_period_s  # stay inside despite rounding
        return float(ends[0]) + slack, float(ends[1]) - slack

    def _intersections(
        self, ccd: int, sample: Floats, row: Floats, surface: Surface, height_m: Floats
    ) -> Floats:
        """Ground points (N, 3) of pixels, from rays exact at expected heights (N,); see the module."""
        states = self._states(row)
        u_e = states.to_e(self.camera.directions_from_pixels(ccd, sample))
        if isinstance(surface, ConstantHeight):
            return emission_points_e(
                u_e, states.p_e, states.v_e, self.earth.omega_e, self.effects, surface.height
            )
        p_e = self._ray_intersections(u_e, states, surface, height_m)
        far = np.flatnonzero(self._path_curvature_m(p_e, u_e, height_m) > _CURVATURE_M)
        if len(far):
            height = geodetic_from_ecef(p_e[far])[2]
            p_e[far] = self._ray_intersections(u_e[far], states.take(far), surface, height)
        return p_e

    def _ray_intersections(self, u_e: Floats, states: _States, surface: Surface, height_m: Floats) -> Floats:
        """Surface points of the rays that are exact at `height_m`."""
        rays = emission_rays_e(u_e, states.p_e, states.v_e, self.earth.omega_e, self.effects, height_m)
        return intersect(*rays, surface)

    def _path_curvature_m(self, p_e: Floats, u_e: Floats, height_m: Floats) -> Floats:
        """Upper bound (N,), m, of the distance at p_e between the light path and its tangent at
        `height_m`.
        """
        if not (self.effects.light_time or self.effects.refraction):
            return np.zeros(len(p_e))
        above = _above_shell(p_e, height_m)
        radius2 = np.einsum("in,in->n", p_e.T, p_e.T)
        cos2 = np.einsum("in,in->n", p_e.T, u_e.T) ** 2 / radius2
        with np.errstate(divide="ignore", invalid="ignore"):
            tan = np.sqrt(np.maximum(1.0 / cos2 - 1.0, 0.0))
        return above**2 * (_CURVATURE_LIGHT_TIME + _CURVATURE_AIR * tan * (1.0 + tan**2))

    def _expected_heights(self, ccd: int, sample: Floats, row: Floats, surface: Surface) -> _HeightsOverImage:
        """Approximate ground heights of pixels (N,): for many pixels from a lattice."""
        low, high = surface.height_range_m()
        middle = 0.5 * (low + high)
        one = _HeightsOverImage(np.zeros(1), np.zeros(1), np.full((1, 1), middle, np.float32), middle)
        if len(row) < _MANY or high - low < _LATTICE_M:
            return one
        rows, samples = (
            np.linspace(np.nanmin(a), np.nanmax(a), n, dtype=np.float64)
            for a, n in ((row, _LATTICE[0]), (sample, _LATTICE[1]))
        )
        if np.ptp(rows) < 1.0 or np.ptp(samples) < 1.0:
            return one
        at_row, at_sample = (grid.ravel() for grid in np.meshgrid(rows, samples, indexing="ij"))
        p_e = self._intersections(ccd, at_sample, at_row, surface, np.full(len(at_row), middle))
        heights = np.nan_to_num(geodetic_from_ecef(p_e)[2], nan=middle).reshape(_LATTICE)
        return _HeightsOverImage(samples, rows, heights.astype(np.float32), middle)

    def _states(self, row: Floats) -> _States:
        if self.table is None:
            return _States(self._exact_states(row))
        covered = self.table.covers(row)
        if covered.all():
            return _States(self.table.at(row))
        packed = np.empty((len(_TOLERANCE), len(row)))
        packed[:, covered] = self.table.at(row[covered])
        packed[:, ~covered] = self._exact_states(row[~covered])
        return _States(packed)

    def _exact_states(self, row: Floats) -> Floats:
        """Floats (15, N) of `_States` at rows (N,), computed without the table."""
        t_s = self.instants(row)
        R_ei = np.swapaxes(self.earth.matrices_ie(t_s), 1, 2)
        p_i, v_i = self.orbit.states_i(t_s)
        if isinstance(self.attitude, AttitudeTrack) and self.attitude.nominal is self.orbit:
            R_si = self.attitude.R_so(t_s) * orbital_frame(p_i, v_i)  # the orbit is evaluated once
        else:
            R_si = self.attitude.R_si(t_s)
        R_ic = (self.R_cs * R_si).inv().as_matrix()
        packed = np.empty((len(t_s), len(_TOLERANCE)))
        packed[:, 0:3] = np.einsum("nij,nj->ni", R_ei, p_i)
        packed[:, 3:6] = np.einsum("nij,nj->ni", R_ei, v_i)
        packed[:, 6:] = (R_ei @ R_ic).reshape(-1, 9)
        return np.ascontiguousarray(packed.T)

    def _for_many(self, row: Floats, margin: float = 0.0) -> Pushbroom:
        """This strip, tabulated over rows (N,) if they are many."""
        row = row[np.isfinite(row)]
        if len(row) < _MANY or (self.table is not None and self.table.covers(row).all()):
            return self
        first, last = self.known_rows()
        first, last = max(float(row.min()) - margin, first), min(float(row.max()) + margin, last)
        return self.tabulated(first, last) if last - first > 1.0 else self


def outline_deg(model: Pushbroom, lines: Mapping[int, int], surface: Surface) -> Floats:
    """Outline (N, 2) of what the CCDs of a strip see of `surface`: longitude and latitude in degrees, in
    order around it; points without ground are left out. `lines` has the number of lines of each CCD.
    """
    ends = {
        (ccd, sample): float(model.camera.directions_from_pixels(ccd, np.array([sample]))[0, 1])
        for ccd in sorted(lines)
        for sample in (0.0, model.camera.n_px(ccd) - 1.0)
    }
    sides = []
    for (ccd, sample), order in ((min(ends, key=ends.__getitem__), 1), (max(ends, key=ends.__getitem__), -1)):
        line = np.linspace(0.0, lines[ccd] - 1.0, _OUTLINE)
        lat, lon, _ = geodetic_from_ecef(model.ground_points(ccd, sample, line, surface))
        lon = np.degrees(lon)
        for middle in lon[np.isfinite(lon)][:1]:  # no step at the date line
            lon = middle + (lon - middle + 180.0) % 360.0 - 180.0
        sides.append(np.column_stack([lon, np.degrees(lat)])[::order])
    outline = np.concatenate(sides)
    return outline[np.isfinite(outline).all(axis=1)]


def _above_shell(p_e: Floats, height_m: Floats) -> Floats:
    """Height (N,), m, of points above the ellipsoid with semi-axes a + h, b + h, to one per cent."""
    a, b = WGS84.semi_major_m + height_m, WGS84.semi_minor_m + height_m
    x, y, z = p_e.T
    return np.asarray(0.5 * a * ((x * x + y * y) / (a * a) + (z / b) ** 2 - 1.0))


def _pixels(sample: ArrayLike, line: ArrayLike) -> tuple[Floats, Floats]:
    a, b = np.broadcast_arrays(np.asarray(sample, dtype=float), np.asarray(line, dtype=float))
    if a.ndim != 1:
        raise ValueError(f"samples and lines must have shape (N,), got {a.shape}")
    return a, b


def _predicted_rows(p_known: Floats, row_known: Floats, p_e: Floats) -> Floats:
    """Rows (N,) of points (N, 3) by an affine fit to the rows of known points; NaN if none is known."""
    known = np.isfinite(row_known)
    if not known.any():
        return np.full(len(p_e), np.nan)
    middle = p_known[known].mean(axis=0)
    scale = max(float(np.abs(p_known[known] - middle).max()), 1.0)
    A = np.column_stack([(p_known[known] - middle) / scale, np.ones(known.sum())])
    plane, *_ = np.linalg.lstsq(A, row_known[known], rcond=1e-9)
    return ((p_e - middle) / scale) @ plane[:3] + plane[3]


def _chunks(n: int, size: int = _CHUNK) -> list[slice]:
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]
