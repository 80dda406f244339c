"""Does the mounting move? Calibrations of one pair of cameras at several times: their mean, their course.

Each calibration k, made at t_k, determines theta_k (frame c, rad, the paper's sign: R_cs = exp[[theta]]
R_cs_ref) and unknowns that all of them share, such as the remote-sensing camera's distortion. These are
eliminated, which leaves the theta_k with one information matrix L over all of them together:

    theta_k = theta(t_k) + a cos(u_k) + b sin(u_k) + e_k,    e = (e_1, ..., e_K) ~ N(0, L⁻¹)

with u the argument of latitude (the thermal change around the orbit; only when asked for), and theta(t)
either a value of its own at each k, or constant, or constant but for one step, or a random walk of density
q (rad²/s on each axis). What is shared moves all theta_k nearly alike: it makes no drift and hardly blurs
one, and the mean over calibrations does not average it away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from boresight.calib.information import InformationPairs
from boresight.features.drift.random_walk import WalkProblem, likely_density
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.record import array, record, scalar

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


@record(kw_only=True)
class MountingSeries:
    """Calibrations of one mounting in the order of time, about one reference: constant over each, free
    between.
    """

    names: tuple[str, ...] = array("K", "names of the calibrations")
    t_s: Array = array("K", "times, increasing, s")
    theta: Array = array("K, 3", "deviation from R_cs_ref, frame c, rad")
    information: Array = array("M, M", "of all theta together, M = 3 K, frame c, rad⁻²")
    cos_sin: Array = array("K, 2", "of the argument of latitude, means over the strips; NaN where unknown")
    R_cs_ref: Rotation = scalar("reference matrix")

    @classmethod
    def of(
        cls,
        pairs: InformationPairs,
        prior_shared: Array,
        t_s: Array,
        cos_sin: Array | None = None,
    ) -> MountingSeries:
        """A series from one information pair a calibration (K of them, in any order). What the pairs share is
        one unknown for all, with the information `prior_shared` (n - 3, n - 3) on it before any calibration.

        Raises
        ------
        ValueError
            For fewer than two calibrations, a name or an instant that occurs twice, matrices more than 0.02
            rad apart (another mounting, or other frames), a pair that does not fix all three turns.
        """
        K = len(pairs.names)
        t = np.asarray(t_s, dtype=float)
        phase = np.full((K, 2), np.nan) if cos_sin is None else np.asarray(cos_sin, dtype=float)
        if K < 2:
            raise ValueError(f"{K} calibrations show no course of time, 2 are needed")
        if t.shape != (K,) or phase.shape != (K, 2):
            raise ValueError(f"{K} pairs need t_s {(K,)}, cos_sin {(K, 2)}; got {t.shape}, {phase.shape}")
        order = np.argsort(t, kind="stable")
        ids = tuple(pairs.names[order].tolist())
        t, F, right = t[order], pairs.F[order], pairs.F_theta[order]
        if len(set(ids)) < K:
            raise ValueError(f"calibration {next(n for n in ids if ids.count(n) > 1)!r} is given twice")
        if not np.all(np.isfinite(t)):
            raise ValueError("every calibration needs a time")
        for k in np.flatnonzero(np.diff(t) <= 0.0):
            raise ValueError(f"calibrations {ids[k]!r} and {ids[k + 1]!r} have the same time")
        for k in range(K):
            if not np.all(np.isfinite(F[k])) or np.linalg.eigvalsh(F[k, :3, :3])[0] <= 0.0:
                raise ValueError(f"calibration {ids[k]!r}: its information is not positive definite")
        theta, information = _without_shared(F, right, prior_shared)
        for k in np.flatnonzero(np.linalg.norm(theta - theta[0], axis=1) > MOST_TURN_RAD):
            raise ValueError(
                f"calibrations {ids[0]!r} and {ids[k]!r} are {np.linalg.norm(theta[k] - theta[0]):.3g} rad "
                f"apart, more than {MOST_TURN_RAD} rad: not one mounting, or not the same frames"
            )
        return cls(
            names=ids,
            t_s=t,
            theta=theta,
            information=information,
            cos_sin=phase[order],
            R_cs_ref=pairs.R_cs_ref,
        )

    @property
    def R_cs(self) -> Rotation:
        """(K,) the matrices."""
        return deviation_from_theta(self.theta) * self.R_cs_ref

    @property
    def covariance(self) -> Array:
        """(K, 3, 3) rad² of each theta, what is shared included."""
        K = len(self.names)
        blocks = np.linalg.inv(self.information).reshape(K, 3, K, 3)
        return np.ascontiguousarray(np.einsum("kikj->kij", blocks))

    def about(self, R_cs_ref: Rotation) -> MountingSeries:
        """The matrices about another, close reference (the information stays, to first order)."""
        return replace(self, theta=theta_between(self.R_cs, R_cs_ref), R_cs_ref=R_cs_ref)

    def merged(self) -> MergedMounting:
        """One matrix from all, as if the mounting had never moved. The reference is first moved to a mean, so
        that rotations are added where they are small.
        """
        series, ones = self, np.ones((len(self.names), 1))
        for _ in range(2):
            fit = _fit(series, ones)
            series = series.about(deviation_from_theta(fit.coefficients[0]) * series.R_cs_ref)
        return MergedMounting(series.R_cs_ref, fit.covariance)


@record
class MergedMounting:
    """One matrix from several calibrations."""

    R_cs: Rotation = scalar("installation matrix")
    covariance: Array = array("3, 3", "of theta, frame c, rad²")


@record
class LinearFit:
    """Weighted least squares of theta on m regressors, the same regressors on each axis."""

    coefficients: Array = array("M, 3", "of the regressors, rad")
    covariance: Array = array("N, N", "N = 3 M, ordered regressor by regressor, rad²")
    chi2: float = scalar("weighted sum of squared residuals")
    dof: int = scalar("degrees of freedom")
    log_information: float = scalar("logarithm of the determinant of the information")

    @property
    def p_value(self) -> float:
        """Probability of a chi2 as large or larger, if the model and the covariances hold."""
        return float(chdtrc(self.dof, self.chi2)) if self.dof > 0 else 1.0


@record
class OrbitPhaseTerm:
    """theta's part a cos(u) + b sin(u), u the argument of latitude, fitted beside the random walk: so a
    drift is not attributed to the orbit.
    """

    cosine: Array = array("3", "a, rad")
    sine: Array = array("3", "b, rad")
    covariance: Array = array("6, 6", "of a, then b, rad²")
    p_value: float = scalar("probability of a term at least as large without any effect")


@record(kw_only=True)
class StepFit:
    """The best single step: constant before it, constant after it, at a time between two calibrations."""

    after: str = scalar("last calibration before the step")
    before: str = scalar("first calibration after the step")
    t_s: float = scalar("middle of the most likely gap, s; the data do not resolve times within a gap")
    interval_s: tuple[float, float] = array("2", "confidence interval of the date, if there was one step, s")
    theta_step: Array = array("3", "after minus before, rad")
    covariance: Array = array("3, 3", "of theta_step, rad²")
    gain: float = scalar("decrease of chi2 by the step")
    p_value: float = scalar("probability of this gain at any gap without a step (Bonferroni)")


@record
class RandomWalk:
    """theta as a random walk, given all calibrations before and after."""

    theta: Array = array("K, 3", "at the times of the series, rad")
    covariance: Array = array("K, 3, 3", "of each theta, rad²")
    density_rad2_s: float = scalar("variance per second on each axis, rad²/s")
    density_interval: tuple[float, float] = array("2", "by the likelihood, rad²/s; NaN for a given density")
    estimated: bool = scalar("whether the density is estimated")


@record(kw_only=True)
class Drift:
    """Results of a series of calibrations. theta is about series.R_cs_ref."""

    series: MountingSeries = scalar("one free theta per calibration, about the merged matrix")
    merged: MergedMounting = scalar("one matrix from all calibrations")
    constant: LinearFit = scalar("fit of one constant and, if requested, the orbit term")
    step: StepFit = scalar("best single step")
    walk: RandomWalk = scalar("random walk")
    orbit_phase: OrbitPhaseTerm | None = scalar("None: not requested")
    moved: bool = scalar("whether a test finds that the mounting has moved")
    settings: DriftSettings = scalar("settings of the estimate")


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
    return Drift(
        series=series,
        merged=merged,
        constant=constant,
        step=step,
        walk=walk,
        orbit_phase=term,
        moved=moved,
        settings=settings,
    )


def _without_shared(F: Array, right: Array, prior_shared: Array) -> tuple[Array, Array]:
    """theta (K, 3) and its information (3 K, 3 K) from pairs (K, n, n), (K, n), the shared unknowns
    eliminated.
    """
    K = len(F)
    shared = prior_shared + F[:, 3:, 3:].sum(axis=0)
    cross = F[:, :3, 3:].reshape(3 * K, -1)
    gain = np.linalg.solve(shared, cross.T)
    information = block_diag(*F[:, :3, :3]) - cross @ gain
    information = 0.5 * (information + information.T)
    own = right[:, :3].ravel() - gain.T @ right[:, 3:].sum(axis=0)
    return np.linalg.solve(information, own).reshape(K, 3), information


def _fit(series: MountingSeries, regressors: Array) -> LinearFit:
    """theta_k = sum over j of regressors[k, j] coefficients[j]; regressors (K, m)."""
    X = np.kron(regressors, np.eye(3))
    weighted = series.information @ X
    normal = X.T @ weighted
    covariance = np.linalg.inv(normal)
    covariance = 0.5 * (covariance + covariance.T)
    coefficients = covariance @ (weighted.T @ series.theta.ravel())
    residual = series.theta.ravel() - X @ coefficients
    chi2 = float(residual @ series.information @ residual)
    log_information = float(np.linalg.slogdet(normal)[1])
    return LinearFit(coefficients.reshape(-1, 3), covariance, chi2, len(X) - X.shape[1], log_information)


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
    p_value = float(chdtrc(6, size))
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
        after=series.names[best],
        before=series.names[best + 1],
        t_s=float(0.5 * (series.t_s[best] + series.t_s[best + 1])),
        interval_s=(float(low), float(high)),
        theta_step=fits[best].coefficients[1],
        covariance=fits[best].covariance[3:6, 3:6],
        gain=gain,
        p_value=min(1.0, (K - 1) * float(chdtrc(3, gain))),
    )


def _random_walk(
    series: MountingSeries, phase: Array, settings: DriftSettings
) -> tuple[RandomWalk, OrbitPhaseTerm | None]:
    problem = WalkProblem.of(series.theta, series.information, series.t_s, phase)
    given = settings.density_rad2_s
    if given is None:
        density, interval = likely_density(problem, settings.confidence)
    else:
        density, interval = given, (float("nan"), float("nan"))
    course = problem.course(density)
    walk = RandomWalk(course.theta, course.covariance, density, interval, estimated=given is None)
    return walk, _phase_term(course.coefficients, course.coefficients_covariance)
