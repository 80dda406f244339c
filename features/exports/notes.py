"""What every export says of its origin: date, program, mission, dump, frames, validity, verdict."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump_schema import DumpFile
from boresight.pipeline.files.text_files import json_if_there, read_toml
from boresight.pipeline.results.identity import identity_of_result, saved_about
from boresight.pipeline.results.ownership import dump_folder_of, origin_of
from boresight.pipeline.results.reading import read_installation
from boresight.pipeline.results.sightings_tables import read_sightings
from boresight.records.record import record, scalar

__all__ = ["Notes", "notes_of", "one_line"]

UNKNOWN = "not known"  # what a note says of a missing text
# The conventions, as every exported file states them.
FRAMES = "s star camera, c remote-sensing camera (x flight, z to the ground); u_c = R_cs u_s; i GCRS, e ITRS"


@record(kw_only=True)
class Notes:
    """Origin of an export, as texts without control characters."""

    created: str = scalar("date of the export, UTC")
    program: str = scalar("program and version that made the result")
    mission: str = scalar("name of the mission")
    satellite: str = scalar("name of the satellite, where the dump states it", default="")
    dump: str = scalar("digest of the dump that the result is made from")
    frames: str = scalar("the frames of matrix and coordinates")
    valid: str = scalar("UTC of the first and the last strip of the result")
    use: str = scalar("first and last date for which the matrix is to be used, where given", default="")
    verdict: str = scalar("outcome of the result's verdict")
    result: str = scalar("id of the result, and when its run ended")
    inputs: str = scalar("digest of all input files and settings")
    about: str = scalar("what the operator says of the result", default="")

    def items(self) -> dict[str, str]:
        """The notes by name, in order, without empty ones."""
        texts = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: text for name, text in texts.items() if text}

    def lines(self) -> list[str]:
        """The notes as "name: text"."""
        return [f"{name}: {text}" for name, text in self.items().items()]


def notes_of(result: Path, dump: Path | None, created: str, use: tuple[str, str] = ("", "")) -> Notes:
    """The notes of a finished result; what it does not say is "not known". `RawDataError` where damaged."""
    installation, origin = read_installation(result), origin_of(result)
    identity, about = identity_of_result(result), saved_about(result)
    verdict = installation.get("verdict")
    outcome = str(verdict.get("outcome", UNKNOWN)) if isinstance(verdict, dict) else UNKNOWN
    return Notes(
        created=f"{created}Z",
        program=one_line(identity.program),
        mission=one_line(about.pop("mission", "") or _mission(result, dump)),
        satellite=one_line(str(json_if_there(result / "evidence" / "context.json").get("satellite") or "")),
        dump=one_line(UNKNOWN if origin is None else origin.dump),
        frames=FRAMES,
        valid=_valid(result),
        use=one_line(f"{use[0] or 'any date'} to {use[1] or 'any date'}" if any(use) else ""),
        verdict=one_line(outcome),
        result=one_line(f"{identity.result}, {identity.finished}"),
        inputs=one_line(identity.inputs),
        about=one_line("; ".join(f"{key}: {text}" for key, text in about.items())),
    )


def _mission(result: Path, dump: Path | None) -> str:
    try:
        noted = dump or dump_folder_of(result)
        return read_toml(noted / "dump.toml", DumpFile, "dump.toml").mission
    except RawDataError:
        return UNKNOWN


def _valid(result: Path) -> str:
    path = result / "sightings" / "passes.parquet"
    if not path.is_file():
        return UNKNOWN
    utc = sorted(map(str, read_sightings(result, "passes", "utc_middle").column("utc_middle").to_pylist()))
    return f"{one_line(utc[0])} to {one_line(utc[-1])}" if utc else UNKNOWN


def one_line(text: str) -> str:
    """The text with every control or other unprintable character replaced by a space."""
    return "".join(c if c.isprintable() else " " for c in text)
