"""What a run depends on: files of dumps, settings, program. Its digest says whether a result is still theirs.

The digest needs every byte of every image, so it is asked for where a finished result may be there already,
and at the end of a run, which has read them by then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from boresight.pipeline.files.content import Identity, identity_of
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.run.digests import digest, files_in
from boresight.pipeline.run.program_key import program_digest
from boresight.pipeline.run.settings import Settings
from boresight.records.record import record, scalar

__all__ = ["RunInputs", "inputs_of"]


@record
class RunInputs:
    """Inputs of a run."""

    dumps: tuple[Dump, ...] = scalar("what is calibrated")
    settings: Settings = scalar("of all stages")
    at_start: list[Identity] = scalar("of each file, what changes when its content does")

    def digest(self) -> str:
        """Digest of everything that a result depends on; empty if a file has changed since the start."""
        if _identities(self.dumps) != self.at_start:
            return ""
        contents = [_content(dump) | {"errors": dump.errors.model_dump()} for dump in self.dumps]
        return digest(contents, self.settings, program_digest("boresight.pipeline.calibration_run"))


def inputs_of(dumps: Sequence[Dump], settings: Settings) -> RunInputs:
    """The inputs of a run as they are now."""
    return RunInputs(tuple(dumps), settings, _identities(dumps))


def _identities(dumps: Sequence[Dump]) -> list[Identity]:
    return [identity_of(path) for path in files_in([_content(dump) for dump in dumps])]


def _content(dump: Dump) -> dict[str, Any]:
    """All of a dump but its place and its stated errors."""
    return {f.name: getattr(dump, f.name) for f in fields(dump) if f.name not in ("root", "errors")}
