"""Errors of the attitude and camera of one image, what the camera model cannot explain included.

The pixels of directions are the camera's model plus a smooth distortion, a sum of Legendre polynomials of the
image's coordinates to the sixth degree, each with a Gaussian coefficient of variance t^2 / 2^degree. The size
t, and the variance v of an error that each star has for itself, are those of the largest evidence; the
coefficients are marginalised. So a lens that the model does not explain makes the stated errors of centre and
field of view as large as a smooth distortion of that size would, however many stars there are: their
residuals are alike where they are near to one another.

The linear terms that no camera has, a stretch along one direction of the image, are of another cause than the
lens: refraction compresses the sky along the vertical, a rolling shutter or resampling stretches rows. Their
size, too, is that of the largest evidence. What stretches an image changes its scale by as much, which no
star of this image shows: it enters the error of the field of view. A stretch along a diagonal may be a shear,
that of a rolling shutter, half of which is a rotation: it enters the error of the roll.

Unknowns are a rotation of the image's centre (3), about the axes of s, the camera's parameters (seven of a
fitted camera; the focal length of one that was given and does not fit), the stretch (2) and the coefficients.
A rotation about the image's centre is nearly independent of all parameters; a rotation about the optical
axis, which may lie anywhere, would be a small difference of large terms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.linalg import cho_solve

from boresight.geometry.star_camera import StarCamera, term_orders
from boresight.records.record import Floats, array, record, scalar
from boresight.star_id.camera_fit import (
    PARAMETERS,
    SMALL_STEP,
    CameraFit,
    pixel_derivatives,
    smooth_derivatives,
)
from boresight.star_id.common_variance import (
    PER_PARAMETER,
    ROUNDS,
    SMALL_CHANGE,
    common_variance,
    share_by_evidence,
    zero_of_falling,
)

__all__ = ["SIZES_PX", "LensEquations", "LensErrors", "lens_errors", "stretch_size", "with_common_variance"]

# Degree of the polynomials of a smooth distortion of one image: one image does not show finer structure.
_DEGREE = 6
# Powers (i, j) of x and y of its terms.
_TERMS = term_orders(_DEGREE)
# Prior sizes, px, that are compared by evidence, in ratios of 1.6: of a stretch along one direction
# (displacement at the ends of the longer side), and of a smooth distortion of a lens.
SIZES_PX = np.geomspace(1e-3, 1e2, 26, dtype=np.float64)
# Squared error of an image's scale over the squared size of a stretch that is seen: 1 in the mean of rolling
# shutters of any direction, which move images along one axis of the detector, and 2 of refraction, along any
# direction. No star tells which, so that it is the geometric mean.
_SCALE_BY_STRETCH2 = np.sqrt(2.0)
# The parameter of a given camera that is an unknown where it does not fit: a lens's focal length changes with
# temperature, and all angles with the Earth's velocity.
_FOCAL = ("focal_m",)
# Of the search for the largest evidence, in logarithms of sizes: step of the numerical derivatives, least
# curvature that is assumed, and longest step (set by hand).
_DERIVATIVE_STEP, _LEAST_CURVATURE, _LONGEST_STEP = 0.1, 0.3, 0.8


@record(kw_only=True)
class LensErrors:
    """Errors of P unknowns: a rotation (3) and F of the camera, the two of a stretch if one is seen, and the
    coefficients of a smooth distortion if one is seen."""

    camera: StarCamera = scalar("as fitted, or given")
    free: tuple[str, ...] = scalar("F names of its parameters")
    slopes: Floats = array("P, 4", "rotation of the image's centre (3) and field of view, rad, by unknown")
    mean: Floats = array("P", "of the unknowns, about the fit")
    covariance: Floats = array("P, P", "of the unknowns")
    common_px2: float = scalar("variance along one axis of an error of each star's own, px^2")
    stretch_px: float = scalar("1-sigma size of the stretch at the ends of the longer side, px; 0: none seen")

    def of_centre(self) -> tuple[Floats, float]:
        """Covariance (3, 3) of a rotation of the image's centre about the axes of s, rad^2, and 1-sigma error
        of the field of view, rad, of a fitted camera. A distortion that is seen, but not in the camera,
        counts as an error; so does half of a shear, if the stretch is that of one."""
        turn, cov_s = self._turn()
        other, field = self.mean.copy(), self.slopes[:, 3]
        if self.stretch_px:
            cov_s = cov_s + self._shear()
            other[self._diagonal - 1 : self._diagonal + 1] = 0.0
        scale2 = _SCALE_BY_STRETCH2 * (self.stretch_px / self._half_px * self.camera.fov_x_rad) ** 2
        sigma2 = field @ self.covariance @ field + (field @ other) ** 2 + scale2
        return cov_s + np.outer(turn, turn), float(np.sqrt(sigma2))

    def turned(self) -> tuple[Floats, Floats]:
        """Rotation (3,) of the image's centre, about the axes of s, and its covariance (3, 3), rad^2: of a
        given camera, whose attitude follows what displaces the stars. A stretch along a diagonal may be half
        of a shear along rows or columns: the covariance has a rotation of its size."""
        turn, cov_s = self._turn()
        return turn, cov_s + self._shear() if self.stretch_px else cov_s

    def predict(self, u_s: Floats, xy_px: Floats) -> tuple[Floats, Floats]:
        """Places (N, 2), px, and covariances (N, 2, 2), px^2, of stars in directions (N, 3), frame s, that
        the camera images at `xy_px` (N, 2)."""
        columns = self._columns(u_s, xy_px)
        cov = _multiplied(columns, self.covariance) @ columns.transpose(0, 2, 1)
        return xy_px + columns @ self.mean, cov + self.common_px2 * np.eye(2)

    def displaced_px(self) -> float:
        """Root mean square displacement along one axis, px, over the detector, by which the stars depart from
        the camera: scale, stretch and smooth distortion, less the best-fitting rotation."""
        if not self.mean.any():  # a fitted camera that explains its stars
            return 0.0
        node, weight = np.polynomial.legendre.leggauss(_DEGREE + 1)  # the mean of its squares is exact
        places = 1.0 + np.stack(np.meshgrid(node, node), axis=2).reshape(-1, 2)
        xy = 0.5 * (places * [self.camera.width_px, self.camera.height_px] - 1.0)
        columns = self._columns(self.camera.directions_from_pixels(xy), xy)
        seen = np.isfinite(columns).all(axis=(1, 2))
        share = np.outer(weight, weight).ravel()[seen]
        columns = (columns[seen] * np.sqrt(share / share.sum())[:, None, None]).reshape(-1, len(self.mean))
        moved = columns @ self.mean
        moved = moved - columns[:, :3] @ np.linalg.lstsq(columns[:, :3], moved, rcond=None)[0]
        return float(np.sqrt(0.5 * (moved**2).sum()))

    def _columns(self, u_s: Floats, xy_px: Floats) -> Floats:
        return _columns(self.camera, u_s, xy_px, self.slopes, self.free, stretched=self.stretch_px > 0.0)

    def _turn(self) -> tuple[Floats, Floats]:
        """Rotation (3,) of the image's centre, and its covariance (3, 3); a stretch alone turns nothing."""
        to_turn = np.eye(3, len(self.mean))
        if self.stretch_px:
            k = self._diagonal
            to_turn[:, k - 1 : k + 1] = self.slopes[k - 1 : k + 1, :3].T
        return to_turn @ self.mean, to_turn @ self.covariance @ to_turn.T

    def _shear(self) -> Floats:
        """Covariance (3, 3) of the rotation about the axis if the diagonal stretch is half of a shear."""
        axis, k = self.camera.middle_axes()[:, 2], self._diagonal
        rotation2 = float(self.mean[k] ** 2 + self.covariance[k, k]) / self._half_px**2
        return np.asarray(rotation2 * np.outer(axis, axis))

    @property
    def _diagonal(self) -> int:
        """Which unknown is the stretch along the diagonals, if one is seen."""
        return 3 + len(self.free) + 1

    @property
    def _half_px(self) -> float:
        return 0.5 * max(self.camera.width_px, self.camera.height_px)


@record(kw_only=True)
class LensEquations:
    """Linear equations for the residuals of the K kept stars of a fit to one image, in P unknowns."""

    camera: StarCamera = scalar("as fitted, or given")
    free: tuple[str, ...] = scalar("names of its parameters that are unknowns")
    variance_factor: float = scalar("of the fit")
    u_s: Floats = array("K, 3", "directions, frame s")
    xy_px: Floats = array("K, 2", "pixels that the camera predicts")
    residual_px: Floats = array("K, 2", "measured minus predicted")
    cov_px: Floats = array("K, 2, 2", "covariances of the centroids, px^2")
    slopes: Floats = array("P, 4", "as in `LensErrors`")
    columns: Floats = array("K, 2, P", "derivatives of the pixels by the unknowns")
    sigma: Floats = array("Q", "prior 1-sigma sizes of the first Q unknowns; inf without one")
    stretch_px: float = scalar("prior size of the stretch; 0 where it is not among the unknowns", default=0.0)

    @classmethod
    def of(cls, fit: CameraFit, u_s: Floats, cov_px: Floats, prior: Mapping[str, float]) -> LensEquations:
        """With rotation and camera as unknowns, of a fit to stars in directions (N, 3), frame s, with
        centroid covariances (N, 2, 2), px^2.

        `prior` holds the 1-sigma deviations of the camera's parameters. `numpy.linalg.LinAlgError` where a
        star lies beyond the turning point of the fitted distortion.
        """
        u_s, slopes = u_s[fit.keep], _camera_slopes(fit.camera, PARAMETERS)
        xy = fit.camera.pixels_from_directions(u_s)
        if not np.isfinite(xy).all():
            raise np.linalg.LinAlgError("the fitted camera cannot image all of the stars")
        return cls(
            camera=fit.camera,
            free=PARAMETERS,
            variance_factor=fit.variance_factor,
            u_s=u_s,
            xy_px=xy,
            residual_px=fit.residual_px[fit.keep],
            cov_px=cov_px[fit.keep],
            slopes=slopes,
            columns=_columns(fit.camera, u_s, xy, slopes, PARAMETERS, stretched=False),
            sigma=np.append(np.full(3, np.inf), [prior.get(name, np.inf) for name in PARAMETERS]),
        )

    @classmethod
    def of_given(cls, camera: StarCamera, u_s: Floats, xy_px: Floats, cov_px: Floats) -> LensEquations:
        """With rotation and focal length as unknowns, of a camera that was given: stars in directions (N, 3),
        frame s, measured at (N, 2), px, with centroid covariances (N, 2, 2), px^2."""
        slopes, xy = _camera_slopes(camera, _FOCAL), camera.pixels_from_directions(u_s)
        return cls(
            camera=camera,
            free=_FOCAL,
            variance_factor=1.0,
            u_s=u_s,
            xy_px=xy,
            residual_px=xy_px - xy,
            cov_px=cov_px,
            slopes=slopes,
            columns=_columns(camera, u_s, xy, slopes, _FOCAL, stretched=False),
            sigma=np.full(3 + len(_FOCAL), np.inf),
        )

    def stretched(self, size_px: float) -> LensEquations:
        """With a stretch of that size as two more unknowns."""
        points = _slope_points(self.camera)
        more = self._with(points, _stretch_derivatives(self.camera, points), size_px)
        return replace(more, sigma=np.append(self.sigma, [size_px, size_px]))

    def displaced_px(self, xy_px: Floats, common_px2: float) -> Floats:
        """Displacements (N, 2) of pixels (N, 2) by the stretch of `stretched`; a variance, px^2, is added to
        each star's."""
        return np.asarray(_stretch_derivatives(self.camera, xy_px) @ self.solved(common_px2).mean[-2:])

    def distorted(self) -> LensEquations:
        """With the coefficients of a smooth distortion, of a size not stated, as the last unknowns."""
        points = _slope_points(self.camera)
        return self._with(points, smooth_derivatives(self.camera, points, _DEGREE), self.stretch_px)

    def _with(self, points: Floats, moved: Floats, stretch_px: float) -> LensEquations:
        """With C more unknowns, which move the images at the slopes' `points` (4, 2) by `moved` (4, 2, C)."""
        slopes = np.vstack([self.slopes, _slopes_of(*self.camera.directions_and_jacobian(points), moved)])
        columns = _columns(self.camera, self.u_s, self.xy_px, slopes, self.free, stretched=stretch_px > 0.0)
        return replace(self, slopes=slopes, columns=columns, stretch_px=stretch_px)

    def solved(self, common_px2: float) -> _Linear:
        """Solution with a variance, px^2, added to each star's along both axes."""
        return self.normal(common_px2).solved(self.sigma)

    def normal(self, common_px2: float) -> _Normal:
        """Normal equations with a variance, px^2, added to each star's along both axes."""
        return _Normal.of(self.columns, self.residual_px, self.cov_px + common_px2 * np.eye(2))

    def stretch_beside(self, solution: _Linear, common_px2: float) -> tuple[Floats, Floats]:
        """A stretch (2,) without prior, and its covariance (2, 2), if it is added to the unknowns of a
        solution with `common_px2`: other unknowns that it would change are eliminated."""
        X = _stretch_derivatives(self.camera, self.xy_px)
        WX = np.linalg.inv(self.cov_px + common_px2 * np.eye(2)) @ X
        shared = np.einsum("kiq,kip->qp", X, solution.weighted)
        normal = np.einsum("kiq,kir->qr", X, WX) - shared @ solution.covariance @ shared.T
        right = np.einsum("kiq,ki->q", WX, self.residual_px - self.columns @ solution.mean)
        return np.linalg.solve(normal, right), np.linalg.inv(normal)


def with_common_variance(equations: LensEquations, start_px2: float) -> float:
    """Variance, px^2 along one axis, of an error that each star has for itself, as the residuals of the
    solution with this variance show it."""
    own, common = 0.5 * np.trace(equations.cov_px, axis1=1, axis2=2), start_px2
    for _ in range(ROUNDS):
        solution = equations.solved(common)
        residual = equations.residual_px - equations.columns @ solution.mean
        square = (residual**2).sum(axis=1)
        before, common = common, common_variance(square, solution.leverage, own, common)
        if abs(common - before) <= SMALL_CHANGE * before:
            break
    return common


def stretch_size(equations: LensEquations, common_px2: float) -> float:
    """1-sigma size, px, of a stretch by its evidence; 0 where that does not ask for one."""
    mean, covariance = equations.stretch_beside(equations.solved(common_px2), common_px2)
    return _likely_size(mean, equations.variance_factor * covariance)


def lens_errors(equations: LensEquations, common_px2: float, stretch_px: float) -> LensErrors:
    """Errors of the camera and rotation of one image, with what else displaces its stars.

    `equations` are those of `LensEquations.of`; `common_px2` is a variance along one axis that is not in
    their covariances, `stretch_px` the size of a stretch. Unless the variance is 0, a smooth distortion is
    looked for, with which the variance is estimated again.
    """
    if stretch_px:
        equations = equations.stretched(stretch_px)
    plain = equations.solved(common_px2)
    is_fit = equations.free == PARAMETERS and not stretch_px  # then it is their most probable value
    mean = np.zeros(len(plain.mean)) if is_fit else plain.mean
    without = _errors(equations, plain, mean, common_px2, equations.variance_factor)
    warped = _warped(equations, plain, common_px2) if common_px2 > 0.0 else None
    return without if warped is None else _mean_of(without, *warped)


def _warped(equations: LensEquations, plain: _Linear, common_px2: float) -> tuple[LensErrors, float] | None:
    """Errors with a smooth distortion, and its share by evidence; None if it has none."""
    equations = equations.distorted()
    decay = np.tile([2.0 ** (-0.5 * (i + j)) for i, j in _TERMS], 2)
    normal = cache(equations.normal)  # one variance is tried with several sizes of the distortion

    def solved(common: float, warp: float) -> _Linear:
        return normal(common).solved(np.append(equations.sigma, warp * decay))

    def sized(size: Floats) -> tuple[float, float]:
        return float(np.exp(2.0 * size[0])), float(np.exp(size[1]))

    start = 0.5 * np.log([common_px2, 4.0 * common_px2])
    # where a smooth distortion leaves no common variance, the evidence rises ever more slowly towards zero
    least = np.array([start[0] + 0.5 * np.log(SMALL_CHANGE), -np.inf])
    if solved(*sized(start)).log_evidence <= plain.log_evidence:  # then no size raises it
        return None
    size, log_evidence = _largest(lambda size: solved(*sized(size)).log_evidence, start, least)
    share = share_by_evidence(log_evidence - plain.log_evidence, len(size) * PER_PARAMETER)
    if share == 0.0:
        return None
    common, warp = sized(size)
    posterior = solved(common, warp)
    return _errors(equations, posterior, posterior.mean, common, 1.0), share


def _mean_of(errors: LensErrors, warped: LensErrors, share: float) -> LensErrors:
    """Mean of the errors without a smooth distortion, all of whose coefficients are zero, and of those with
    one, which have this share; what they differ by is in the covariance."""
    more = (0, len(warped.mean) - len(errors.mean))
    off = warped.mean - np.pad(errors.mean, more)
    covariance = (1.0 - share) * np.pad(errors.covariance, more) + share * warped.covariance
    return replace(
        warped,
        mean=warped.mean - (1.0 - share) * off,
        covariance=covariance + share * (1.0 - share) * np.outer(off, off),
        common_px2=(1.0 - share) * errors.common_px2 + share * warped.common_px2,
    )


def _likely_size(mean: Floats, cov: Floats) -> float:
    """Size of the largest evidence, px, of a stretch (2,) that was found with a covariance (2, 2), times the
    root of its share."""
    value, vector = np.linalg.eigh(cov)
    square = (mean @ vector) ** 2

    def gained(size: Floats) -> Floats:
        t2 = size[:, None] ** 2
        return 0.5 * (square / value - square / (value + t2) - np.log1p(t2 / value)).sum(axis=1)

    def slope(size: float) -> float:
        v = value + size**2
        return float((square / v**2 - 1.0 / v).sum())

    best = min(max(int(gained(SIZES_PX).argmax()), 1), len(SIZES_PX) - 2)
    size = zero_of_falling(slope, *SIZES_PX[[best - 1, best + 1]].tolist())
    likeliest = gained(np.array([size], dtype=np.float64))
    return size * share_by_evidence(float(likeliest[0]), PER_PARAMETER) ** 0.5


def _largest(function: Callable[[Floats], float], start: Floats, least: Floats) -> tuple[Floats, float]:
    """Place (2,), nowhere below `least` (2,), and value of the maximum of a smooth function near `start` (2,)
    by Newton steps that ascend whatever the curvature (`scipy.optimize` takes 0.1 s to load)."""
    h, place = _DERIVATIVE_STEP, start
    moves = h * np.eye(2)
    for _ in range(ROUNDS):
        here, both = function(place), function(place + h)
        more, less = (np.array([function(place + sign * move) for move in moves]) for sign in (1.0, -1.0))
        slope, along, across = (more - less) / (2.0 * h), more + less - 2.0 * here, both - more.sum() + here
        held = (place <= least) & (slope < 0.0)
        slope, across = np.where(held, 0.0, slope), 0.0 if held.any() else across
        curvature, axes = np.linalg.eigh(np.array([[along[0], across], [across, along[1]]]) / h**2)
        step = axes @ (axes.T @ slope / np.maximum(np.abs(curvature), _LEAST_CURVATURE))
        length = float(np.hypot(*step))
        place = np.maximum(place + step * min(1.0, _LONGEST_STEP / max(length, SMALL_STEP)), least)
        if length < SMALL_STEP:
            break
    return place, function(place)


def _errors(
    equations: LensEquations, posterior: _Linear, mean: Floats, common_px2: float, factor: float
) -> LensErrors:
    return LensErrors(
        camera=equations.camera,
        free=equations.free,
        slopes=equations.slopes,
        mean=mean,
        covariance=factor * posterior.covariance,
        common_px2=common_px2,
        stretch_px=equations.stretch_px,
    )


@record(kw_only=True)
class _Linear:
    """Solution of linear equations with Gaussian priors."""

    mean: Floats = array("P", "of the unknowns")
    factor: Floats = array("P, P", "lower Cholesky factor of the normal matrix of unknowns over `unit`")
    unit: Floats = array("P", "of each unknown, by which the normal matrix has a diagonal of ones")
    columns: Floats = array("K, 2, P", "design")
    weighted: Floats = array("K, 2, P", "design, times the inverse covariances of the observations")
    log_evidence: float = scalar("restricted likelihood: unknowns without prior are marginalised")

    @property
    def covariance(self) -> Floats:
        """(P, P) of the unknowns."""
        inverse = cho_solve((self.factor, True), np.eye(len(self.unit)), check_finite=False)
        return np.asarray(inverse * self.unit[:, None] * self.unit)

    @property
    def leverage(self) -> Floats:
        """(K,) trace of each observation pair's part in the fit."""
        return np.einsum("kip,kip->k", _multiplied(self.columns, self.covariance), self.weighted)


@record(kw_only=True)
class _Normal:
    """Normal equations of linear equations, without priors."""

    matrix: Floats = array("P, P", "normal matrix")
    right: Floats = array("P", "right-hand side")
    columns: Floats = array("K, 2, P", "design")
    weighted: Floats = array("K, 2, P", "design, times the inverse covariances of the observations")
    squares: float = scalar("weighted sum of the squared residuals")
    log_det_weights: float = scalar("logarithm of the determinant of the inverse covariances")

    @classmethod
    def of(cls, columns: Floats, residual: Floats, cov: Floats) -> _Normal:
        """From design (K, 2, P), residuals (K, 2) and their covariances (K, 2, 2)."""
        W = np.linalg.inv(cov)
        WX = W @ columns
        flat, weighted = (part.reshape(-1, columns.shape[2]) for part in (columns, WX))
        return cls(
            matrix=flat.T @ weighted,
            right=weighted.T @ residual.ravel(),
            columns=columns,
            weighted=WX,
            squares=float(np.einsum("ki,kij,kj->", residual, W, residual)),
            log_det_weights=float(np.linalg.slogdet(W)[1].sum()),
        )

    def solved(self, sigma: Floats) -> _Linear:
        """Solution with prior sigmas (P,), inf without one."""
        weight = np.where(np.isfinite(sigma), sigma, 1.0) ** -2.0 * np.isfinite(sigma)
        normal = self.matrix + np.diag(weight)
        unit = 1.0 / np.sqrt(np.diag(normal))
        factor = np.linalg.cholesky(normal * unit[:, None] * unit)
        mean = unit * cho_solve((factor, True), unit * self.right, check_finite=False)
        log_det = 2.0 * float(np.log(np.diag(factor) / unit).sum()) - self.log_det_weights
        log_det += 2.0 * float(np.log(sigma[np.isfinite(sigma)]).sum())
        return _Linear(
            mean=mean,
            factor=factor,
            unit=unit,
            columns=self.columns,
            weighted=self.weighted,
            log_evidence=-0.5 * (self.squares - float(self.right @ mean) + log_det),
        )


def _multiplied(columns: Floats, matrix: Floats) -> Floats:
    """(N, 2, P) products of each (2, P) and one matrix (P, P), as one product."""
    return np.asarray((columns.reshape(-1, len(matrix)) @ matrix).reshape(columns.shape))


def _columns(
    camera: StarCamera, u_s: Floats, xy_px: Floats, slopes: Floats, free: tuple[str, ...], *, stretched: bool
) -> Floats:
    """(N, 2, P) derivatives of the pixels of directions (N, 3), frame s, by the unknowns."""
    (J, A), known = pixel_derivatives(camera, u_s, free), 3 + len(free)
    parts = [A, J + A @ slopes[3:known, :3].T]
    if stretched:
        parts.append(_stretch_derivatives(camera, xy_px) + A @ slopes[known : known + 2, :3].T)
        known += 2
    if len(slopes) > known:
        parts.append(smooth_derivatives(camera, xy_px, _DEGREE) + A @ slopes[known:, :3].T)
    return np.concatenate(parts, axis=2)


def _camera_slopes(camera: StarCamera, free: tuple[str, ...]) -> Floats:
    """(3 + F, 4) slopes of a rotation of the centre (the centre's error itself) and of the camera's
    parameters `free`."""
    u_s, J = camera.directions_and_jacobian(_slope_points(camera))
    return np.vstack([np.zeros((3, 4)), _slopes_of(u_s, J, pixel_derivatives(camera, u_s, free)[0])])


def _stretch_derivatives(camera: StarCamera, xy_px: Floats) -> Floats:
    """Displacements (N, 2, 2) of pixels (N, 2) by a stretch of columns against rows, and by one along one
    diagonal against the other; 1 px at the ends of the longer side."""
    half = 0.5 * max(camera.width_px, camera.height_px)
    x, y = (xy_px - 0.5 * (np.array([camera.width_px, camera.height_px]) - 1.0)).T / half
    return np.stack([np.column_stack([x, -y]), np.column_stack([y, x])], axis=2)


def _slope_points(camera: StarCamera) -> Floats:
    """(4, 2) the image's centre, the pixel above it, and the ends of the middle row, px."""
    x, y = 0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1)
    return np.vstack([[x, y], [x, y - 1.0], camera.row_ends_px()])


def _slopes_of(u_s: Floats, J: Floats, moved: Floats) -> Floats:
    """(C, 4) rotation of the centre and change of the field of view, rad, by what moves the images at
    `_slope_points` by `moved` (4, 2, C): a pixel, with the direction (4, 3) and its derivatives (4, 3, 2),
    sees what the camera's model has where it is moved from."""
    turned = -J @ moved  # (4, 3, C)
    if not np.isfinite(turned).all():  # beyond a turning point there is no direction
        raise np.linalg.LinAlgError("the lens does not reach the edges of the image")
    (middle, above, left, right), (of_middle, of_above, of_left, of_right) = u_s, turned
    x, y, z = middle.tolist()
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # the vector product of the middle with
    side, chord = across @ above, right - left
    square, length2 = side @ side, chord @ chord
    # the direction up is that of the pixel above, less its part along the middle
    roll = side @ (of_above - (above @ middle) * of_middle) / square
    rotation = across @ of_middle + np.outer(middle, roll)
    field = chord @ (of_right - of_left) / np.sqrt(length2 * (1.0 - 0.25 * length2))
    return np.vstack([rotation, field]).T
