"""`boresight heads`: the star cameras of a satellite aligned with one another."""

from __future__ import annotations

from pathlib import Path

from boresight.features.heads.alignment import heads_alone
from boresight.features.heads.head_files import heads_json, heads_lines, write_heads
from boresight.pipeline.console.arguments import DumpsArgument, SettingsFile, option
from boresight.pipeline.console.messages import Answer
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.run.settings import read_settings
from boresight.pipeline.run.several_dumps import dump_names

__all__ = ["heads_command"]


def heads_command(
    dumps: DumpsArgument,
    out: Path | None = option("Folder for heads.json and heads.png; of several dumps, one in it for each."),
    settings: SettingsFile = None,
) -> Answer:
    """Align the star cameras of a satellite with one another from the sky alone, without any ground.

    Example: boresight heads dump --out heads
    """
    roots = [dump.resolve() for dump in dumps]
    names = dump_names(roots) if len(roots) > 1 else [""]
    lines, contents, files = list[str](), [], list[Path]()
    for root, name in zip(roots, names):
        found = heads_alone(open_dump(root, sky_alone=True), read_settings(settings))
        lines += [f"dump {name}"] * bool(name) + heads_lines(found)
        contents.append({"dump": str(root)} | heads_json(found))
        files += () if out is None else write_heads(found, out / name if name else out)
    return Answer(text="\n".join(lines), content={"dumps": contents}, files=tuple(files))
