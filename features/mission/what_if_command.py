"""`boresight what-if`: a saved result with other strips, or with other errors of strips."""

from __future__ import annotations

import numpy as np
import typer

from boresight.features.mission.what_if import strips_of_result, what_if_of
from boresight.pipeline.console.arguments import CameraOption, ResultArgument, option
from boresight.pipeline.console.messages import Answer

__all__ = ["what_if_command"]


def what_if_command(
    result: ResultArgument,
    without: list[str] | None = option("Leave out this strip. May be repeated."),
    only: list[str] | None = option("Only this strip. May be repeated."),
    sigma: list[str] | None = option("STRIP=FACTOR: its errors are larger by that factor. May be repeated."),
    camera: CameraOption = "",
) -> Answer:
    """Leave out or reweight strips of a finished result: shift and 1-sigma of the matrix, at once.

    Example: boresight what-if result --without s02 --sigma s03=2
    """
    factors = dict.fromkeys(without or (), np.inf)
    if only:
        factors |= {name: np.inf for name in strips_of_result(result) if name not in only}
    try:
        for text in sigma or ():
            name, _, factor = text.rpartition("=")
            factors[name] = float(factor)
        found = what_if_of(result, factors, camera)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    return Answer(text=found.summary(), content=found.content())
