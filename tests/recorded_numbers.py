"""Numbers as they were when they were last looked at: a change of any that is not meant is noticed.

Tests against truth and outside authorities allow for noise; a constant that is changed by a factor of two may
pass them all. A record holds of each table its numbers in a form that any change moves: count, mean, rms and
a mean that depends on their order. After a change that is meant,

    RECORD_NUMBERS=1 pytest FILE

writes the record anew; what has changed in it is to be looked at.
"""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from numpy.typing import ArrayLike

RECORDS = Path(__file__).with_name("recorded")
NUMBER = re.compile(r"(?<![\w#.-])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w#])")
RELATIVE = 2e-4  # other processors and libraries round otherwise, and iterations end elsewhere
CHANGING = ("cpu_ms", "seconds", "made", "version", "commit", "times")


def summary(values: ArrayLike) -> list[float]:
    """How many numbers are finite, their mean, rms, and mean with weights that rise from row to row."""
    rows = np.asarray(values, dtype=float).reshape(-1)
    good = rows[np.isfinite(rows)]
    if not len(good):
        return [0, 0.0, 0.0, 0.0]
    ramp = good * np.linspace(-1.0, 1.0, len(good))
    sizes = good.mean(), np.sqrt(np.mean(good**2)), ramp.mean()
    return [len(good), *(float(f"{one:.6g}") for one in sizes)]


def numbers_in(text: str) -> list[float]:
    """All numbers of a text, in order, but those within words."""
    return [float(one) for one in NUMBER.findall(text)]


def numbers_by_line(text: str) -> dict[str, list[float]]:
    """Those of each line apart: a small number does not vanish beside large ones."""
    return {
        f"line {n:03d}": numbers for n, line in enumerate(text.splitlines()) if (numbers := numbers_in(line))
    }


def columns_of(table: pd.DataFrame, name: str = "") -> dict[str, np.ndarray]:
    """The columns of a table that hold numbers."""
    found = table.select_dtypes(["number", "bool"])
    return {f"{name}{column}": found[column].to_numpy(dtype=float) for column in found}


def assert_recorded(name: str, found: Mapping[str, ArrayLike], relative: float = RELATIVE) -> None:
    """Compare the summaries of numbers with `recorded/NAME.json`."""
    path, now = RECORDS / f"{name}.json", {key: summary(values) for key, values in found.items()}
    if os.environ.get("RECORD_NUMBERS"):
        lines = (f"{json.dumps(key)}: {json.dumps(values)}" for key, values in now.items())
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    before = json.loads(path.read_text(encoding="utf-8"))
    wrong = [
        f"{key}: {before.get(key)} recorded, {now.get(key)} found"
        for key in before.keys() | now.keys()
        if key not in before or key not in now or not _alike(before[key], now[key], relative)
    ]
    remedy = f"If that is meant: RECORD_NUMBERS=1 pytest, and look at git diff {path.name}"
    assert not wrong, "\n".join([*sorted(wrong), remedy])


def _alike(before: list[float], now: list[float], relative: float) -> bool:
    size = relative * max(before[2], abs(before[1]), 1e-300)  # the rms, which may be too small
    return before[0] == now[0] and all(abs(a - b) <= size for a, b in zip(before[1:], now[1:]))


def flat(name: str, value: object) -> dict[str, list[float]]:
    """Numbers of a JSON value, by the path of their keys; lists of numbers stay together."""
    if isinstance(value, int | float):
        return {name: [float(value)]}
    found: dict[str, list[float]] = {}
    parts = value.items() if isinstance(value, dict) else ()
    items = [(name, one) for one in value] if isinstance(value, list) else []
    for path, one in [*items, *((f"{name}/{key}", one) for key, one in parts if key not in CHANGING)]:
        for key, numbers in flat(path, one).items():
            found.setdefault(key, []).extend(numbers)
    return found


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
