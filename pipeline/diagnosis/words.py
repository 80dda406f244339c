"""Sentences for what a calibration doubts."""

from __future__ import annotations

from boresight.calib.estimate import TargetResiduals
from boresight.geometry.ledger import either_of

__all__ = ["doubts"]


def doubts(targets: TargetResiduals) -> list[str]:
    """One sentence for each group of targets of which one is wrong, the likeliest first."""
    groups = map(either_of, targets.doubtful)
    return [f"{group} is wrong; the data do not tell which: they have less weight." for group in groups]
