"""Read the Parquet tables of a result; a damaged file is an error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent, check_regular

__all__ = ["arrow_array", "arrow_rows", "column", "fixed", "fixed_list", "list_values", "read_parquet"]

# NumPy type of an Arrow type; others are read as objects.
NUMBERS = {pa.float64(): np.float64, pa.int64(): np.int64, pa.bool_(): np.bool_}
EXPECTED = "the table that `calibrate` wrote"  # what messages say was expected
MAX_VALUES, MAX_BYTES = 2**26, 2**29  # of the columns that are read; a star takes 26 values


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
    with refusing(file, "file", EXPECTED, (OSError, ValueError, MemoryError, pa.ArrowException)):
        with pq.ParquetFile(path, page_checksum_verification=True) as stored:
            repeated = _check_footer(stored, names, file)
            if not repeated:
                table = stored.read(columns=names, use_threads=False)
        if repeated:
            table = _with_repeated_texts(path, names, repeated)
    for name, kind in (columns or {}).items():
        if name not in table.column_names:
            raise RawDataError(file, f"column {name}", "no such column", EXPECTED)
        column = table.column(name)
        if column.type != kind or column.null_count:
            found = f"{column.type} with {column.null_count} empty cells"
            raise RawDataError(file, f"column {name}", found, f"{kind} without empty cells")
    return table


def _check_footer(stored: pq.ParquetFile, names: Sequence[str] | None, file: str) -> list[str]:
    """Columns of which equal texts, written once, may take more than `MAX_TEXT_BYTES`; `RawDataError` where
    the wanted columns state more values, or more bytes, than are read.
    """
    footer = stored.metadata
    groups = [footer.row_group(n) for n in range(footer.num_row_groups)]
    every = [group.column(n) for group in groups for n in range(footer.num_columns)]
    chunks = [one for one in every if names is None or one.path_in_schema.partition(".")[0] in names]
    check_extent(file, "columns", (sum(one.num_values for one in chunks),), MAX_VALUES, "values")
    size = sum(one.total_uncompressed_size for one in chunks)
    check_extent(file, "columns", (size,), MAX_BYTES, "bytes")
    texts = [one for one in chunks if one.physical_type == "BYTE_ARRAY" and one.has_dictionary_page]
    wide = [one for one in texts if one.num_values * one.total_uncompressed_size > MAX_BYTES]
    return sorted({one.path_in_schema for one in wide})


def _with_repeated_texts(path: Path, names: Sequence[str] | None, repeated: Sequence[str]) -> pa.Table:
    """The table, of whose columns of `repeated` texts the lengths are added before they are written out."""
    with pq.ParquetFile(path, page_checksum_verification=True, read_dictionary=list(repeated)) as stored:
        table = stored.read(columns=names, use_threads=False)
    for name in repeated:
        texts = table.column(name)
        size = 0
        for part in texts.chunks:
            lengths = [len(text or "") for text in part.dictionary.to_pylist()]
            size += int(np.take([*lengths, 0], part.indices.fill_null(len(lengths))).sum())
        check_extent(str(path), f"column {name}", (size,), MAX_BYTES, "bytes")
        plain = texts.cast(texts.type.value_type)
        table = table.set_column(table.column_names.index(name), name, plain)
    return table


def arrow_array(values: Sequence[Any] | np.ndarray, kind: pa.DataType | None = None) -> pa.Array:
    """Values (N,), of Python or NumPy, as an Arrow array of a type, or their own; None is an empty cell.

    Made of its buffers: `pa.array` loads pandas, which takes 0.3 s.
    """
    if kind is None:
        own = np.asarray(values).dtype
        kind = pa.string() if own.kind == "U" else pa.from_numpy_dtype(own)
    given = None if isinstance(values, np.ndarray) else [value is not None for value in values]
    valid = None if given is None or all(given) else pa.py_buffer(np.packbits(given, bitorder="little"))
    if kind in (pa.string(), pa.binary()):
        filled = (b"" if one is None else one for one in values)
        parts = [one if isinstance(one, bytes) else str(one).encode() for one in filled]
        ends = np.cumsum([0, *map(len, parts)], dtype=np.int32)
        content = [valid, pa.py_buffer(ends), pa.py_buffer(b"".join(parts))]
        return pa.Array.from_buffers(kind, len(parts), content)
    if pa.types.is_fixed_size_list(kind):
        filled = ((0.0,) * kind.list_size if one is None else one for one in values)
        items = arrow_array([item for one in filled for item in one], kind.value_type)
        return pa.Array.from_buffers(kind, len(values), [valid], children=[items])
    if valid is not None:
        values = [0 if value is None else value for value in values]
    numbers: np.ndarray = np.ascontiguousarray(values, dtype=NUMBERS[kind])
    if kind == pa.bool_():
        numbers = np.packbits(numbers, bitorder="little")
    return pa.Array.from_buffers(kind, len(values), [valid, pa.py_buffer(numbers)])


def arrow_rows(rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> pa.Table:
    """The table that `pa.Table.from_pylist` makes of rows of numbers, texts and lists of fixed length."""
    columns = [arrow_array([row.get(field.name) for row in rows], field.type) for field in schema]
    return pa.Table.from_arrays(columns, schema=schema)


def fixed_list(values: np.ndarray) -> pa.Array:
    """An array (N, ...) as N lists of fixed length."""
    width = int(np.prod(values.shape[1:]))
    flat = np.ascontiguousarray(values, dtype=float).ravel()
    return pa.FixedSizeListArray.from_arrays(arrow_array(flat, pa.float64()), width)


def list_values(table: pa.Table, name: str, *shape: int) -> np.ndarray:
    """A column written by `fixed_list` as an array (N, *shape)."""
    flat = table.column(name).combine_chunks()
    values = _values(flat.values) if len(table) else np.zeros(0)
    return values.astype(float).reshape(len(table), *shape)


def column(table: pa.Table, name: str) -> np.ndarray:
    """A column of single values as a NumPy array."""
    return _values(table.column(name).combine_chunks())


def _values(array: pa.Array) -> np.ndarray:
    """Values (N,) of an array; an empty cell is NaN or None. Arrow's `to_numpy` loads pandas."""
    if array.type not in NUMBERS:
        return np.array(array.to_pylist(), dtype=object)
    if array.null_count:
        return np.array([np.nan if value is None else value for value in array.to_pylist()])
    if array.type == pa.bool_():
        return np.array(array.to_pylist(), dtype=bool)
    return np.from_dlpack(array).copy()
