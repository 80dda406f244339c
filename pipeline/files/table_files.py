"""Parquet tables that the program itself has written, read back. What is damaged is told, never believed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import RawDataError

__all__ = ["fixed", "read_parquet"]

EXPECTED = "the table that `calibrate` wrote"


def fixed(width: int) -> pa.DataType:
    """The type of a column of lists of `width` numbers."""
    return pa.list_(pa.float64(), width)


def read_parquet(path: Path, columns: Mapping[str, pa.DataType] | None = None) -> pa.Table:
    """A table, or those of its columns that are named with their types. Its own checksums are verified, where
    it has some. `RawDataError` for a file that is missing, damaged or another one.
    """
    file = str(path)
    if not path.is_file():
        raise RawDataError(file, "file", "nothing", EXPECTED)
    names = None if columns is None else list(columns)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as stored:
            table = stored.read(columns=names, use_threads=False)
    except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
        raise RawDataError(file, "file", str(error), EXPECTED) from error
    for name, kind in (columns or {}).items():
        if name not in table.column_names:
            raise RawDataError(file, f"column {name}", "no such column", EXPECTED)
        column = table.column(name)
        if column.type != kind or column.null_count:
            found = f"{column.type} with {column.null_count} empty cells"
            raise RawDataError(file, f"column {name}", found, f"{kind} without empty cells")
    return table
