"""The command line of all features."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import typer

from boresight.features.table import features
from boresight.pipeline.console.program import SPINE, errors_reported, program
from boresight.version import __version__

__all__ = ["begin", "command_line", "run_command_line"]

# Words of a command line after which nothing shows that libraries are loading.
SILENT = {"--quiet", "-q", "--json", "--help", "-h"}


def command_line(words: Sequence[str] | None = None) -> typer.Typer:
    """The program; of `words`, what follows its name on the command line, only the command is imported."""
    return program((SPINE, *features()), words)


def run_command_line() -> None:
    """Entry point of the command `boresight`. Matplotlib draws into files only, whatever backend a user's
    shell names; rasterio reads no store by itself (`files.object_store` does) and goes without boto3; SciPy,
    which imports all names of NumPy, loads no more of it (test tools, a Fortran compiler) by that.
    """
    os.environ["MPLBACKEND"] = "agg"
    os.environ["PYDANTIC_DISABLE_PLUGINS"] = "1"  # they are looked for in all installed packages
    os.environ.setdefault("GDAL_CACHEMAX", "16")  # MB; else 5 % of the memory, for tiles that are read once
    sys.modules.setdefault("boto3", None)  # type: ignore[arg-type]  # where it is installed, 0.1 s to load
    words = _words()
    begin(words)
    if words and not words[0].startswith("-"):
        import numpy  # only a command needs it

        numpy.__all__ = [name for name in numpy.__all__ if name in vars(numpy)]  # the others: 0.08 s to load
    with errors_reported():
        command_line(words)()


def begin(words: Sequence[str]) -> None:
    """On a terminal, say at once what begins: loading a command's libraries takes a second."""
    is_asked = words and not words[0].startswith("-") and "_BORESIGHT_COMPLETE" not in os.environ
    if is_asked and sys.stderr is not None and sys.stderr.isatty() and not SILENT & set(words):
        print(f"boresight {__version__}: {words[0]} ...", file=sys.stderr, flush=True)


def _words() -> list[str]:
    """What was typed after the program's name; while a shell completes a line, that line."""
    typed = os.environ.get("_TYPER_COMPLETE_ARGS", os.environ.get("COMP_WORDS", ""))
    return typed.split()[1:] if "_BORESIGHT_COMPLETE" in os.environ else sys.argv[1:]
