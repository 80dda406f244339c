"""The star camera: pixels of its detector <-> directions in its own frame s (paper, eqs. 3-6).

Frame s has z along the optical axis, outward; x and y are *opposite* to the image's column and row axes,
because the lens inverts the image. Distortion maps an ideal image point to the measured one, so the
projection from direction to pixel is explicit and its inverse is solved by Newton's method. Beyond the
turning point of the distortion polynomial the projection is undefined: NaN.

The paper's lens images an angle t from the axis at f tan t. For other lenses there are a third radial term
(Brown to r^6), the projections f t (with its radial terms the model of Kannala & Brandt 2006) and
2 f tan(t/2), and a smooth distortion of the image for what these leave: sums of Legendre polynomials of
image coordinates, as SIP polynomials, but nearly orthogonal. A point is displaced along columns and rows by
sum c_ij P_i(x) P_j(y),  2 <= i + j <= degree, where x and y run from -1 to 1 over the longer side of the
image, its middle at 0. Constant and linear terms are the camera's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.polynomial.legendre import legval
from numpy.typing import ArrayLike, NDArray

from boresight.records.record import Bools, Floats, array, check_numbers, record, scalar, value_text

__all__ = [
    "LEAST_FORWARD",
    "Complex",
    "OpenCVParameters",
    "Projection",
    "SmoothDistortion",
    "StarCamera",
    "complex_of",
    "legendre_terms",
    "pairs_of",
    "term_orders",
]

Projection = Literal["tangent", "equidistant", "stereographic"]

Complex = NDArray[np.complex128]

_MM = 1e3  # mm per metre: the paper's distortion numbers are for coordinates in millimetres
# Error of the inverse, mm, that counts as exact: the rounding of doubles at 1 m, 2e-16 of it.
_EXACT_MM = 2e-13
# Cosine of the angle from the axis, 89 degrees, up to which pixels and stars of a fisheye are used: at 90 a
# direction has no place in the tangent plane.
LEAST_FORWARD = math.cos(math.radians(89.0))
_SLOPES_ERROR_PX = 1e-5  # error, px, of the directions at which pixels are derived
_SQUARE = 1e-3  # difference of the focal lengths along columns and rows of an OpenCV camera, at most
_BEYOND = 1.2  # times half the longer side: farther out the displacement stays what it is there
_EXACT_PX = 1e-11  # step, px, at which the inverse has converged: the rounding of doubles at 1e5 px
_CURVATURE_PER_MM = 0.02  # of a lens, at most: the error after a Newton step is its square times this


@record
class SmoothDistortion:
    """Displacement of the points of an image of `width_px` x `height_px`."""

    degree: int = scalar("largest i + j of a term")
    coefficients_px: Floats = array("2, T", "of columns and rows, px, in the order of `term_orders`")
    width_px: int = scalar("columns of the image")
    height_px: int = scalar("rows of the image")

    def __post_init__(self) -> None:
        if self.coefficients_px.shape[1] != (terms := len(term_orders(self.degree))):
            found = self.coefficients_px.shape[1]
            raise ValueError(f"a distortion of degree {self.degree} has {terms} coefficients, got {found}")

    def shift_px(self, xy_px: Floats) -> Floats:
        """Displacements (N, 2), px, of points (N, 2), px."""
        terms = legendre_terms(xy_px, self.width_px, self.height_px, self.degree)
        return np.asarray(terms @ self.coefficients_px.T)

    def applied(self, xy_px: Floats) -> Floats:
        """The displaced points (N, 2) of points (N, 2), px."""
        return xy_px + self.shift_px(xy_px)

    def removed(self, xy_px: Floats) -> Floats:
        """The points (N, 2), px, that are displaced to points (N, 2); NaN where the distortion is too steep
        to be inverted by repetition."""
        before = xy_px
        for _ in range(30):
            found = xy_px - self.shift_px(before)
            step, before = np.abs(found - before), found
            if not (step >= _EXACT_PX).any():
                return found
        return np.where((step < 1e-6).all(axis=1, keepdims=True), found, np.nan)


def term_orders(degree: int) -> tuple[tuple[int, int], ...]:
    """Orders (i, j) of the terms, by their sum."""
    return tuple((i, n - i) for n in range(2, degree + 1) for i in range(n + 1))


def legendre_terms(xy_px: Floats, width_px: int, height_px: int, degree: int) -> Floats:
    """(N, T) terms at points (N, 2), px."""
    half = 0.5 * max(width_px, height_px)
    middle = 0.5 * np.array([width_px - 1, height_px - 1])
    x, y = np.clip((xy_px - middle) / half, -_BEYOND, _BEYOND).T
    along_x, along_y = (legval(t, np.eye(degree + 1)) for t in (x, y))
    return np.stack([along_x[i] * along_y[j] for i, j in term_orders(degree)], axis=1)


@record
class OpenCVParameters:
    """Camera parameters in OpenCV's convention: pixels, distortion of coordinates divided by f.

    OpenCV's camera frame has x and y along the image's column and row axes: `v_cv = [-u_x, -u_y, u_z]`.
    """

    camera_matrix: Floats = array("3, 3", "focal length and principal point, px")
    distortion: Floats = array("D", "k1, k2, p1, p2, k3 (and further coefficients, which must be zero)")


@record(kw_only=True)
class StarCamera:
    """A frame camera with radial and tangential distortion, in the paper's form (Table 2, eqs. 4-6).

    `p1`, `p2` (1/mm), `q1` (1/mm^2), `q2` (1/mm^4) and `q3` (1/mm^6) act on image coordinates in millimetres.
    Table 2 lists its four numbers in the order p1, p2, q1, q2.
    """

    focal_m: float = scalar("focal length")
    pixel_m: float = scalar("pixel pitch, the same along columns and rows")
    width_px: int = scalar("columns of the detector")
    height_px: int = scalar("rows of the detector")
    principal_px: tuple[float, float] = array("2", "(x0, y0); (0, 0) is the centre of the first pixel")
    p1: float = scalar("tangential distortion, 1/mm", default=0.0)
    p2: float = scalar("tangential distortion, 1/mm", default=0.0)
    q1: float = scalar("radial distortion, 1/mm²", default=0.0)
    q2: float = scalar("radial distortion, 1/mm⁴", default=0.0)
    q3: float = scalar("radial distortion, 1/mm⁶", default=0.0)
    projection: Projection = scalar(
        '"tangent": r = f tan t; "equidistant": r = f t; "stereographic": r = 2 f tan(t/2)', default="tangent"
    )
    smooth: SmoothDistortion | None = scalar("of the image, after all others", default=None)

    def __post_init__(self) -> None:
        if not isinstance(self.projection, str) or self.projection not in get_args(Projection):
            found = f"{' or '.join(get_args(Projection))} expected, got {value_text(self.projection)}"
            raise ValueError(f"StarCamera.projection: {found}")
        check_numbers(self, any_value=("p1", "p2", "q1", "q2", "q3"))

    @property
    def field_radius_rad(self) -> float:
        """Angle from the axis to the farthest corner of the detector; pi/2 where that has no direction."""
        x, y = float(self.width_px) - 0.5, float(self.height_px) - 0.5
        corners = np.array([[-0.5, -0.5], [x, -0.5], [-0.5, y], [x, y]])
        return float(np.arccos(np.nan_to_num(self.directions_from_pixels(corners)[:, 2]).min()))

    @property
    def fov_x_rad(self) -> float:
        """Angle between the ends of the detector's middle row (`row_ends_px`)."""
        return _fov_x(self)

    def row_ends_px(self) -> Floats:
        """The ends (2, 2), px, of the middle row: the middles of the detector's left and right edges or, of a
        fisheye with an edge behind the camera, the last pixels within 89 degrees of its axis."""
        return _row_ends(self).copy()

    def middle_axes(self) -> Floats:
        """Rotation matrix (3, 3) whose columns, in frame s, are right, down and the direction of the image's
        middle; down points away from row 0."""
        return _middle_axes(self).copy()

    def contains(self, xy_px: ArrayLike) -> Bools:
        """Mask (N,) of points (N, 2), px, on the detector; its edge is half a pixel beyond the outer
        centres.
        """
        xy = _points(xy_px)
        upper = np.array([self.width_px, self.height_px]) - 0.5
        return np.asarray(((xy >= -0.5) & (xy <= upper)).all(axis=1))

    def directions_from_pixels(self, xy_px: ArrayLike) -> Floats:
        """Unit vectors (N, 3) in frame s towards points (column, row) (N, 2) of the detector, px, as
        measured, distortion not removed (paper, eqs. 3-6): `[-x, -y, f]` normalised, x and y the ideal image
        coordinates.

        NaN for NaN, and for a point so far outside the detector that it is the image of no direction. Raises
        `ValueError` if `xy_px` is not (N, 2).

        Examples
        --------
        >>> camera = StarCamera(
        ...     focal_m=0.1, pixel_m=1e-5, width_px=1001, height_px=1001, principal_px=(500.0, 500.0)
        ... )
        >>> camera.directions_from_pixels([[500.0, 500.0]])
        array([[-0.,  0.,  1.]])
        """
        return _normalised(self.tangents_from_pixels(xy_px))

    def tangents_from_pixels(self, xy_px: ArrayLike, *, error_px: float = 0.0) -> Floats:
        """Tangent-plane points (N, 2), `(u_x, u_y) / u_z`, of image points (N, 2), px; NaN as in
        `directions_from_pixels`. An allowed error `error_px` saves iterations."""
        ideal = self._ideal_mm(_points(xy_px), max(error_px * self.pixel_m * _MM, _EXACT_MM))
        if self.projection != "tangent":
            ideal = _radially(ideal, self.focal_m * _MM, _TANGENT_OVER_RADIUS[self.projection])
        return pairs_of(ideal * (-1.0 / (self.focal_m * _MM)))

    def pixels_from_directions(self, u_s: ArrayLike) -> Floats:
        """Image points (column, row) (N, 2), px, of directions (N, 3) of any length, frame s, distortion
        included.

        They may lie outside the detector (see `contains`). NaN behind the camera and beyond the turning point
        of the distortion polynomial, where the projection is undefined. Raises `ValueError` if `u_s` is not
        (N, 3).
        """
        u = np.asarray(u_s, dtype=float)
        if u.ndim != 2 or u.shape[1] != 3:
            raise ValueError(f"u_s must have shape (N, 3), got {u.shape}")
        ahead = np.where(u[:, 2] > 0.0, u[:, 2], np.nan)
        ideal = complex_of(u[:, :2]) * (-self.focal_m * _MM / ahead)
        if self.projection != "tangent":
            ideal = _radially(ideal, self.focal_m * _MM, _RADIUS_OVER_TANGENT[self.projection])
        actual, own, other = self._distorted(ideal)
        actual[~self._is_valid(ideal, own, other)] = complex(np.nan, np.nan)
        xy = np.asarray(self.principal_px) + pairs_of(actual) / (self.pixel_m * _MM)
        return xy if self.smooth is None else self.smooth.applied(xy)

    def pixel_jacobian(self, xy_px: ArrayLike) -> Floats:
        """Derivative of the unit vectors, (N, 3, 2): `d u_s / d(column, row)`, rad/px.

        A covariance C (2, 2) px² of a centroid gives that of its direction: `J C J^T` (3, 3) rad².
        """
        return self.directions_and_jacobian(xy_px)[1]

    def directions_and_jacobian(self, xy_px: ArrayLike) -> tuple[Floats, Floats]:
        """`directions_from_pixels` (N, 3) and `pixel_jacobian` (N, 3, 2): the distortion is inverted once."""
        if self.smooth is not None or self.projection != "tangent":
            return self.directions_from_pixels(xy_px), self._differences(_points(xy_px))
        ideal = self._ideal_mm(_points(xy_px))
        _, own, other = self._distorted(ideal)
        dactual_dideal = np.empty((len(ideal), 2, 2))
        dactual_dideal[:, 0, 0], dactual_dideal[:, 1, 1] = own + other.real, own - other.real
        dactual_dideal[:, 0, 1] = dactual_dideal[:, 1, 0] = other.imag
        f_mm = self.focal_m * _MM
        u = _normalised(pairs_of(ideal * (-1.0 / f_mm)))
        across = (np.eye(3) - u[:, :, None] * u[:, None, :]) * (u[:, 2] / f_mm)[:, None, None]
        J = -across[:, :, :2] @ _inverse_2x2(dactual_dideal) * (self.pixel_m * _MM)
        return u, J

    def pixel_slopes(self, xy_px: ArrayLike) -> Floats:
        """Derivative of the pixels by direction, (N, 2, 3): `d(column, row) / d u_s`, px, at the directions
        of pixels (N, 2), to which both rows are normal: the pseudo-inverse of `pixel_jacobian`.
        """
        if self.smooth is not None or self.projection != "tangent":
            J = self.pixel_jacobian(xy_px)
            M = J.transpose(0, 2, 1) @ J
            return np.asarray(_inverse_2x2(M) @ J.transpose(0, 2, 1))
        ideal = self._ideal_mm(_points(xy_px), _SLOPES_ERROR_PX * self.pixel_m * _MM)
        t = ideal * (-1.0 / (self.focal_m * _MM))
        scale = np.sqrt(1.0 + t.real * t.real + t.imag * t.imag) * (-self.focal_m / self.pixel_m)
        slopes = np.empty((len(t), 2, 3))
        _, own, other = self._distorted(ideal)
        slopes[:, 0, 0], slopes[:, 1, 1] = scale * (own + other.real), scale * (own - other.real)
        slopes[:, 0, 1] = slopes[:, 1, 0] = scale * other.imag
        slopes[:, :, 2] = pairs_of(-scale * (own * t + other * t.conj()))
        return slopes

    def opencv_parameters(self) -> OpenCVParameters:
        """Parameters in OpenCV's convention: k1 = q1 f^2, k2 = q2 f^4, p1cv = p2 f, p2cv = p1 f, k3 = q3 f^6
        with f in mm. `ValueError` for a projection or a smooth distortion that it does not know.
        """
        if self.smooth is not None or self.projection != "tangent":
            raise ValueError(f"OpenCV has no such lens: {self.projection}, or with a smooth distortion")
        f = self.focal_m * _MM
        f_px = self.focal_m / self.pixel_m
        x0, y0 = self.principal_px
        k = [self.q1 * f**2, self.q2 * f**4, self.p2 * f, self.p1 * f, self.q3 * f**6]
        matrix = np.array([[f_px, 0.0, x0], [0.0, f_px, y0], [0.0, 0.0, 1.0]])
        return OpenCVParameters(matrix, np.array(k if self.q3 else k[:4]))

    @classmethod
    def from_opencv(
        cls,
        camera_matrix: ArrayLike,
        distortion: ArrayLike | None = (),
        *,
        size_px: tuple[int, int],
        pixel_m: float = 5e-6,
    ) -> StarCamera:
        """The camera of `cv2.calibrateCamera`'s matrix (3, 3), px, and distortion k1, k2, p1, p2, k3: the
        inverse of `opencv_parameters`.

        `size_px` is (width, height). The pitch `pixel_m` changes no direction. `ValueError` where pixels are
        not square to 1e-3, or there are further coefficients that are not zero.
        """
        matrix = np.asarray(camera_matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or matrix[2].tolist() != [0.0, 0.0, 1.0]:
            raise ValueError(
                f"camera_matrix: (f, 0, x), (0, f, y), (0, 0, 1) expected, got {matrix.tolist()}"
            )
        (f_x, skew, x0), (_, f_y, y0), _ = matrix.tolist()
        k1, k2, p1, p2, k3, *more = np.append(() if distortion is None else distortion, np.zeros(5)).tolist()
        if not (f_x > 0.0 and abs(f_y / f_x - 1.0) < _SQUARE and abs(skew) < _SQUARE * f_x):
            alike = f"focal lengths alike to {_SQUARE:g}, no skew"
            raise ValueError(f"camera_matrix: {alike} expected, got {f_x:g}, {f_y:g}, {skew:g}")
        if any(more):
            raise ValueError(f"distortion: k1, k2, p1, p2, k3 expected, got further ones: {more}")
        focal_m = float(np.sqrt(f_x * f_y)) * pixel_m
        f = focal_m * _MM
        width, height = size_px
        pinhole = cls(
            focal_m=focal_m, pixel_m=pixel_m, width_px=width, height_px=height, principal_px=(x0, y0)
        )
        return replace(pinhole, p1=p2 / f, p2=p1 / f, q1=k1 / f**2, q2=k2 / f**4, q3=k3 / f**6)

    def _distorted(self, z: Complex) -> tuple[Complex, Floats, Complex]:
        """Distorted points of ideal points z = x + iy, mm (eq. 4); derivatives by z and by its conjugate.

        With t = p1 + i p2 eq. (5) is  z + d = s z + r^2 t, where s = 1 + q1 r^2 + q2 r^4 + q3 r^6 + 2 t.z. A
        small dz moves the distorted point by  own dz + other conj(dz), own being real; areas grow by own^2 -
        |other|^2.
        """
        t = complex(self.p1, self.p2)
        r2 = z.real * z.real + z.imag * z.imag
        sideways = 2.0 * (self.p1 * z.real + self.p2 * z.imag)
        s = r2 * (self.q1 + r2 * (self.q2 + r2 * self.q3)) + (sideways + 1.0)
        slope = self.q1 + r2 * (2.0 * self.q2 + 3.0 * r2 * self.q3)
        return s * z + r2 * t, s + (r2 * slope + sideways), z * (slope * z + 2.0 * t)

    def _is_valid(self, z: Complex, own: Floats, other: Complex) -> Bools:
        """Mask (N,) of points where the distortion is monotone and keeps orientation; arguments of
        `_distorted`.
        """
        return np.asarray((np.abs(z) < self._turning_point_mm) & (own > np.abs(other)))

    @property
    def _turning_point_mm(self) -> float:
        """Smallest radius where the distorted radius stops growing, 1 + 3 q1 r^2 + 5 q2 r^4 + 7 q3 r^6 = 0;
        inf if none.
        """
        if self.q3 != 0.0:
            squares = np.roots([7.0 * self.q3, 5.0 * self.q2, 3.0 * self.q1, 1.0])
            positive = squares.real[(np.abs(squares.imag) < 1e-9 * np.abs(squares)) & (squares.real > 0.0)]
            return math.sqrt(positive.min()) if len(positive) else math.inf
        discriminant = 9.0 * self.q1**2 - 20.0 * self.q2
        reciprocal = -3.0 * self.q1 + math.sqrt(max(discriminant, 0.0))  # of half of r^2
        return math.sqrt(2.0 / reciprocal) if discriminant >= 0.0 and reciprocal > 1e-30 else math.inf

    def _ideal_mm(self, xy_px: Floats, error_mm: float = _EXACT_MM) -> Complex:
        """Ideal points x + iy (N,), mm, of pixels (N, 2): inverse of eq. (4); NaN where there is none.

        Newton's step for a residual m is  (own m - other conj(m)) / (own^2 - |other|^2).
        """
        last_mm = math.sqrt(error_mm / _CURVATURE_PER_MM)
        if self.smooth is not None:
            xy_px = self.smooth.removed(xy_px)
        goal = (complex_of(xy_px) - complex(*self.principal_px)) * (self.pixel_m * _MM)
        if not any((self.p1, self.p2, self.q1, self.q2, self.q3)):
            return goal
        z = goal
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(25):
                distorted, own, other = self._distorted(z)
                residual = goal - distorted
                step = (own * residual - other * residual.conj()) / (own * own - np.abs(other) ** 2)
                z = z + step
                size = np.abs(step)
                if not (size >= last_mm).any():
                    break
            found = (size < last_mm) & self._is_valid(z, own, other)
        z[~found] = complex(np.nan, np.nan)
        return z

    def _differences(self, xy_px: Floats) -> Floats:
        """`pixel_jacobian` by differences of directions a tenth of a pixel apart: exact to 1e-9 of itself."""
        steps = 0.1 * np.eye(2)
        columns = [
            self.directions_from_pixels(xy_px + 0.5 * step) - self.directions_from_pixels(xy_px - 0.5 * step)
            for step in steps
        ]
        J, u = np.stack(columns, axis=2) / 0.1, self.directions_from_pixels(xy_px)
        return J - u[:, :, None] * np.einsum("ni,nij->nj", u, J)[:, None]  # a unit vector turns, only


@lru_cache(maxsize=4)  # every image of a camera asks
def _middle_axes(camera: StarCamera) -> Floats:
    x, y = 0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1)
    middle, above = camera.directions_from_pixels([[x, y], [x, y - 1.0]])
    up = above - middle * (above @ middle)
    up /= np.linalg.norm(up)
    return np.stack([np.cross(middle, up), -up, middle], axis=1)


@lru_cache(maxsize=4)
def _row_ends(camera: StarCamera) -> Floats:
    row = 0.5 * (camera.height_px - 1)
    edges = np.array([[-0.5, row], [camera.width_px - 0.5, row]])
    if camera.projection == "tangent" or np.isfinite(camera.directions_from_pixels(edges)).all():
        return edges
    pixels = np.array([[column, row] for column in range(camera.width_px)])
    seen = pixels[camera.directions_from_pixels(pixels)[:, 2] > LEAST_FORWARD]
    return seen[[0, -1]] if len(seen) else edges


@lru_cache(maxsize=4)
def _fov_x(camera: StarCamera) -> float:
    left, right = camera.directions_from_pixels(_row_ends(camera))
    return float(2.0 * np.arcsin(0.5 * np.linalg.norm(right - left)))


def _radially(z: Complex, f_mm: float, factor: Callable[[Floats], Floats]) -> Complex:
    """Points z (N,), mm, with their radii multiplied by a function of radius over f."""
    return np.asarray(z * factor(np.maximum(np.abs(z) / f_mm, 1e-12)))


# Radius r over f against the tangent of the angle t: r / tan t of tangents, and tan t / r of radii, NaN from
# t = 90 deg.
_RADIUS_OVER_TANGENT: dict[str, Callable[[Floats], Floats]] = {
    "equidistant": lambda tangent: np.arctan(tangent) / tangent,
    "stereographic": lambda tangent: 2.0 / (1.0 + np.sqrt(1.0 + tangent * tangent)),
}
_TANGENT_OVER_RADIUS: dict[str, Callable[[Floats], Floats]] = {
    "equidistant": lambda angle: np.where(angle < 0.5 * np.pi, np.tan(angle) / angle, np.nan),
    "stereographic": lambda radius: np.where(radius < 2.0, 1.0 / (1.0 - 0.25 * radius * radius), np.nan),
}


def complex_of(points: Floats) -> Complex:
    """x + iy of points (N, 2)."""
    return np.ascontiguousarray(points).view(np.complex128)[:, 0]


def pairs_of(z: Complex) -> Floats:
    """Points (N, 2) of x + iy."""
    return z.view(float).reshape(-1, 2)


def _normalised(tangents: Floats) -> Floats:
    """Unit vectors (N, 3) of points (N, 2) of the tangent plane."""
    v = np.column_stack([tangents, np.ones(len(tangents))])
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _points(xy_px: ArrayLike) -> Floats:
    xy = np.asarray(xy_px, dtype=float)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"xy_px must have shape (N, 2), got {xy.shape}")
    return xy


def _inverse_2x2(J: Floats) -> Floats:
    a, b, c, d = J[:, 0, 0], J[:, 0, 1], J[:, 1, 0], J[:, 1, 1]
    inverse = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return inverse / (a * d - b * c)[:, None, None]
