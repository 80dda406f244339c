"""The mounting's course over years, from the information of many results at once.

Result k, made at t_k, has information on theta_k (frame c, rad, the paper's sign: R_cs = exp[[theta]]
R_cs_ref) and on what all results share, the distortion of the remote-sensing camera. The course is linear and
Gaussian:

    theta(t) = mean + annual + orbit phase + beta angle + temperature + steps + random walk

with the same columns X for each axis, so that unknowns (coefficients, walk, shared) have one set of normal
equations. A term is in the model only where the fall of chi2 that it brings has a small probability by
chance, given all others, and terms are tried before steps. A random walk is a sum of ramps between knots in
time, each with the prior variance q dt on each axis (q in rad²/s).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array
from scipy.special import chdtrc

from boresight.features.mission.saved_mounting import utc_at
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.records.record import Floats, Ints, array, record, scalar

__all__ = [
    "CourseFit",
    "CourseModel",
    "CourseSettings",
    "CourseStep",
    "MountingCourse",
    "MountingSeries",
    "aliases",
    "annual_columns",
    "dated_steps",
    "estimate_course",
    "explained_by_free",
    "fit_columns",
    "step_gains",
    "with_reference_moved",
]

YEAR_S = 365.25 * DAY_S  # Julian year
# Terms of the course by their names; which of a series' conditions their columns are made of.
TERMS = ("annual", "orbit phase", "beta angle", "temperature")
# Canonical correlation of two terms from which the data do not tell them apart: a coefficient then has three
# times the 1-sigma that it would have alone.
ALIAS = 0.95
# Least spread of a term's columns over the results, of columns between -1 and 1: below it the term is not
# told from the mean.
LEAST_SPREAD = 0.05
MOST_KNOTS = 48  # of the random walk: a knot in three weeks of three years
MOST_GAPS = 1000  # gaps between results that are tried for a step at first; then those about the best


@record(kw_only=True)
class CourseSettings:
    """What is asked of a course."""

    false_term: float = scalar("probability that any term is accepted without cause", default=0.01)
    false_steps_per_year: float = scalar("steps accepted without cause, a year", default=0.01)
    confidence: float = scalar("of the interval of a step's date", default=0.95)


@record(kw_only=True)
class MountingSeries:
    """Information pairs of K results in the order of time, with what they share, and their conditions."""

    names: tuple[str, ...] = array("K", "ids of the results")
    t_s: Floats = array("K", "middle of each result's strips, s")
    F: Floats = array("K, 3, 3", "information on theta, frame c, rad⁻²")
    F_shared: Floats = array("K, 3, S", "of theta with the shared unknowns")
    right: Floats = array("K, 3", "F theta + F_shared shared, at the best values of the result")
    shared_F: Floats = array("S, S", "on the shared unknowns: sum over the results, and prior")
    shared_right: Floats = array("S", "right-hand side of the shared unknowns, sum over the results")
    cos_sin: Floats = array("K, 2", "of the argument of latitude; NaN: not known")
    beta_rad: Floats = array("K", "height of the Sun over the orbital plane; NaN: not known")
    temperature_c: Floats = array("K", "of the star camera; NaN: not stated")
    exchanges: tuple[int, ...] = scalar("rows before which a camera was exchanged", default=())

    @property
    def years(self) -> float:
        """Length of the series."""
        return float(self.t_s[-1] - self.t_s[0]) / YEAR_S

    def conditions(self, term: str) -> Floats:
        """What a term is made of, (K, m); of m = 0 where it is not known for all results."""
        known = {
            "annual": lambda: annual_columns(self.t_s),
            "orbit phase": lambda: self.cos_sin,
            "beta angle": lambda: np.sin(self.beta_rad)[:, None],
            "temperature": lambda: 0.1 * (self.temperature_c - np.mean(self.temperature_c))[:, None],
        }[term]()
        return known if np.isfinite(known).all() else np.empty((len(self.t_s), 0))

    def directions(self, term: str) -> Floats:
        """Combinations (m, r) of a term's conditions that vary enough to differ from the mean; where
        all do, the conditions as they are.
        """
        of_term = self.conditions(term)
        m = of_term.shape[1]
        if not m or len(of_term) < m + 3:
            return np.zeros((m, 0))
        centred = of_term - of_term.mean(axis=0)
        _, spread, V = np.linalg.svd(centred, full_matrices=False)
        told = spread > LEAST_SPREAD * np.sqrt(len(of_term))
        return np.eye(m) if told.all() else np.asarray(V[told].T)

    def columns(self, term: str) -> Floats:
        """Columns (K, r) of a term: its conditions in the directions that differ from the mean."""
        return self.conditions(term) @ self.directions(term)

    @property
    def candidates(self) -> tuple[str, ...]:
        """Terms that the conditions of the results tell from the mean."""
        return tuple(term for term in TERMS if self.directions(term).shape[1])


@record(kw_only=True)
class CourseFit:
    """Weighted least squares of theta on columns, shared unknowns estimated with them."""

    coefficients: Floats = array("M, 3", "of the columns, rad")
    covariance: Floats = array("N, N", "of the coefficients, N = 3 M, column by column, rad²")
    shared: Floats = array("S", "the shared unknowns")
    explained: float = scalar("fall of chi2 from theta = 0")


@record(kw_only=True)
class CourseStep:
    """A sudden change of theta between two results."""

    row: int = scalar("of the first result after it")
    interval_s: tuple[float, float] = scalar("holds its date with the settings' confidence")
    probability: float = scalar("that it lies between these two results, if there is a step")
    p_value: float = scalar("probability of a step as large anywhere in the series by chance; 0: an exchange")
    is_exchange: bool = scalar("known from the results: a star camera was exchanged")
    theta: Floats = array("3", "change, rad")
    covariance: Floats = array("3, 3", "of the change, rad²")

    def t_s(self, series: MountingSeries) -> float:
        """Middle between the results before and after it, s."""
        return float(0.5 * (series.t_s[self.row - 1] + series.t_s[self.row]))

    def content(self, series: MountingSeries) -> dict[str, Any]:
        """For programs."""
        return {
            "after": series.names[self.row - 1],
            "before": series.names[self.row],
            "utc": utc_at(self.t_s(series)),
            "utc_interval": [utc_at(t_s) for t_s in self.interval_s],
            "probability": self.probability,
            "p_value": self.p_value,
            "is_exchange": self.is_exchange,
            "theta_rad": self.theta.tolist(),
            "covariance_rad2": self.covariance.tolist(),
        }


@record(kw_only=True)
class MountingCourse:
    """The accepted model of a series."""

    series: MountingSeries = scalar("the results")
    terms: tuple[str, ...] = scalar("accepted terms, in the order of `TERMS`")
    p_values: dict[str, float] = scalar("of each candidate, given all that is accepted beside it")
    steps: tuple[CourseStep, ...] = scalar("accepted steps, in the order of time")
    density_rad2_s: float = scalar("most likely of the random walk, each axis; in all predictions")
    density_p_value: float = scalar("of the walk, given terms and steps")
    walks: bool = scalar("whether that is evidence of a walk")
    chi2: float = scalar("of the results about the model without walk")
    dof: int = scalar("its degrees of freedom")
    fit: CourseFit = scalar("coefficients of mean, terms, steps, walk")

    @property
    def p_value(self) -> float:
        """Probability of so large a chi2, if the results' covariances and the model hold."""
        return float(chdtrc(self.dof, self.chi2)) if self.dof > 0 else 1.0

    @property
    def walk_arcsec(self) -> float:
        """1 sigma of the random walk over a day."""
        return float(np.sqrt(self.density_rad2_s * DAY_S)) / ARCSEC

    def of_term(self, term: str) -> tuple[Floats, Floats]:
        """Coefficients (M, 3) of an accepted term's columns, rad, and their covariance (N, N), N = 3 M."""
        first = 1 + sum(self.series.columns(one).shape[1] for one in self.terms[: self.terms.index(term)])
        n = self.series.columns(term).shape[1]
        return self.fit.coefficients[first : first + n], _block(self.fit.covariance, first, n)

    def at(self, t_s: Floats, conditions: dict[str, Floats] | None = None) -> tuple[Floats, Floats]:
        """theta (N, 3) at instants (N,) and its covariance (N, 3, 3); the walk goes on after the last result.

        `conditions`: (N, m) of terms by name; unstated, their means over the results.
        """
        X = self._columns_at(np.asarray(t_s, dtype=float), conditions or {})
        n = len(self.fit.coefficients)
        covariance = np.einsum("ni,iajb,nj->nab", X, self.fit.covariance.reshape(n, 3, n, 3), X)
        beyond = np.maximum(t_s - self.series.t_s[-1], 0.0) + np.maximum(self.series.t_s[0] - t_s, 0.0)
        return X @ self.fit.coefficients, covariance + (self.density_rad2_s * beyond)[:, None, None] * np.eye(
            3
        )

    @property
    def free(self) -> tuple[Floats, Floats]:
        """theta (K, 3) of each result by itself and its covariance (K, 3, 3), at the best shared unknowns."""
        own = self.series.right - self.series.F_shared @ self.fit.shared
        covariance = np.linalg.inv(self.series.F)
        return np.asarray(np.einsum("kab,kb->ka", covariance, own)), np.asarray(covariance)

    def of_conditions(self) -> Floats:
        """Part (K, 3) of theta by which the conditions of each result differ from their means."""
        part = np.zeros((len(self.series.t_s), 3))
        for term in self.terms:
            if term != "annual":
                columns = self.series.columns(term)
                part += (columns - columns.mean(axis=0)) @ self.of_term(term)[0]
        return part

    def content(self) -> dict[str, Any]:
        """For programs: terms, steps, random walk, and how well the results agree with them."""
        return {
            "terms": {term: self._term_content(term, p) for term, p in self.p_values.items()},
            "steps": [step.content(self.series) for step in self.steps],
            "random_walk": {
                "accepted": self.walks,
                "density_rad2_s": self.density_rad2_s,
                "p_value": self.density_p_value,
            },
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
        }

    def _term_content(self, term: str, p: float) -> dict[str, Any]:
        content: dict[str, Any] = {"accepted": term in self.terms, "p_value": p}
        if term in self.terms:
            values, covariance = self.of_term(term)
            content |= {"coefficients_rad": values.tolist(), "covariance_rad2": covariance.tolist()}
        return content

    def _columns_at(self, t_s: Floats, conditions: dict[str, Floats]) -> Floats:
        parts: list[Floats] = [np.ones((len(t_s), 1))]
        for term in self.terms:
            if term == "annual":
                parts.append(annual_columns(t_s) @ self.series.directions(term))
            elif term in conditions:
                parts.append(conditions[term] @ self.series.directions(term))
            else:
                parts.append(np.tile(self.series.columns(term).mean(axis=0), (len(t_s), 1)))
        dates = np.array([step.t_s(self.series) for step in self.steps])
        parts.append((t_s[:, None] > dates).astype(float))
        if self.density_rad2_s:
            parts.append(_ramps(t_s, _knots(self.series.t_s)))
        return np.hstack(parts)


def annual_columns(t_s: Floats) -> Floats:
    """Cosine and sine (N, 2) of the time of the year from 2000-01-01T12:00 TAI."""
    phase = 2.0 * np.pi * np.asarray(t_s) / YEAR_S
    return np.column_stack([np.cos(phase), np.sin(phase)])


def aliases(series: MountingSeries) -> list[str]:
    """Sentences on what the results cannot tell apart."""
    said, count = [], len(series.t_s)
    for term in TERMS:
        if not series.conditions(term).shape[1]:
            said.append(f"{term}: not stated by all results, so not tried")
        elif term not in series.candidates:
            said.append(f"{term}: varies too little over the results to be distinguished from the mean")
        elif np.diff(series.directions(term).shape) < 0:
            said.append(f"{term}: seen in part only, one of its directions is not told from the mean")
    for n, one in enumerate(series.candidates):
        for other in series.candidates[n + 1 :]:
            bases = [np.linalg.qr(c - c.mean(axis=0))[0] for c in map(series.columns, (one, other))]
            alike = float(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)[0]) if count > 4 else 1.0
            if alike > ALIAS:
                said.append(
                    f"{one} and {other} cannot be told apart (correlation {alike:.3f}): what is stated for "
                    "one may be the other's"
                )
    if series.years < 1.0:
        said.append(f"annual: the results span {series.years:.2f} years, a season is not told from a trend")
    return said


class CourseModel(NamedTuple):
    """What a course has beside its mean."""

    terms: tuple[str, ...] = ()
    steps: tuple[int, ...] = ()  # rows before which they are
    density: float = 0.0  # of the random walk, rad²/s

    def columns(self, series: MountingSeries) -> Floats:
        """Columns (K, m): mean, terms, steps."""
        rows = np.arange(len(series.t_s))
        of_terms = [series.columns(term) for term in self.terms]
        later = (rows[:, None] >= np.array(self.steps, dtype=int)).astype(float)
        return np.hstack([np.ones((len(rows), 1)), *of_terms, later])

    def loss(self, series: MountingSeries) -> float:
        """-2 log L, from that of theta = 0 at rest."""
        return _Normal.of(series, self.columns(series), self.density > 0.0).loss(series, self.density)

    def cost(self, series: MountingSeries) -> float:
        """Schwarz's criterion: -2 log L and the logarithm of K for each number that was fitted."""
        of_terms = sum(series.columns(term).shape[1] for term in self.terms)
        fitted = 4 * (len(self.steps) - len(series.exchanges)) + 3 * of_terms + (self.density > 0.0)
        return self.loss(series) + fitted * float(np.log(len(series.t_s)))

    def p_term(self, series: MountingSeries, term: str) -> float:
        """Probability of the fall of chi2 by a term, given the others."""
        without = tuple(one for one in self.terms if one != term)
        having = tuple(one for one in TERMS if one in without or one == term)
        less, more = (self._replace(terms=some).loss(series) for some in (without, having))
        return float(chdtrc(3 * series.columns(term).shape[1], max(less - more, 0.0)))

    def best_step(self, series: MountingSeries) -> tuple[int, float]:
        """Row before which one more step lowers chi2 most, and by how much."""
        X, count = self.columns(series), len(series.t_s)
        stride = 1 + (count - 1) // MOST_GAPS
        rows = np.setdiff1d(np.arange(1, count, stride), self.steps)
        if not len(rows):
            return 1, 0.0
        gains, _ = step_gains(series, X, self.density, rows)
        best = int(rows[np.argmax(gains)])
        if stride > 1:
            rows = np.setdiff1d(np.arange(max(1, best - stride), min(count, best + stride)), self.steps)
            gains, _ = step_gains(series, X, self.density, rows)
            best = int(rows[np.argmax(gains)])
        return best, float(gains.max())


def estimate_course(series: MountingSeries, settings: CourseSettings | None = None) -> MountingCourse:
    """The terms, steps and random walk that a series gives evidence for. `ValueError` for fewer than 2."""
    settings = settings or CourseSettings()
    if len(series.t_s) < 2:
        raise ValueError(f"{len(series.t_s)} results show no course of time, 2 are needed")
    at_rest = CourseModel(steps=series.exchanges)
    model, p_walk = _with_walk(_accepted(series, 0.0, settings), series)
    if model[:2] != at_rest[:2] or p_walk < settings.false_term:
        # a walk looks like steps and like a season, and these like a walk
        options = [model]
        for beside in dict.fromkeys((model.terms, ())):
            bare, _ = _with_walk(at_rest._replace(terms=beside), series)
            options.append(_accepted(series, bare.density, settings))
        costs = [option.cost(series) for option in options]
        model, p_walk = _with_walk(options[int(np.argmin(costs))], series)
    X = model.columns(series)
    plain = fit_columns(series, X)
    chi2 = explained_by_free(series) - plain.explained
    return MountingCourse(
        series=series,
        terms=model.terms,
        p_values={term: model.p_term(series, term) for term in series.candidates},
        steps=dated_steps(series, model, series.exchanges, settings),
        density_rad2_s=model.density,
        density_p_value=p_walk,
        walks=p_walk < settings.false_term,
        chi2=float(chi2),
        dof=3 * (len(series.t_s) - X.shape[1]),
        fit=fit_columns(series, X, model.density) if model.density else plain,
    )


def _accepted(series: MountingSeries, density: float, settings: CourseSettings) -> CourseModel:
    """Terms and steps with evidence, terms first, each again given the others until none changes."""
    model = CourseModel(steps=series.exchanges, density=density)
    for _ in range(4):  # terms given steps, steps given terms
        before = model
        model = _with_steps(_with_terms(model, series, settings), series, settings)
        if model == before:
            break
    return model


def _with_terms(model: CourseModel, series: MountingSeries, settings: CourseSettings) -> CourseModel:
    """The model with the terms that have evidence, given its steps."""
    limit = settings.false_term / max(len(series.candidates), 1)
    for _ in range(2 * len(TERMS)):
        terms, p = model.terms, {term: model.p_term(series, term) for term in series.candidates}
        if wrong := [term for term in terms if p[term] >= limit]:
            terms = tuple(term for term in terms if term != max(wrong, key=lambda one: p[one]))
        elif more := [term for term in p if term not in terms and p[term] < limit]:
            best = min(more, key=lambda one: p[one])
            terms = tuple(term for term in TERMS if term in terms or term == best)
        else:
            break
        model = model._replace(terms=terms)
    return model


def _with_steps(model: CourseModel, series: MountingSeries, settings: CourseSettings) -> CourseModel:
    """The model with the steps that have evidence: the best one more while it has; each moved to its best
    place given the others, and taken out again where it has lost its evidence.
    """
    model, count = model._replace(steps=series.exchanges), len(series.t_s)
    limit = min(0.5, settings.false_steps_per_year * max(series.years, 0.1)) / max(count - 1, 1)
    for _ in range(20):  # steps that are looked for
        row, gain = model.best_step(series)
        if chdtrc(3, gain) >= limit:
            break
        model = model._replace(steps=tuple(sorted((*model.steps, row))))
        for _ in range(3 if len(model.steps) > 1 else 0):
            before = model
            for own in [one for one in model.steps if one not in series.exchanges]:
                others = model._replace(steps=tuple(one for one in model.steps if one != own))
                row, gain = others.best_step(series)
                found = chdtrc(3, gain) < limit
                model = others._replace(steps=tuple(sorted((*others.steps, row)))) if found else others
            if model == before:
                break
    return model


def dated_steps(
    series: MountingSeries, model: CourseModel, known: tuple[int, ...], settings: CourseSettings
) -> tuple[CourseStep, ...]:
    """Each step of a model with its date: gaps between its neighbours have a probability in proportion to
    their length and to the likelihood with the step's size integrated out. Steps that are `known` have their
    dates.
    """
    X, steps = model.columns(series), model.steps
    fit = fit_columns(series, X, model.density)
    first = X.shape[1] - len(steps)
    dated, t_s, count = [], series.t_s, len(series.t_s)
    for n, row in enumerate(steps):
        low = steps[n - 1] + 1 if n else 1
        high = steps[n + 1] if n + 1 < len(steps) else count
        rows = np.arange(low, high)
        if len(rows) > MOST_GAPS:  # what is far away has no part in the date
            rows = rows[np.abs(rows - row) <= MOST_GAPS // 2]
        others = model._replace(steps=tuple(one for one in steps if one != row)).columns(series)
        gains, log_determinants = step_gains(series, others, model.density, rows)
        log_weight = 0.5 * (gains - log_determinants)
        weight = np.diff(t_s)[rows - 1] * np.exp(log_weight - log_weight.max())
        cumulative = np.concatenate([[0.0], np.cumsum(weight) / weight.sum()])
        tail, edges = 0.5 * (1.0 - settings.confidence), t_s[np.append(rows - 1, rows[-1])]
        interval = np.interp([tail, 1.0 - tail], cumulative, edges)
        here = int(np.flatnonzero(rows == row)[0])
        is_known = row in known
        dated.append(
            CourseStep(
                row=row,
                interval_s=(t_s[row - 1], t_s[row]) if is_known else (float(interval[0]), float(interval[1])),
                probability=1.0 if is_known else float(np.diff(cumulative)[here]),
                p_value=0.0 if is_known else min(1.0, (count - 1) * float(chdtrc(3, gains[here]))),
                is_exchange=is_known,
                theta=fit.coefficients[first + n],
                covariance=_block(fit.covariance, first + n, 1),
            )
        )
    return tuple(dated)


def fit_columns(series: MountingSeries, X: Floats, density: float = 0.0) -> CourseFit:
    """The best coefficients of columns (K, m); with a density (rad²/s) the walk's ramps after them."""
    normal = _Normal.of(series, X, with_walk=density > 0.0)
    _, scale, factor = normal.factored(series, density)
    n, x = len(normal.N), scale * cho_solve(factor, scale * normal.right)
    inverse = cho_solve(factor, np.eye(len(x)))[:n, :n] * np.outer(scale[:n], scale[:n])
    return CourseFit(
        coefficients=x[:n].reshape(-1, 3),
        covariance=0.5 * (inverse + inverse.T),
        shared=x[n:],
        explained=float(x @ normal.right),
    )


def step_gains(series: MountingSeries, X: Floats, density: float, rows: Ints) -> tuple[Floats, Floats]:
    """Fall of chi2 (G,) by one more step before each of `rows` (G,) beside columns (K, m) and the walk, and
    the logarithm of the determinant of the information on it.
    """
    normal = _Normal.of(series, X, with_walk=density > 0.0)
    _, scale, factor = normal.factored(series, density)
    n, x = len(normal.N), scale * cho_solve(factor, scale * normal.right)
    of_columns, of_walk = np.split(x[:n].reshape(-1, 3), [X.shape[1]])
    there = X @ of_columns + normal.walk.course(of_walk)
    residual = series.right - np.einsum("kab,kb->ka", series.F, there) - series.F_shared @ x[n:]
    own = _from(series.F, rows)
    ramps = normal.walk.sums_from(series.F.reshape(-1, 9), rows).reshape(len(rows), -1, 3)
    columns = _from(X[:, :, None, None] * series.F[:, None], rows).reshape(len(rows), -1, 3)
    C = np.concatenate([columns, ramps, np.swapaxes(_from(series.F_shared, rows), 1, 2)], axis=1)
    wide = (C * scale[:, None]).transpose(1, 0, 2).reshape(len(x), -1)
    half = solve_triangular(factor[0], wide, lower=True).reshape(len(x), len(rows), 3)
    information = own - np.einsum("nga,ngb->gab", half, half, optimize=True)
    values, vectors = np.linalg.eigh(0.5 * (information + np.swapaxes(information, 1, 2)))
    # a direction that mean, terms and steps take up already has no information left
    seen = values > 1e-9 * np.einsum("gaa->g", own)[:, None]
    along = np.einsum("gab,ga->gb", vectors, _from(residual, rows))
    values = np.where(seen, values, 1.0)
    return np.sum(np.where(seen, along**2 / values, 0.0), axis=1), np.sum(np.log(values), axis=1)


@record
class _Walk:
    """The ramps of a walk by sums: each is 0 before its interval between two knots, and 1 after it."""

    steps_s: Floats  # (w,) lengths of the intervals
    first: Ints  # (w + 1,) first row in each, and the number of rows
    whole: csr_array  # (w, K) which results are in it
    part: csr_array  # (w, K) how much of it has passed at these

    @classmethod
    def between(cls, knots: Floats, t_s: Floats) -> _Walk:
        first = np.append(np.searchsorted(t_s, knots[:-1]), len(t_s))
        begin, steps_s = (np.repeat(values, np.diff(first)) for values in (knots[:-1], np.diff(knots)))
        at, shape = np.arange(len(begin)), (len(first) - 1, len(t_s))
        part = (t_s - begin) / steps_s if len(begin) else begin
        first = first if len(begin) else np.zeros(1, dtype=int)
        whole, passed = (csr_array((data, at, first), shape) for data in (np.ones(len(at)), part))
        return cls(np.diff(knots), first, whole, passed)

    def course(self, ramps: Floats) -> Floats:
        """The walk (K, 3) of the ramps' coefficients (w, 3)."""
        return np.asarray(self.whole.T @ (np.cumsum(ramps, axis=0) - ramps) + self.part.T @ ramps)

    def sums(self, values: Floats, of: csr_array | None = None) -> Floats:
        """Sums (w, n) of ramp times values (K, n) of the results; `of` (w, K): the ramps in the intervals."""
        return np.asarray((self.part if of is None else of) @ values + self.after(values))

    def after(self, values: Floats) -> Floats:
        """Sums (w, n) of values (K, n) over the rows after each interval."""
        within = self.whole @ values
        return np.asarray(np.cumsum(within[::-1], axis=0)[::-1] - within)

    def sums_from(self, values: Floats, rows: Ints) -> Floats:
        """Sums (G, w, n) of ramp times values (K, n) over the rows k >= row, for each of `rows`."""
        own = np.searchsorted(self.first, rows, side="right") - 1  # interval of each row
        if not len(self.steps_s):
            return np.zeros((len(rows), 0, values.shape[1]))
        order = (np.arange(len(self.steps_s)) - own[:, None])[:, :, None]
        part = self.part.sum(axis=0)[:, None] * values
        here = _from(part, rows) + (self.after(values) - self.after(part))[own]
        later = np.where(order > 0, self.sums(values), here[:, None])
        return np.where(order < 0, _from(values, rows)[:, None], later)


@record
class _Normal:
    """Normal equations of columns, of the walk's ramps after them, and of the shared unknowns."""

    walk: _Walk
    N: Floats  # (3 m, 3 m) of columns and ramps
    cross: Floats  # (3 m, n) with the shared unknowns
    right: Floats  # (3 m + n,)

    @classmethod
    def of(cls, series: MountingSeries, X: Floats, with_walk: bool) -> _Normal:
        walk = _Walk.between(_knots(series.t_s) if with_walk else np.zeros(1), series.t_s)
        c, (a, b) = X.shape[1], np.triu_indices(3)
        m, F = c + len(walk.steps_s), series.F[:, a, b]
        each, ramp = (X[:, :, None] * F[:, None]).reshape(len(X), -1), np.arange(m - c)
        upper = np.empty((m, m, len(a)))
        upper[:c, :c] = (X.T @ each).reshape(c, c, -1)
        upper[c:, :c] = walk.sums(each).reshape(-1, c, len(a))
        upper[:c, c:] = np.swapaxes(upper[c:, :c], 0, 1)
        upper[c:, c:] = walk.sums(F)[np.maximum(ramp[:, None], ramp)]  # the earlier one is 1 there
        upper[c + ramp, c + ramp] = walk.sums(F, walk.part.power(2))
        blocks = np.empty((m, 3, m, 3))
        blocks[:, a, :, b] = blocks[:, b, :, a] = np.moveaxis(upper, 2, 0)
        cross, right = (
            np.concatenate([X.T @ values, walk.sums(values)]).reshape(3 * m, -1)
            for values in (series.F_shared.reshape(len(X), -1), series.right)
        )
        right = np.concatenate([right.ravel(), series.shared_right])
        return cls(walk, blocks.reshape(3 * m, 3 * m), cross, right)

    def factored(self, series: MountingSeries, density: float) -> tuple[Floats, Floats, tuple[Any, bool]]:
        """Prior information (3 m,) of the columns with a density of the walk, the scale (3 m + n,) of all
        unknowns, and the factor of the equations so scaled: coefficients are radians, shared unknowns are in
        units of their prior.
        """
        prior, w = np.zeros(len(self.N)), len(self.walk.steps_s)
        prior[len(prior) - 3 * w :] = np.repeat(1.0 / (density * self.walk.steps_s), 3) if w else 0.0
        whole = np.block([[self.N + np.diag(prior), self.cross], [self.cross.T, series.shared_F]])
        scale = 1.0 / np.sqrt(np.diag(whole))
        return prior, scale, cho_factor(whole * np.outer(scale, scale), lower=True)

    def loss(self, series: MountingSeries, density: float) -> float:
        """-2 log L with a density of the walk, from that of theta = 0 at rest."""
        prior, scale, factor = self.factored(series, density)
        right = scale * self.right
        return self.log_volume(series, prior) - float(right @ cho_solve(factor, right))

    def log_volume(self, series: MountingSeries, prior: Floats) -> float:
        """log |I + Q Zᵀ L Z| of the walk: Q the prior covariance of its ramps, L the results' information."""
        walk = prior > 0.0
        if not walk.any():
            return 0.0
        shared = self.cross[walk] @ np.linalg.solve(series.shared_F, self.cross[walk].T)
        inner, root = self.N[np.ix_(walk, walk)] - shared, prior[walk] ** -0.5
        return float(np.linalg.slogdet(np.eye(len(root)) + root[:, None] * inner * root)[1])


def _with_walk(model: CourseModel, series: MountingSeries) -> tuple[CourseModel, float]:
    """The model with the most likely density of the walk, and the probability of so much by chance."""
    at_rest, X = model._replace(density=0.0), model.columns(series)
    if len(series.t_s) < X.shape[1] + 2:
        return at_rest, 1.0
    sigma2 = 1.0 / np.median(np.linalg.eigvalsh(series.F), axis=0)[-1]
    span = float(series.t_s[-1] - series.t_s[0])
    rest, normal = at_rest.loss(series), _Normal.of(series, X, with_walk=True)

    def loss(log_density: float) -> float:
        return normal.loss(series, float(np.exp(log_density)))

    around = np.log(sigma2 / span)
    grid = around + np.linspace(-4.0, 10.0, 8)
    losses = [loss(x) for x in grid]
    best = int(np.argmin(losses))
    if losses[best] >= rest:
        return at_rest, 1.0
    window = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(loss, bounds=window, method="bounded", options={"xatol": 0.05})
    gain = max(rest - float(found.fun), 0.0)
    return model._replace(density=float(np.exp(found.x))), 0.5 * float(chdtrc(1, gain))


def explained_by_free(series: MountingSeries) -> float:
    """Fall of chi2 where each result has a theta of its own."""
    gain = np.linalg.solve(series.F, series.F_shared)
    free = np.linalg.solve(series.F, series.right[:, :, None])[:, :, 0]
    S = series.shared_F - np.einsum("kas,kat->st", series.F_shared, gain)
    right = series.shared_right - np.einsum("kas,ka->s", gain, series.right)
    own = float(np.einsum("ka,ka->", series.right, free))
    return own + (float(right @ np.linalg.solve(S, right)) if len(S) else 0.0)


def _knots(t_s: Floats) -> Floats:
    """Instants between which the walk is straight."""
    distinct = np.unique(t_s)
    return distinct if len(distinct) <= MOST_KNOTS else np.linspace(t_s[0], t_s[-1], MOST_KNOTS)


def _ramps(t_s: Floats, knots: Floats) -> Floats:
    """(N, knots - 1) parts of each interval between knots that have passed at instants (N,)."""
    return np.clip((t_s[:, None] - knots[:-1]) / np.diff(knots), 0.0, 1.0)


def _from(values: Floats, rows: Ints) -> Floats:
    """Sums over the rows k >= row, for each of `rows`, increasing."""
    at, first = np.arange(rows[0], len(values)), np.append(rows, len(values)) - rows[0]
    groups = csr_array((np.ones(len(at)), at, first), (len(rows), len(values)))
    sums = groups @ values.reshape(len(values), int(np.prod(values.shape[1:])))
    return np.cumsum(sums[::-1], axis=0)[::-1].reshape(len(rows), *values.shape[1:])


def _block(covariance: Floats, first: int, count: int) -> Floats:
    here = slice(3 * first, 3 * (first + count))
    return covariance[here, here]


def with_reference_moved(series: MountingSeries, shift: Floats) -> MountingSeries:
    """The series about references that deviate by -shift (K, 3) from its own: theta becomes theta + shift."""
    return replace(
        series,
        right=series.right + np.einsum("kab,kb->ka", series.F, shift),
        shared_right=series.shared_right + np.einsum("kas,ka->s", series.F_shared, shift),
    )
