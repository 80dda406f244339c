"""`boresight dump init`: the skeleton of a dump."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from boresight.features.targets.dump_skeleton import Skeleton, write_skeleton
from boresight.pipeline.console.arguments import option
from boresight.pipeline.console.messages import Answer

__all__ = ["dump_init_command"]


def dump_init_command(
    folder: Annotated[Path, typer.Argument(help="New or empty folder.")],
    ask: bool = option("Ask for what follows, one question each.", False, "--ask"),
    attitudes: bool = option(
        "Attitudes that a star tracker has solved, no star images.", False, "--attitudes"
    ),
    points: bool = option("Measured image points, no targets and strips' images.", False, "--points"),
    *,
    known: Skeleton,
) -> Answer:
    """Write a skeleton of a dump, every file with comments, to be filled in.

    Example: boresight dump init my-dump --mission demo --focal-m 10 --ccds 4
    """
    if ask:
        given = {n: v for n, v in asdict(known).items() if not (attitudes and n.startswith("star_"))}
        asked = {name: typer.prompt(name, default=value, err=True) for name, value in given.items()}
        known = replace(known, **asked)
    files = tuple(write_skeleton(folder, known, attitudes=attitudes, points=points))
    text = f"{len(files)} files -> {folder}; fill them in, then: boresight dump check {folder}"
    return Answer(text=text, files=files)
