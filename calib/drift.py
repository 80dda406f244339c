"""Does the mounting move? Calibrations of one pair of cameras at several times: their mean, their course.

Each calibration k, made at t_k, gives theta_k (frame c, rad, the paper's sign: R_cs = exp[[theta]] R_cs_ref)
with its covariance C_k, all other unknowns eliminated with their priors. Taken as independent of one another,

    theta_k = theta(t_k) + a cos(u_k) + b sin(u_k) + e_k,    e_k ~ N(0, C_k)

with u the argument of latitude (the thermal change around the orbit; only when asked for), and theta(t)
either a value of its own at each k, or constant, or constant but for one step, or a random walk of density
q (rad²/s on each axis). What all calibrations share, such as an error of the camera's distortion, moves them
all alike: it makes no drift, and it is not in the covariance of the mean either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import brentq, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import chi2 as chi2_distribution

from calib.information import ExactSum
from geometry.installation import deviation_from_theta, theta_between

__all__ = [
    "Drift",
    "DriftSettings",
    "LinearFit",
    "MergedMounting",
    "MountingSeries",
    "OrbitPhaseTerm",
    "RandomWalk",
    "StepFit",
    "estimate_drift",
]

Array = NDArray[np.float64]

# Between two calibrations of one mounting; beyond, the axes of their covariances are not the same.
MOST_TURN_RAD = 0.02


@dataclass(frozen=True, slots=True)
class DriftSettings:
    """What is asked of a series of calibrations."""

    probability_false_alarm: float = 0.01  # of calling a mounting at rest moved, both tests together
    confidence: float = 0.95  # of the intervals of the step's date and of the walk's density
    density_rad2_s: float | None = None  # of the random walk, rad²/s on each axis; None: estimated
    orbit_phase: bool = False  # fit a term of the argument of latitude

    def __post_init__(self) -> None:
        for name in ("probability_false_alarm", "confidence"):
            if not 0.0 < (value := getattr(self, name)) < 1.0:
                raise ValueError(f"{name} must lie between 0 and 1, got {value}")
        if self.density_rad2_s is not None and not 0.0 <= self.density_rad2_s < np.inf:
            raise ValueError(f"density_rad2_s must be 0 or more, got {self.density_rad2_s}")


@dataclass(frozen=True, slots=True, eq=False)
class MountingSeries:
    """Calibrations of one mounting in the order of time, about one reference: constant over each, free
    between.
    """

    names: tuple[str, ...]  # K
    t_s: Array  # (K,) increasing
    theta: Array  # (K, 3) rad, frame c, against R_cs_ref
    covariance: Array  # (K, 3, 3) rad², frame c
    cos_sin: Array  # (K, 2) of the argument of latitude, means over the strips of each; NaN where not known
    R_cs_ref: Rotation

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        t_s: Array,
        R_cs: Rotation,
        covariance: Array,
        cos_sin: Array | None = None,
    ) -> MountingSeries:
        """A series from K matrices and their covariances, in any order; the earliest matrix is the reference.

        Raises
        ------
        ValueError
            For fewer than two calibrations, a name or an instant that occurs twice, matrices more than 0.02
            rad apart (another mounting, or other frames), a covariance that is not positive definite.
        """
        K = len(names)
        t, C = np.asarray(t_s, dtype=float), np.asarray(covariance, dtype=float)
        phase = np.full((K, 2), np.nan) if cos_sin is None else np.asarray(cos_sin, dtype=float)
        if K < 2:
            raise ValueError(f"{K} calibrations show no course of time, 2 are needed")
        if t.shape != (K,) or len(R_cs) != K or C.shape != (K, 3, 3) or phase.shape != (K, 2):
            raise ValueError(
                f"{K} names need t_s {(K,)}, {K} matrices, covariance {(K, 3, 3)}, cos_sin {(K, 2)}; "
                f"got {t.shape}, {len(R_cs)}, {C.shape}, {phase.shape}"
            )
        order = np.argsort(t, kind="stable")
        ids = tuple(str(names[k]) for k in order)
        t, C, R, phase = t[order], C[order], R_cs[order], phase[order]
        if len(set(ids)) < K:
            raise ValueError(f"calibration {next(n for n in ids if ids.count(n) > 1)!r} is given twice")
        if not np.all(np.isfinite(t)):
            raise ValueError("every calibration needs a time")
        for k in np.flatnonzero(np.diff(t) <= 0.0):
            raise ValueError(f"calibrations {ids[k]!r} and {ids[k + 1]!r} speak of one and the same time")
        for k in range(K):
            if not np.all(np.isfinite(C[k])) or np.linalg.eigvalsh(0.5 * (C[k] + C[k].T))[0] <= 0.0:
                raise ValueError(f"calibration {ids[k]!r}: its covariance is not positive definite")
        theta = theta_between(R, R[0])
        for k in np.flatnonzero(np.linalg.norm(theta, axis=1) > MOST_TURN_RAD):
            raise ValueError(
                f"calibrations {ids[0]!r} and {ids[k]!r} are {np.linalg.norm(theta[k]):.3g} rad apart, more "
                f"than {MOST_TURN_RAD} rad: not one mounting, or not the same frames"
            )
        return cls(ids, t, theta, 0.5 * (C + np.swapaxes(C, 1, 2)), phase, R[0])

    @property
    def R_cs(self) -> Rotation:
        """(K,) the matrices."""
        return deviation_from_theta(self.theta) * self.R_cs_ref

    @property
    def information(self) -> Array:
        """(K, 3, 3) rad⁻²."""
        inverse = np.linalg.inv(self.covariance)
        return np.asarray(0.5 * (inverse + np.swapaxes(inverse, 1, 2)))

    def about(self, R_cs_ref: Rotation) -> MountingSeries:
        """The same matrices about another reference near by (covariances stay, to first order)."""
        theta = theta_between(self.R_cs, R_cs_ref)
        return MountingSeries(self.names, self.t_s, theta, self.covariance, self.cos_sin, R_cs_ref)

    def merged(self) -> MergedMounting:
        """One matrix from all, as if the mounting had never moved: the exact sum of their information.

        The reference is first moved to a mean, so that turns are added where they are small; the sums are
        rounded once, so the result is the same, bit for bit, in whatever order calibrations were given.
        """
        F = self.information
        first = np.asarray(np.linalg.solve(*_exact_sums(F, self.theta)), dtype=float)
        R_cs_ref = deviation_from_theta(first) * self.R_cs_ref
        series = self.about(R_cs_ref)
        total, right = _exact_sums(F, series.theta)
        covariance = np.linalg.inv(total)
        R_cs = deviation_from_theta(covariance @ right) * R_cs_ref
        return MergedMounting(R_cs, 0.5 * (covariance + covariance.T), len(self.names))


@dataclass(frozen=True, slots=True, eq=False)
class MergedMounting:
    """One matrix from several calibrations."""

    R_cs: Rotation
    covariance: Array  # (3, 3) rad², of theta, frame c; without what all calibrations share
    calibrations: int


@dataclass(frozen=True, slots=True, eq=False)
class LinearFit:
    """Weighted least squares of theta on m regressors, the same regressors on each axis."""

    coefficients: Array  # (m, 3) rad
    covariance: Array  # (3 m, 3 m) rad², ordered regressor by regressor
    chi2: float
    dof: int
    log_information: float  # of the determinant of the information

    @property
    def p_value(self) -> float:
        """Probability of a chi2 as large or larger, if the model holds and the covariances are honest."""
        return float(chi2_distribution.sf(self.chi2, self.dof)) if self.dof > 0 else 1.0


@dataclass(frozen=True, slots=True, eq=False)
class OrbitPhaseTerm:
    """theta's part a cos(u) + b sin(u), u the argument of latitude, fitted beside the random walk: so a
    mounting that moves is not taken for one that breathes.
    """

    cosine: Array  # (3,) a, rad
    sine: Array  # (3,) b, rad
    covariance: Array  # (6, 6) rad², of a, then b
    p_value: float  # of a term as large, if there is none


@dataclass(frozen=True, slots=True, eq=False)
class StepFit:
    """The best single step: constant before it, constant after it, at a time between two calibrations."""

    after: str  # the last calibration before the step
    before: str  # the first one after it
    t_s: float  # middle of the most likely gap; within a gap the data know no better
    interval_s: tuple[float, float]  # holds the date with the stated confidence, if there was one step
    theta_step: Array  # (3,) rad, after minus before
    covariance: Array  # (3, 3) rad²
    gain: float  # by which the step lowers chi2
    p_value: float  # of a gain as large at any of the gaps (Bonferroni), if there was none


@dataclass(frozen=True, slots=True, eq=False)
class RandomWalk:
    """theta as a random walk, given all calibrations before and after."""

    theta: Array  # (K, 3) rad at the times of the series
    covariance: Array  # (K, 3, 3) rad²
    density_rad2_s: float  # variance a second, each axis
    density_interval: tuple[float, float]  # rad²/s, by the likelihood; NaN for a given density
    estimated: bool


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """What a series of calibrations says of the mounting's course. theta is about series.R_cs_ref."""

    series: MountingSeries  # a constant of its own at each calibration, about the merged matrix
    merged: MergedMounting
    constant: LinearFit  # one constant, and the orbit's term where it was asked for
    step: StepFit
    walk: RandomWalk
    orbit_phase: OrbitPhaseTerm | None  # None: not asked for
    moved: bool
    settings: DriftSettings


def estimate_drift(series: MountingSeries, settings: DriftSettings) -> Drift:
    """Mean, course and tests of a series.

    The mounting has moved when the chi2 against one constant, or the gain of the best step, is beyond what
    half of `probability_false_alarm` each allows. Raises `ValueError` for an orbit term that cannot be told
    from a constant (phases unknown, or all alike).
    """
    merged = series.merged()
    series = series.about(merged.R_cs)
    ones = np.ones((len(series.names), 1))
    phase = _phase_regressors(series) if settings.orbit_phase else np.empty((len(series.names), 0))
    constant = _fit(series, np.hstack([ones, phase]))
    step = _best_step(series, phase, constant.chi2, settings.confidence)
    walk, term = _random_walk(series, phase, settings)
    share = 0.5 * settings.probability_false_alarm
    moved = constant.p_value < share or step.p_value < share
    return Drift(series, merged, constant, step, walk, term, moved, settings)


def _exact_sums(F: Array, theta: Array) -> tuple[Array, Array]:
    right = np.einsum("kij,kj->ki", F, theta)
    sums = ExactSum.of(np.hstack([F.reshape(-1, 9), right])).rounded()
    return sums[:9].reshape(3, 3), sums[9:]


def _fit(series: MountingSeries, regressors: Array) -> LinearFit:
    """theta_k = sum over j of regressors[k, j] coefficients[j]; regressors (K, m)."""
    F, m = series.information, regressors.shape[1]
    normal = np.einsum("ka,kb,kij->aibj", regressors, regressors, F, optimize=True).reshape(3 * m, 3 * m)
    right = np.einsum("ka,kij,kj->ai", regressors, F, series.theta, optimize=True).ravel()
    covariance = np.linalg.inv(normal)
    coefficients = (covariance @ right).reshape(m, 3)
    residual = series.theta - regressors @ coefficients
    chi2 = float(np.einsum("ki,kij,kj->", residual, F, residual))
    log_information = float(np.linalg.slogdet(normal)[1])
    return LinearFit(coefficients, covariance, chi2, 3 * (len(F) - m), log_information)


def _phase_regressors(series: MountingSeries) -> Array:
    if unknown := [n for n, row in zip(series.names, series.cos_sin) if not np.all(np.isfinite(row))]:
        raise ValueError(f"the orbit phase of {len(unknown)} calibrations is not known, first {unknown[0]!r}")
    spread = np.linalg.svd(series.cos_sin - series.cos_sin.mean(axis=0), compute_uv=False)
    if len(series.names) < 5 or spread[1] < 0.05 * np.sqrt(len(series.names)):
        raise ValueError(
            f"{len(series.names)} calibrations at orbit phases so much alike do not tell an orbit term from "
            "a constant: at least 5, at three or more well separated arguments of latitude, are needed"
        )
    return series.cos_sin


def _phase_term(coefficients: Array, covariance: Array) -> OrbitPhaseTerm | None:
    """From coefficients (2, 3) with covariance (6, 6); None from none of them."""
    if not len(coefficients):
        return None
    values = coefficients.ravel()
    size = float(values @ np.linalg.solve(covariance, values))
    p_value = float(chi2_distribution.sf(size, 6))
    return OrbitPhaseTerm(coefficients[0], coefficients[1], covariance, p_value)


def _best_step(series: MountingSeries, phase: Array, chi2_constant: float, confidence: float) -> StepFit:
    """Every gap between two calibrations in turn. The date's posterior is flat within a gap; a gap has its
    length times the likelihood with the levels before and after integrated out.
    """
    K = len(series.names)
    fits = []
    for gap in range(K - 1):
        later = (np.arange(K) > gap).astype(float)[:, None]
        regressors = np.hstack([np.ones((K, 1)), later, phase])
        if np.linalg.svd(regressors, compute_uv=False)[-1] < 1e-6:
            raise ValueError(
                f"a step after {series.names[gap]!r} cannot be told from an orbit term at these orbit phases"
            )
        fits.append(_fit(series, regressors))
    best = int(np.argmin([fit.chi2 for fit in fits]))
    gain = max(chi2_constant - fits[best].chi2, 0.0)
    log_likelihood = np.array([-0.5 * (fit.chi2 + fit.log_information) for fit in fits])
    weight = np.diff(series.t_s) * np.exp(log_likelihood - log_likelihood.max())
    cumulative = np.concatenate([[0.0], np.cumsum(weight) / weight.sum()])
    tail = 0.5 * (1.0 - confidence)
    low, high = np.interp([tail, 1.0 - tail], cumulative, series.t_s)
    return StepFit(
        series.names[best],
        series.names[best + 1],
        float(0.5 * (series.t_s[best] + series.t_s[best + 1])),
        (float(low), float(high)),
        fits[best].coefficients[1],
        fits[best].covariance[3:6, 3:6],
        gain,
        min(1.0, (K - 1) * float(chi2_distribution.sf(gain, 3))),
    )


def _random_walk(
    series: MountingSeries, phase: Array, settings: DriftSettings
) -> tuple[RandomWalk, OrbitPhaseTerm | None]:
    given = settings.density_rad2_s
    if given is None:
        density, interval = _likely_density(series, phase, settings.confidence)
    else:
        density, interval = given, (float("nan"), float("nan"))
    theta, covariance, term = _walk(series, phase, density)
    return RandomWalk(theta, covariance, density, interval, estimated=given is None), term


def _likely_density(
    series: MountingSeries, phase: Array, confidence: float
) -> tuple[float, tuple[float, float]]:
    """Most likely density (rad²/s), and the interval in which the likelihood falls by less than chi2 of one
    degree of freedom allows. 0 where no walk is as likely as any.
    """
    gaps, K = np.diff(series.t_s), len(series.names)
    variance = np.trace(series.covariance, axis1=1, axis2=2) / 3.0
    least = variance.min() / (series.t_s[-1] - series.t_s[0]) / K * 1e-5
    most = (variance.max() + np.ptp(series.theta, axis=0).max() ** 2) / gaps.min() * 1e2

    def loss(log_density: float) -> float:
        return _walk_loss(series, phase, float(np.exp(log_density)))

    grid = np.linspace(np.log(least), np.log(most), 60)
    losses = np.array([loss(x) for x in grid])
    at = int(np.argmin(losses))
    window = (grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)])
    found = minimize_scalar(loss, bounds=window, method="bounded", options={"xatol": 1e-4})
    at_rest = _walk_loss(series, phase, 0.0)
    resting = at_rest <= found.fun + 1e-6
    lowest = min(at_rest, float(found.fun))
    limit = lowest + float(chi2_distribution.ppf(confidence, 1))
    centre = grid[0] if resting else float(found.x)
    below, above = grid[(grid < centre) & (losses > limit)], grid[(grid > centre) & (losses > limit)]
    low = high = 0.0
    if len(below) and not resting:
        low = float(np.exp(brentq(lambda x: loss(x) - limit, below[-1], centre)))
    if len(above):
        high = float(np.exp(brentq(lambda x: loss(x) - limit, centre, above[0])))
    else:
        high = float("inf")
    return (0.0 if resting else float(np.exp(found.x))), (low, high)


@dataclass(frozen=True, slots=True, eq=False)
class _WalkSolution:
    """The normal equations of a walk, solved: theta is K levels, plus phase coefficients times regressors."""

    factor: Array  # banded Cholesky factor of the levels' information
    levels: Array  # (K, 3), phase coefficients at their best
    lift: Array  # (3 K, 3 m): the levels' answer to the phase coefficients, sign turned
    phase: Array  # (m, 3) the coefficients
    phase_covariance: Array  # (3 m, 3 m)
    loss: float  # -2 log likelihood, the first level and the coefficients integrated out


def _walk(series: MountingSeries, phase: Array, density: float) -> tuple[Array, Array, OrbitPhaseTerm | None]:
    """Smoothed levels (K, 3) of a walk, their covariances (K, 3, 3), and the orbit's term beside them."""
    K, m = len(series.names), phase.shape[1]
    if density == 0.0:
        fit = _fit(series, np.hstack([np.ones((K, 1)), phase]))
        level, covariance = fit.coefficients[0], fit.covariance[:3, :3]
        term = _phase_term(fit.coefficients[1:], fit.covariance[3:, 3:])
        return np.tile(level, (K, 1)), np.tile(covariance, (K, 1, 1)), term
    solved = _solve_walk(series, phase, density)
    covariances = np.empty((K, 3, 3))
    for k in range(K):
        unit = np.zeros((3 * K, 3))
        unit[3 * k : 3 * k + 3] = np.eye(3)
        covariances[k] = cho_solve_banded((solved.factor, True), unit)[3 * k : 3 * k + 3]
        if m:
            rows = solved.lift[3 * k : 3 * k + 3]
            covariances[k] += rows @ solved.phase_covariance @ rows.T
    return solved.levels, covariances, _phase_term(solved.phase, solved.phase_covariance)


def _walk_loss(series: MountingSeries, phase: Array, density: float) -> float:
    if density == 0.0:
        return _rest_loss(series, _fit(series, np.hstack([np.ones((len(series.names), 1)), phase])))
    return _solve_walk(series, phase, density).loss


def _rest_loss(series: MountingSeries, fit: LinearFit) -> float:
    return float(np.linalg.slogdet(series.covariance)[1].sum()) + fit.log_information + fit.chi2


def _solve_walk(series: MountingSeries, phase: Array, density: float) -> _WalkSolution:
    """Information of the levels, blocks of 3 on three diagonals: calibrations on the middle one, and
    1 / (q dt) for each step. First level and phase coefficients have no prior.
    """
    K, m = len(series.names), phase.shape[1]
    F, gaps = series.information, np.diff(series.t_s)
    stiffness = 1.0 / (density * gaps)
    blocks = F.copy()
    blocks[:-1] += stiffness[:, None, None] * np.eye(3)
    blocks[1:] += stiffness[:, None, None] * np.eye(3)
    banded = np.zeros((4, 3 * K))  # lower form: row d holds the d-th diagonal below the main one
    for i in range(3):
        for j in range(i + 1):
            banded[i - j, j::3] = blocks[:, i, j]
    banded[3, : 3 * (K - 1)] = -np.repeat(stiffness, 3)
    factor = cholesky_banded(banded, lower=True)
    right = np.einsum("kij,kj->ki", F, series.theta).ravel()
    cross = np.einsum("kij,ka->kiaj", F, phase).reshape(3 * K, 3 * m)  # levels to phase coefficients
    lift = cho_solve_banded((factor, True), cross) if m else cross
    levels = cho_solve_banded((factor, True), right)
    schur = np.einsum("ka,kb,kij->aibj", phase, phase, F).reshape(3 * m, 3 * m) - cross.T @ lift
    right_phase = np.einsum("ka,ki->ai", phase, right.reshape(K, 3)).ravel() - cross.T @ levels
    coefficients = np.linalg.solve(schur, right_phase) if m else np.zeros(0)
    levels = levels - lift @ coefficients
    model = levels.reshape(K, 3) + phase @ coefficients.reshape(m, 3)
    residual, steps = series.theta - model, np.diff(levels.reshape(K, 3), axis=0)
    chi2 = np.einsum("ki,kij,kj->", residual, F, residual) + (stiffness[:, None] * steps**2).sum()
    loss = chi2 + np.linalg.slogdet(series.covariance)[1].sum() - 3.0 * np.log(stiffness).sum()
    loss += 2.0 * np.log(factor[0]).sum() + (np.linalg.slogdet(schur)[1] if m else 0.0)
    covariance = np.linalg.inv(schur) if m else np.zeros((0, 0))
    phase_best = coefficients.reshape(m, 3)
    return _WalkSolution(factor, levels.reshape(K, 3), lift, phase_best, covariance, float(loss))
