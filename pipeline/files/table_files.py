"""Parquet tables that the program itself has written, read back. What is damaged is told, never believed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from boresight.pipeline.errors import RawDataError

__all__ = ["column", "fixed", "fixed_list", "list_values", "read_parquet"]

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


def fixed_list(values: np.ndarray) -> pa.Array:
    """An array (N, ...) as N lists of fixed length."""
    width = int(np.prod(values.shape[1:]))
    flat = np.ascontiguousarray(values, dtype=float).ravel()
    return pa.FixedSizeListArray.from_arrays(pa.array(flat, pa.float64()), width)


def list_values(table: pa.Table, name: str, *shape: int) -> np.ndarray:
    """The inverse of `fixed_list`: (N, *shape)."""
    flat = table.column(name).combine_chunks()
    values = flat.flatten().to_numpy(zero_copy_only=False) if len(table) else np.zeros(0)
    return np.array(values, dtype=float).reshape(len(table), *shape)


def column(table: pa.Table, name: str) -> np.ndarray:
    """A plain column as a NumPy array."""
    return np.array(table.column(name).to_numpy())
