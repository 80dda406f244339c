"""The star camera: pixels of its detector <-> directions in its own frame s (paper, eqs. 3-6).

Frame s has z along the optical axis, outward; x and y are *opposite* to the image's column and row axes,
because the lens turns the image round. Distortion takes an ideal image point to where it is really formed, so
the way from direction to pixel is explicit and the way back is solved by Newton's method. What a lens does
outside its own fold (where the distortion polynomial turns back) is not an image: such directions give NaN,
never a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["OpenCVParameters", "StarCamera"]

Array = NDArray[np.float64]

_MM = 1e3  # mm per metre: the paper's distortion numbers are for coordinates in millimetres
_NEWTON_STEPS = 25
_NEWTON_MM = 1e-13  # last step of the inversion: 1.6e-11 px for a pixel of 6.4 um


@dataclass(frozen=True, slots=True, eq=False)
class OpenCVParameters:
    """The same lens as OpenCV writes it: in pixels, distortion for coordinates divided by f.

    OpenCV's camera frame has x and y along the image's column and row axes: `v_cv = [-u_x, -u_y, u_z]`.
    """

    camera_matrix: Array  # (3, 3)
    distortion: Array  # (4,) k1, k2, p1, p2


@dataclass(frozen=True, slots=True, eq=False)
class StarCamera:
    """A frame camera with radial and tangential distortion, in the paper's form (Table 2, eqs. 4-6).

    `p1`, `p2` (1/mm), `q1` (1/mm^2) and `q2` (1/mm^4) act on image coordinates in millimetres. Table 2 lists
    its four numbers in the order p1, p2, q1, q2.
    """

    focal_m: float
    pixel_m: float  # pitch, the same along columns and rows
    width_px: int
    height_px: int
    principal_px: tuple[float, float]  # (x0, y0); (0, 0) is the centre of the first pixel
    p1: float = 0.0
    p2: float = 0.0
    q1: float = 0.0
    q2: float = 0.0

    def __post_init__(self) -> None:
        for name in ("focal_m", "pixel_m", "width_px", "height_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"StarCamera.{name} must be positive, got {getattr(self, name)}")
        if len(self.principal_px) != 2:
            raise ValueError(f"StarCamera.principal_px must be (x0, y0), got {self.principal_px}")

    @property
    def field_radius_rad(self) -> float:
        """Angle from the optical axis to the farthest corner of the detector."""
        x, y = float(self.width_px) - 0.5, float(self.height_px) - 0.5
        corners = np.array([[-0.5, -0.5], [x, -0.5], [-0.5, y], [x, y]])
        return float(np.arccos(self.directions_from_pixels(corners)[:, 2].min()))

    def contains(self, xy_px: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (N, 2) fall on the detector; pixels reach half a pixel beyond their centres."""
        xy = _points(xy_px)
        upper = np.array([self.width_px, self.height_px]) - 0.5
        return np.asarray(((xy >= -0.5) & (xy <= upper)).all(axis=1))

    def directions_from_pixels(self, xy_px: ArrayLike) -> Array:
        """Unit vectors in frame s towards points of the detector (paper, eqs. 3-6).

        Parameters
        ----------
        xy_px : (N, 2)
            Points (column, row) as measured, distortion not removed.

        Returns
        -------
        u_s : (N, 3)
            `[-x, -y, f]` normalised, x and y the ideal image coordinates; NaN for NaN, and for a point which
            lies so far outside that no ideal point is imaged on it.
        """
        ideal = self._ideal_mm(self._image_mm(xy_px))
        v_s = np.column_stack([-ideal, np.full(len(ideal), self.focal_m * _MM)])
        return v_s / np.linalg.norm(v_s, axis=1, keepdims=True)

    def pixels_from_directions(self, u_s: ArrayLike) -> Array:
        """Image points (N, 2) of directions (N, 3) in frame s, distortion included.

        The points may lie outside the detector (`contains` tells). NaN behind the camera, and beyond the fold
        of the distortion polynomial, where it would lead a direction far outside the field back into the
        image.
        """
        u = np.asarray(u_s, dtype=float)
        if u.ndim != 2 or u.shape[1] != 3:
            raise ValueError(f"u_s must have shape (N, 3), got {u.shape}")
        ahead = u[:, 2] > 0.0
        z = np.where(ahead, u[:, 2], np.nan)
        p = u[:, :2].T * (-self.focal_m * _MM / z)
        actual, diagonal, mixed = self._bent(p)
        actual[:, ~self._upright(p, diagonal, mixed)] = np.nan
        return np.asarray(self.principal_px) + actual.T / (self.pixel_m * _MM)

    def pixel_jacobian(self, xy_px: ArrayLike) -> Array:
        """Derivative of the unit vectors, (N, 3, 2): `d u_s / d(column, row)`, rad/px.

        A covariance of a centroid (2, 2) px^2 becomes that of its direction: `J C J^T` (3, 3) rad^2.
        """
        ideal = self._ideal_mm(self._image_mm(xy_px))
        v = np.column_stack([-ideal, np.full(len(ideal), self.focal_m * _MM)])
        norm = np.linalg.norm(v, axis=1)
        u = v / norm[:, None]
        across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / norm[:, None, None]
        du_dideal = -across[:, :, :2]
        dactual_dideal = self._distortion_jacobian(ideal)
        return du_dideal @ _inverse_2x2(dactual_dideal) * (self.pixel_m * _MM)

    def opencv_parameters(self) -> OpenCVParameters:
        """This lens in OpenCV's terms: k1 = q1 f^2, k2 = q2 f^4, p1cv = p2 f, p2cv = p1 f with f in mm."""
        f = self.focal_m * _MM
        f_px = self.focal_m / self.pixel_m
        x0, y0 = self.principal_px
        return OpenCVParameters(
            camera_matrix=np.array([[f_px, 0.0, x0], [0.0, f_px, y0], [0.0, 0.0, 1.0]]),
            distortion=np.array([self.q1 * f**2, self.q2 * f**4, self.p2 * f, self.p1 * f]),
        )

    @classmethod
    def from_opencv(
        cls, parameters: OpenCVParameters, *, pixel_m: float, width_px: int, height_px: int
    ) -> StarCamera:
        """The camera that OpenCV describes by `parameters`, its pixels being squares of `pixel_m`.

        Raises `ValueError` for what this model cannot hold: pixels that are not square, skew, more than four
        distortion coefficients other than zero.
        """
        K = np.asarray(parameters.camera_matrix, dtype=float)
        d = np.zeros(max(4, np.size(parameters.distortion)))
        d[: np.size(parameters.distortion)] = np.ravel(parameters.distortion)
        if not np.isclose(K[0, 0], K[1, 1], rtol=1e-12) or K[0, 1] != 0.0:
            raise ValueError(
                f"square pixels without skew expected, got fx={K[0, 0]}, fy={K[1, 1]}, skew={K[0, 1]}"
            )
        if np.any(d[4:] != 0.0):
            raise ValueError(f"only k1, k2, p1, p2 can be taken over, got further coefficients {d[4:]}")
        f = K[0, 0] * pixel_m * _MM
        return cls(
            focal_m=K[0, 0] * pixel_m,
            pixel_m=pixel_m,
            width_px=width_px,
            height_px=height_px,
            principal_px=(float(K[0, 2]), float(K[1, 2])),
            p1=float(d[3] / f),
            p2=float(d[2] / f),
            q1=float(d[0] / f**2),
            q2=float(d[1] / f**4),
        )

    def _image_mm(self, xy_px: ArrayLike) -> Array:
        return (_points(xy_px) - np.asarray(self.principal_px)) * (self.pixel_m * _MM)

    def _distortion_jacobian(self, ideal: Array) -> Array:
        """d(actual) / d(ideal), (N, 2, 2)."""
        _, diagonal, mixed = self._bent(ideal.T)
        J = np.empty((len(ideal), 2, 2))
        J[:, 0, 0], J[:, 1, 1] = diagonal
        J[:, 0, 1] = J[:, 1, 0] = mixed
        return J

    def _bent(self, p: Array) -> tuple[Array, Array, Array]:
        """Real places (2, N) of ideal points p (2, N), mm (eq. 4), and their derivatives: (2, N) each
        coordinate by itself, (N,) each by the other.

        With t = (p1, p2) eq. (5) is p + d = s p + r^2 t, where s = 1 + q1 r^2 + q2 r^4 + 2 t.p, so the
        derivative is s I + 2 (q1 + 2 q2 r^2) p p^T + 2 (p t^T + t p^T).
        """
        t = self._tangential
        x, y = p
        r2 = x * x + y * y
        s = r2 * (self.q1 + r2 * self.q2) + (2.0 * (self.p1 * x + self.p2 * y) + 1.0)
        slope = 2.0 * self.q1 + (4.0 * self.q2) * r2
        diagonal = s + p * (slope * p + 4.0 * t)
        mixed = slope * x * y + 2.0 * (self.p2 * x + self.p1 * y)
        return s * p + t * r2, diagonal, mixed

    @property
    def _tangential(self) -> Array:
        return np.array([[self.p1], [self.p2]])

    def _upright(self, p: Array, diagonal: Array, mixed: Array) -> NDArray[np.bool_]:
        """(N,) where the image still grows outward and is not turned over; arguments as in `_bent`."""
        with np.errstate(invalid="ignore"):
            near = p[0] * p[0] + p[1] * p[1] < self._fold_mm2
            return np.asarray(near & (diagonal[0] * diagonal[1] > mixed * mixed))

    @property
    def _fold_mm2(self) -> float:
        """The smallest r^2 at which the radial image stops growing, 1 + 3 q1 r^2 + 5 q2 r^4 = 0."""
        discriminant = 9.0 * self.q1**2 - 20.0 * self.q2
        reciprocal = -3.0 * self.q1 + np.sqrt(max(discriminant, 0.0))  # of half the root
        return float(2.0 / reciprocal) if discriminant >= 0.0 and reciprocal > 1e-30 else float("inf")

    def _ideal_mm(self, actual: Array) -> Array:
        """Inverse of eq. (4): the ideal points whose real places are `actual`; NaN where there is none."""
        goal = np.ascontiguousarray(actual.T)
        p = goal.copy()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(_NEWTON_STEPS):
                real, diagonal, mixed = self._bent(p)
                miss = goal - real
                determinant = diagonal[0] * diagonal[1] - mixed * mixed
                step = (diagonal[::-1] * miss - mixed * miss[::-1]) / determinant
                if not (np.abs(step) >= _NEWTON_MM).any():
                    break
                p += step
            found = (np.abs(miss) < 1e-10).all(axis=0) & self._upright(p, diagonal, mixed)
        ideal = p.T.copy()
        ideal[~found] = np.nan
        return ideal


def _points(xy_px: ArrayLike) -> Array:
    xy = np.asarray(xy_px, dtype=float)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"xy_px must have shape (N, 2), got {xy.shape}")
    return xy


def _inverse_2x2(J: Array) -> Array:
    a, b, c, d = J[:, 0, 0], J[:, 0, 1], J[:, 1, 0], J[:, 1, 1]
    inverse = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return inverse / (a * d - b * c)[:, None, None]
