"""The argument DUMP of commands: a folder, or an address in a store."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.files.object_store import dump_folder

__all__ = ["DumpArgument", "DumpOption", "DumpsArgument"]

DumpArgument = Annotated[
    Path,
    typer.Argument(metavar="DUMP", parser=dump_folder, help="Folder or address (s3://...) with a dump.toml."),
]
DumpsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="DUMP",
        parser=dump_folder,
        help="Folder or address (s3://...) with a dump.toml; several of one mission, in any order.",
    ),
]
DumpOption = Annotated[
    Path | None,
    typer.Option(
        metavar="PATH",
        parser=dump_folder,
        help="The dump it was made from, if it is no longer where it was.",
    ),
]
