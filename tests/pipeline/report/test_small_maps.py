"""Maps of the page of several dumps."""

from __future__ import annotations

import re
import shutil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from boresight.pipeline.report.dumps_page import LONGEST_BAR, round_bar, small_maps
from boresight.pipeline.report.marks import SHAPES
from boresight.pipeline.report.page_template import template


@given(st.floats(1e-4, 1e4))
def test_a_bar_is_round_and_nearly_as_long_as_there_is_room(metres: float) -> None:
    bar = round_bar(metres)
    value, unit = bar.words.split()
    length_m = float(value) * (1000.0 if unit == "km" else 1.0)
    assert bar.length == pytest.approx(length_m / metres, abs=0.051)  # it is rounded to a tenth
    assert LONGEST_BAR / 2.5 * (1 - 1e-9) - 0.05 <= bar.length <= LONGEST_BAR
    assert f"{length_m:.0e}"[0] in "125"


def test_a_dump_has_a_map_with_its_targets_and_one_without_evidence_has_none(finished, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(finished[1], tmp_path / name, ignore=shutil.ignore_patterns("work"))
    (tmp_path / "b" / "report.html").unlink()
    shutil.rmtree(tmp_path / "b" / "evidence")
    (one,) = small_maps(tmp_path, ["a", "b"])
    assert (one.name, one.page) == ("a", "a/report.html")
    drawn = str(template("map.html.j2").module.small(one, SHAPES))
    assert drawn.count('class="spot used') == 12 and "1 strip with 12 targets, 12 used." in drawn
    assert '<a href="a/report.html">a</a>' in drawn and one.ground.words in drawn
    assert not re.search(r' id="|url\(#', drawn)  # several stand on one page
