"""Everything that a report needs, read back from a result's folder; and numbers that remember where they come
from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.table_files import fixed, read_parquet
from boresight.pipeline.files.text_files import read_json

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
    installation = read_json(result / "installation.json", str(result / "installation.json"))
    if not (result / "evidence" / "context.json").is_file():
        again = "what `calibrate` writes unless --no-report is given; run it again, finished work is kept"
        raise RawDataError(str(result / "evidence"), "folder", "not there, or not whole", again)
    tables = {
        name: read_parquet(result / "sightings" / f"{name}.parquet", names)
        for name, names in _SIGHTINGS.items()
    }
    tables |= {name: read_parquet(result / "evidence" / f"{name}.parquet") for name in _EVIDENCE}
    tables["detections"] = read_parquet(result / "evidence" / "exposure.parquet")
    run = result / "run.json"
    return Saved(
        installation,
        read_json(result / "evidence" / "context.json", str(result / "evidence" / "context.json")),
        read_json(run, str(run)) if run.is_file() else {},
        **tables,
    )


_SIGHTINGS: dict[str, dict[str, pa.DataType] | None] = {  # of a long archive only the columns that are drawn
    "stars": {"xy_px": fixed(2), "residual_s": fixed(3), "normalised": pa.float64(), "kept": pa.bool_()},
    "exposures": {"t_s": pa.float64(), "usable": pa.bool_(), "chi2": pa.float64(), "dof": pa.int64()},
    "targets": None,
    "omissions": None,
}
_EVIDENCE = ("inputs", "convergence", "angles", "matches")
