"""Records as Arrow tables, by the declaration of a `@record` alone.

An array field whose shape begins with the letter of the rows ("N, 3, 3") is a column, with a list of fixed
length in each row where it has more dimensions. A tuple of records with that shape gives one column for each
field of theirs. All other fields are values of the record as a whole, kept as JSON. Values come back bit for
bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa

from boresight.pipeline.files.table_files import arrow_array, column, fixed_list, list_values
from boresight.records.record import Bools, Floats, Ints, Texts, shape_of

__all__ = ["columns_of", "plain", "record_from_columns", "record_from_table", "table_from_record"]

_hints = cache(get_type_hints)  # evaluates every annotation
# Arrow type of a column by the annotation of a record's field.
ITEMS: dict[Any, pa.DataType] = {
    Floats: pa.float64(),
    Floats | None: pa.float64(),
    Ints: pa.int64(),
    Bools: pa.bool_(),
    Texts: pa.string(),
    float: pa.float64(),
    bytes: pa.binary(),
}


# Types of record fields that may be None; their column of a table is then all null.
OPTIONAL = (Floats | None,)


def columns_of(record: Any, rows: str = "N") -> dict[str, pa.Array]:
    """Columns of a record by their names, one entry per row of its arrays (N, ...)."""
    columns: dict[str, pa.Array] = {}
    for name, hint, inner in _row_fields(record.__class__, rows):
        value = getattr(record, name)
        if value is None:
            columns[name] = pa.nulls(len(next(iter(columns.values()))), ITEMS[hint])
        elif get_origin(hint) is tuple:
            columns |= {n: arrow_array([getattr(one, n) for one in value], ITEMS[h]) for n, h in _items(hint)}
        elif inner:
            columns[name] = fixed_list(value)
        else:
            columns[name] = arrow_array(value.tolist() if hint == Texts else np.asarray(value), ITEMS[hint])
    return columns


def record_from_columns(kind: Any, table: pa.Table, rows: str = "N", /, **values: Any) -> Any:
    """The record of type `kind` with the columns of a table; `values` are its other fields."""
    for name, hint, inner in _row_fields(kind, rows):
        if get_origin(hint) is tuple:
            cells = [table.column(n).to_pylist() for n, _ in _items(hint)]
            values[name] = tuple(get_args(hint)[0](*row) for row in zip(*cells))
        elif inner:
            values[name] = list_values(table, name, *inner)
        elif hint in OPTIONAL and table.column(name).null_count == len(table):
            values[name] = None
        else:
            value = column(table, name)
            values[name] = np.array(value.tolist(), dtype=str) if hint == Texts else value
    return kind(**values)


def table_from_record(record: Any) -> tuple[pa.Table, dict[str, Any]]:
    """A record's columns, and its other values under the names of their fields, ready for JSON."""
    table = pa.table(columns_of(record))
    of_rows = {name for name, _, _ in _row_fields(record.__class__, "N")}
    values = {f.name: plain(getattr(record, f.name)) for f in fields(record) if f.name not in of_rows}
    return table, {"record": type(record).__name__} | values


def record_from_table(kinds: Sequence[type], table: pa.Table, values: dict[str, Any]) -> Any:
    """The inverse of `table_from_record`, for a record of one of `kinds`. `ValueError` for any other."""
    by_name = {kind.__name__: kind for kind in kinds}
    if (kind := by_name.get(values.get("record", ""))) is None:
        raise ValueError(f"expected a table of {' or '.join(by_name)}, found {values.get('record')!r}")
    hints = _hints(kind)
    own = {name: _restored(hints[name], value) for name, value in values.items() if name in hints}
    return record_from_columns(kind, table, **own)


@cache
def _row_fields(kind: Any, rows: str) -> tuple[tuple[str, Any, tuple[int, ...]], ...]:
    """Name, annotation and shape of one entry, of the fields with one entry for each row."""
    hints = _hints(kind)
    shapes = {field.name: shape_of(field) for field in fields(kind)}
    return tuple(
        (name, hints[name], tuple(int(length) for length in shape[1:]))
        for name, shape in shapes.items()
        if shape and shape[0] == rows
    )


def _items(hint: Any) -> list[tuple[str, Any]]:
    """Fields of the records in a tuple of them."""
    return list(_hints(get_args(hint)[0]).items())


def plain(value: Any) -> Any:
    """`value` as JSON has it: a record as an object, arrays and tuples as lists, an enum as its value."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value) if field.init}
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.value if isinstance(value, Enum) else value


def _restored(hint: Any, value: Any) -> Any:
    if get_origin(hint) is tuple:
        return tuple(_restored(get_args(hint)[0], item) for item in value)
    if is_dataclass(hint):
        hints = _hints(hint)  # type: ignore[arg-type]
        return hint(**{name: _restored(hints[name], item) for name, item in value.items()})  # type: ignore
    return hint(value) if isinstance(hint, type) and issubclass(hint, Enum) else value
