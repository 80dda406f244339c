"""The verdict of a model against its operator's location grid."""

from __future__ import annotations

from typing import Annotated

import typer

from boresight.pipeline.console.messages import DONE, LIMIT_MISSED, Answer

__all__ = ["Limit", "agreement"]

FEW, FARTHEST = 0.01, 5.0  # share of rows beyond the limit, and how far, that are rounding (set by hand)
Limit = Annotated[float, typer.Option(help="Largest distance from the grid that agrees, m.", min=0.0)]


def agreement(lines: list[str], largest_m: float, limit_m: float, beyond: int = 0, rows: int = 0) -> Answer:
    """The answer of a check: its verdict is the last line and the exit status. Of a grid whose writer rounds,
    a few of its `rows` may be `beyond` the limit, none by more than `FARTHEST` times.
    """
    few = beyond <= FEW * rows and largest_m <= FARTHEST * limit_m
    agrees = largest_m <= limit_m or few
    told = "agrees with" if agrees else "does not agree with"
    but = f" but for {beyond} of its {rows} rows" if agrees and beyond else ""
    verdict = f"the model {told} the grid{but}: largest {largest_m:.5f} m, limit {limit_m:g} m"
    return Answer(
        text="\n".join([*lines, verdict]),
        content={"agrees": agrees, "largest_m": largest_m, "limit_m": limit_m},
        exit_status=DONE if agrees else LIMIT_MISSED,
    )
