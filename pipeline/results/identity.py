"""Which result this is: its id, who made it when with what from what, and what its operator says of it.

The same block stands on the page, in the signed sheets and in every export. Of a result's files only run.json
tells time, commit and command, so that all others are the same, bit for bit, for the same inputs.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, StringConstraints

from boresight.pipeline.files.text_files import json_if_there, read_toml
from boresight.pipeline.files.whole_file import write_json
from boresight.records.record import record, scalar

__all__ = ["ABOUT", "About", "Identity", "identity_of_result", "result_id", "saved_about", "write_about"]

ABOUT = "about.json"  # name of the file in a result's folder
UNKNOWN = "not known"  # what a page says of a missing text
ID_DIGITS = 16  # hexadecimal: two results of 2^32 share one with probability 1/2

Text = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f-\x9f]*$")]


class About(BaseModel):
    """What an operator says of a result: the keys of the file given by `--about`, all optional."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    mission: Text | None = None
    document: Text | None = None  # number of the document that the result becomes
    organisation: Text | None = None
    author: Text | None = None
    reviewer: Text | None = None
    approver: Text | None = None
    remark: Text | None = None


@record(kw_only=True)
class Identity:
    """A result, as texts."""

    result: str = scalar("id: the first 16 hexadecimal digits of the SHA-256 of installation.json")
    finished: str = scalar("when the run ended, UTC")
    program: str = scalar("program, version and commit")
    command: str = scalar("the command line")
    dump: str = scalar("folder or address of the dump, or of the dumps")
    inputs: str = scalar("digest of all input files, settings and the program")


def result_id(result: Path) -> str:
    """Id of a finished result, which anyone can make with `sha256sum installation.json`."""
    return hashlib.sha256((result / "installation.json").read_bytes()).hexdigest()[:ID_DIGITS]


def identity_of_result(result: Path) -> Identity:
    """The identity of a finished result; what an older version did not keep is "not known"."""
    run = json_if_there(result / "run.json")
    commit = f" (commit {run['commit']})" if run.get("commit") else ""
    dumps = run.get("dumps")
    return Identity(
        result=result_id(result),
        finished=str(run.get("finished_utc", UNKNOWN)),
        program=f"boresight {run.get('version', UNKNOWN)}{commit}",
        command=str(run.get("command", UNKNOWN)),
        dump=", ".join(map(str, dumps.values())) if dumps else str(run.get("dump", UNKNOWN)),
        inputs=str(run.get("inputs", UNKNOWN)),
    )


def write_about(result: Path, file: Path | None) -> bool:
    """Keep what a TOML file says of a result, if one is given, and whether; `RawDataError`: a wrong key."""
    if file is None:
        return False
    write_json(result / ABOUT, read_toml(file, About, str(file)).model_dump(exclude_none=True))
    return True


def saved_about(result: Path) -> dict[str, str]:
    """What the operator said of a result, by the keys of `About`; empty where nothing was said."""
    return {key: str(value) for key, value in json_if_there(result / ABOUT).items()}
