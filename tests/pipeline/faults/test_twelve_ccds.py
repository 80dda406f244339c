"""The whole path on a camera of 12 CCDs and a campaign of 12 strips, whose ids begin alike: each of two
errors at once is named by console and page, though the name of one is the beginning of the other's.
"""

import json
from pathlib import Path

import fault_dumps
import pytest
from command_line import invoked
from edits import rows_of, write_rows

SHIFT_PX = 1.5  # of the points of a CCD: 15 of their 1-sigma


@pytest.fixture(scope="module")
def twelve(made_once) -> Path:
    """Measured points of 12 CCDs in 12 strips, s1 to s12."""
    folder = made_once("twelve", lambda folder: fault_dumps.sound_dump("twelve", 1, folder))
    return folder / "twelve-1"


def moved_points(source: Path, target: Path, ccds: tuple[int, ...]) -> Path:
    """A copy of the dump in which the samples of some CCDs are too large."""
    fault_dumps.linked(source, target)
    path = target / "points.csv"
    rows = rows_of(path)
    for row in rows:
        if int(row["ccd"]) in ccds:
            row["sample"] = repr(float(row["sample"]) + SHIFT_PX)
    write_rows(path, rows)
    return target


def test_errors_of_ccds_one_and_eleven_are_both_told_by_console_and_page(twelve, tmp_path):
    dump, out = moved_points(twelve, tmp_path / "dump", (1, 11)), tmp_path / "result"
    told_on_console = invoked("calibrate", dump, "--out", out).stdout
    findings = json.loads((out / "evidence" / "context.json").read_text(encoding="utf-8"))["findings"]
    page = (out / "report.html").read_text(encoding="utf-8")
    told = {subject["ccd"] for finding in findings for subject in finding["subjects"]}
    assert {1, 11} <= told and not told & {0, *range(2, 11)}
    for item in ("CCD 1", "CCD 11"):
        (finding,) = [finding for finding in findings if finding["item"] == item]
        assert f"{finding['cause']}, {item}: " in told_on_console
        assert finding["text"][:40] in page
