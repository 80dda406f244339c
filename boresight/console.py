"""The command line of all features."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import typer

from boresight.features.table import features
from boresight.pipeline.console.program import errors_reported, program
from boresight.pipeline.console.spine import SPINE

__all__ = ["command_line", "run_command_line"]


def command_line(words: Sequence[str] | None = None) -> typer.Typer:
    """The program; of `words`, what follows its name on the command line, only the command is imported."""
    return program((SPINE, *features()), words)


def run_command_line() -> None:
    """Entry point of the command `boresight`. Matplotlib draws into files only, whatever backend a user's
    shell names.
    """
    os.environ["MPLBACKEND"] = "agg"
    with errors_reported():
        command_line(_words())()


def _words() -> list[str]:
    """What was typed after the program's name; while a shell completes a line, that line."""
    typed = os.environ.get("_TYPER_COMPLETE_ARGS", os.environ.get("COMP_WORDS", ""))
    return typed.split()[1:] if "_BORESIGHT_COMPLETE" in os.environ else sys.argv[1:]
