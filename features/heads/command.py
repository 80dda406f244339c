"""Commands for the star cameras of a dump by themselves: noise and heads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.console.arguments import DumpArgument, DumpsArgument, SettingsFile
from boresight.pipeline.console.messages import Answer, talks

__all__ = ["add_heads_commands"]


def add_heads_commands(app: typer.Typer) -> None:
    """Plug the commands into the program."""
    app.command()(talks(noise, with_json=True))
    app.command()(talks(heads, with_json=True))


def noise(
    dump: DumpArgument,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for noise.toml (keys for dump.toml), noise.json and noise.png."),
    ] = None,
    write: Annotated[
        bool, typer.Option("--write", help="State the noise in the dump's own dump.toml.")
    ] = False,
    lowest_hz: Annotated[
        float, typer.Option(help="Of a single star camera: slower motion is the satellite's.", min=0.0)
    ] = 0.5,
    settings: SettingsFile = None,
) -> Answer:
    """Estimate the noise of the star cameras' attitudes from the record: white, correlated, constant.

    Example: boresight noise dump --out noise --write
    """
    from boresight.features.heads.head_files import noise_json, noise_lines, write_noise
    from boresight.features.heads.stated_noise import state_noise
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.run.settings import read_settings
    from boresight.pipeline.stages.head_records import noise_of_heads

    found = noise_of_heads(open_dump(dump.resolve()), read_settings(settings), lowest_hz)
    files = () if out is None else write_noise(found, out)
    text = "\n".join(noise_lines(found))
    if write:
        stated = state_noise(dump.resolve(), dict(zip(found.names, found.fit.heads)))
        text, files = f"{text}\nstated in {dump / 'dump.toml'}", (*files, stated)
    return Answer(text=text, content=noise_json(found), files=files)


def heads(
    dumps: DumpsArgument,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for heads.json and heads.png; of several dumps, one in it for each."),
    ] = None,
    settings: SettingsFile = None,
) -> Answer:
    """Align the star cameras of a satellite with one another from the sky alone, without any ground.

    Example: boresight heads dump --out heads
    """
    from boresight.features.heads.head_files import heads_json, heads_lines, write_heads
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.run.settings import read_settings
    from boresight.pipeline.stages.head_records import heads_alone
    from boresight.pipeline.stages.joint import dump_names

    roots = [dump.resolve() for dump in dumps]
    names = dump_names(roots) if len(roots) > 1 else [""]
    lines, contents, files = list[str](), [], list[Path]()
    for root, name in zip(roots, names):
        found = heads_alone(open_dump(root), read_settings(settings))
        lines += [f"dump {name}"] * bool(name) + heads_lines(found)
        contents.append({"dump": str(root)} | heads_json(found))
        files += () if out is None else write_heads(found, out / name if name else out)
    return Answer(text="\n".join(lines), content={"dumps": contents}, files=tuple(files))
