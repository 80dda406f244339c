"""The verdict of a model against its operator's location grid."""

from __future__ import annotations

from typing import Annotated

import typer

from boresight.pipeline.console.messages import DONE, LIMIT_MISSED, Answer

__all__ = ["Limit", "agreement"]

Limit = Annotated[float, typer.Option(help="Largest distance from the grid that agrees, m.", min=0.0)]


def agreement(lines: list[str], largest_m: float, limit_m: float) -> Answer:
    """The answer of a check: its verdict is the last line and the exit status."""
    agrees = largest_m <= limit_m
    told = "agrees with" if agrees else "does not agree with"
    verdict = f"the model {told} the grid: largest {largest_m:.5f} m, limit {limit_m:g} m"
    return Answer(
        text="\n".join([*lines, verdict]),
        content={"agrees": agrees, "largest_m": largest_m, "limit_m": limit_m},
        exit_status=DONE if agrees else LIMIT_MISSED,
    )
