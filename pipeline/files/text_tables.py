"""Write tables of text: TOML, and CSV with one line of column names."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

__all__ = ["write_csv", "write_toml"]


def write_toml(path: Path, tables: Mapping[str, Any]) -> None:
    """Write nested tables as a TOML file."""
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write rows of values under the names of their columns."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(columns)
        table.writerows(rows)
