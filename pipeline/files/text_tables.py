"""Write tables of text: TOML, and CSV with one line of column names.

Spreadsheets run a cell that begins with one of `= + - @`, also after a tab or line end, as a formula.
Text from inputs (names of files, ids of other programs) therefore gets an apostrophe before such a
character, and control characters are written as escapes; numbers stay as they are.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from boresight.pipeline.errors import printable

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["csv_line", "leaves", "table_csv", "write_csv", "write_toml"]

FORMULA = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")  # the latter of full width


def write_toml(path: Path, tables: Mapping[str, Any]) -> None:
    """Write nested tables as a TOML file."""
    import tomlkit  # 6 ms to load, in commands that write none

    path.write_text(tomlkit.dumps(tables), encoding="utf-8")


def leaves(values: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of nested tables with its dotted name; an empty table is a value."""
    if isinstance(values, Mapping) and values:
        for key, value in values.items():
            yield from leaves(value, f"{path}.{key}" if path else str(key))
    else:
        yield path, values


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write rows of values under the names of their columns."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(columns)
        table.writerows(rows)


def csv_line(values: Iterable[Any]) -> str:
    """One line of CSV, without its end, in which no text is a formula."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow([_no_formula(value) for value in values])
    return line.getvalue()


def table_csv(table: pd.DataFrame, float_format: str | None = None) -> str:
    """CSV text of a table, in which no text is a formula."""
    texts = {str(n): table[n].map(_no_formula) for n in table if table[n].dtype.kind not in "biuf"}
    return str(table.assign(**texts).to_csv(index=False, lineterminator="\n", float_format=float_format))


def _no_formula(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.startswith(FORMULA) else text
