"""The result of a strip of the fixture has the numbers that were recorded: tables, matrix, and figures of the
page.
"""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from recorded_numbers import assert_recorded, numbers_in
from report_page import report_html

from boresight.pipeline.report.saved import read_saved

CHANGING = ("cpu_ms", "seconds", "made", "version", "commit", "times")


def flat(name: str, value: object) -> dict[str, list[float]]:
    """Numbers of a JSON value, by the path of their keys; lists of numbers stay together."""
    if isinstance(value, dict):
        found: dict[str, list[float]] = {}
        for key, one in value.items():
            if key not in CHANGING:
                for path, numbers in flat(f"{name}/{key}", one).items():
                    found.setdefault(path, []).extend(numbers)
        return found
    if isinstance(value, list):
        found = {}
        for one in value:
            for path, numbers in flat(name, one).items():
                found.setdefault(path, []).extend(numbers)
        return found
    return {name: [float(value)]} if isinstance(value, int | float) else {}


def table_numbers(path: Path) -> dict[str, list[float]]:
    """Numbers of each column of a table; those of one quantity by many unknowns together."""
    found: dict[str, list[float]] = {}
    for name, column in zip((table := pq.read_table(path)).column_names, table.columns):
        try:
            values = [np.nan if one is None else one for one in column.to_pylist()]
            numbers = np.array(values, dtype=float).ravel()
        except (TypeError, ValueError):
            continue
        if name not in CHANGING:
            found.setdefault(f"{path.stem}/{name.partition(':')[0]}", []).extend(numbers.tolist())
    return found


def test_tables_and_matrix_are_those_recorded(finished: tuple[Path, Path]) -> None:
    _, result = finished
    found = flat("installation", json.loads((result / "installation.json").read_text()))
    for path in sorted([*result.glob("sightings/*.parquet"), *result.glob("evidence/*.parquet")]):
        found |= table_numbers(path)
    found |= flat("context", json.loads((result / "evidence" / "context.json").read_text()))
    # After the only strip the estimate is that of the whole: rounding is left, which differs by processor.
    assert np.abs(found.pop("convergence/theta_rad")).max() < 1e-12
    assert_recorded("result", found)


def test_figures_of_the_page_are_those_recorded(finished: tuple[Path, Path]) -> None:
    _, result = finished
    page = report_html(read_saved(result))
    found: dict[str, list[float]] = {}
    for n, svg in enumerate(re.findall(r"<svg\b.*?</svg>", page, re.DOTALL)):
        bare = re.sub(r'(?:id|class|href|xlink:href|data-[\w-]+|src|clip-path|style)="[^"]*"', "", svg)
        found[f"svg {n}"] = numbers_in(re.sub(r'data:[^"]*', "", bare))
    assert len(found) > 8
    assert_recorded("page", found, relative=1e-3)  # of the figure's size: a tenth of a pixel and more
