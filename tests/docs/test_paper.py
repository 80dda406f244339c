"""docs/notes/paper.md: every row names a committed record and takes its figures from it."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "benchmarks" / "results"
FIGURE = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]\d+)?(?![\w.]*\d)")


def tables() -> Iterator[tuple[list[str], list[str]]]:
    """Head and cells of each row of the page's tables."""
    head: list[str] = []
    for line in (ROOT / "docs" / "notes" / "paper.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("| ") else []
        if not cells:
            head = []
        elif not head:
            head = cells
        elif set(line) - set("| -"):
            yield head, cells


ROWS = list(tables())


def test_the_page_has_a_row_for_every_equation_figure_and_table():
    first = [cells[0] for _, cells in ROWS]
    equations = [f"({n})" for n in (*range(1, 29), *(f"A{k}" for k in range(1, 16)))]
    assert [name for name in equations if name not in first] == []
    for kind, last in (("figure", 10), ("table", 5)):
        names = " ".join(cells[0] for head, cells in ROWS if head[0] == kind)
        assert [n for n in range(1, last + 1) if not re.search(rf"\b{n}\b", names)] == []
    assert len(ROWS) >= 70


@pytest.mark.parametrize(("head", "cells"), ROWS, ids=[cells[0] for _, cells in ROWS])
def test_a_row_takes_its_figures_from_its_records(head: list[str], cells: list[str]):
    assert len(cells) == len(head)
    row = dict(zip([name.split(":")[0] for name in head], cells))
    names = re.findall(r"`([\w-]+\.txt)`", row["record"])
    text = "\n".join((RECORDS / name).read_text(encoding="utf-8") for name in names)
    recorded = set(FIGURE.findall(text))
    figures = FIGURE.findall(re.sub(r"`[^`]*`|\([^)]*\)", "", row["ours"]))
    assert figures, row["ours"]
    assert [figure for figure in figures if figure not in recorded] == [], names
    assert row["verdict"]
