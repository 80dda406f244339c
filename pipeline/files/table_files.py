"""Read the Parquet tables of a result; a damaged file is an error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import check_regular

__all__ = ["column", "fixed", "fixed_list", "list_values", "read_parquet"]

EXPECTED = "the table that `calibrate` wrote"


def fixed(width: int) -> pa.DataType:
    """The Arrow type of a column of lists of `width` numbers."""
    return pa.list_(pa.float64(), width)


def read_parquet(path: Path, columns: Mapping[str, pa.DataType] | None = None) -> pa.Table:
    """A table, or its columns of the given names and types. The file's checksums are verified if it has any.

    `RawDataError` for a file that is missing or damaged, and for columns that are missing or of other types.
    """
    file = str(path)
    check_regular(path, file, EXPECTED)
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
    """A column written by `fixed_list` as an array (N, *shape)."""
    flat = table.column(name).combine_chunks()
    values = flat.flatten().to_numpy(zero_copy_only=False) if len(table) else np.zeros(0)
    return np.array(values, dtype=float).reshape(len(table), *shape)


def column(table: pa.Table, name: str) -> np.ndarray:
    """A column of single values as a NumPy array."""
    return np.array(table.column(name).to_numpy())
