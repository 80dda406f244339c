"""Pushbroom cameras: samples of a CCD <-> directions in the remote-sensing camera's frame c (paper, eq. 1).

Frame c has z along the optical axis towards the ground, x along the direction of flight, y along the
detectors. An image point `(x_f, y_f)` of the focal plane (metres) is seen in the direction `[-x_f, -y_f, f]`,
normalised: the star camera's sign convention. `LineCamera` is described by its hardware (paper, Table 3),
`LookAngleCamera` by tabulated look angles, as operators publish them. Both are a `LineSensor`, the interface
that the pushbroom model uses. `StripImage` is what rooms that look at a strip's pixels need to know of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from boresight.records.record import Floats, array, check_numbers, inner, record, scalar

__all__ = [
    "Ccd",
    "LineCamera",
    "LineSensor",
    "LookAngleCamera",
    "LookTable",
    "StripImage",
    "TimeOfRow",
    "edge_tangent",
    "end_looks",
    "gaussian_sigma_px",
]

TimeOfRow = Literal["start", "middle", "end"]


class LineSensor(Protocol):
    """Interface of a pushbroom model to its camera. `ccd` is an index from 0."""

    @property
    def n_ccds(self) -> int:
        """Number of CCDs."""

    def n_px(self, ccd: int) -> int:
        """Number of pixels of a CCD."""

    def directions_from_pixels(self, ccd: int, sample: ArrayLike) -> Floats:
        """Unit vectors (N, 3) in frame c towards samples (N,), fractional ones included."""

    def sample_jacobian(self, ccd: int, sample: ArrayLike) -> Floats:
        """d u_c / d sample, (N, 3), rad/px."""

    def samples_from_directions(self, ccd: int, u_c: ArrayLike) -> tuple[Floats, Floats]:
        """The nearest sample (N,) to each direction (N, 3), and its distance across the detector, px (N,).

        The distance is positive towards +x of frame c. NaN for directions behind the camera.
        """

    @property
    def pixel_rad(self) -> float:
        """Angle of one sample of the first CCD, rad."""

    def delay_to_middle_s(self, row_period_s: float) -> float:
        """Seconds from a row's time label to the middle of its exposure."""


class StripImage(Protocol):
    """A strip's raw pixels, read by window: the CCDs of a camera, or the single image of the virtual CCD."""

    @property
    def ccds(self) -> Sequence[int]:
        """The CCDs that were recorded, numbered as in the camera model."""

    def shape(self, ccd: int) -> tuple[int, int]:
        """(lines, samples) of one CCD's image."""

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray[Any]:
        """Pixels (rows, columns) line0..line1, sample0..sample1 (ends excluded, inside the image), any real
        type; NaN marks what must not be used: no data, cloud, saturation.
        """


def end_looks(camera: LineSensor) -> Floats:
    """Unit vectors (2 C, 3) in frame c towards the first and the last sample of each CCD."""
    last = [camera.n_px(ccd) - 1.0 for ccd in range(camera.n_ccds)]
    ends = [camera.directions_from_pixels(ccd, np.array([0.0, end])) for ccd, end in enumerate(last)]
    return np.concatenate(ends)


def edge_tangent(camera: LineSensor) -> float:
    """Largest tangent of the angle between a pixel's look direction and the camera's axis."""
    u_c = end_looks(camera)
    return float(np.max(np.hypot(u_c[:, 0], u_c[:, 1]) / u_c[:, 2]))


def gaussian_sigma_px(mtf_at_nyquist: float) -> float:
    """Width, px, of the Gaussian whose transfer function has this value at half a cycle per pixel."""
    return float(np.sqrt(-2.0 * np.log(mtf_at_nyquist)) / np.pi)


@record(kw_only=True)
class Ccd:
    """One line detector in the focal plane (paper, Table 3).

    Without rotation and distortion sample n lies at `x_f = x_offset_m`, `y_f = y_first_m + n pixel_m`. The
    distortion table gives, at measured samples, the offset of the image along the detector as in eq. (4)
    (measured = ideal + offset), zero at the principal sample: a cubic spline (not-a-knot) between its
    entries, linear beyond its ends; a second column may give the offset across the detector. Raises
    `ValueError` for sizes that are not positive, a table that is not increasing, or one that reverses the
    order of the samples.
    """

    n_px: int = scalar("number of samples")
    y_first_m: float = scalar("y_f of sample 0")
    x_offset_m: float = scalar("x_f of the detector; with TDI of the middle of the block of stages")
    rotation_rad: float = scalar("about the principal sample, from +x_f towards +y_f")
    pixel_m: float = scalar("pitch of the samples")
    principal_sample: float = scalar("sample about which the detector is rotated; its distortion is zero")
    distortion_samples: Floats = array(
        "D", "samples of the distortion table, increasing", default_factory=lambda: np.zeros(0)
    )
    distortion_offsets_m: Floats = array(
        "D", "offset of the image along the detector there", default_factory=lambda: np.zeros(0)
    )
    across_offsets_m: Floats = array(
        "E",
        "offset of the image across the detector there, towards +x_f; none: zero",
        default_factory=lambda: np.zeros(0),
    )
    _spline: CubicSpline | None = field(init=False, repr=False, default=None)
    _across: CubicSpline | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        samples = np.asarray(self.distortion_samples, dtype=float)
        offsets = np.asarray(self.distortion_offsets_m, dtype=float)
        across = np.asarray(self.across_offsets_m, dtype=float)
        if len(across) not in (0, len(samples)):
            raise ValueError(f"across_offsets_m must have 0 or {len(samples)} entries, got {len(across)}")
        if len(samples) == 1 or np.any(np.diff(samples) <= 0.0):
            raise ValueError(f"distortion_samples must be two or more in increasing order, got {samples}")
        place = ("y_first_m", "x_offset_m", "rotation_rad", "principal_sample")
        check_numbers(self, any_value=place)
        if not np.isfinite([*(getattr(self, name) for name in place), *samples, *offsets, *across]).all():
            raise ValueError(f"{', '.join(place)} and the distortion table must be finite")
        object.__setattr__(self, "distortion_samples", samples)
        object.__setattr__(self, "distortion_offsets_m", offsets)
        if len(samples):
            object.__setattr__(self, "_spline", CubicSpline(samples, offsets))
        if len(across):
            object.__setattr__(self, "_across", CubicSpline(samples, across))
        ends = np.array([0.0, self.n_px - 1.0])
        along, slope = self._along(ends)
        if np.any(slope <= 0.0) or along[1] <= along[0]:
            raise ValueError("the distortion table reverses the order of the samples")

    @property
    def bare(self) -> Ccd:
        """The detector without its distortion table."""
        none = np.zeros(0)
        return replace(self, distortion_samples=none, distortion_offsets_m=none, across_offsets_m=none)

    def focal_plane(self, sample: ArrayLike) -> Floats:
        """Ideal image points (N, 2), `(x_f, y_f)`, m, of samples (N,), distortion removed."""
        n = np.asarray(sample, dtype=float)
        points = self._along(n)[0] * self.axis[:, None]  # components lie together in memory
        points += self.axis_point[:, None]
        points -= self._off_line(n)[0] * self.normal[:, None]
        return points.T

    def focal_plane_slope(self, sample: ArrayLike) -> Floats:
        """Derivative d(x_f, y_f) / d sample (N, 2), m/px, at samples (N,)."""
        n = np.asarray(sample, dtype=float)
        return self._along(n)[1][:, None] * self.axis - self._off_line(n)[1][:, None] * self.normal

    def samples(self, xy_f: Floats) -> tuple[Floats, Floats]:
        """The nearest sample (N,) of focal-plane points (N, 2), m, and their distance across the detector
        (N,), m.

        The distance is positive towards +x_f.
        """
        offset = xy_f - self.axis_point
        along = offset @ self.axis
        across = offset @ self.normal
        sample = self.principal_sample + along / self.pixel_m
        for _ in range(20):
            before, slope = self._along(sample)
            step = (along - before) / slope
            sample = sample + step
            if np.nanmax(np.abs(step), initial=0.0) < 1e-10:
                break
        return sample, across + self._off_line(sample)[0]

    @property
    def normal(self) -> Floats:
        """Unit vector (2,) across the detector, towards +x_f."""
        return np.array([np.cos(self.rotation_rad), np.sin(self.rotation_rad)])

    @property
    def axis(self) -> Floats:
        """Unit vector (2,) along the detector, towards +y_f."""
        return np.array([-np.sin(self.rotation_rad), np.cos(self.rotation_rad)])

    @property
    def axis_point(self) -> Floats:
        """Ideal image point (2,) of the principal sample, m."""
        return np.array([self.x_offset_m, self.y_first_m + self.principal_sample * self.pixel_m])

    def _along(self, sample: Floats) -> tuple[Floats, Floats]:
        """Ideal distance along the detector from its principal sample (N,), m, and its derivative, m/px."""
        offset, beyond, slope = self._offset(self._spline, sample)
        return (sample - self.principal_sample) * self.pixel_m - offset - beyond, self.pixel_m - slope

    def _off_line(self, sample: Floats) -> tuple[Floats, Floats]:
        """Offset across the detector (N,), m, and its derivative, m/px."""
        offset, beyond, slope = self._offset(self._across, sample)
        return offset + beyond, slope

    def _offset(self, spline: CubicSpline | None, sample: Floats) -> tuple[Floats, Floats, Floats]:
        """Offset (N,) of a table within its ends, m, its growth from there on, and its derivative, m/px."""
        if spline is None:
            return (np.zeros(len(sample)),) * 3
        inside = np.clip(sample, self.distortion_samples[0], self.distortion_samples[-1])
        slope = spline(inside, 1)
        return spline(inside), slope * (sample - inside), slope


@record
class LineCamera:
    """A camera of one or more staggered CCDs behind one lens (paper, section 3.1 and Table 3).

    A row of a TDI image is exposed during `tdi_stages` row periods; `time_of_row` says which instant of them
    a row's time label means. The pushbroom model uses the middle. Raises `ValueError` for a focal length that
    is not positive, no CCD, fewer than one stage or an unknown `time_of_row`.
    """

    focal_m: float = scalar("focal length")
    ccds: tuple[Ccd, ...] = array("C", "detectors")
    tdi_stages: int = scalar("rows over which one row's light is accumulated", default=1)
    time_of_row: TimeOfRow = scalar("instant of the exposure that a row's time label means", default="middle")
    n_ccds = inner[int]("ccds", "number of CCDs", of=len)

    def __post_init__(self) -> None:
        check_numbers(self)
        if not self.ccds:
            raise ValueError("LineCamera.ccds must hold at least one CCD")
        if self.time_of_row not in ("start", "middle", "end"):
            raise ValueError(f"LineCamera.time_of_row must be start, middle or end, got {self.time_of_row!r}")

    def n_px(self, ccd: int) -> int:
        """Number of pixels of a CCD."""
        return self.ccds[ccd].n_px

    def directions_from_pixels(self, ccd: int, sample: ArrayLike) -> Floats:
        """Unit look vectors (N, 3), frame c, of samples (N,) of one CCD (paper, eq. 1, with lambda < 0);
        fractional samples, which may lie beyond the ends of the detector. `ccd` is an index from 0.
        """
        x_f, y_f = self.ccds[ccd].focal_plane(sample).T
        v_c = np.array([-x_f, -y_f, np.full(len(x_f), self.focal_m)])  # components lie together in memory
        return (v_c * (1.0 / np.sqrt(x_f * x_f + y_f * y_f + self.focal_m**2))).T

    def sample_jacobian(self, ccd: int, sample: ArrayLike) -> Floats:
        """Derivative d u_c / d sample (N, 3), rad/px, at samples (N,)."""
        xy_f = self.ccds[ccd].focal_plane(sample)
        v_c = np.column_stack([-xy_f, np.full(len(xy_f), self.focal_m)])
        slope = np.zeros_like(v_c)
        slope[:, :2] = -self.ccds[ccd].focal_plane_slope(sample)
        norm = np.linalg.norm(v_c, axis=1, keepdims=True)
        u_c = v_c / norm
        return (slope - u_c * np.einsum("ni,ni->n", u_c, slope)[:, None]) / norm

    def samples_from_directions(self, ccd: int, u_c: ArrayLike) -> tuple[Floats, Floats]:
        """The nearest sample (N,) to directions (N, 3), frame c, and their distance (N,) across the detector,
        px, positive towards +x_c. NaN behind the camera.
        """
        u = np.asarray(u_c, dtype=float)
        xy_f = -u[:, :2] * (self.focal_m / np.where(u[:, 2] > 0.0, u[:, 2], np.nan))[:, None]
        sample, across = self.ccds[ccd].samples(xy_f)
        return sample, -across / self.ccds[ccd].pixel_m

    @property
    def pixel_rad(self) -> float:
        """Angle of one sample of the first CCD, rad."""
        return self.ccds[0].pixel_m / self.focal_m

    def delay_to_middle_s(self, row_period_s: float) -> float:
        """Seconds from a row's time label to the middle of its exposure, all TDI stages included."""
        half = 0.5 * self.tdi_stages * row_period_s
        return {"start": half, "middle": 0.0, "end": -half}[self.time_of_row]


@record
class LookTable:
    """One detector given by tangents at some samples: `u_c ~ [tan_x, tan_y, 1]`.

    Interpolated by a cubic spline (linearly between two samples), extrapolated linearly. Raises `ValueError`
    for fewer than two samples, samples not increasing, or `tan_y` not strictly monotone.
    """

    n_px: int = scalar("number of samples of the detector")
    samples: Floats = array("K", "samples at which the tangents are given, increasing")
    tan_x: Floats = array("K", "u_x / u_z")
    tan_y: Floats = array("K", "u_y / u_z, strictly monotone")

    def __post_init__(self) -> None:
        check_numbers(self)
        for name in ("samples", "tan_x", "tan_y"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        if len(self.samples) < 2 or not np.all(np.diff(self.samples) > 0.0) or np.isnan(self.tan_x).any():
            raise ValueError("LookTable needs two or more samples in increasing order, each with tangents")
        along = np.diff(self.tan_y)
        if not (np.all(along > 0.0) or np.all(along < 0.0)):
            raise ValueError("LookTable.tan_y must be strictly monotone along the detector")


@record
class LookAngleCamera:
    """A camera given by tables of look directions, one a CCD, as operators publish it.

    Raises `ValueError` without a CCD.
    """

    ccds: tuple[LookTable, ...] = array("C", "detectors")
    _in_plane: LineCamera = field(init=False, repr=False)  # of focal length 1
    n_ccds = inner[int]("ccds", "number of CCDs", of=len)

    def __post_init__(self) -> None:
        if not self.ccds:
            raise ValueError("LookAngleCamera.ccds must hold at least one table")
        object.__setattr__(self, "_in_plane", self._with_focal_length(1.0))

    def n_px(self, ccd: int) -> int:
        """Number of pixels of a CCD."""
        return self.ccds[ccd].n_px

    def directions_from_pixels(self, ccd: int, sample: ArrayLike) -> Floats:
        """Unit look vectors (N, 3), frame c, of samples (N,)."""
        return self._in_plane.directions_from_pixels(ccd, sample)

    def sample_jacobian(self, ccd: int, sample: ArrayLike) -> Floats:
        """Derivative d u_c / d sample (N, 3), rad/px."""
        return self._in_plane.sample_jacobian(ccd, sample)

    def samples_from_directions(self, ccd: int, u_c: ArrayLike) -> tuple[Floats, Floats]:
        """The nearest sample (N,) to directions (N, 3), and their distance across, px, towards +x_c."""
        sample, across = self._in_plane.samples_from_directions(ccd, u_c)
        return sample, across * np.sign(np.cos(self._in_plane.ccds[ccd].rotation_rad))

    @property
    def pixel_rad(self) -> float:
        """Angle of one sample in the middle of the first CCD, rad."""
        middle = 0.5 * (self.ccds[0].n_px - 1.0)
        return float(np.linalg.norm(self.sample_jacobian(0, np.array([middle]))))

    def delay_to_middle_s(self, row_period_s: float) -> float:
        """Zero: time labels are those of the middle of the exposure."""
        return 0.0

    def with_focal_plane(self) -> LineCamera:
        """A camera with a focal plane and these look directions, whose first pixels are 10 um wide.

        Each detector is the chord of its table, and the table's difference from it the distortion. Exact at
        all samples, because both are cubic splines through the same ones.
        """
        return self._with_focal_length(1e-5 / self.pixel_rad)

    def _with_focal_length(self, focal_m: float) -> LineCamera:
        return LineCamera(focal_m, tuple(_ccd_of(table, focal_m) for table in self.ccds))


def _ccd_of(table: LookTable, focal_m: float) -> Ccd:
    """A look table as a detector in the focal plane; one of increasing `tan_y` is rotated by 180 degrees."""
    points = -focal_m * np.column_stack([table.tan_x, table.tan_y])  # (x_f, y_f)
    k = len(table.samples) // 2
    from_principal = points - points[k]
    chord = points[-1] - points[0]
    pitch = float(np.hypot(*chord) / np.ptp(table.samples))
    dx, dy = chord / np.hypot(*chord)
    principal = float(table.samples[k])
    return Ccd(
        n_px=table.n_px,
        y_first_m=float(points[k, 1] - principal * pitch),
        x_offset_m=float(points[k, 0]),
        rotation_rad=float(np.arctan2(-dx, dy)),
        pixel_m=pitch,
        principal_sample=principal,
        distortion_samples=table.samples,
        distortion_offsets_m=(table.samples - principal) * pitch - from_principal @ [dx, dy],
        across_offsets_m=-(from_principal @ [dy, -dx]),
    )
