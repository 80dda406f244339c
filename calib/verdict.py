"""Whether the data of a calibration contradict themselves: tests of the estimate's own statistics.

A wrong camera model, orbit or target list leaves traces that do not depend on the truth: residuals larger
than the stated standard deviations, strips that disagree, many rejected observations, coordinates that occur
twice. Each test has a p-value; the verdict is `refuted` if one falls below its share of the overall
false-alarm rate (Bonferroni). Stated standard deviations are never exact, so those of chi-square tests may be
off by a stated factor before the test counts it.

Residuals that are too small do not refute, they are a caution: an error that is stated too large makes the
covariance wide and the matrix no worse. What they may also mean is that the observations are not independent
(points from one model or one ortho-image): residuals do not show an error that all of them share.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from enum import Enum

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc, chdtr, chdtrc

from boresight.calib.estimate import InstallationEstimate
from boresight.calib.finding import Finding
from boresight.calib.heads import HeadAgreement, WithoutHead
from boresight.calib.hypotheses import Hypothesis
from boresight.calib.reliability import HypothesisTest, Reliability
from boresight.calib.simultaneous_strips import groups_of
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.records.ledger import Kind, Reason, Subject, count_words, list_words
from boresight.records.record import Floats, array, check_numbers, record, scalar

__all__ = ["Check", "CheckKind", "Outcome", "Suspect", "Verdict", "VerdictSettings", "assess", "p_residuals"]

SAME_PLACE_M = 0.05  # two surveyed targets are never nearer; rounding of coordinates is far smaller
LARGER, PROBABILITY_LARGER = 1.2, 1e-3  # residuals over the stated, and by chance, from which that is said
FEWEST_DOF = 5  # of the targets' residuals: with four targets any one of them is checked by the others
NEARLY_SAME_PLACE_M = 10.0  # candidates: along a straight path of the satellite instead of its curved one


class Outcome(Enum):
    """Result of the consistency tests."""

    CONSISTENT = "consistent"
    FINDINGS = "consistent, findings"
    REFUTED = "refuted"
    NOT_CHECKABLE = "not checkable"


class CheckKind(Enum):
    """What a check tests."""

    STAR_RESIDUALS = "residuals of stars"
    STARS_REJECTED = "share of stars rejected"
    TARGET_RESIDUALS = "residuals of targets"
    TARGETS_REJECTED = "share of targets rejected"
    BETWEEN_STRIPS = "agreement between strips"
    BETWEEN_HEADS = "agreement between heads"
    STEADY_HEADS = "alignment between heads from strip to strip"
    START_MATRIX = "distance from the pre-launch matrix"
    DUPLICATED_TARGETS = "equal coordinates of targets"
    CONVERGENCE = "convergence"
    ORBIT_BIAS = "bias of the orbit against the sky"


class Suspect(Enum):
    """Inputs to look at if a check fails."""

    STAR_CAMERA_MODEL = "focal length, principal point and distortion of the star camera"
    STAR_SIGMA = "stated noise of star positions"
    LINE_CAMERA_MODEL = "look directions of the remote-sensing camera"
    ORBIT = "positions and velocities of the satellite"
    CLOCKS = "times of rows, exposures and orbit"
    STATED_ERRORS = "stated errors of position, clock, vibration and distortion"
    TARGET_COORDINATES = "coordinates of targets, their height system and stated errors"
    TARGET_LIST = "targets listed more than once"
    HEADS = "attitudes of the head that is named: its times, its mounting, its aberration"
    HEAD_NOISE = "stated noise of attitudes ([star_cameras.noise], or sigma and cov columns of their file)"
    NOT_INDEPENDENT = "whether the observations share an error that residuals do not show"
    GROUND_MATRIX = "pre-launch installation matrix and its stated error"
    MOUNTING = "whether the mounting moved between the strips (boresight drift)"


# What to look at where a check is not passed, by its kind.
LOOK_AT = {
    CheckKind.STAR_RESIDUALS: (Suspect.STAR_CAMERA_MODEL, Suspect.STAR_SIGMA),
    CheckKind.STARS_REJECTED: (Suspect.STAR_CAMERA_MODEL, Suspect.STAR_SIGMA),
    CheckKind.TARGET_RESIDUALS: (
        Suspect.ORBIT,
        Suspect.TARGET_COORDINATES,
        Suspect.LINE_CAMERA_MODEL,
        Suspect.CLOCKS,
        Suspect.STATED_ERRORS,
    ),
    CheckKind.TARGETS_REJECTED: (
        Suspect.TARGET_COORDINATES,
        Suspect.LINE_CAMERA_MODEL,
        Suspect.HEAD_NOISE,
        Suspect.STATED_ERRORS,
    ),
    CheckKind.BETWEEN_STRIPS: (Suspect.ORBIT, Suspect.CLOCKS, Suspect.STATED_ERRORS, Suspect.MOUNTING),
    CheckKind.BETWEEN_HEADS: (Suspect.HEAD_NOISE, Suspect.HEADS),
    CheckKind.STEADY_HEADS: (Suspect.HEADS, Suspect.HEAD_NOISE),
    CheckKind.START_MATRIX: (Suspect.STAR_CAMERA_MODEL, Suspect.GROUND_MATRIX),
    CheckKind.DUPLICATED_TARGETS: (Suspect.TARGET_LIST,),
    CheckKind.CONVERGENCE: (Suspect.GROUND_MATRIX,),
    CheckKind.ORBIT_BIAS: (Suspect.ORBIT, Suspect.TARGET_COORDINATES, Suspect.STATED_ERRORS),
}


TOO_SMALL = {  # where residuals are smaller than stated
    CheckKind.STAR_RESIDUALS: (Suspect.STAR_SIGMA, Suspect.NOT_INDEPENDENT),
    CheckKind.TARGET_RESIDUALS: (Suspect.STATED_ERRORS, Suspect.TARGET_COORDINATES, Suspect.NOT_INDEPENDENT),
    CheckKind.BETWEEN_HEADS: (Suspect.HEAD_NOISE, Suspect.NOT_INDEPENDENT),
}
OF_HEADS = (CheckKind.BETWEEN_HEADS, CheckKind.STEADY_HEADS)  # tested only where there are several


@record
class VerdictSettings:
    """Limits of the verdict. They admit what correct data show."""

    probability_false_alarm: float = scalar(
        "that consistent data are refuted, all checks together", default=1e-4
    )
    sigma_understated: float = scalar("tolerated factor of true over stated standard deviations", default=1.1)
    sigma_overstated: float = scalar("tolerated factor of stated over true standard deviations", default=2.0)
    share_stars_rejected: float = scalar("tolerated share of stars with gross errors", default=0.02)
    share_targets_rejected: float = scalar("tolerated share of targets with gross errors", default=0.15)

    def __post_init__(self) -> None:
        check_numbers(self, zero=("share_stars_rejected", "share_targets_rejected"))


@record(kw_only=True)
class Check:
    """One test of the estimate's statistics."""

    kind: CheckKind = scalar("what is tested")
    statistic: float = scalar("chi-square, or a count")
    expected: float = scalar("value expected of consistent data: degrees of freedom, or the tolerated count")
    n: int = scalar("degrees of freedom, or number of observations counted")
    p_value: float = scalar(
        "probability of a statistic as unlikely as this, if the data are consistent and "
        "stated standard deviations are as far off as is tolerated; NaN: not applicable"
    )
    p_plain: float = scalar("the same with the stated standard deviations as they are; NaN: of a count")
    limit: float = scalar("p-value below which the check fails")
    names: tuple[tuple[str, ...], ...] = scalar(
        "groups of targets with equal coordinates; the head that contradicts; the orbit's bias", default=()
    )

    @property
    def holds(self) -> bool:
        """Whether the check was made and finds no contradiction."""
        return self.p_value >= self.limit

    @property
    def fails(self) -> bool:
        """Whether the check was made and finds a contradiction."""
        return self.p_value < self.limit

    @property
    def is_caution(self) -> bool:
        """Whether it fails because residuals are smaller than stated, which does not refute."""
        return self.fails and self.kind in TOO_SMALL and self.statistic < self.expected

    @property
    def look_at(self) -> tuple[Suspect, ...]:
        """Inputs to look at if the check fails, the likeliest first."""
        return (TOO_SMALL if self.is_caution else LOOK_AT)[self.kind]


@record(kw_only=True)
class Verdict:
    """Outcome of all checks, and the axis that the data determine worst."""

    outcome: Outcome = scalar(
        "`REFUTED` if a check fails, cautions excepted, or a finding refutes; else `NOT_CHECKABLE` where too "
        "little is redundant; else `FINDINGS` where a finding is a fault"
    )
    checks: tuple[Check, ...] = scalar("all checks, in a fixed order")
    probability_false_alarm: float = scalar("that consistent data are refuted, at most")
    weakest_axis_c: Floats = array("3", "unit vector, frame c: the rotation with the largest 1-sigma")
    weakest_sigma_rad: float = scalar("its 1-sigma, rad")
    dof: int = scalar("degrees of freedom of the targets' residuals, by which the matrix is checked")
    findings: tuple[Finding, ...] = scalar("probable causes, those that refute first", default=())
    tests: tuple[HypothesisTest, ...] = scalar(
        "what each input error would do, and what shows it", default=()
    )

    def with_findings(self, more: Sequence[Finding]) -> Verdict:
        """The verdict with further findings, and the outcome that follows from all of them."""
        findings = tuple(sorted((*self.findings, *more), key=lambda one: (not one.refutes, not one.is_fault)))
        return replace(self, findings=findings, outcome=_outcome(self.checks, self.dof, findings))

    @property
    def sentence(self) -> str:
        """The outcome in one line, for every place that states it."""
        applicable = [check for check in self.checks if check.holds or check.fails]
        held, n, cautions = sum(one.holds for one in applicable), len(applicable), len(self.cautions)
        faults = [one for one in self.findings if one.is_fault]
        match self.outcome:
            case Outcome.CONSISTENT:
                small = ", but residuals are smaller than stated" if cautions else ""
                missing = f", {len(self.checks) - n} not applicable" if n < len(self.checks) else ""
                return f"consistent: {held} of {n} checks hold{missing}{small}"
            case Outcome.FINDINGS:
                many = "1 input looks" if len(faults) == 1 else f"{len(faults)} inputs look"
                return f"consistent, findings: {many} wrong; correct and calibrate again"
            case Outcome.NOT_CHECKABLE:
                return (
                    f"not checkable: {max(self.dof, 0)} degrees of freedom, {FEWEST_DOF} are needed "
                    f"({FEWEST_DOF // 2 + 2} targets); add targets"
                )
        causes = [f"{one.cause}, {one.item}" for one in faults if one.refutes]
        causes = causes or [check.kind.value for check in self.refuted_by]
        more = f" and {len(causes) - 2} more" if len(causes) > 2 else ""
        return f"refuted by {'; '.join(causes[:2])}{more}; do not use this matrix"

    @property
    def refuted_by(self) -> tuple[Check, ...]:
        """Checks that fail, the least likely first."""
        failed = (c for c in self.checks if c.fails and not c.is_caution)
        return tuple(sorted(failed, key=lambda c: c.p_value))

    @property
    def cautions(self) -> tuple[Check, ...]:
        """Checks that fail because residuals are smaller than stated, the least likely first."""
        return tuple(sorted((c for c in self.checks if c.is_caution), key=lambda c: c.p_value))


def assess(
    estimate: InstallationEstimate,
    strips: Sequence[StripSightings],
    settings: VerdictSettings | None = None,
    *,
    sigma_installation_rad: Floats | None = None,
    reliability: Reliability | None = None,
    target_files: str = "targets.csv",
) -> Verdict:
    """The verdict on an estimate and the sightings that it was made from, of which only the targets'
    directions and ids are used.

    `sigma_installation_rad` (T,) is the 1-sigma of the starting matrix about the axes of frame c, of several
    cameras one after another; without it that check is not made. The causes of `reliability` decide with the
    checks. `target_files` are those with the coordinates of the targets, as findings name them.
    """
    settings, agreement = settings or VerdictSettings(), estimate.agreement
    single = agreement.dof <= 0 and agreement.dof_gain <= 0  # no checks of heads
    kinds = len(CheckKind) - single * len(OF_HEADS) - (estimate.bias is None)
    checks = _Checks(settings, settings.probability_false_alarm / kinds)
    found = [
        checks.residuals(CheckKind.STAR_RESIDUALS, estimate.chi2_stars, estimate.dof_stars),
        checks.residuals(CheckKind.TARGET_RESIDUALS, estimate.chi2, estimate.dof),
        *_shares(estimate, checks),
    ]
    heads, between = _between_heads(agreement, checks), _between_strips(estimate, checks)
    causes, of_bias = (reliability.findings, reliability.of_bias) if reliability else ((), ())
    # A head that moves, and a cause that refutes, set the strips against one another.
    named = any(check.names for check in heads) or any(one.refutes for one in causes)
    found += [replace(between, names=()) if named else between, *heads]
    if sigma_installation_rad is not None:
        found.append(_from_start(estimate, sigma_installation_rad, checks))
    found += [_duplicates(strips, checks), _convergence(estimate, checks), *_orbit_bias(estimate, checks)]
    of_cameras = [estimate.of_camera(name)[1] for name in estimate.cameras]
    values, vectors = np.linalg.eigh(max(of_cameras, key=lambda one: float(np.linalg.eigvalsh(one)[-1])))
    verdict = Verdict(
        outcome=Outcome.CONSISTENT,
        checks=tuple(found),
        dof=estimate.dof,
        tests=reliability.tests if reliability else (),
        probability_false_alarm=settings.probability_false_alarm,
        weakest_axis_c=vectors[:, -1],
        weakest_sigma_rad=float(np.sqrt(values[-1])),
    )
    heads_told = [one for one in _head_findings(heads) if not any(one.subjects == c.subjects for c in causes)]
    told = tuple(_twice_finding(found, target_files)) or heads_told or causes
    told = told or tuple(_orbit_finding(estimate, found, of_bias, target_files))
    return verdict.with_findings([*told, *_larger_than_stated(found, reliability)])


def _larger_than_stated(checks: Sequence[Check], reliability: Reliability | None) -> Iterator[Finding]:
    """That residuals are larger than stated by more than chance, though within what is tolerated: the
    covariance is as much too small. Where causes are found, those of targets that they leave.
    """
    causes, rest = (reliability.findings, reliability.rest) if reliability else ((), None)
    for check in checks:
        left = causes and check.kind is CheckKind.TARGET_RESIDUALS
        chi2, n = (rest or (0.0, 0)) if left else (check.statistic, check.n)
        if check.kind not in (CheckKind.STAR_RESIDUALS, CheckKind.TARGET_RESIDUALS) or n <= 0:
            continue
        ratio, p_value = float(np.sqrt(max(chi2, 0.0) / n)), float(chdtrc(n, chi2))
        # A check that fails reports itself.
        if (check.holds or left) and ratio > LARGER and p_value < PROBABILITY_LARGER:
            yield Finding(
                cause=check.kind.value,
                item="left by these causes" if left else "all",
                text=f"{ratio:.2f} times the stated errors, χ² {chi2:.0f} for {n}: "
                f"check {'for a further cause, or ' if left else ''}{check.look_at[-1].value}.",
                is_fault=False,
                p_value=p_value,
            )


def _outcome(checks: Sequence[Check], dof: int, findings: Sequence[Finding]) -> Outcome:
    if any(c.fails and not c.is_caution for c in checks) or any(one.refutes for one in findings):
        return Outcome.REFUTED
    if dof < FEWEST_DOF:
        return Outcome.NOT_CHECKABLE
    return Outcome.FINDINGS if any(one.is_fault for one in findings) else Outcome.CONSISTENT


@record(by_value=True)
class _Checks:
    """How checks are made."""

    settings: VerdictSettings
    limit: float  # p-value below which a check fails

    def of(
        self,
        kind: CheckKind,
        statistic: float,
        expected: float,
        n: int,
        p_value: float,
        p_plain: float = np.nan,
        names: tuple[tuple[str, ...], ...] = (),
    ) -> Check:
        return Check(
            kind=kind,
            statistic=statistic,
            expected=expected,
            n=n,
            p_value=p_value if n > 0 else np.nan,
            p_plain=p_plain,
            limit=self.limit,
            names=names,
        )

    def residuals(self, kind: CheckKind, chi2: float, dof: int) -> Check:
        """Small residuals, too, contradict the stated errors (`Check.is_caution`)."""
        p_value = p_residuals(chi2, dof, self.settings.sigma_understated, self.settings.sigma_overstated)
        return self.of(kind, chi2, dof, dof, p_value, p_residuals(chi2, dof))

    def too_large(
        self, kind: CheckKind, chi2: float, dof: int, names: tuple[tuple[str, ...], ...] = ()
    ) -> Check:
        """One-sided: a chi-square of standard deviations that may be too small by the tolerated factor, which
        is another one for a matrix before launch.
        """
        at_start = kind is CheckKind.START_MATRIX
        tolerated = self.settings.sigma_overstated if at_start else self.settings.sigma_understated
        p_value, p_plain = (float(chdtrc(dof, chi2 / x**2)) if dof > 0 else np.nan for x in (tolerated, 1.0))
        return self.of(kind, chi2, dof, dof, p_value, p_plain, names)


def p_residuals(chi2: float, dof: int, understated: float = 1.0, overstated: float = 1.0) -> float:
    """Two-sided probability of residuals as large or as small as chi2, if the standard deviations are
    `understated` or `overstated` by no more than these factors; NaN without degrees of freedom.
    """
    if dof <= 0:
        return np.nan
    above, below = chdtrc(dof, chi2 / understated**2), chdtr(dof, chi2 * overstated**2)
    return float(min(1.0, 2.0 * min(above, below)))


def _shares(estimate: InstallationEstimate, checks: _Checks) -> list[Check]:
    """Counts of rejected stars and targets against the tolerated shares."""

    def of(kind: CheckKind, reason: Reason, kept: int, share: float) -> Check:
        rejected = sum(entry.reason is reason for entry in estimate.rejected)
        n = kept + rejected
        return checks.of(kind, rejected, share * n, n, float(bdtrc(rejected - 1, n, share)))

    (n_stars, n_targets), limits = (estimate.n_stars, estimate.n_targets), checks.settings
    return [
        of(CheckKind.STARS_REJECTED, Reason.STAR_RESIDUAL, n_stars, limits.share_stars_rejected),
        of(CheckKind.TARGETS_REJECTED, Reason.TARGET_RESIDUAL, n_targets, limits.share_targets_rejected),
    ]


def _between_strips(estimate: InstallationEstimate, checks: _Checks) -> Check:
    """Decrease of chi2 if each strip had a matrix of its own: chi-square of 3 (strips - 1) if one serves all.

    Axes that a strip alone does not determine are not counted. A check that fails names the strips without
    one of which the others agree, unless that is true of most.
    """
    pairs, prior = estimate.pairs, estimate.prior_shared

    def without(k: int | None) -> Check:
        rows = np.delete(np.arange(len(pairs.F)), [] if k is None else [k])
        F, right = pairs.F[rows], pairs.F_theta[rows]
        free, of_free = _explained(F, right, prior)
        one, of_one = _explained(F.sum(axis=0)[None], right.sum(axis=0)[None], prior)
        return checks.too_large(CheckKind.BETWEEN_STRIPS, max(free - one, 0.0), of_free - of_one)

    check, S = without(None), len(pairs.F)
    if not check.fails or S < 3:
        return check
    names = [str(name) for k, name in enumerate(pairs.names) if not without(k).fails]
    return replace(check, names=tuple((name,) for name in names)) if 2 * len(names) < S else check


def _explained(F: Floats, right: Floats, prior: Floats) -> tuple[float, int]:
    """bᵀ N⁻¹ b of the normal equations (S, n, n), (S, n) of S strips with a matrix each, whose axes are
    eliminated strip by strip; and how many of these axes the strips determine.
    """
    t, explained, axes = F.shape[1] - len(prior), 0.0, 0
    N, b = prior + F[:, t:, t:].sum(axis=0), right[:, t:].sum(axis=0)
    for of_strip, b_strip in zip(F, right):
        scale = 1.0 / np.sqrt(np.maximum(np.diag(of_strip)[:t], np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(scale[:, None] * of_strip[:t, :t] * scale)
        seen = values > 1e-10 * max(values[-1], 0.0)
        root = (scale[:, None] * vectors)[:, seen] / np.sqrt(values[seen])
        along, shared = root.T @ b_strip[:t], root.T @ of_strip[:t, t:]
        explained, axes = explained + float(along @ along), axes + int(seen.sum())
        N, b = N - shared.T @ shared, b - shared.T @ along
    return explained + float(b @ np.linalg.solve(N, b)), axes


def _between_heads(agreement: HeadAgreement, checks: _Checks) -> list[Check]:
    """Differences between heads' attitudes, over all rows and from strip to strip; a check that fails names
    the head without which the rest agrees best.
    """
    found = []
    if agreement.dof > 0:
        found.append(checks.residuals(CheckKind.BETWEEN_HEADS, agreement.chi2, agreement.dof))
    if agreement.dof_gain > 0:
        found.append(checks.too_large(CheckKind.STEADY_HEADS, agreement.gain, agreement.dof_gain))
    if not agreement.without:
        return found
    name = min(agreement.without, key=_excess).head or "reference head"
    return [replace(check, names=((name,),)) if check.fails else check for check in found]


def _excess(one: WithoutHead) -> float:
    """chi2 as a deviate of a normal distribution (Wilson & Hilferty 1931)."""
    variance = 2.0 / (9.0 * max(one.dof, 1))
    return float((np.cbrt(one.chi2 / max(one.dof, 1)) - 1.0 + variance) / np.sqrt(variance))


def _from_start(estimate: InstallationEstimate, sigma_rad: Floats, checks: _Checks) -> Check:
    covariance = estimate.cov_theta + np.diag(np.asarray(sigma_rad, dtype=float) ** 2)
    statistic = float(estimate.theta @ np.linalg.solve(covariance, estimate.theta))
    return checks.too_large(CheckKind.START_MATRIX, statistic, len(estimate.theta))


def _head_findings(checks: Sequence[Check]) -> Iterator[Finding]:
    """The head whose attitudes contradict those of the others, by the least likely of the checks that fail:
    it turns whole strips, which any hypothesis about them then explains in part.
    """
    for check in sorted((one for one in checks if one.names), key=lambda one: one.p_value)[:1]:
        head, where = Subject(Kind.HEAD, head=check.names[0][0]), ("dump.toml", "star_cameras")
        text = f"contradict the other heads, χ² {check.statistic:.3g} for {check.expected:.0f}: check its "
        text += "file, rotation label, clock, aberration and noise in dump.toml, and its mounting."
        yield Finding.about("attitudes of a head", head, text, *where, refutes=True, p_value=check.p_value)


def _orbit_bias(estimate: InstallationEstimate, checks: _Checks) -> list[Check]:
    """Bias common to all ground strips against zero: the stated position errors are independent from strip to
    strip, and their mean is part of the bias' covariance.
    """
    if estimate.bias is None or not (rows := [n for n, x in enumerate(estimate.bias.names) if x != "clock"]):
        return []
    value, covariance = estimate.bias.value[rows], estimate.bias.covariance[np.ix_(rows, rows)]
    statistic = float(value @ np.linalg.solve(covariance, value))
    names = tuple((text,) for text in estimate.bias.texts() if not text.startswith("clock"))
    return [checks.too_large(CheckKind.ORBIT_BIAS, statistic, len(rows), names)]


def _orbit_finding(
    estimate: InstallationEstimate, checks: Sequence[Check], others: Sequence[Hypothesis], target_files: str
) -> Iterator[Finding]:
    """The bias of the orbit against the sky, where its check fails: the largest part of it in its sigmas.
    The first of `others`, which explain it too, is listed.
    """
    failed = [check for check in checks if check.kind is CheckKind.ORBIT_BIAS and check.fails]
    if (bias := estimate.bias) is None or not failed:
        return
    rows = [n for n, name in enumerate(bias.names) if name != "clock"]
    n = max(rows, key=lambda n: abs(bias.value[n]) / bias.sigma[n])
    value, sigma = float(bias.value[n]), float(bias.sigma[n])
    other = "".join(f"; or {one.field} in {one.file}" for one in others[:1])
    yield Finding(
        cause="orbit, or datum of the targets",
        item="all ground strips",
        text=f"{value:+.3g} ± {sigma:.2g} m {bias.names[n]}, against the sky: check the orbit; "
        f"latitude, longitude, height_kind in {target_files}{other}.",
        value=value,
        sigma=sigma,
        unit="m",
        file=f"orbit, {target_files}",
        refutes=True,
        p_value=failed[0].p_value,
        rivals=tuple(f"{one.cause}, {one.item}" for one in others[:1]),
    )


def _duplicates(strips: Sequence[StripSightings], checks: _Checks) -> Check:
    """Targets of different ids at one place on the ground; a single pair refutes the list."""
    groups: dict[str, set[str]] = {}
    for members in groups_of(strips):
        ground = GroundSightings.together([strip.ground for strip in members])
        names = ground.target_id.tolist()
        for a, b in [] if ground.is_star.any() else _same_place(ground):
            if names[a] != names[b]:
                both = groups.get(names[a], {names[a]}) | groups.get(names[b], {names[b]})
                groups.update(dict.fromkeys(both, both))
    found = tuple(sorted({tuple(sorted(group)) for group in groups.values()}))
    n = len({name for strip in strips for name in strip.ground.target_id.tolist()})
    p_value = 0.0 if found else 1.0
    return checks.of(CheckKind.DUPLICATED_TARGETS, len(groups), 0, n, p_value, names=found)


def _twice_finding(checks: Sequence[Check], target_files: str) -> Iterator[Finding]:
    """That targets are listed under several ids, measured at other pixels each time."""
    for check in (one for one in checks if one.kind is CheckKind.DUPLICATED_TARGETS and one.fails):
        names = list_words([" and ".join(group) for group in check.names], 1)
        text = f"one place each: {names}; keep one row of each in {target_files}."
        cause, item = "targets listed more than once", count_words(int(check.statistic), "target")
        yield Finding(cause=cause, item=item, text=text, file=target_files, field="id", refutes=True)


def _same_place(ground: GroundSightings) -> list[tuple[int, int]]:
    """Pairs of rows that see one point of the ground, at instants that are at most tens of rows apart."""
    if not len(ground.t_s):
        return []
    t, v, seen = ground.t_s[:, None], ground.v_rel_i, ground.range_m[:, None] * ground.u_i
    near = KDTree(seen + (t - t[0]) * v).query_pairs(NEARLY_SAME_PLACE_M, output_type="ndarray")
    first, second = near[:, 0], near[:, 1]
    moved = 0.5 * (v[first] + v[second]) * (t[second] - t[first])
    same = np.linalg.norm(seen[second] - seen[first] + moved, axis=1) < SAME_PLACE_M
    return [(int(a), int(b)) for a, b in near[same]]


def _convergence(estimate: InstallationEstimate, checks: _Checks) -> Check:
    """Statistic: the last correction in units of its predicted 1-sigma, the largest of three axes."""
    size = float(np.max(np.abs(estimate.iterations[-1].theta_step) / estimate.sigma_theta))
    return checks.of(CheckKind.CONVERGENCE, size, 0, 3, float(estimate.converged_covariance))
