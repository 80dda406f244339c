"""`boresight noise`: the noise of the star cameras' attitudes."""

from __future__ import annotations

from pathlib import Path

from boresight.features.heads.head_files import noise_json, noise_lines, write_noise
from boresight.pipeline.console.arguments import DumpArgument, SettingsFile, option
from boresight.pipeline.console.messages import Answer
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.stated_noise import state_noise
from boresight.pipeline.head_noise.of_dump import noise_of_heads
from boresight.pipeline.run.settings import read_settings

__all__ = ["noise_command"]


def noise_command(
    dump: DumpArgument,
    out: Path | None = option("Folder for noise.toml (keys for dump.toml), noise.json and noise.png."),
    write: bool = option("State the noise in the dump's own dump.toml.", False, "--write"),
    lowest_hz: float = option("Of a single star camera: slower motion is the satellite's.", 0.5, min=0.0),
    settings: SettingsFile = None,
) -> Answer:
    """Estimate the noise of the star cameras' attitudes from the record: white, correlated, constant.

    Example: boresight noise dump --out noise --write
    """
    found = noise_of_heads(open_dump(dump.resolve(), sky_alone=True), read_settings(settings), lowest_hz)
    files = () if out is None else write_noise(found, out)
    text = "\n".join(noise_lines(found))
    if write:
        stated = state_noise(dump.resolve(), dict(zip(found.names, found.fit.heads)))
        text, files = f"{text}\nstated in {dump / 'dump.toml'}", (*files, stated)
    return Answer(text=text, content=noise_json(found), files=files)
