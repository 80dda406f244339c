"""A line for each exposure and strip as it ends: what became of it, and whether it was computed now."""

from __future__ import annotations

import logging
from typing import Any

from boresight.geometry.ledger import Entry
from boresight.pipeline.errors import printable

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
    return outcome.told() if hasattr(outcome, "told") else [type(outcome).__name__]
