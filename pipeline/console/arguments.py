"""Arguments and options of several commands: DUMP, a folder or an address in a store; --settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.files.object_store import dump_folder

__all__ = ["DumpArgument", "DumpOption", "DumpsArgument", "SettingsFile"]

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
SettingsFile = Annotated[Path | None, typer.Option(help="TOML file of settings; unknown keys are refused.")]
