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
    """Measured points of 12 CCDs in 12 strips, s1 to s12; the samples of CCDs 1 and 11 are too large."""

    def fill(folder: Path) -> None:
        dump = fault_dumps.sound_dump("twelve", 1, folder)
        rows = rows_of(dump / "points.csv")
        for row in rows:
            if row["ccd"] in ("1", "11"):
                row["sample"] = repr(float(row["sample"]) + SHIFT_PX)
        write_rows(dump / "points.csv", rows)

    return made_once("twelve", fill) / "twelve-1"


def test_errors_of_ccds_one_and_eleven_are_both_told_by_console_and_page(twelve, tmp_path):
    out = tmp_path / "result"
    told_on_console = invoked("calibrate", twelve, "--out", out).stdout
    findings = json.loads((out / "evidence" / "context.json").read_text(encoding="utf-8"))["findings"]
    page = (out / "report.html").read_text(encoding="utf-8")
    told = {subject["ccd"] for finding in findings for subject in finding["subjects"]}
    assert {1, 11} <= told and not told & {0, *range(2, 11)}
    for item in ("CCD 1", "CCD 11"):
        (finding,) = [finding for finding in findings if finding["item"] == item]
        assert f"{finding['cause']}, {item}: " in told_on_console
        assert finding["text"][:40] in page
