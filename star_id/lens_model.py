"""The lens model that the stars of many images show: Brown's, Kannala and Brandt's or a stereographic lens's,
or one of these with a smooth distortion, chosen by evidence.

Brown's model to q2 is kept unless a smooth distortion (`geometry.star_camera`) explains more than
chance, or another projection, or q3. Fisheyes are tried with the stereographic projection, too, which a
polynomial about the equidistant one does not follow near 90 degrees; the widest are not tried with Brown's. A
coefficient of degree n has a Gaussian prior of variance t^2 / 2^n, so terms of rising degree count as far as
the stars determine them. The size t is that of the largest evidence, noise of unknown scale and all rotations
and camera parameters marginalised. It stays in the stated errors: where there are no stars, the distortion is
known no better than that. Models of like evidence differ by more than the errors of each: the covariance is
the mean of theirs, with their differences.

What even this leaves is seen in neighbouring stars of different images: the mean product of their residuals
is the variance of the unmodelled map, free of noise. A step where a detector is stitched displaces few near
neighbours, but all stars along a column or row: stars of like columns, or rows, are compared too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import SmoothDistortion, StarCamera, term_orders
from boresight.records.record import Bools, Floats, Ints, array, inner, record, scalar
from boresight.star_id.beyond_chance import MEDIAN_CHI2, SELDOM_SIGMA
from boresight.star_id.camera_fit import (
    PARAMETERS,
    Q3,
    CameraFit,
    IdentifiedStars,
    detector_grid,
    fit_camera,
    pixel_derivatives,
    smooth_derivatives,
)
from boresight.star_id.lens_misfit import SIZES_PX

__all__ = [
    "CLEARLY_MORE",
    "LARGEST_UNMODELLED_PX",
    "TANGENT_RAD",
    "WIDE_RAD",
    "LensModel",
    "choose_lens",
    "unmodelled_px",
]

# Degree of the polynomials of a smooth distortion of a lens, from many images.
_DEGREE = 10
# Gain of log evidence by a smooth distortion for it to be taken: e^4, 55 to 1.
_SEEN = 4.0
# Field of view, rad, from which a lens may be a fisheye (set by hand), and angle of a star from the axis
# beyond which it may be stereographic: to there q1 to q3 follow tan(t/2) to 1e-7 of the radius.
WIDE_RAD = np.radians(45.0)
# Angle of a star from the axis, rad, beyond which a lens has no tangent projection: lenses with one image
# 110 deg at most, their corners 65 deg from the axis.
TANGENT_RAD = np.radians(70.0)
# Ratio of stars without gross errors from which they are those of another projection: Brown's loses the
# edges of fisheyes (set by hand).
CLEARLY_MORE = 1.1
# Fewest pairs of stars near one another that show a distortion left over.
_FEWEST_PAIRS = 50
# Largest distortion, px, that the chosen lens model may leave unexplained; beyond it errors near sharp
# structure exceed twice what is stated, and the lens is refused (benchmarks/star_cameras.py). Pairs of stars
# have at least this error: stated ones of bright stars are smaller than what the PSF is wrong by.
LARGEST_UNMODELLED_PX = 0.01
# Prior displacement of the corner by q3, as a share of its radius: larger ones do not occur in lenses that
# q1 and q2 describe (set by hand).
_Q3_CORNER = 0.002
# Distances, as shares of the detector's width, within which stars may see the same distortion; the middle one
# between columns, or between rows, too, for steps of a detector.
_NEAR = (0.01, 0.02, 0.05)
# Most pairs that are formed: 16 MB; of more stars narrower lines are compared.
_MOST_PAIRS = 1_000_000


_Case = TypeVar("_Case")
_Fitted = TypeVar("_Fitted")


@record(kw_only=True)
class LensModel:
    """A camera with C coefficients of a smooth distortion (none: C = 0), and its F + C errors."""

    camera: StarCamera = scalar("with the chosen parameters")
    fitted: tuple[str, ...] = scalar("names, of PARAMETERS and Q3")
    parameters: tuple[str, ...] = scalar("F names of those with errors: q3 may be doubtful, and not fitted")
    covariance: Floats = array("P, P", "of parameters (own units) and coefficients (px); P = F + C")
    size_px: float = scalar("prior 1-sigma size t of the smooth distortion, px; 0 without one")
    used: float = scalar("degrees of freedom that the coefficients use")
    fit: CameraFit = scalar("of `parameters`, the smooth distortion held")


def choose_lens(stars: IdentifiedStars, camera: StarCamera, rotations: Rotation) -> LensModel:
    """Lens model of identified stars (N) of K images; `camera` and `rotations` (K,) are approximate.

    A projection whose fit fails is not chosen; `numpy.linalg.LinAlgError` where all fail.
    """
    bases = _projections(stars, camera, rotations)
    fits = [*_each(lambda base: _good_stars(stars, base, rotations), bases)]
    if not fits:
        raise np.linalg.LinAlgError("no projection can be fitted")
    plain, good = max(fits, key=lambda fit: fit[1].sum())
    if good.sum() < CLEARLY_MORE * fits[0][1].sum():
        plain, good = fits[0]
    placed = stars.xy_px[good], stars.cov_px[good]
    inner = IdentifiedStars(*placed, stars.u_i[good], stars.frame[good], stars.t_s)
    cases = [(base, free) for free in (PARAMETERS, (*PARAMETERS, Q3)) for base in bases]
    trials = [*_each(lambda case: _Trial.of(inner, case[0], rotations, case[1]), cases)]
    if not trials:
        raise np.linalg.LinAlgError("no projection can be fitted to the stars without gross errors")
    first = trials[0]
    best = max(trials, key=lambda trial: trial.log_evidence)
    is_plain = not first.size_px and first.camera.projection == plain.camera.projection
    if best.log_evidence > first.log_evidence + _SEEN:
        chosen = best.model(stars)
    else:
        chosen = _model(plain, PARAMETERS) if is_plain else first.model(stars)
    return chosen if chosen.size_px else replace(chosen, covariance=_covariance(chosen.camera, trials))


def _projections(stars: IdentifiedStars, camera: StarCamera, rotations: Rotation) -> tuple[StarCamera, ...]:
    """The start of each projection that a lens with these stars may have."""
    brown = replace(camera, smooth=None, q3=0.0, projection="tangent")
    if camera.projection != "tangent":
        brown = replace(brown, q1=0.0, q2=0.0)
    equidistant = replace(brown, projection="equidistant", q1=0.0, q2=0.0)
    stereographic = replace(equidistant, projection="stereographic")
    along_axis = np.einsum("nj,nj->n", rotations.as_matrix()[stars.frame, 2], stars.u_i)
    widest = np.arccos(np.clip(along_axis.min(), -1.0, 1.0))
    if widest > TANGENT_RAD:
        return equidistant, stereographic
    return (brown, equidistant, stereographic) if widest > WIDE_RAD else (brown, equidistant)


def _each(fit: Callable[[_Case], _Fitted], cases: Iterable[_Case]) -> Iterator[_Fitted]:
    """The fits of those cases in which it succeeds."""
    for case in cases:
        try:
            yield fit(case)
        except np.linalg.LinAlgError:
            continue


def _model(fit: CameraFit, free: tuple[str, ...]) -> LensModel:
    """The model of a fit, without smooth distortion; its covariance is that of `_covariance`."""
    every = (*PARAMETERS, Q3)
    none = np.zeros((len(every), len(every)))
    return LensModel(
        camera=fit.camera, fitted=free, parameters=every, covariance=none, size_px=0.0, used=0.0, fit=fit
    )


def _covariance(camera: StarCamera, trials: list[_Trial]) -> Floats:
    """Covariance (8, 8) of PARAMETERS and Q3 of a camera without smooth distortion.

    It is the mean, by evidence, of those of the models without, each with the square of its difference from
    the camera; differences and covariances of other models are those of parameters that give the same map.
    """
    every = (*PARAMETERS, Q3)
    smooth_free = [trial for trial in trials if not trial.size_px]
    evidence = np.array([trial.log_evidence for trial in smooth_free])
    share = np.exp(evidence - evidence.max())
    grid = detector_grid(camera)
    u_s = camera.directions_from_pixels(grid)
    design = np.concatenate(pixel_derivatives(camera, u_s, every), axis=2)
    total = np.zeros((len(every), len(every)))
    for trial, weight in zip(smooth_free, share / share.sum()):
        off = trial.camera.pixels_from_directions(u_s) - grid
        seen = np.isfinite(off).all(axis=1)  # of wide fields the corners may have no direction
        J, _ = pixel_derivatives(trial.camera, u_s[seen], trial.free)
        columns = design[seen].reshape(-1, design.shape[2])
        unit = 1.0 / np.linalg.norm(columns, axis=0)
        wanted = np.concatenate([J, off[seen, :, None]], axis=2).reshape(len(columns), -1)
        alike = np.linalg.lstsq(columns * unit, wanted, rcond=None)[0] * unit[:, None]
        by_parameter, off = alike[: len(every), :-1], alike[: len(every), -1]
        own = max(1.0, trial.solved.scale) * trial.solved.covariance
        total += weight * (by_parameter @ own @ by_parameter.T + np.outer(off, off))
    return total


def unmodelled_px(xy_px: Floats, residual_px: Floats, sigma_px: Floats, frame: Ints, width_px: int) -> float:
    """Root mean square, along one axis, of what the lens model leaves of the pixel map, px; 0 if not
    significant. Residuals (N, 2) of stars at (N, 2), errors (N,) along one axis, in images `frame` (N,)."""
    found, line = [0.0], min(_NEAR[1], _MOST_PAIRS / len(xy_px) ** 2)
    alike = [(xy_px, near) for near in _NEAR] + [(xy_px[:, [axis]], line) for axis in (0, 1)]
    for places, near in alike:
        pairs = cKDTree(places).query_pairs(near * width_px, output_type="ndarray")
        pairs = pairs[frame[pairs[:, 0]] != frame[pairs[:, 1]]]
        if len(pairs) >= _FEWEST_PAIRS:
            found.append(_shared_px(residual_px, sigma_px, *pairs.T))
    return max(found)


def _shared_px(residual_px: Floats, sigma_px: Floats, a: Ints, b: Ints) -> float:
    """Root mean product of the residuals of pairs of stars `a`, `b` (K,), px; 0 if not significant."""
    variance = 0.0
    for _ in range(3):  # the weight of a pair depends on the variance that is sought
        noise2 = sigma_px**2 + max(variance, LARGEST_UNMODELLED_PX**2)
        weight = 1.0 / (noise2[a] * noise2[b])
        limit = SELDOM_SIGMA * np.sqrt(noise2)[:, None]
        clipped = np.clip(residual_px, -limit, limit)
        product = 0.5 * weight * (clipped[a] * clipped[b]).sum(axis=1)
        # a star is in several pairs: the error is that of the sums by star
        by_star = np.bincount(a, product, minlength=len(sigma_px))
        variance = float(product.sum() / weight.sum())
        error = float(np.sqrt((by_star**2).sum()) / weight.sum())
    return float(np.sqrt(variance)) if variance > SELDOM_SIGMA * error else 0.0


def _good_stars(stars: IdentifiedStars, camera: StarCamera, rotations: Rotation) -> tuple[CameraFit, Bools]:
    """The fit of one projection to all stars, and the stars (N,) that are no gross errors."""
    plain = fit_camera(stars, camera, rotations)
    return plain, _without_gross(stars, plain)


def _without_gross(stars: IdentifiedStars, plain: CameraFit) -> Bools:
    """(N,) which stars agree with their neighbours under the most flexible model."""
    keep = np.ones(len(stars.xy_px), dtype=bool)
    for _ in range(4):  # rejecting outliers and fitting again
        system = _System.of(stars, plain, PARAMETERS, keep)
        residual = system.residual - system.columns @ system.solved(1.0).mean
        chi2 = 0.5 * (residual**2).sum(axis=1) / (0.5 * np.trace(stars.cov_px, axis1=1, axis2=2))
        limit = SELDOM_SIGMA**2 * max(1.0, 2.0 * float(np.median(chi2)) / MEDIAN_CHI2)
        before, keep = keep, chi2 < limit
        if np.array_equal(before, keep):
            break
    return keep


@record(kw_only=True)
class _Solved:
    """Posterior with one size of the smooth distortion."""

    mean: Floats = array("P", "of F parameters and C coefficients, from the start")
    lower: Floats = array("P, P", "Cholesky factor of the normal matrix, its diagonal scaled to 1")
    unit: Floats = array("P", "of each unknown, by that scale")
    smooth: Floats = array("C", "prior precision of the coefficients")
    scale: float = scalar("reduced chi2")
    log_evidence: float = scalar("of the noise's scale marginalised")

    @property
    def covariance(self) -> Floats:
        """(P, P) with unit noise scale."""
        return cho_solve((self.lower, True), np.eye(len(self.unit))) * self.unit[:, None] * self.unit

    @property
    def used(self) -> float:
        """Degrees of freedom of the coefficients."""
        own = np.diag(self.covariance)[len(self.unit) - len(self.smooth) :]
        return len(self.smooth) - float(self.smooth @ own)


@record(kw_only=True)
class _System:
    """Normal equations of F parameters and C coefficients, rotations eliminated."""

    normal: Floats = array("P, P", "information")
    right: Floats = array("P", "gradient")
    chi2: float = scalar("at the start")
    dof: float = scalar("observations less rotations and parameters")
    prior: Floats = array("F", "precision of the parameters: only of q3")
    columns: Floats = array("N, 2, P", "design, rotations eliminated by the images' own")
    residual: Floats = array("N, 2", "at the start")

    @classmethod
    def of(cls, stars: IdentifiedStars, fit: CameraFit, free: tuple[str, ...], keep: Bools) -> _System:
        """The equations about a fit; stars that are not in `keep` (N,) have no weight.

        `numpy.linalg.LinAlgError` where a star lies beyond the turning point of the fitted distortion.
        """
        camera = fit.camera
        u_s = np.einsum("nij,nj->ni", fit.rotations.as_matrix()[stars.frame], stars.u_i)
        xy = camera.pixels_from_directions(u_s)
        if not np.isfinite(xy).all():
            raise np.linalg.LinAlgError("the fitted camera cannot image all of the stars")
        (J, A), residual = pixel_derivatives(camera, u_s, free), stars.xy_px - xy
        J = np.concatenate([J, smooth_derivatives(camera, xy, _DEGREE)], axis=2)
        W = np.linalg.inv(stars.cov_px) * keep[:, None, None]
        for k in range(len(stars.t_s)):
            rows = stars.frame == k
            AW = (A[rows].transpose(0, 2, 1) @ W[rows]).transpose(1, 0, 2).reshape(3, -1)
            both = np.concatenate([J[rows], residual[rows, :, None]], axis=2)
            taken = np.linalg.solve(AW @ A[rows].reshape(-1, 3), AW @ both.reshape(-1, both.shape[2]))
            both = both - A[rows] @ taken
            J[rows], residual[rows] = both[:, :, :-1], both[:, :, -1]
        WJ = (W @ J).reshape(-1, J.shape[2])
        prior = np.zeros(len(free))
        if Q3 in free:
            corner_mm = 0.5e3 * np.hypot(camera.width_px, camera.height_px) * camera.pixel_m
            prior[free.index(Q3)] = (_Q3_CORNER / corner_mm**6) ** -2.0
        return cls(
            normal=J.reshape(WJ.shape).T @ WJ,
            right=WJ.T @ residual.ravel(),
            chi2=float(np.einsum("ni,nij,nj->", residual, W, residual)),
            dof=float(2 * keep.sum() - 3 * len(stars.t_s) - len(free)),
            prior=prior,
            columns=J,
            residual=residual,
        )

    def likeliest_size_px(self) -> float:
        """1-sigma size of the smooth distortion of the largest evidence, between those compared, too:
        of two alike ones rounding would choose."""

        def against(log_size: float) -> float:
            return -self.solved(float(np.exp(log_size))).log_evidence

        sizes = np.log(SIZES_PX)
        best = min(max(int(np.argmin([against(size) for size in sizes])), 1), len(sizes) - 2)
        bounds = sizes[best - 1], sizes[best + 1]
        return float(np.exp(scipy.optimize.minimize_scalar(against, bounds=bounds, method="bounded").x))

    def solved(self, size_px: float) -> _Solved:
        """Posterior with a smooth distortion of 1-sigma size; 0: without one."""
        F = len(self.prior)
        rows = slice(None) if size_px else slice(F)
        orders = [float(i + j) for i, j in term_orders(_DEGREE if size_px else 0)]
        precision = np.append(self.prior, np.exp2(np.tile(orders, 2)) / max(size_px, 1e-9) ** 2)
        normal = self.normal[rows, rows] + np.diag(precision)
        unit = 1.0 / np.sqrt(np.diag(normal))
        factor = cho_factor(normal * unit[:, None] * unit, lower=True)
        mean = unit * cho_solve(factor, unit * self.right[rows])
        chi2 = max(self.chi2 - float(self.right[rows] @ mean), 1e-9)
        log_det = 2.0 * float(np.log(np.diag(factor[0]) / unit).sum())
        log_det -= float(np.log(precision[precision > 0.0]).sum())
        return _Solved(
            mean=mean,
            lower=factor[0],
            unit=unit,
            smooth=precision[F:],
            scale=chi2 / self.dof,
            log_evidence=-0.5 * (self.dof * np.log(chi2 / self.dof) + log_det),
        )


@record(kw_only=True)
class _Trial:
    """One projection and set of parameters with its most probable smooth distortion."""

    camera: StarCamera = scalar("fitted, without smooth distortion")
    rotations: Rotation = array("K", "fitted")
    free: tuple[str, ...] = scalar("parameters")
    size_px: float = scalar("1-sigma size of the smooth distortion, px; 0 without one")
    solved: _Solved = scalar("posterior")
    log_evidence = inner[float]("solved.log_evidence", "of the model with its likeliest smooth distortion")

    @classmethod
    def of(
        cls, stars: IdentifiedStars, camera: StarCamera, rotations: Rotation, free: tuple[str, ...]
    ) -> _Trial:
        fit = fit_camera(stars, camera, rotations, free)
        system = _System.of(stars, fit, free, np.ones(len(stars.xy_px), dtype=bool))
        size, without = system.likeliest_size_px(), system.solved(0.0)
        solved = system.solved(size)
        if solved.log_evidence <= without.log_evidence + _SEEN:
            size, solved = 0.0, without
        return cls(camera=fit.camera, rotations=fit.rotations, free=free, size_px=size, solved=solved)

    def model(self, stars: IdentifiedStars) -> LensModel:
        """The model, fitted to all stars with the smooth distortion held at its mean."""
        camera, F = self.camera, len(self.free)
        if self.size_px:
            smooth = SmoothDistortion(
                degree=_DEGREE,
                coefficients_px=self.solved.mean[F:].reshape(2, -1),
                width_px=camera.width_px,
                height_px=camera.height_px,
            )
            camera = replace(camera, smooth=smooth)
        fit = fit_camera(stars, camera, self.rotations, self.free)
        if not self.size_px:
            return _model(fit, self.free)
        return LensModel(
            camera=fit.camera,
            fitted=self.free,
            parameters=self.free,
            covariance=max(1.0, self.solved.scale) * self.solved.covariance,
            size_px=self.size_px,
            used=self.solved.used,
            fit=fit,
        )
