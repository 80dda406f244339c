"""What a command tells at its end, as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import euler_zxy_from_theta
from boresight.geometry.sightings import StarSightings
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.record_tables import record_from_table
from boresight.pipeline.results.folder import dumps_in
from boresight.pipeline.results.validate import Validation
from boresight.pipeline.stages.calibrate import Calibration
from boresight.pipeline.stages.joint import JointCalibration
from boresight.pipeline.stages.strip import MatchedTargets
from boresight.pipeline.work.unit_store import read_meta, read_unit

__all__ = ["calibration_summary", "joint_summary", "status_summary", "validation_summary"]

Array = NDArray[np.float64]
MOST_REASONS = 8


def calibration_summary(found: Calibration) -> str:
    """Matrix, deviation, 1-sigma, what it rests on, what was left out."""
    return "\n".join(_estimate_lines(found.estimate) + _omission_lines(found.omissions))


def joint_summary(of_dumps: Mapping[str, Calibration], joint: JointCalibration) -> str:
    """A line a dump, then the joint matrix as that of one dump."""
    lines = [f"{'1 sigma, arcsec, of':26s}" + "".join(f"{axis:>14s}" for axis in "XYZ")]
    lines += [_row(f"  {name}", one.estimate.sigma_theta / ARCSEC, ".4f") for name, one in of_dumps.items()]
    lines.append(f"jointly from {len(of_dumps)} dumps:")
    return "\n".join(lines + _estimate_lines(joint.estimate) + _omission_lines(joint.omissions))


def _estimate_lines(estimate: InstallationEstimate) -> list[str]:
    matrix = estimate.R_cs.as_matrix()
    euler = np.degrees(euler_zxy_from_theta(estimate.theta))
    lines = ["R_cs ="]
    lines += ["  [" + "  ".join(f"{value:+.12f}" for value in row) + "]" for row in matrix]
    lines += [
        _row("theta, rad", estimate.theta, "+.9f"),
        _row("Z-X-Y angles x y z, deg", euler, "+.7f"),
        _row("1 sigma, arcsec", estimate.sigma_theta / ARCSEC, ".4f"),
        f"{'from':26s}{estimate.n_exposures} exposures with {estimate.n_stars} stars, "
        f"{estimate.n_strips} strips with {estimate.n_targets} targets",
        f"{'chi2 / dof':26s}{estimate.chi2:.1f} / {estimate.dof}",
    ]
    if not estimate.converged:
        lines.append("not converged: M is not the unit matrix to the tolerance; do not use this matrix")
    return lines


def validation_summary(validation: Validation) -> str:
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
    if validation.without:
        lines.append(f"no position for {validation.without} check points (no attitude or no ground there)")
    return "\n".join(lines)


def status_summary(result: Path) -> str:
    """Counts of finished units by stage, and what they left out; of several dumps, of each."""
    if names := dumps_in(result):
        lines = []
        for name in names:
            begun = (result / name).is_dir()
            text = status_summary(result / name) if begun else "not begun"
            lines += [f"dump {name}", *("  " + line for line in text.splitlines())]
        return "\n".join([*lines, f"all dumps together: {_finished(result)}"])
    work = result / "work"
    if not work.is_dir() and not (result / "installation.json").is_file():
        raise RawDataError(str(result), "folder", "no run", "a folder that `boresight calibrate` wrote")
    lines = []
    for stage in sorted(path for path in work.iterdir() if path.is_dir()) if work.is_dir() else []:
        done, damaged, failed = 0, 0, []
        for path in sorted(stage.glob("*.parquet")):
            if (unit := read_unit(path)) is None:
                damaged += 1
            else:
                done += 1
                outcome = record_from_table((StarSightings, MatchedTargets, Omission), unit, read_meta(unit))
                if isinstance(outcome, Omission):
                    failed.append(outcome)
                elif isinstance(outcome, MatchedTargets):
                    failed += outcome.omissions
        text = f"{stage.name:14s}{done} done" + (f", {damaged} damaged files" if damaged else "")
        lines.append(text + (f", {len(failed)} left out" if failed else ""))
        lines += ["  " + line for line in _omission_lines(failed)[1:]]
    return "\n".join([*lines, _finished(result)])


def _finished(result: Path) -> str:
    if (result / "installation.json").is_file():
        return "finished: installation.json is there"
    return "not finished: no installation.json yet"


def _row(name: str, values: Array, form: str) -> str:
    return f"{name:26s}" + "".join(f"{format(value, form):>14s}" for value in values)


def _omission_lines(omissions: Sequence[Omission]) -> list[str]:
    if not omissions:
        return [f"{'left out':26s}nothing"]
    kinds = Counter(omission.kind for omission in omissions)
    total = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in sorted(kinds.items()))
    lines = [f"{'left out':26s}{total}"]
    for omission in [o for o in omissions if o.kind not in ("star", "target")][:MOST_REASONS]:
        lines.append(f"  {omission.kind} {omission.name}: {omission.reason}")
    return lines
