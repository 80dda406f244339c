"""The virtual CCD: one ideal line in place of several staggered detectors (paper, section 3.1).

The virtual CCD is the straight line in the focal plane that best fits the look directions of all real pixels
(paper, eqs. 26-27), divided into equal pixels of an ideal pinhole camera. Raw images are resampled to it by
way of the ground: the ground point of a virtual pixel on the mean elevation plane is projected into the real
CCD. Ground d metres off that plane is displaced by stagger / focal length times d; with a terrain in place of
the plane there is no displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import Attitude, interpolation_weights
from boresight.geometry.groundlight import OrbitLike
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import orbital_frame
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.terrain import Surface
from boresight.records.record import Floats, array, record, scalar

__all__ = ["ReadStrip", "SmoothAttitude", "VirtualStrip", "virtual_camera"]

Array = NDArray[np.float64]
Image = NDArray[np.float32]
# ccd, line0, line1, sample0, sample1 -> (lines, samples)
ReadStrip = Callable[[int, int, int, int, int], NDArray[Any]]

_NODE_LINES = 16  # lattice of the mapping between the images, cubics between:
_NODE_SAMPLES = 96  # 1 ms of motion and 50 m of ground
_MARGIN_PX = 5  # support of the interpolation
# Lines resampled at a time, which bounds memory.
_BLOCK_LINES = 512
# Instants at which a real attitude is taken for the smooth one: 50 in each second of a strip of 20 s.
_INSTANTS = 1001
_DEGREE = 2  # of the smooth attitude in time: an RPC follows parabolas, over tens of seconds no cubics


def virtual_camera(camera: LineCamera) -> LineCamera:
    """Camera with one ideal detector, the virtual CCD of `camera` (paper, eqs. 26-27).

    The pitch of its pixels is the mean of the real ones. The line has the ends of the real detectors; time
    labels of its rows are those of the middle of their exposure.
    """
    points = np.vstack([ccd.focal_plane(np.arange(ccd.n_px)) for ccd in camera.ccds])
    along, across = points[:, 1], points[:, 0]
    A = np.column_stack([along, np.ones(len(along))])
    (a, b), *_ = np.linalg.lstsq(A, across, rcond=None)
    pitch = float(np.mean([ccd.pixel_m for ccd in camera.ccds]))
    length = np.hypot(1.0, a) * np.ptp(along)
    ideal = Ccd(
        n_px=int(np.floor(length / pitch)) + 1,
        y_first_m=float(along.min()),
        x_offset_m=float(a * along.min() + b),
        rotation_rad=float(-np.arctan(a)),
        pixel_m=pitch,
        principal_sample=0.0,
    )
    return LineCamera(camera.focal_m, (ideal,))


@record
class SmoothAttitude:
    """Parabolas in time, relative to the orbital frame, that are nearest to an attitude.

    `R_si(t) = exp(turn_s(t)) R_so_middle R_oi(t)`.
    """

    orbit: OrbitLike = scalar("orbit, whose frame o follows the nominal motion")
    R_so_middle: Rotation = scalar("frame o to s in the middle of the strip")
    coefficients: Floats = array("3, 3", "of turn_s, rad, by powers of (t - t_middle_s) / half_s")
    t_middle_s: float = scalar("middle of the strip, TAI seconds since the epoch")
    half_s: float = scalar("half of its duration, s")
    span_s: tuple[float, float] = array("2", "first and last instant at which it is known")

    @classmethod
    def nearest(cls, real: Attitude, orbit: OrbitLike, first_s: float, last_s: float) -> Self:
        """The one nearest to `real` between two instants, by least squares."""
        middle, half = 0.5 * (first_s + last_s), 0.5 * (last_s - first_s)
        x = np.linspace(-1.0, 1.0, _INSTANTS)
        t = np.clip(middle + half * x, first_s, last_s)
        R_so = real.R_si(t) * orbital_frame(*orbit.states_i(t)).inv()
        at_middle = R_so[_INSTANTS // 2]
        turn = (R_so * at_middle.inv()).as_rotvec()
        coefficients = np.polynomial.polynomial.polyfit(x, turn, _DEGREE)
        return cls(orbit, at_middle, coefficients, middle, half, real.span_s)

    def R_si(self, t_s: ArrayLike) -> Rotation:
        """The rotation from GCRS to frame s at instants (N,)."""
        t = np.asarray(t_s, dtype=float)
        turn = np.polynomial.polynomial.polyval((t - self.t_middle_s) / self.half_s, self.coefficients).T
        return Rotation.from_rotvec(turn) * self.R_so_middle * orbital_frame(*self.orbit.states_i(t))


@record
class VirtualStrip:
    """A strip of several CCDs, and the strip as the virtual CCD would image it (`virtual`).

    Line n of the virtual image has the instant of row n of the strip. Raises `TypeError` unless the
    camera is a `LineCamera`.
    """

    real: Pushbroom = scalar("the strip with its real CCDs; its camera is a `LineCamera`")
    surface: Surface = scalar("the mean elevation plane, or the terrain")
    smooth_rows: tuple[float, float] | None = scalar(
        "rows over which the virtual attitude is smooth; None: it is the real one", default=None
    )
    virtual: Pushbroom = field(init=False)

    def __post_init__(self) -> None:
        real, camera, rows = self.real, self._camera, self.real.rows
        middle = rows.t_first_row_s + camera.delay_to_middle_s(rows.row_period_s)
        attitude: Attitude = real.attitude
        if self.smooth_rows is not None:
            span_s = real.instants(self.smooth_rows).tolist()
            attitude = SmoothAttitude.nearest(attitude, real.orbit, *span_s)
        virtual = replace(
            real,
            camera=virtual_camera(camera),
            rows=RowClock(middle, rows.row_period_s),
            attitude=attitude,
            table=None,
        )
        object.__setattr__(self, "virtual", virtual)

    @property
    def width_px(self) -> int:
        """Pixels of the virtual CCD."""
        return self.virtual.camera.n_px(0)

    def seams(self, line: float) -> list[tuple[int, float, float]]:
        """Index, first and last virtual sample of each CCD's part of the virtual line, in order, near `line`.

        A seam is in the middle of the overlap of two neighbours on the ground, or of the gap between them.
        The ground moves across between the instants of staggered detectors, so this is not exactly the middle
        of their overlap in the focal plane.
        """
        ends = []
        for k in range(self._camera.n_ccds):
            corners = np.array([0.0, self._camera.n_px(k) - 1.0])
            own_line = self.real.rows.lines_of_rows(k, np.full(2, line))
            ground = self.real.ground_points(k, corners, own_line, self.surface)
            first, last = self.virtual.pixels_from_ground(0, ground)[0]
            ends.append((k, float(first), float(last)))
        ends.sort(key=lambda end: end[1])
        parts = []
        for n, (k, first, last) in enumerate(ends):
            begin = 0.5 * (ends[n - 1][2] + first) if n else -0.5
            end = 0.5 * (last + ends[n + 1][1]) if n + 1 < len(ends) else self.width_px - 0.5
            parts.append((k, begin, end))
        return parts

    def source_pixels(self, ccd: int, sample: Array, line: Array) -> tuple[Array, Array]:
        """Pixels (sample (N,), line (N,)) of a real CCD that see the ground points of virtual pixels (N,)."""
        ground = self.virtual.ground_points(0, sample, line, self.surface)
        return self.real.pixels_from_ground(ccd, ground)

    def resampled(
        self, ccd: int, read: ReadStrip, n_lines: int, lines: tuple[int, int], samples: tuple[int, int]
    ) -> Image:
        """Window (lines, samples) of the virtual image resampled from one CCD, NaN outside that CCD's image.

        Lanczos interpolation over 8 x 8 px, at positions rounded to 1/32 px. `read` returns windows of the
        raw image, which has `n_lines` lines.
        """
        at_line, at_sample = np.arange(*lines, dtype=float), np.arange(*samples, dtype=float)
        node_lines, node_samples = _nodes(at_line, _NODE_LINES), _nodes(at_sample, _NODE_SAMPLES)
        sample, line = np.meshgrid(node_samples, node_lines)
        found = self.source_pixels(ccd, sample.ravel(), line.ravel())
        source = [part.reshape(line.shape) for part in found]
        to_lines = interpolation_weights(node_lines, at_line)
        to_samples = interpolation_weights(node_samples, at_sample)
        unseen = np.isnan(source[0]).astype(float)
        doubtful = np.abs(to_lines) @ unseen @ np.abs(to_samples).T > 1e-9
        column, row = (np.where(doubtful, np.nan, to_lines @ np.nan_to_num(s) @ to_samples.T) for s in source)
        nothing: Image = np.full(column.shape, np.nan, dtype=np.float32)
        if not np.isfinite(column).any():
            return nothing
        left, right = _window(column, self._camera.n_px(ccd))
        top, bottom = _window(row, n_lines)
        if left >= right or top >= bottom:
            return nothing
        raw = np.asarray(read(ccd, top, bottom, left, right), dtype=np.float32)
        image = cv2.remap(
            raw,
            (column - left).astype(np.float32),
            (row - top).astype(np.float32),
            interpolation=cv2.INTER_LANCZOS4,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=[float("nan")],
        )
        return np.asarray(image, dtype=np.float32)

    def stitched(self, read: ReadStrip, n_lines: Mapping[int, int], lines: tuple[int, int]) -> Image:
        """Lines (lines, `width_px`) of the virtual image from all CCDs, NaN where none imaged the ground.

        `n_lines` has the number of lines of each raw image; a CCD that is not in it has none.
        """
        image: Image = np.full((lines[1] - lines[0], self.width_px), np.nan, dtype=np.float32)
        for ccd, begin, end in self.seams(float(np.mean(lines))):
            first, last = max(0, int(np.ceil(begin))), min(self.width_px, int(np.ceil(end)))
            for top in range(lines[0], lines[1], _BLOCK_LINES):
                bottom = min(top + _BLOCK_LINES, lines[1])
                image[top - lines[0] : bottom - lines[0], first:last] = self.resampled(
                    ccd, read, n_lines.get(ccd, 0), (top, bottom), (first, last)
                )
        return image

    @property
    def _camera(self) -> LineCamera:
        if not isinstance(self.real.camera, LineCamera):
            raise TypeError(f"a virtual CCD needs a LineCamera, got {type(self.real.camera).__name__}")
        return self.real.camera


def _nodes(at: Array, step: int) -> Array:
    """Evenly spaced nodes, five or more, from the first to the last of `at`, at most `step` apart."""
    count = max(4, int(np.ceil((at[-1] - at[0]) / step)))
    return np.asarray(at[0] + np.arange(count + 1) * (max(at[-1] - at[0], 1.0) / count), dtype=np.float64)


def _window(pixel: Array, size: int) -> tuple[int, int]:
    """Pixels along one axis of a raw image that hold positions (H, W), with the interpolation's margin."""
    low, high = float(np.nanmin(pixel)), float(np.nanmax(pixel))
    return max(0, int(np.floor(low)) - _MARGIN_PX), min(size, int(np.ceil(high)) + _MARGIN_PX + 1)
