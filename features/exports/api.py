"""A result written in formats that other tools read."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

from boresight.accepted import PathLike, instance_of, listed, new_folder_of, path_of, wrong
from boresight.features.exports.formats import FORMATS, ExportRequest, Remark, export
from boresight.features.exports.spice_export import SpiceFrames
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.results.reading import read_installation

__all__ = ["export_files"]


def export_files(
    result: PathLike,
    formats: str | Sequence[str],
    out: PathLike,
    *,
    dump: PathLike | None = None,
    strips: str | Sequence[str] = (),
    camera: str = "",
) -> list[Path]:
    """Write a result folder in `formats` into the folder `out`; the files written.

    Names and ids for SPICE are those of `boresight export`. Raises `ValueError` for an unknown format,
    `RawDataError` for a damaged result, `DataNotSufficientError` where a format has nothing to write.
    """
    names = [str(name) for name in listed(formats, "formats", "names of formats")]
    if unknown := [name for name in names if name not in FORMATS]:
        raise wrong("formats", unknown[0], f"names among {', '.join(FORMATS)}")
    if not names:
        raise wrong("formats", "no names", "at least one")
    if set(names) != {"spice"} and read_installation(path_of(result, "result")).get("made_from") == "vectors":
        raise wrong("formats", names, "spice alone: the result is from vectors, without strips")
    folder = new_folder_of(out, "out")
    request = ExportRequest(
        result=path_of(result, "result"),
        camera=instance_of(camera, str, "camera"),
        dump=None if dump is None else path_of(dump, "dump"),
        strips=tuple(str(one) for one in listed(strips, "strips", "ids of strips")),
        frames=SpiceFrames(),
        creation_utc=datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S"),
    )
    written: list[Path] = []
    for name in names:
        found = list(export(name, request, folder))
        files = [one for one in found if not isinstance(one, Remark)]
        if not files:
            why = "; ".join(one.text for one in found if isinstance(one, Remark))
            raise DataNotSufficientError(f"nothing to write as {name}{f': {why}' if why else ''}")
        written += files
    return written
