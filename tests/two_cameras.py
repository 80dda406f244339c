"""The mission of `fixtures/mini` with its four CCDs as two cameras of two CCDs each."""

import shutil
import tomllib
from pathlib import Path

from edits import rows_of, write_rows

from boresight.pipeline.files.text_tables import write_toml

NAMES = ("left", "right")


def two_cameras(mini: Path, dump: Path) -> Path:
    """A dump in the new folder `dump` whose images are those of `mini`: strips "a-left", "a-right", ..."""
    unlike = shutil.ignore_patterns("dump.toml", "strips.csv", "remote_camera.toml", "truth")
    shutil.copytree(mini, dump, ignore=unlike)
    head = tomllib.loads((mini / "dump.toml").read_text())
    del head["files"]["remote_camera"]
    write_toml(dump / "dump.toml", head | {"cameras": [{"id": n, "file": f"{n}.toml"} for n in NAMES]})
    camera = tomllib.loads((mini / "remote_camera.toml").read_text())
    for n, name in enumerate(NAMES):
        write_toml(dump / f"{name}.toml", camera | {"ccds": camera["ccds"][2 * n : 2 * n + 2]})
    rows = rows_of(mini / "strips.csv")
    for row in rows:
        which, ccd = divmod(int(row["ccd"]), 2)
        row.update(id=f"{row['id']}-{NAMES[which]}", ccd=str(ccd), camera=NAMES[which])
    write_rows(dump / "strips.csv", rows)
    return dump
