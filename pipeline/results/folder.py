"""The folder that `calibrate` writes.

    installation.json            the matrix, its covariance and what it is based on
    sightings/stars.parquet      every identified star of every exposure, one row group an exposure
    sightings/exposures.parquet  attitude of every exposure from its stars
    sightings/targets.parquet    every matched target: measured and known direction, residual
    sightings/passes.parquet     when each strip was taken, where in the orbit, by which camera
    sightings/strips.parquet     normal equations (F, F theta) of every strip: all that a later merge needs
    sightings/ledger.parquet     what became of what is not used, and why
    work/                        finished exposures and strips, for a run that is started again
    run.json                     times and counts of the run that wrote the rest
    requirement.json             the accuracy required, where one was given
    about.json                   what the operator says of the result, where `--about` was given
    validation.json              errors against the truth, where `validate` found them
    interior/                    what `remote-camera-calibrate` found, where it was asked to write there

The result of several dumps has `dumps.json` too, the full result of each dump in a folder of its own, and of
itself what is joint: no stars, exposures and work.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import read_json
from boresight.pipeline.files.whole_file import remove_abandoned
from boresight.pipeline.run.unit_store import UnitStore

__all__ = [
    "DUMPS",
    "INTERIOR",
    "VALIDATION",
    "ScratchFolder",
    "begin_result",
    "dumps_in",
    "results_in",
    "store_of",
]

DUMPS, VALIDATION = "dumps.json", "validation.json"  # names of files in a result's folder
# File of a result, below its folder, that holds an interior orientation; its picture and camera file lie
# beside it.
INTERIOR = "interior/interior.json"


def store_of(result: Path) -> UnitStore:
    """The store of a result's finished exposures and strips."""
    return UnitStore(result / "work")


def begin_result(result: Path) -> None:
    """Make the folder; remove the marks of a finished run, and incomplete files of killed processes."""
    result.mkdir(parents=True, exist_ok=True)
    remove_abandoned(result)
    evidence = ("evidence/context.json", "evidence/budget.json")
    for name in ("installation.json", DUMPS, "drift.json", VALIDATION, INTERIOR, *evidence):
        (result / name).unlink(missing_ok=True)


def dumps_in(result: Path) -> tuple[str, ...]:
    """Names of the dumps of a joint result, none for one dump; `RawDataError` if damaged."""
    if not (path := result / DUMPS).is_file():
        return ()
    names = read_json(path).get("dumps")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RawDataError(str(path), "dumps", names, "a list of names")
    return tuple(names)


def results_in(result: Path) -> list[Path]:
    """Folder of the result itself; of several dumps, the folders of those that are finished."""
    if not (names := dumps_in(result)):
        return [result]
    return [result / name for name in names if (result / name / "installation.json").is_file()]


class ScratchFolder:
    """A folder that exists as long as this object: the files of a result that was given no folder, written by
    `fill` when they are first asked for.
    """

    def __init__(self, fill: Callable[[Path], object] = lambda path: None) -> None:
        self._fill = fill

    @cached_property
    def path(self) -> Path:
        """The folder, filled."""
        path = Path(tempfile.mkdtemp(prefix="boresight-"))
        weakref.finalize(self, shutil.rmtree, path, ignore_errors=True)
        self._fill(path)
        return path
