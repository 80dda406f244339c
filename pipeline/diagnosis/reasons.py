"""Sentences for the observations that a calibration rejected or doubts."""

from __future__ import annotations

import numpy as np

from boresight.calib.estimate import Rejected, TargetResiduals, WhyRejected

__all__ = ["doubts", "rejection_reason"]


def rejection_reason(rejected: Rejected) -> str:
    """One sentence: why the observation takes no part, with the numbers of its test."""
    one, tested = rejected, f"chi-square {rejected.statistic:.1f} for 2 degrees of freedom, limit "
    tested += f"{rejected.limit:.1f}"
    match one.why:
        case WhyRejected.ATTITUDE_NOT_FIXED:
            return f"{one.n_good} good stars of {one.n_all} do not fix the attitude"
        case WhyRejected.STAR_RESIDUAL:
            sigma = f"{np.sqrt(one.statistic):.1f} sigma from the attitude of the other {one.n_good} stars"
            return f"{sigma} ({tested})"
        case WhyRejected.TARGET_RESIDUAL:
            sigma = f"{np.sqrt(one.statistic):.1f} sigma from the position that the other {one.kind}s predict"
            instead = f"; it or {' or '.join(one.rivals)}: the data do not tell which" if one.rivals else ""
            return f"{sigma} ({tested}){instead}"
        case WhyRejected.NOT_COVERED:
            return "its instant lies more than half a step outside the usable exposures"
        case WhyRejected.NO_TARGET_COVERED:
            return f"{one.n_good} usable exposures cover none of {one.n_all} targets"


def doubts(targets: TargetResiduals) -> list[str]:
    """One sentence for each group of targets of which one is wrong, the likeliest first."""
    groups = (" or ".join(group) for group in targets.doubtful)
    return [f"{group} is wrong; the data do not tell which: they have less weight." for group in groups]
