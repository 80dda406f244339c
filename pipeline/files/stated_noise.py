"""State the noise of the heads in a dump's own dump.toml; comments and all other keys stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import tomlkit

from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump_schema import DumpFile
from boresight.pipeline.files.text_files import read_text, read_toml
from boresight.pipeline.files.whole_file import write_text
from boresight.records.record import Floats

__all__ = ["noise_keys", "state_noise"]


PERIODIC = ("periodic_arcsec", "period_s", "harmonics")  # which a record of one orbit does not show


def noise_keys(noise: AttitudeNoise, with_white: bool) -> dict[str, list[float] | str]:
    """Keys of [star_cameras.noise], estimated; without the white part where rows or stars give it."""

    def listed(values: Floats) -> list[float]:
        return [float(f"{value:.4g}") for value in values.tolist()]

    return {
        **({"white_arcsec": listed(noise.white_rad / ARCSEC)} if with_white else {}),
        "correlated_arcsec": listed(noise.correlated_rad / ARCSEC),
        "correlation_time_s": listed(noise.correlation_time_s),
        "constant_arcsec": listed(noise.constant_rad / ARCSEC),
        **({"constant_time_s": listed(noise.constant_time_s)} if noise.constant_time_s.all() else {}),
        "origin": "estimated",
    }


def state_noise(root: Path, noise: Mapping[str, AttitudeNoise]) -> Path:
    """Write the noise of each head, by its name, into `root`/dump.toml. Returns the file.

    `RawDataError` for a dump without [[star_cameras]]: the noise of a single star camera's images is that of
    its stars.
    """
    path = root / "dump.toml"
    stated = read_toml(path, DumpFile, "dump.toml")
    if not stated.star_cameras:
        raise RawDataError("dump.toml", "star_cameras", "none", "[[star_cameras]], whose noise can be stated")
    document = tomlkit.parse(read_text(path, "dump.toml"))
    heads = document.unwrap()["star_cameras"]
    for table, head in zip(document["star_cameras"], heads, strict=True):  # type: ignore[arg-type]
        found = noise[str(head["name"])]
        # Stars, or errors in the rows of a table of attitudes, are the one statement of the white part.
        before = head.get("noise", {})
        kept = {key: before[key] for key in PERIODIC if key in before}
        table["noise"] = noise_keys(found, "white_arcsec" in before) | kept  # type: ignore[index]
    text = tomlkit.dumps(document)
    write_text(path, text)
    read_toml(path, DumpFile, "dump.toml")
    return path
