"""Summaries of a calibration and a validation as text for the terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from boresight.calib.estimate import InstallationEstimate
from boresight.calib.verdict import Outcome
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import euler_zxy_from_theta
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.calibration.joint import JointCalibration
from boresight.pipeline.results.check_point_test import RmsTest
from boresight.pipeline.results.validate import TruthErrors
from boresight.pipeline.results.writing import (
    blind_spots_json,
    ground_m_per_rad,
    joint_ground_m_per_rad,
    verdict_json,
)
from boresight.records.ledger import Kind, Reason, either_of
from boresight.records.record import Floats

__all__ = [
    "REASON_WORDS",
    "blind_lines",
    "calibration_summary",
    "check_point_words",
    "finding_lines",
    "joint_summary",
    "kind_of",
    "omission_lines",
    "two_digits",
    "unit_effect",
    "validation_summary",
    "verdict_lines",
]

# Most reasons why something is not used that the console lists without --verbose.
MOST_REASONS = 8
# Told after what went wrong.
UNNEEDED = (Reason.OUT_OF_VIEW, Reason.NOT_NEEDED, Reason.ATTITUDES_NOT_NEEDED, Reason.NO_TARGET)
# Most blind spots that the console names, and the least effect of one; installation.json has all.
MOST_BLIND, LEAST_EFFECT_RAD = 6, 0.005 * ARCSEC
WHOLE_FROM, WHOLE_BELOW = 9.95, 1e6  # numbers that are stated without decimals
REASON_WORDS: dict[str, str] = {  # of reasons that counts alone do not explain
    Reason.TARGET_RESIDUAL: "gross error",
    Reason.LOW_CORRELATION: "cloud or change",
    Reason.NO_CORRELATION: "cloud or change",
    Reason.NOT_CONVERGED: "cloud or change",
    Reason.FEW_VALID_PIXELS: "cloud, no data or image edge",
    Reason.ONE_GREY_VALUE: "one grey value: dead or saturated",
    Reason.PROBABLY_WRONG: "not found reliably",
    Reason.NO_COMMON_ROTATION: "not found (no common rotation)",
}


def calibration_summary(found: DumpCalibration, findings: Sequence[Mapping[str, Any]] = ()) -> str:
    """Verdict, what to look at, matrix, deviation, 1-sigma, counts, and what is not used."""
    lines = verdict_lines(verdict_json(found.verdict, found.rows)) + finding_lines(findings)
    lines += blind_lines(blind_spots_json(found.verdict), found.estimate.sigma_theta)
    grounds = [ground_m_per_rad(found.strips, found.camera)]
    lines += _estimate_lines(found.estimate, found.strips, grounds)
    lines += _doubt_lines(found.estimate)
    return "\n".join(lines + omission_lines([entry.row for entry in found.omissions]))


def joint_summary(of_dumps: Mapping[str, DumpCalibration], joint: JointCalibration) -> str:
    """A line for each dump, then the joint result as that of one dump."""
    lines = verdict_lines(verdict_json(joint.verdict, joint.rows))
    for name, one in of_dumps.items():
        if one.verdict.outcome is Outcome.REFUTED:
            lines += [f"dump {name}", *("  " + line for line in verdict_lines(verdict_json(one.verdict)))]
    lines.append(f"{'1 sigma, arcsec, of':26s}" + "".join(f"{axis:>14s}" for axis in "XYZ"))
    lines += [_row(f"  {name}", one.estimate.sigma_theta / ARCSEC, ".4f") for name, one in of_dumps.items()]
    lines += blind_lines(blind_spots_json(joint.verdict), joint.estimate.sigma_theta)
    several = len(joint.estimate.cameras) > 1
    lines.append("all cameras together:" if several else f"jointly from {len(of_dumps)} dumps:")
    sigma_rad = joint.sigma_installation_rad
    lines += _estimate_lines(joint.estimate, joint.strips, joint_ground_m_per_rad(joint), sigma_rad)
    lines += _doubt_lines(joint.estimate)
    return "\n".join(lines + omission_lines([entry.row for entry in joint.omissions]))


def verdict_lines(verdict: Mapping[str, Any]) -> list[str]:
    """The verdict of an installation.json: its sentence, the checks that fail, and what to look at."""
    failed = [check for check in verdict["checks"] if check["fails"]]
    lines = [f"{'verdict':26s}{verdict['sentence']}"]
    for check in sorted(failed, key=lambda check: (check["is_caution"], check["p_value"])):
        found, expected = f"{check['statistic']:.6g}", f"{check['expected']:.6g}"
        lines.append(f"  {check['kind']}: {found}, expected {expected} (p {check['p_value']:.1e})")
        groups = [_equal_names(group) for group in check["names"]]
        if groups:
            lines.append(f"    {', '.join(groups[:3])}" + (" ..." if groups[3:] else ""))
        lines.append(f"    look at: {'; '.join(check['look_at'])}")
    return lines


def finding_lines(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The findings of a report (`read_findings`), one line each."""
    texts = [f"{one['cause']}, {one['item']}: {one['text']}" for one in findings]
    return [f"{'look at' if n == 0 else '':26s}{text}" for n, text in enumerate(texts)]


def kind_of(cause: str) -> str:
    """Kind of an error that the data cannot show: a datum is not told from the orbit."""
    kind = cause.partition(",")[0]
    return "orbit or targets" if kind == "datum of the targets" else kind


def blind_lines(spots: Sequence[Mapping[str, Any]], sigma_rad: Floats) -> list[str]:
    """The errors with most effect that data cannot show at all, in one line; 1-sigma of theta (T,), rad."""
    kinds: dict[str, Mapping[str, Any]] = {}
    for one in spots:
        if one["is_unseen"] and np.abs(one["effect_rad"]).max() >= LEAST_EFFECT_RAD:
            kinds.setdefault(kind_of(one["cause"]), one)
    shown = [f"{kind} ({unit_effect(one, sigma_rad)})" for kind, one in list(kinds.items())[:MOST_BLIND]]
    if len(kinds) > MOST_BLIND:
        shown.append(f"{len(kinds) - MOST_BLIND} more in installation.json")
    return [f"{'cannot show' if n == 0 else '':26s}{text}" for n, text in enumerate(shown)]


def unit_effect(one: Mapping[str, Any], sigma_rad: Floats) -> str:
    """What one unit of an error does to the axis that it moves most, and to all that it moves by more than
    their 1-sigma (T,): "1 ms: 2.8″ Y".
    """
    effect = np.abs(np.array(one["effect_rad"]))
    largest = int(np.argmax(effect))
    axes = np.flatnonzero((effect > sigma_rad) | (np.arange(len(effect)) == largest))
    amount = "all of it" if one["unit"] == "times" else f"1 {one['unit']}"
    moved = [(float(effect[axis]) / ARCSEC, "XYZ"[axis % 3]) for axis in axes if axis // 3 == largest // 3]
    return f"{amount}: " + ", ".join(f"{value:{two_digits(value)}}″ {axis}" for value, axis in moved)


def two_digits(value: float) -> str:
    """Format of a number of two digits that is read by people: 104, not 1e+02; 0.38; 2.5."""
    return ".0f" if WHOLE_FROM <= abs(value) < WHOLE_BELOW else ".2g"


def _equal_names(group: Sequence[str]) -> str:
    """Targets with equal coordinates: three by name, of more the first three and their number."""
    return " = ".join(group[:3]) + (f" = ... ({len(group)} in all)" if len(group) > 3 else "")


def _matrix_lines(estimate: InstallationEstimate, n: int, m_per_rad: Floats) -> list[str]:
    """Matrix of a camera, angles in arc-seconds, their 1 sigma in metres on the ground."""
    name, own = estimate.cameras[n], slice(3 * n, 3 * n + 3)
    R_cs, _ = estimate.of_camera(name)
    theta, sigma = estimate.theta[own], estimate.sigma_theta[own]
    lines = [f"R_cs of camera {name} =" if name else "R_cs ="]
    lines += ["  [" + "  ".join(f"{value:+.12f}" for value in row) + "]" for row in R_cs.as_matrix()]
    lines += [
        _row("theta, arcsec", theta / ARCSEC, "+.3f"),
        _row("Z-X-Y angles, arcsec", euler_zxy_from_theta(theta) / ARCSEC, "+.3f"),
        _row("1 sigma, arcsec", sigma / ARCSEC, ".4f"),
    ]
    if np.isfinite(m_per_rad).all():  # scans of the sky see no ground
        lines.append(_row("1 sigma on the ground, m", sigma * m_per_rad, ".2f"))
    return lines


def _between_lines(estimate: InstallationEstimate, sigma_rad: Floats | None) -> Iterator[str]:
    """The rotations between cameras: their deviation from those before launch, its 1 sigma and verdict."""
    for one in estimate.between(sigma_rad):
        yield _row(f"{one.cameras[1]} to {one.cameras[0]}"[:25], one.theta / ARCSEC, "+.3f")
        yield _row("  1 sigma, arcsec", one.sigma / ARCSEC, ".4f")
        told = "as before launch, within its stated error" if one.as_before_launch else "not as before launch"
        yield f"{'':26s}{told} (p {one.p_value:.2g})"


def _estimate_lines(
    estimate: InstallationEstimate,
    strips: Sequence[StripSightings],
    grounds: Sequence[Floats],
    sigma_rad: Floats | None = None,
) -> list[str]:
    """The matrix of each camera, the rotations between them, and what they come from."""
    lines = [line for n, ground in enumerate(grounds) for line in _matrix_lines(estimate, n, ground)]
    lines += _between_lines(estimate, sigma_rad)
    n = estimate.n_strips
    lines += [
        f"{'from':26s}{estimate.n_exposures} exposures with {estimate.n_stars} stars, "
        f"{n} {'strip' if n == 1 else 'strips'} with {_seen(estimate, strips)}",
        f"{'chi2 / dof':26s}{estimate.chi2:.1f} / {estimate.dof}",
    ]
    for n, head in enumerate(estimate.heads if len(estimate.heads) > 1 else ()):
        sigma = np.sqrt(np.diag(estimate.cov_heads)[3 * n : 3 * n + 3]) / ARCSEC
        lines.append(_row(f"head {head.name[:20]}", head.R_cs.as_quat(canonical=True), "+.9f"))
        lines.append(_row("  1 sigma, arcsec", sigma, ".4f"))
    if estimate.bias is not None:
        lines.append(f"{'bias, stated less true':26s}{', '.join(estimate.bias.texts())}")
    for one in estimate.references:
        axes = zip(("east", "north", "up"), one.value_m, one.sigma_m)
        text = ", ".join(f"{axis} {value:+.2f} ± {sigma:.2f} m" for axis, value, sigma in axes)
        lines.append(f"{f'reference {one.name}'[:25]:26s}{text}, stated less true")
    for wave in estimate.periodic:
        lines.append(
            f"{f'head {wave.head}'[:25]:26s}error that comes back every {wave.period_s:.6g} s, arcsec"
        )
        for h in range(len(wave.cosine_rad)):
            lines += [
                _row(f"  cosine {h + 1}", wave.cosine_rad[h] / ARCSEC, "+.3f"),
                _row("    1 sigma", wave.sigma_cosine_rad[h] / ARCSEC, ".3f"),
                _row(f"  sine {h + 1}", wave.sine_rad[h] / ARCSEC, "+.3f"),
                _row("    1 sigma", wave.sigma_sine_rad[h] / ARCSEC, ".3f"),
            ]
    if not estimate.converged_covariance:
        lines.append("not converged: the last correction is not negligible; do not use this matrix")
    return lines


def _seen(estimate: InstallationEstimate, strips: Sequence[StripSightings]) -> str:
    """How many targets strips of the ground show, stars those of the sky, or both together."""
    of_ground = {bool(np.isfinite(one.ground.range_m).any()) for one in strips if len(one.ground.range_m)}
    kinds = {True: "targets", False: "stars"}
    return f"{estimate.n_targets} {' and '.join(kinds[kind] for kind in sorted(of_ground, reverse=True))}"


def _doubt_lines(estimate: InstallationEstimate) -> list[str]:
    """Groups of targets of which one is wrong, the likeliest first."""
    text = "is wrong; the data do not tell which: they have less weight."
    groups = map(either_of, estimate.targets.doubtful)
    return [f"{'one target in doubt':26s}{group} {text}" for group in groups]


def validation_summary(validation: TruthErrors) -> str:
    """Errors per axis and on the ground, before and after."""
    error, sigma = validation.error_rad / ARCSEC, validation.sigma_rad / ARCSEC
    lines = [
        f"{'error against truth':26s}" + "".join(f"{axis:>12s}" for axis in "XYZ"),
        _row("  before, arcsec", validation.before_rad / ARCSEC, "+.3f"),
        _row("  after, arcsec", error, "+.4f"),
        _row("  stated 1 sigma, arcsec", sigma, ".4f"),
        _row("  after, in sigmas", error / sigma, "+.2f"),
        f"{'NEES (3 is expected)':26s}{validation.nees:12.2f}",
    ]
    n = len(validation.after.along_m)
    if n:
        lines.append(f"geo-positioning at {n} check points, rms, m{'along':>18s}{'across':>10s}")
        for name, points in (("before", validation.before), ("after", validation.after)):
            along, across = points.rms_m
            lines.append(f"  {name:24s}{along:36.2f}{across:10.2f}")
    lines += [check_point_words(one) for one in validation.predicted]
    if validation.without:
        lines.append(f"no position for {validation.without} check points: no attitude or no ground there")
    return "\n".join(lines)


def check_point_words(test: RmsTest) -> str:
    """One line on the errors of check points in one direction and those that were predicted."""
    text = f"check points: {test.rms_m:.2f} m {test.direction} track where {test.predicted_m:.2f} m was "
    text += "predicted: "
    if test.allowed:
        return text + f"allowed (p = {test.p_value:.2g})"
    return (
        f"{text}not allowed (p = {test.p_value:.2g}, limit {test.limit:g}): an error under [errors] of "
        "dump.toml is stated too small, or an input is wrong"
    )


def _row(name: str, values: Floats, form: str) -> str:
    width = 14 if len(values) < 4 else 13  # 80 columns
    return f"{name:26s}" + "".join(f"{format(value, form):>{width}s}" for value in values)


def omission_lines(rows: Sequence[Mapping[str, Any]], most: int | None = MOST_REASONS) -> list[str]:
    """What is not used, rows of the ledger: counts by kind and cause, then the reasons of the first `most`
    (None: of all), targets and stars last.
    """
    if not rows:
        return [f"{'not used':26s}nothing"]
    kinds = sorted({row["kind"] for row in rows})
    by_kind = {kind: [row for row in rows if row["kind"] == kind] for kind in kinds}
    lines: list[str] = []
    for kind, those in by_kind.items():
        name = "" if lines else "not used"
        lines.append(f"{name:26s}{len(those)} {kind}{'s' if len(those) > 1 else ''}: {_causes(those)}")
    shown = [row for row in rows if row["kind"] not in (Kind.STAR, Kind.TARGET)]
    shown += by_kind.get("target", [])
    shown.sort(key=lambda row: row["cause"] in UNNEEDED)
    shown += by_kind.get("star", []) if most is None else []
    lines += [f"  {row['kind']} {row['name']}: {row['reason']}" for row in shown[:most]]
    if most is not None and shown[most:]:
        lines.append(f"  and {len(shown) - most} more, see report.html or `boresight status`")
    return lines


def _causes(rows: Sequence[Mapping[str, Any]]) -> str:
    """Counts by cause in words; of gross errors also the largest, in sigmas."""
    counts = Counter(REASON_WORDS.get(row["cause"], row["cause"]) for row in rows)
    gross = [row["statistic"] for row in rows if row["cause"] == Reason.TARGET_RESIDUAL]
    largest = float(np.sqrt(max(gross))) if gross else None
    sized = f" (up to {largest:.1f} sigma)" if largest is not None and counts["gross error"] > 1 else ""
    sized = f" ({largest:.1f} sigma)" if largest is not None and not sized else sized
    texts = {cause: f"{n} {cause}" for cause, n in counts.most_common()}
    return ", ".join(text + (sized if cause == "gross error" else "") for cause, text in texts.items())
