"""`boresight dump init`: the skeleton of a dump."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.targets.dump_skeleton import Skeleton, write_skeleton
from boresight.pipeline.console.messages import Answer

__all__ = ["dump_init_command"]


def dump_init_command(
    folder: Annotated[Path, typer.Argument(help="New or empty folder.")],
    ask: Annotated[bool, typer.Option("--ask", help="Ask for what follows, one question each.")] = False,
    attitudes: Annotated[
        bool, typer.Option("--attitudes", help="Attitudes that a star tracker has solved, no star images.")
    ] = False,
    points: Annotated[
        bool, typer.Option("--points", help="Measured image points, no targets and strips' images.")
    ] = False,
    mission: Annotated[str, typer.Option(help="Name of the mission.")] = "my mission",
    star_focal_mm: Annotated[float, typer.Option(help="Star camera: focal length.", min=1.0)] = 100.0,
    star_pixel_um: Annotated[float, typer.Option(help="Star camera: pixel pitch.", min=0.1)] = 6.4,
    star_width_px: Annotated[int, typer.Option(help="Star camera: columns.", min=16)] = 5120,
    star_height_px: Annotated[int, typer.Option(help="Star camera: rows.", min=16)] = 3840,
    focal_m: Annotated[float, typer.Option(help="Remote-sensing camera: focal length.", min=1e-3)] = 10.0,
    pixel_um: Annotated[float, typer.Option(help="Remote-sensing camera: pixel pitch.", min=0.1)] = 10.0,
    ccds: Annotated[int, typer.Option(help="Remote-sensing camera: CCDs.", min=1, max=64)] = 1,
    ccd_px: Annotated[int, typer.Option(help="Remote-sensing camera: samples of a CCD.", min=16)] = 6144,
    bit_depth: Annotated[int, typer.Option(help="Bits of a count of both.", min=8, max=16)] = 8,
    position_m: Annotated[float, typer.Option(help="1-sigma of the orbit.", min=0.0)] = 2.0,
    clock_s: Annotated[float, typer.Option(help="1-sigma of the strips' times.", min=0.0)] = 1e-4,
) -> Answer:
    """Write a skeleton of a dump, every file with comments, to be filled in.

    Example: boresight dump init my-dump --mission demo --focal-m 10 --ccds 4
    """
    given = {name: value for name, value in locals().items() if name in Skeleton.__annotations__}
    if ask:
        asked = [name for name in given if not (attitudes and name.startswith("star_"))]
        given |= {name: typer.prompt(name, default=given[name], err=True) for name in asked}
    files = tuple(write_skeleton(folder, Skeleton(**given), attitudes=attitudes, points=points))
    text = f"{len(files)} files -> {folder}; fill them in, then: boresight dump check {folder}"
    return Answer(text=text, files=files)
