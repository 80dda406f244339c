"""Figures of a report drawn by several processes."""

from __future__ import annotations

from pathlib import Path

from boresight.pipeline.report.page import report_html
from boresight.pipeline.report.saved import read_saved
from boresight.pipeline.run.processes import Processes


def test_a_report_is_the_same_whoever_draws_its_figures(finished: tuple[Path, Path]) -> None:
    saved = read_saved(finished[1])
    of_one = report_html(saved)
    assert of_one.count("<svg") > 8
    assert report_html(saved, executor=Processes(2)) == of_one
