"""A command that prints all that commands print, in a module that loads little: run on terminals too."""

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.console.messages import Answer, say, tell, with_messages
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.errors import RawDataError

__all__ = ["say", "worker"]


def work(status: Annotated[int, typer.Option(help="Of the answer.")] = 0) -> Answer:
    """Work.

    Example: boresight work --status 0
    """
    with progress_bars() as progress:
        for n in range(101):
            progress("units", n, 100)
    say("a remark")
    tell("a result \x1b[2J")
    if status == 9:
        raise RawDataError("a.csv", "line 2", "x", "a number")
    return Answer(text="the end", content={"n": float("nan")}, files=(Path("a.csv"),), exit_status=status)


worker = typer.Typer()
worker.command()(with_messages(work, "work", with_json=True))
