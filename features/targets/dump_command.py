"""Commands for those who write dumps: dump init, dump check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.console.arguments import DumpArgument, SettingsFile
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, Answer, talks

__all__ = ["add_dump_commands"]

dump_app = typer.Typer(help="Dumps: begin one, check one.", no_args_is_help=True, rich_markup_mode=None)


def add_dump_commands(app: typer.Typer) -> None:
    """Add the commands to the program."""
    dump_app.command()(talks(init))
    dump_app.command()(talks(check, with_json=True))
    app.add_typer(dump_app, name="dump")


def init(
    folder: Annotated[Path, typer.Argument(help="New or empty folder.")],
    ask: Annotated[bool, typer.Option("--ask", help="Ask for what follows, one question each.")] = False,
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
    from boresight.features.targets.dump_skeleton import Skeleton, write_skeleton

    given = {name: value for name, value in locals().items() if name in Skeleton.__annotations__}
    if ask:
        given = {name: typer.prompt(name, default=value, err=True) for name, value in given.items()}
    files = tuple(write_skeleton(folder, Skeleton(**given)))
    text = f"{len(files)} files -> {folder}; fill them in, then: boresight dump check {folder}"
    return Answer(text=text, files=files)


def check(
    dump: DumpArgument,
    out: Annotated[Path | None, typer.Option(help="HTML page with the footprints on a map.")] = None,
    settings: SettingsFile = None,
    workers: Annotated[int | None, typer.Option(help="Processes for the star images.", min=1)] = None,
) -> Answer:
    """Check everything about a dump that needs no calibration: all errors at once, footprints, targets.

    Example: boresight dump check my-dump --out check.html
    """
    from boresight.features.targets.check_page import write_check_page
    from boresight.features.targets.dump_check import check_dump, check_lines
    from boresight.pipeline.files.record_tables import plain
    from boresight.pipeline.run.settings import read_settings
    from boresight.pipeline.run.workers import executor_for

    with executor_for(workers, None, 0) as executor:
        found = check_dump(dump, read_settings(settings), executor)
    lines = check_lines(found)
    if out is not None:
        write_check_page(found, out)
        lines.append(f"-> {out}")
    failed = bool(found.faults) or not (found.footprints or found.sky_strips)
    return Answer(
        text="\n".join(lines),
        content={
            "errors": [str(fault) for fault in found.faults],
            "facts": list(found.facts),
            "omitted": [plain(omission) for omission in found.omissions],
            "targets": [plain(target) for target in found.targets],
            "footprints": {name: outline.tolist() for name, outline in found.footprints.items()},
        },
        files=() if out is None else (out,),
        exit_status=DATA_DID_NOT_ALLOW if failed else DONE,
    )
