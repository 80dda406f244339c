"""A line for each exposure and strip as it ends: what became of it, and whether it was computed now."""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any

from boresight.geometry.ledger import Entry
from boresight.geometry.sightings import StarSightings
from boresight.pipeline.errors import printable
from boresight.pipeline.stages.strip import MatchedTargets

__all__ = ["log_unit"]

log = logging.getLogger("boresight.commands.units")  # shown by commands with --verbose, kept by --log-file


def log_unit(stage: str, outcome: Any, computed: bool) -> None:
    """Log the outcome of one exposure or strip of a stage, and each reason why something is not used."""
    if not log.isEnabledFor(logging.DEBUG):
        return
    found = "" if computed else " (from an earlier run)"
    for n, line in enumerate(_lines(outcome)):
        log.debug("%s", printable(f"{stage} {line}{found}" if n == 0 else f"    {line}"))


def _lines(outcome: Any) -> list[str]:
    if isinstance(outcome, Entry):
        return [f"{outcome.subject.name}: not used, {outcome.text}"]
    if isinstance(outcome, StarSightings):
        return [f"{outcome.exposure_id}: {len(outcome.hip)} stars"]
    if isinstance(outcome, MatchedTargets):
        reasons = Counter(entry.reason for entry in outcome.omissions)
        text = f"{outcome.strip_id}: {len(outcome.target_id)} targets matched"
        text += "".join(f", {n} {reason}" for reason, n in reasons.most_common())
        return [text, *(f"{entry.subject.name}: {entry.text}" for entry in outcome.omissions)]
    return [type(outcome).__name__]
