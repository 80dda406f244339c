"""The results of a strip of the fixture and of the sky alone have the numbers that were recorded: tables,
matrix, and figures of the page.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import ran
from recorded_numbers import assert_recorded, flat, numbers_in, table_numbers
from report_page import report_html

from boresight.pipeline.report.saved import read_saved


@pytest.fixture(params=["", "sky_"])
def case(request: pytest.FixtureRequest) -> tuple[str, Path]:
    """Beginning of the record's name, and the result."""
    of_sky = request.param and request.getfixturevalue("sky_result")
    return request.param, of_sky or request.getfixturevalue("finished")[1]


def test_tables_and_matrix_are_those_recorded(case: tuple[str, Path]) -> None:
    name, result = case
    found = flat("installation", json.loads((result / "installation.json").read_text()))
    for path in sorted([*result.glob("sightings/*.parquet"), *result.glob("evidence/*.parquet")]):
        found |= table_numbers(path)
    found |= flat("context", json.loads((result / "evidence" / "context.json").read_text()))
    found["status"] = numbers_in(ran("status", result).output)
    # After the only strip the estimate is that of the whole: rounding is left, which differs by processor.
    assert np.abs(found.pop("convergence/theta_rad")).max() < 1e-12
    assert_recorded(f"{name}result", found)


def test_figures_of_the_page_are_those_recorded(case: tuple[str, Path]) -> None:
    name, page = case[0], report_html(read_saved(case[1]))
    found: dict[str, list[float]] = {}
    for n, svg in enumerate(re.findall(r"<svg\b.*?</svg>", page, re.DOTALL)):
        bare = re.sub(r'(?:id|class|href|xlink:href|data-[\w-]+|src|clip-path|style)="[^"]*"', "", svg)
        places = re.sub(r"(?<![A-Za-z])[ML](?=[-\d])", " ", bare)  # of lines: "M1 2L3 4"
        numbers = numbers_in(re.sub(r'data:[^"]*', "", places))
        found |= {f"svg {n} {k}": numbers[k : k + 20] for k in range(0, len(numbers), 20)}
    assert len(found) > 8
    assert_recorded(f"{name}page", found, relative=1e-3)  # of their size: a tenth of a pixel
