"""`boresight status`: what of a run is finished and what is not used."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.console.messages import Answer
from boresight.pipeline.files.record_tables import plain

__all__ = ["status_command"]


def status_command(
    result: Annotated[Path, typer.Argument(help="Folder of a run, finished or not.")],
) -> Answer:
    """Show what of a run is finished, what it still needs, and everything that is not used and why.

    Example: boresight status result
    """
    from boresight.pipeline.results.status import run_status, status_lines  # loads all stages of a run

    found = run_status(result)
    return Answer(text="\n".join(status_lines(found)), content=plain(found))
