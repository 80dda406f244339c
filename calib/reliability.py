"""Reliability of an adjustment: which error of an input explains what the estimate contradicts, which errors
would be found, and which cannot be seen at all (Baarda 1968; Teunissen, Testing Theory, 2006; 2018).

For whitened residuals r, the matrix M that takes them to what all estimated unknowns leave, and a hypothesis
whose unit moves r by B (`hypotheses`):

    size        b = Bᵀ M r / S,    S = Bᵀ M B,    variance 1 / S
    test        T = b² S,    chi-square of one degree of freedom if the input is right
    detectable  b_min = sqrt(lambda / S): found with probability 0.9 at the false-alarm rate of the test
    effect      theta moves by x b, x the part of theta of the solution with B as residuals
    redundancy  S / (S + xᵀ F x), F the information on theta: 0 if theta takes up the whole error

What was rejected counts: observations are good with normal errors, or gross errors of any size at a cost k,
the limit of their test. The evidence for a hypothesis is by how much it lowers

    chi2(observations kept) + k (number rejected),

each searched anew for its minimum, which is the likelihood of a mixture of good and gross observations. The
hypothesis of most evidence becomes an unknown and the rest is tested again, three at most. The p-values of
all hypotheses together keep the stated false-alarm rate (Holm 1979). A further cause must have a hundredth of
the evidence of those before it, or of the chi-square of their sizes, where that is more: a linear column
leaves something of a large error.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from operator import is_

import numpy as np
from scipy import sparse
from scipy.special import chdtrc, chdtri

from boresight.calib import hypotheses, joint_solution
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.finding import MOST_WORDS, Finding
from boresight.calib.gross_errors import noncentrality_of
from boresight.calib.heads import aligned
from boresight.calib.noise_groups import LEAST_FACTOR, NoiseGroup, noisiest
from boresight.calib.settings import CalibrationSettings
from boresight.calib.simultaneous_strips import moved_in_passes, passes_of
from boresight.calib.star_camera_error import star_effects, summed
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import StripSightings
from boresight.geometry.star_camera import StarCamera
from boresight.records.ledger import Subject
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["PROBABILITY_FOUND", "Contradiction", "HypothesisTest", "Reliability", "blind_spots", "examine"]

PROBABILITY_FOUND = 2e-3  # that right inputs are said to look wrong, all hypotheses together
PROBABILITY_REFUTED = 5e-4  # that right inputs are said to spoil the matrix
HARM_SIGMA = 1.0  # change of theta, in its 1-sigma, by which a cause refutes
# Most causes that are named together for one calibration: with more, any pattern of residuals is explained
# (set by hand).
MOST_CAUSES = 3
STATED = ("cause", "item", "unit", "file", "field")  # what tests and findings repeat of a hypothesis
# Share of an error that shows in the residuals, below which it is a blind spot: it shows only at a hundred
# times its own size.
LEAST_REDUNDANCY = 0.01
NO_REDUNDANCY = 1e-5  # less is rounding and curvature: the error explains nothing
HIDDEN_SIGMA = 2.0  # harm that may stay hidden and is named
# Probability with which an error of the stated minimal detectable size is found (Baarda 1968 has 0.8; set
# by hand).
POWER = 0.9
PROBABILITY_SUSPECT = 1e-3  # that any of all good observations is named
MOST_SEARCHED = 16  # hypotheses under which rejected observations are searched anew, the likeliest ones
MOST_ROUNDS = 8  # of such a search
BEYOND_SIGMAS = 3.0  # by which an estimated size may exceed the largest possible one
EQUAL = 1.0  # difference of evidence by which two causes explain the same
MOST_RIVALS = 3  # that a finding names
LEAST_RANGE_M = 4e5  # of a satellite to what it sees
NOT_LINEAR = 0.01  # of the evidence of a cause: less may be what its linear form leaves
AMBIGUOUS = 2.0 * np.log(19.0)  # difference of evidence below which the data do not tell two causes apart


@record(kw_only=True)
class HypothesisTest:
    """One hypothesis, tested at the weights of the estimate."""

    cause: str = scalar("what would be wrong")
    item: str = scalar("what it concerns")
    unit: str = scalar("of all sizes")
    file: str = scalar("file of the dump that states the input")
    field: str = scalar("field of that file")
    value: float = scalar("size of the error, stated less true; NaN: nothing shows it")
    sigma: float = scalar("1-sigma of `value`; inf: nothing shows it")
    statistic: float = scalar("chi-square of 1 degree of freedom if the input is right")
    p_value: float = scalar("of `statistic`")
    detectable: float = scalar("smallest error that is found with probability 0.9; inf: none")
    redundancy: float = scalar("0: the matrix takes up the whole error, 1: it takes up none")
    effect_rad: Floats = array("T", "change of theta by one unit, axes of c of each camera, rad")
    effect_sigma: float = scalar("the same in 1-sigma of theta")

    @property
    def is_unseen(self) -> bool:
        """Whether theta takes up all, but for a hundredth, that the error does to the observations."""
        return self.redundancy < LEAST_REDUNDANCY

    @property
    def hidden_sigma(self) -> float:
        """By how much, in 1-sigma of theta, the smallest error that is found moves theta."""
        return self.effect_sigma * self.detectable if self.effect_sigma > 0.0 else 0.0


@record(kw_only=True)
class Contradiction:
    """An observation that contradicts the rest, and that no cause explains."""

    subject: Subject = scalar("target or star, with strip and CCD")
    distance: float = scalar("from where the rest places it, in standard errors")
    residual: Floats = array("2", "what contradicts, all unknowns estimated, whitened")
    estimated: Floats = array("2", "part of it by which estimated unknowns differ from what was measured")
    covariance: Floats = array("2, 2", "of both: errors of the observation and of all that places it")
    by_place: Floats = array("2, 3", "change of both by a target stated 1 m too far along, right, down")

    def displaced_m(self, stated_m: Floats, axes_o: Floats) -> tuple[Floats, Floats]:
        """How far the stated place lies from the true one along two directions `axes_o` (3, 2), along the
        track, to the right and down, m (2,) with covariance, m². `stated_m` (2,) is the same by rays to the
        ground, with attitudes that are not those of the estimate: it enters as far as the distance is so
        large that its square, by the least distance of a satellite, exceeds its 1-sigma.
        """
        back = np.linalg.inv(self.by_place @ axes_o)
        covariance = back @ self.covariance @ back.T
        curved = (stated_m @ stated_m / LEAST_RANGE_M) ** 2
        share = curved / (curved + 0.5 * np.trace(covariance))
        off_m = back @ self.residual + share * (stated_m - back @ (self.residual - self.estimated))
        return off_m, covariance


@record
class Reliability:
    """Tests of all hypotheses, the causes that they name, and what these do not explain."""

    tests: tuple[HypothesisTest, ...] = scalar("every hypothesis, in the order of the table")
    findings: tuple[Finding, ...] = scalar("causes, the one of most evidence first")
    suspects: tuple[Contradiction, ...] = scalar("observations farther off than any of so many good ones")
    of_bias: tuple[hypotheses.Hypothesis, ...] = scalar(
        "those about the ground, of a largest possible size, that explain its bias", default=()
    )
    rest: tuple[float, int] | None = scalar(
        "chi-square that the causes leave, and its degrees of freedom; None: no cause, or one of noise",
        default=None,
    )
    scatter: Finding | None = scalar("the last cause, where it is larger errors of a group", default=None)


@record
class _Fit:
    """A minimum of the mixture's criterion, some hypotheses being unknowns."""

    kept: Bools  # (J,)
    criterion: float
    theta: Floats  # (3 C,) about the matrices of the estimate
    covariance: Floats  # (3 C, 3 C) of theta
    size: Floats  # (H,) of the hypotheses
    sigma: Floats  # (H,)
    statistic: Floats  # (J,) of the observations, chi-square of two degrees of freedom
    residual: Floats  # (J, 2) whitened
    variance: Floats  # (J, 2, 2) of the residuals

    def rest(self, limit: float, n: int) -> tuple[float, int]:
        """Chi-square of the observations kept, of n, and its degrees of freedom."""
        kept = int(self.kept.sum())
        return self.criterion - limit * (n - kept), 2 * kept - len(self.theta) - len(self.size)


@record(kw_only=True)
class _Adjustment:
    """A calibration about its result, with the columns of all hypotheses."""

    problem: joint_solution.Problem = scalar("strips of the calibration")
    step: joint_solution.Step = scalar("with the weights of the estimate")
    of: hypotheses.HypothesisInputs = scalar("what the hypotheses are computed from")
    table: list[hypotheses.Hypothesis] = scalar("H hypotheses")
    B: sparse.csc_array = scalar(
        "change (2 J, H) of the whitened residuals, two a target, by one unit of each"
    )
    by_place: Floats = array("J, 2, 3", "the same by a target stated 1 m too far along, right, down")
    measured: Floats = array(
        "J, 2", "whitened residuals by what was measured, no unknown but theta estimated"
    )
    star_information: Floats = array("H, H", "of the stars of the exposures")
    star_right: Floats = array("H", "right-hand side of the stars")
    limit: float = scalar("cost of a rejected observation")
    tolerated: float = scalar("factor of true over stated standard deviations")

    def solved(self, weight: Floats | Bools) -> joint_solution.Step:
        """The solution with other weights (J,)."""
        return joint_solution.solve_weighted(self.problem, self.step.about, weight.astype(float), self.step)

    def beside(
        self, step: joint_solution.Step, chosen: Sequence[int]
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Of every hypothesis beside a solution and the hypotheses `chosen`: information (H,) on its size,
        and the same with their sizes given, right-hand side (H,), and change of theta (H, T) by one unit and,
        in 1-sigma, its square (H,).
        """
        given, with_chosen, x = joint_solution.absorbed(step, self.B, chosen)
        given, with_chosen = (
            given + np.diag(self.star_information),
            with_chosen + self.star_information[chosen],
        )
        lift = np.linalg.pinv(with_chosen[:, chosen], rcond=1e-10, hermitian=True) @ with_chosen
        right = (step.weight[:, None] * step.whitened).ravel() @ self.B + self.star_right
        theta = x[: len(step.solution.theta)].T
        by_theta = np.einsum("ha,ab,hb->h", theta, step.solution.information, theta)
        own = given - np.sum(with_chosen * lift, axis=0)
        return own, given, right - lift.T @ right[chosen], theta, by_theta

    def concerns(self, hypothesis: int) -> Bools:
        """The observations (J,) that a hypothesis moves."""
        moved = np.zeros(len(self.step.weight), dtype=bool)
        moved[self.B.indices[self.B.indptr[hypothesis] : self.B.indptr[hypothesis + 1]] // 2] = True
        return moved

    def subjects(self, rows: Bools) -> tuple[Subject, ...]:
        """The observations of a mask (J,)."""
        return tuple(self.of.subject(row) for row in np.flatnonzero(rows).tolist())


def blind_spots(tests: Sequence[HypothesisTest]) -> tuple[HypothesisTest, ...]:
    """Errors that the data cannot show, those with most effect a unit first; then those that may move theta
    by more than 2 sigma before they are found, those that hide most first.
    """
    unseen = sorted((t for t in tests if t.is_unseen), key=lambda t: -t.effect_sigma)
    hidden = (t for t in tests if not t.is_unseen and t.hidden_sigma > HIDDEN_SIGMA)
    return (*unseen, *sorted(hidden, key=lambda t: -t.hidden_sigma))


def examine(
    estimate: InstallationEstimate,
    strips: Sequence[StripSightings],
    settings: CalibrationSettings,
    *,
    pixel_rad: float | Mapping[str, float],
    star_camera: StarCamera | None = None,
    inputs: Sequence[hypotheses.MovedInput] = (),
    pivots: Mapping[tuple[str, int], float] | None = None,
    target_files: str = "targets.csv",
    sigma_understated: float = 1.1,
    table_of: hypotheses.HypothesisTable = hypotheses.hypotheses,
) -> Reliability:
    """Every hypothesis held against a calibration, the `estimate` of `calibrate_strips` by `settings`: the
    tests at its weights, and at most three causes.

    Observations of `strips` that the estimate does not contain, those of a strip that was not used, say,
    count as rejected. `pixel_rad` is the angle of a pixel of the remote-sensing camera, or of each by name;
    `star_camera` the one whose model gave the stars' directions, None where attitudes were delivered;
    `inputs` are further inputs whose errors were evaluated by prediction; `pivots` samples about which CCDs
    rotate, by camera and CCD, else the mean of their observations; `target_files` those with the coordinates
    of the targets, as findings name them; true standard deviations may be `sigma_understated` times the
    stated ones; `table_of` gives the hypotheses.
    """
    posed = _posed(estimate, strips, settings)
    moved = [moved_in_passes(one, strips, posed.passes) for one in inputs]
    problem, found, limit, names = posed.problem, estimate.targets, estimate.rejection.limit, estimate.cameras
    passes = [posed.passes[n] for n in problem.members]
    prepared = [posed.prepared[n] for n in problem.members]
    effects = star_effects(passes, star_camera, limit) if star_camera else []
    of = hypotheses.HypothesisInputs(
        prepared,
        estimate.R_cs,
        [pixel_rad[name] if isinstance(pixel_rad, Mapping) else pixel_rad for name in names],
        effects=effects,
        inputs=moved,
        pivots=pivots,
        target_files=target_files,
        cameras=names,
        usual={
            hypotheses.STABILITY: settings.sigma_mounting_rad / ARCSEC,
            hypotheses.POSITION: max(hypotheses.USUAL[hypotheses.POSITION], settings.sigma_position_m),
        },
    )
    keys = zip(found.strip_id.tolist(), found.target_id.tolist(), found.ccd.tolist(), found.sample.tolist())
    weights = dict(zip(keys, found.weight.tolist()))
    columns = of.column("strip"), of.ground.target_id, of.ground.ccd, of.ground.xy_px[:, 0]
    weight = np.array([weights.get(key, 0.0) for key in zip(*(column.tolist() for column in columns))])
    step = joint_solution.solve_weighted(
        problem, joint_solution.linearised(problem, estimate.R_cs), weight * problem.inside
    )
    table, across = table_of(of), step.across
    information, right = summed(effects)
    parts = np.array([h.star_part for h in table])
    off_c: Floats = of.ground.u_c - of.in_c(of.column("v_s"))
    one = _Adjustment(
        problem=problem,
        step=step,
        of=of,
        table=table,
        B=_columns(across, table),
        by_place=across @ of.C @ of.column("move_s"),
        measured=(across @ off_c[:, :, None])[:, :, 0],
        star_information=information[np.ix_(parts, parts)] * np.outer(parts >= 0, parts >= 0),
        star_right=right[parts] * (parts >= 0),
        limit=limit,
        tolerated=sigma_understated,
    )
    tests = _tests(one)
    findings, chosen, last, noise = _causes(one, tests)
    suspects, of_bias = tuple(_suspects(one, chosen, last, noise)), tuple(_of_bias(one, estimate))
    rest = last.rest(limit, int(problem.inside.sum())) if chosen and noise is None else None
    scatter = findings[-1] if noise is not None else None
    return Reliability(tuple(tests), tuple(findings), suspects, of_bias, rest, scatter)


def _posed(
    estimate: InstallationEstimate, strips: Sequence[StripSightings], settings: CalibrationSettings
) -> joint_solution.Posed:
    """The problem that an estimate solves, or that its strips pose with what it does not contain."""
    known = estimate.posed
    if known and known.problem.settings is settings and len(known.strips) == len(strips):
        if all(map(is_, known.strips, strips)):
            return known
    first = estimate.heads[0].R_cs
    alignment = {head.name: first.inv() * head.R_cs for head in estimate.heads}
    passes = aligned(passes_of(strips, settings.attitudes), alignment)
    return joint_solution.Posed.of(strips, passes, settings, (), estimate.cameras, estimate.prior)


def _columns(across: Floats, table: Sequence[hypotheses.Hypothesis]) -> sparse.csc_array:
    """Change (2 J, H) of the whitened residuals by one unit of each hypothesis."""
    size = [(across[h.rows] @ h.moves_c[:, :, None]).ravel() for h in table]
    rows = [(2 * h.rows[:, None] + np.arange(2)).ravel() for h in table]
    first = np.cumsum([0, *map(len, rows)])
    B = sparse.csc_array(
        (np.concatenate(size), np.concatenate(rows), first), shape=(2 * len(across), len(table))
    )
    B.eliminate_zeros()
    return B


def _tests(one: _Adjustment) -> list[HypothesisTest]:
    """Every hypothesis by itself, at the weights of the estimate."""
    S, _, y, theta, by_theta = one.beside(one.step, [])
    redundancy = np.divide(S, S + by_theta, out=np.zeros(len(S)), where=S + by_theta > 0.0)
    seen = redundancy > 1e-9
    limit = float(chdtri(1, PROBABILITY_FOUND / len(S)))
    noncentrality = noncentrality_of(limit, 1, POWER) * one.tolerated**2
    tests = []
    for n, h in enumerate(one.table):
        statistic = float(y[n] ** 2 / S[n]) if seen[n] else 0.0
        tests.append(
            HypothesisTest(
                **{name: getattr(h, name) for name in STATED},
                value=float(y[n] / S[n]) if seen[n] else np.nan,
                sigma=float(S[n] ** -0.5) if seen[n] else np.inf,
                statistic=statistic,
                p_value=float(chdtrc(1, statistic / one.tolerated**2)),
                detectable=float(np.sqrt(noncentrality / S[n])) if seen[n] else np.inf,
                redundancy=float(redundancy[n]),
                effect_rad=theta[n],
                effect_sigma=float(np.sqrt(by_theta[n])),
            )
        )
    return tests


def _of_bias(one: _Adjustment, estimate: InstallationEstimate) -> Iterator[hypotheses.Hypothesis]:
    """Hypotheses about targets on the ground of which some possible size leaves nothing of the bias of the
    orbit that is significant: the bias takes up what they do to the residuals.
    """
    if (bias := estimate.bias) is None:
        return
    names = list(one.problem.shared.names)
    rows = [len(estimate.theta) + names.index(f"bias/{name}") for name in bias.names]
    x = joint_solution.absorbed(one.step, one.B)[2]
    weight = np.linalg.inv(bias.covariance + np.diag(bias.stated**2))
    limit = float(chdtri(len(rows), PROBABILITY_SUSPECT))
    before = float(bias.value @ weight @ bias.value)
    is_star = one.of.ground.is_star
    for n, (h, effect_m) in enumerate(zip(one.table, (x[rows] * bias.stated[:, None]).T)):
        own = float(effect_m @ weight @ effect_m)
        if np.isfinite(h.most) and not (one.concerns(n) & is_star).any() and own * h.most**2 > limit:
            size = float(effect_m @ weight @ bias.value) / own
            possible = abs(size) < h.largest + BEYOND_SIGMAS / np.sqrt(own)
            if possible and before - own * size**2 < limit < before:
                yield h


def _suspects(
    one: _Adjustment, chosen: Sequence[int], last: _Fit, noise: NoiseGroup | None
) -> Iterator[Contradiction]:
    """Observations that the last fit, with the hypotheses `chosen`, rejects: beyond the limit of all of them
    together, and beyond what the linear form leaves of a large error that concerns them. Where a group has
    larger errors than stated, it is held against these.
    """
    if noise:
        scaled = np.where(noise.inside, last.statistic / noise.factor**2, last.statistic)
        last = replace(last, statistic=scaled, kept=last.kept | (scaled < one.limit))
    limit = np.full(len(last.kept), float(chdtri(2, PROBABILITY_SUSPECT / len(last.kept))))
    for n, size, sigma in zip(chosen, last.size, last.sigma):
        limit += NOT_LINEAR * (size / sigma) ** 2 * one.concerns(n)
    for n in np.flatnonzero(one.problem.inside & ~last.kept & (last.statistic > limit)).tolist():
        yield Contradiction(
            subject=one.of.subject(n),
            distance=float(np.sqrt(last.statistic[n])),
            residual=last.residual[n],
            estimated=last.residual[n] - one.measured[n],
            covariance=last.variance[n],
            by_place=one.by_place[n],
        )


def _causes(
    one: _Adjustment, tests: Sequence[HypothesisTest]
) -> tuple[list[Finding], list[int], _Fit, NoiseGroup | None]:
    """Forward selection: hypotheses that explain more than chance, each beside those before it; their rows,
    and the fit with all of them as unknowns. It ends with a group whose errors are larger than stated, where
    that explains more than any hypothesis.
    """
    lost = int(np.sum(one.problem.inside & (one.step.weight < 1.0)))  # rejected, or of less weight
    if lost < 2 and min(test.p_value for test in tests) * len(tests) >= PROBABILITY_FOUND:
        plain = one.solved(one.problem.inside & (one.step.weight > 0.0))
        return [], [], next(_fits(one, [[]], plain)), None
    chosen: list[int] = []
    findings: list[Finding] = []
    n, before, strongest = len(one.table), _minima(one, [[]], _starts(one))[0], 0.0
    while len(chosen) < MOST_CAUSES:
        likeliest = _likeliest(one, chosen, before)
        minima = _minima(one, [[*chosen, h] for h in likeliest], _starts(one, before.kept))
        trials = dict(zip(likeliest, minima))
        largest = {h: one.table[h].largest + BEYOND_SIGMAS * fit.sigma[-1] for h, fit in trials.items()}
        trials = {h: fit for h, fit in trials.items() if abs(fit.size[-1]) < largest[h]}  # sizes that can be
        gain = {h: before.criterion - fit.criterion for h, fit in trials.items()}
        worth = {h: gain[h] - one.table[h].price(float(fit.size[-1])) for h, fit in trials.items()}
        strip, ccd, is_star = one.of.column("strip"), one.of.ground.ccd, one.of.ground.is_star
        inside = one.problem.inside
        noise = noisiest(before.statistic, one.limit, one.tolerated, strip, ccd, is_star, inside)
        if noise and noise.gain > max(worth.values(), default=0.0):
            p_value = float(chdtrc(1, noise.gain)) * n
            if p_value <= PROBABILITY_FOUND:
                return [*findings, _of_noise(one, noise, before, p_value)], chosen, before, noise
        if not gain:
            break
        most = max(worth.values())
        # By what two linear forms of the same large error may differ.
        left = NOT_LINEAR * max(0.0, *gain.values())
        alike = [h for h in gain if most - worth[h] < EQUAL + left]
        decade = {h: np.floor((gain[h] - worth[h]) / (2.0 * np.log(10.0))) for h in alike}
        # Of equals the most usual size, then what concerns most, then the first of the table.
        best = min(alike, key=lambda h: (decade[h], -one.concerns(h).sum(), h))
        p_value = float(chdtrc(1, max(gain[best], 0.0) / one.tolerated**2)) * one.table[best].rarity
        if p_value * (n - len(chosen)) > PROBABILITY_FOUND:
            break
        rivals = sorted(h for h in gain if most - worth[h] < AMBIGUOUS + left)
        further = _finding(one, best, trials, rivals, p_value * (n - len(chosen)), before)
        if gain[best] < NOT_LINEAR * strongest:  # what the linear form of a large error leaves is its own
            findings[0] = replace(findings[0], refutes=findings[0].refutes or further.refutes)
            break
        chosen.append(best)
        findings.append(further)
        before = trials[best]
        strongest = max(strongest, gain[best], float((before.size[-1] / before.sigma[-1]) ** 2))
    return findings, chosen, before, None


def _of_noise(one: _Adjustment, noise: NoiseGroup, before: _Fit, p_value: float) -> Finding:
    """The finding about a group whose errors are larger than stated, and the matrix with these. It refutes
    where that moves the matrix, or makes some direction of it much less certain than stated.
    """
    squared = np.where(noise.inside, noise.factor**2, 1.0)
    kept = one.problem.inside & (before.statistic / squared < one.limit)
    solution = one.solved(kept / squared).solution
    moved, information = solution.theta - one.step.solution.theta, one.step.solution.information
    effect = float(np.sqrt(moved @ information @ moved))
    larger = float(np.sqrt(np.linalg.eigvals(information @ solution.covariance).real.max()))
    harms = effect > HARM_SIGMA or larger > LEAST_FACTOR
    return Finding(
        cause="noise of the image points or coordinates",
        item=noise.item,
        subjects=noise.subjects,
        text=f"{noise.factor:.2g} times the stated errors: check their stated sigmas, and vibration and "
        "distortion in dump.toml.",
        value=noise.factor,
        sigma=noise.factor / np.sqrt(4.0 * noise.inside.sum()),
        unit="times the stated",
        file="dump.toml",
        field="errors",
        refutes=harms and p_value <= PROBABILITY_REFUTED,
        effect_rad=-moved,
        effect_sigma=effect,
        p_value=min(p_value, 1.0),
        explains=one.subjects(noise.inside & ~before.kept),
    )


def _likeliest(one: _Adjustment, chosen: Sequence[int], before: _Fit) -> list[int]:
    """Hypotheses to search under: those that explain most at the weights as they are, and with rejected
    observations in the fit, each with what weight its residual leaves it.
    """
    inside, found = one.problem.inside, list[int]()
    plain = one.solved(before.kept)
    statistic = np.maximum(joint_solution.squared_mahalanobis(plain), 1e-9)
    soft = np.where(before.kept, 1.0, np.minimum(1.0, one.limit / statistic)) * inside
    for weight in (before.kept, soft, inside):
        step = one.solved(weight)
        own, given, right, _, by_theta = one.beside(step, chosen)
        seen = own > np.maximum(1e-9 * given, NO_REDUNDANCY * (own + by_theta))
        size = np.divide(right, own, out=np.zeros(len(own)), where=seen)
        gain = np.divide(right**2, own, out=np.zeros(len(own)), where=seen)
        gain -= [h.price(float(of_h)) for h, of_h in zip(one.table, size)]
        gain[chosen] = 0.0
        found += [n for n in np.argsort(-gain, kind="stable")[:MOST_SEARCHED].tolist() if gain[n] > 0.0]
    return list(dict.fromkeys(found))


def _starts(one: _Adjustment, *further: Bools) -> dict[bytes, joint_solution.Step]:
    """Solutions that searches begin with, by their observations: kept, of any weight, all, and `further`."""
    inside, weight = one.problem.inside, one.step.weight
    starts = (inside & (weight == 1.0), inside & (weight > 0.0), inside, *further)
    enough = (kept for kept in starts if 2 * kept.sum() >= len(one.step.solution.theta))
    return {kept.tobytes(): one.solved(kept) for kept in enough}


def _minima(
    one: _Adjustment, each: Sequence[Sequence[int]], starts: Mapping[bytes, joint_solution.Step]
) -> list[_Fit]:
    """The least criterion with hypotheses as unknowns, those of `each` set by themselves, searched from
    several `starts`. Searches that come to the same observations share their solution.
    """
    inside, n_theta = one.problem.inside, len(one.step.solution.theta)
    best: list[_Fit | None] = [None] * len(each)
    tried = set[tuple[int, bytes]]()
    for start in starts:
        reached = {start: [*range(len(each))]}
        for _ in range(MOST_ROUNDS):
            after = defaultdict[bytes, list[int]](list)
            for key, those in reached.items():
                kept = np.frombuffer(key, dtype=bool)
                new = [n for n in those if (n, key) not in tried and 2 * kept.sum() >= n_theta + len(each[n])]
                tried.update((n, key) for n in new)
                step = (starts.get(key) or one.solved(kept)) if new else one.step
                for n, fit in zip(new, _fits(one, [each[n] for n in new], step)):
                    least = best[n]
                    if fit.sigma.all() and (least is None or fit.criterion < least.criterion):
                        best[n] = fit  # without what an unknown would need, it is no explanation
                    after[(inside & (fit.statistic < one.limit)).tobytes()].append(n)
            reached = after
    # Where none of the starts has observations enough, all are kept.
    return [fit or next(_fits(one, [rows], one.solved(inside))) for fit, rows in zip(best, each)]


def _fits(one: _Adjustment, each: Sequence[Sequence[int]], step: joint_solution.Step) -> Iterator[_Fit]:
    """A solution of weights 0 and 1 with the hypotheses of `each` set as unknowns."""
    kept = step.weight == 1.0
    rejected = one.limit * float(np.sum(one.problem.inside & ~kept))
    columns = list(dict.fromkeys(row for rows in each for row in rows))
    B = one.B[:, columns].toarray()
    left_by, x_by = joint_solution.respond(step, B.reshape(len(kept), 2, len(columns)))
    weighted_by, x_by = np.repeat(step.weight, 2)[:, None] * B, x_by[: len(step.solution.theta)]
    for rows in each:
        of = [columns.index(row) for row in rows]
        left, weighted, x = left_by[:, :, of], weighted_by[:, of], x_by[:, of]
        S = weighted.T @ left.reshape(weighted.shape) + one.star_information[np.ix_(rows, rows)]
        y = weighted.T @ step.whitened.ravel() + one.star_right[rows]
        of_sizes = np.asarray(np.linalg.pinv(0.5 * (S + S.T), rcond=1e-10, hermitian=True), dtype=np.float64)
        size = of_sizes @ y
        e = step.whitened - left @ size
        leverage = step.leverage + left @ of_sizes @ np.swapaxes(left, 1, 2)
        variance = np.eye(2) + np.where(kept, -1.0, 1.0)[:, None, None] * leverage
        yield _Fit(
            kept,
            step.chi2 - float(y @ size) + rejected,
            step.solution.theta - x @ size,
            step.solution.covariance + x @ of_sizes @ x.T,
            size,
            np.sqrt(np.maximum(np.diag(of_sizes), 0.0)),
            joint_solution.squared_over(e, variance),
            e,
            variance,
        )


def _finding(
    one: _Adjustment, best: int, trials: dict[int, _Fit], rivals: Sequence[int], p_value: float, before: _Fit
) -> Finding:
    """The cause `best`; its harm is that of the rival which moves the matrix most."""
    h, fit = one.table[best], trials[best]
    information = one.step.solution.information
    published = one.step.solution.theta

    def harm(n: int) -> float:
        """How far theta moves, less what observations that come back move it by chance."""
        moved = trials[n].theta - published
        chance = float(np.trace(information @ (one.step.solution.covariance - trials[n].covariance)))
        return float(np.sqrt(max(float(moved @ information @ moved) - max(chance, 0.0), 0.0)))

    value, sigma = float(fit.size[-1]), float(fit.sigma[-1])
    worst = max(harm(n) for n in rivals)
    sign = h.words[0] if value > 0.0 else h.words[1]
    text = f"{abs(value):.3g} ± {sigma:.2g} {h.unit} {sign}: {h.remedy}"
    named = {one.table[n].named: one.table[n] for n in rivals}
    others = _rivals(h, [other for name, other in named.items() if name != h.named])
    excluded = "" if others else _excluded(one, best, trials, rivals, before)
    parts = [f"; or {_beside(h, other)}" for other in others]
    while len(f"{h.cause} {h.item} {text}{''.join(parts)}".split()) > MOST_WORDS and len(parts) > 1:
        parts, others = parts[:-1], others[:-1]
    text += "".join(parts)
    if excluded and len(f"{h.cause} {h.item} {text}{excluded}".split()) <= MOST_WORDS:
        text += excluded
    return Finding(
        cause=h.cause,
        item=h.item,
        text=f"{text}.",
        **{name: getattr(h, name) for name in ("unit", "file", "field", "subjects")},
        value=value,
        sigma=sigma,
        refutes=worst > HARM_SIGMA and p_value <= PROBABILITY_REFUTED,
        effect_rad=published - fit.theta,
        effect_sigma=worst,
        p_value=min(p_value, 1.0),
        rivals=tuple(other.named for other in others),
        explains=one.subjects(one.problem.inside & ~before.kept & fit.kept & one.concerns(best)),
    )


def _rivals(h: hypotheses.Hypothesis, others: Sequence[hypotheses.Hypothesis]) -> list[hypotheses.Hypothesis]:
    """Other causes that explain as much: the same of other items, then the first of each other kind."""
    alike = [other for other in others if other.cause == h.cause][:MOST_RIVALS]
    kinds: dict[str, hypotheses.Hypothesis] = {}
    for other in others:
        if other.cause != h.cause:
            kinds.setdefault(other.kind, other)
    return [*alike, *kinds.values()][:MOST_RIVALS]


def _beside(h: hypotheses.Hypothesis, other: hypotheses.Hypothesis) -> str:
    """Another cause in words, without what it has in common."""
    return other.item if other.cause == h.cause else other.cause if other.item == h.item else other.named


def _excluded(
    one: _Adjustment, best: int, trials: Mapping[int, _Fit], rivals: Sequence[int], before: _Fit
) -> str:
    """The cause of another kind that explains most of what the `best` one does, but for what excludes it:
    other residuals, or its size beside that of a usual error; then with the key that states it.
    """
    gain = {n: before.criterion - fit.criterion for n, fit in trials.items()}
    cause, usual_of = one.table[best].cause, one.table[best].usual_of
    others = [
        n for n in trials if n not in rivals and one.table[n].cause != cause and 2.0 * gain[n] > gain[best]
    ]
    if not others:
        return ""
    most = max(others, key=lambda n: gain[n])
    by_size = usual_of and gain[most] > gain[best] - AMBIGUOUS
    why = f", {usual_of} being {one.table[best].usual:g}" if by_size else ""
    return f"; not {one.table[most].named}{why}"
