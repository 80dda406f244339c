"""Texts of a dump changed by tests; tables of CSV as lists of rows, each a dictionary of its cells."""

import csv
from collections.abc import Iterable
from pathlib import Path

__all__ = ["replaced", "rows_of", "write_rows"]

Row = dict[str, str]


def rows_of(path: Path) -> list[Row]:
    """All rows below the header."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write rows, at least one, under a header of the first one's columns: as a new file, as the old one may
    be a link."""
    first, *others = rows
    path.unlink(missing_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, first, lineterminator="\n")
        writer.writeheader()
        writer.writerows([first, *others])


def replaced(path: Path, old: str, new: str, count: int = -1) -> None:
    """Put a text in the place of another one that a file must have: everywhere, or at the first places."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count), newline="")
