"""Everything that a report needs, read back from a result's folder; and numbers that remember where they come
from."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import RawDataError
from pipeline.files.text_files import read_text

__all__ = ["Number", "Saved", "number_at", "read_saved"]


@dataclass(frozen=True, slots=True)
class Number:
    """A number of the page: what is shown, and what it was made from.

    `text` is `exact * scale` in the format `form`; `exact` stands in the file `source` under `key` (a path of
    keys and indices), or is the square root of what stands there when `root` is set.
    """

    exact: float
    source: str
    key: str
    form: str
    scale: float = 1.0
    root: bool = False

    @property
    def text(self) -> str:
        value = self.exact * self.scale
        if not math.isfinite(value):
            return "not known" if math.isnan(value) else "no limit"
        return format(value, self.form).replace("-", "\N{MINUS SIGN}")


@dataclass(frozen=True, slots=True, eq=False)
class Saved:
    """A result's files: three of JSON and the tables by name."""

    installation: dict[str, Any]
    context: dict[str, Any]
    run: dict[str, Any]  # empty where the run left none
    stars: pa.Table
    exposures: pa.Table
    targets: pa.Table
    omissions: pa.Table
    inputs: pa.Table
    convergence: pa.Table
    angles: pa.Table
    matches: pa.Table
    detections: pa.Table

    def number(self, key: str, form: str, *, scale: float = 1.0, root: bool = False) -> Number:
        """The number of installation.json under `key`, a path such as `covariance_rad2.0.1`."""
        value = number_at(self.installation, key)
        return Number(math.sqrt(value) if root else value, "installation.json", key, form, scale, root)

    def context_number(self, key: str, form: str, *, scale: float = 1.0) -> Number:
        """The number of evidence/context.json under `key`."""
        return Number(number_at(self.context, key), "evidence/context.json", key, form, scale)

    def cell(self, table: str, column: str, row: int, form: str, *, scale: float = 1.0) -> Number:
        """One cell of a table; `table` is its path without `.parquet`."""
        value = getattr(self, table.rpartition("/")[2]).column(column)[row].as_py()
        return Number(float(value), f"{table}.parquet", f"{column}.{row}", form, scale)


def number_at(content: Any, key: str) -> float:
    """What stands under a path of keys and indices."""
    for part in key.split("."):
        content = content[int(part)] if isinstance(content, list) else content[part]
    return float(content)


def read_saved(result: Path) -> Saved:
    """Read a finished result. `RawDataError` names what is missing."""
    installation = _json(result / "installation.json")
    if not (result / "evidence" / "context.json").is_file():
        again = "what `calibrate` writes unless --no-report is given; run it again, finished work is kept"
        raise RawDataError(str(result / "evidence"), "folder", "not there, or not whole", again)
    tables = {
        name: _table(result / "sightings" / f"{name}.parquet", names) for name, names in _SIGHTINGS.items()
    }
    tables |= {name: _table(result / "evidence" / f"{name}.parquet") for name in _EVIDENCE}
    tables["detections"] = _table(result / "evidence" / "exposure.parquet")
    run = result / "run.json"
    return Saved(
        installation,
        _json(result / "evidence" / "context.json"),
        _json(run) if run.is_file() else {},
        **tables,
    )


_SIGHTINGS: dict[str, list[str] | None] = {  # of a long archive only the columns that are drawn
    "stars": ["xy_px", "residual_s", "normalised", "kept"],
    "exposures": ["t_s", "usable", "chi2", "dof"],
    "targets": None,
    "omissions": None,
}
_EVIDENCE = ("inputs", "convergence", "angles", "matches")


def _json(path: Path) -> dict[str, Any]:
    text = read_text(path, str(path))
    try:
        content = json.loads(text)
    except ValueError as error:
        raise RawDataError(str(path), "JSON", str(error), "what `calibrate` wrote") from error
    if not isinstance(content, dict):
        raise RawDataError(str(path), "JSON", type(content).__name__, "an object")
    return content


def _table(path: Path, columns: list[str] | None = None) -> pa.Table:
    if not path.is_file():
        raise RawDataError(str(path), "file", "nothing", "the table that `calibrate` wrote")
    try:
        return pq.read_table(path, columns=columns)
    except (OSError, pa.ArrowException) as error:
        raise RawDataError(str(path), "file", str(error), "the table that `calibrate` wrote") from error
