"""Arguments and options of several commands, and of records whose fields are options."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import typer

from boresight.pipeline.files.object_store import dump_folder

__all__ = [
    "AboutFile",
    "CameraOption",
    "DumpArgument",
    "DumpOption",
    "DumpsArgument",
    "RequireArcsec",
    "RequireMetres",
    "ResultArgument",
    "SettingsFile",
    "StaleEop",
    "argument",
    "option",
]


def option(help_text: str, default: Any = None, *names: str, **how: Any) -> Any:
    """An option of a command, as the default of its parameter, or as a field of a record that it takes:
    `names` (or its own name), and what `typer.Option` accepts.
    """
    stated = {"meaning": help_text, "option": typer.Option(*names, help=help_text, **how)}
    return dataclasses.field(default=default, metadata=stated)


def argument(help_text: str, default: Any = ..., **how: Any) -> Any:
    """An argument of a command, as the default of its parameter, and what `typer.Argument` accepts."""
    return dataclasses.field(default=default, metadata={"option": typer.Argument(help=help_text, **how)})


AboutFile = Annotated[
    Path | None,
    typer.Option(
        "--about",
        help="TOML file with mission, document, organisation, author, reviewer, approver, remark: for the "
        "page, the signed sheets and the exports.",
    ),
]
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
        metavar="PATH", parser=dump_folder, help="The dump it was made from, if it is no longer where it was."
    ),
]
CameraOption = Annotated[str, typer.Option(help="Which camera, of a result of several.")]
SettingsFile = Annotated[Path | None, typer.Option(help="TOML file of settings; unknown keys are refused.")]
ResultArgument = Annotated[Path, typer.Argument(help="Folder that `calibrate` wrote.")]
StaleEop = Annotated[
    bool, typer.Option(help="Go on past the end of the Earth-orientation table, with a warning.")
]
RequireArcsec = Annotated[
    float | None, typer.Option(help="Largest 1-sigma about each axis that is enough, arc-seconds.", min=0.0)
]
RequireMetres = Annotated[
    float | None, typer.Option(help="Largest 1-sigma that is enough, metres on the ground.", min=0.0)
]
