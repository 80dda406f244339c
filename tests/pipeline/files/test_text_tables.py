"""CSV that is written: no text of an input is a formula in a spreadsheet, and no number is changed."""

import csv
import io
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import invoked, ran
from edits import rows_of
from PIL import Image

import boresight
from boresight.pipeline.files.text_tables import csv_line, table_csv

HARMFUL = {
    "=cmd|' /C calc'!A0": "'=cmd|' /C calc'!A0",
    "+1+1": "'+1+1",
    "-2+3": "'-2+3",
    "@SUM(1)": "'@SUM(1)",
    "\uff1d1": "'\uff1d1",
    "\t=1": r"\t=1",
    "\r=1": r"\r=1",
    "a\n=1": r"a\n=1",
}


@pytest.mark.parametrize("text", HARMFUL)
def test_text_that_begins_like_a_formula_gets_an_apostrophe_and_controls_are_escaped(text: str) -> None:
    cells = next(csv.reader(io.StringIO(csv_line([text, -1.5, "a=b", None, True]), newline="")))
    assert cells == [HARMFUL[text], "-1.5", "a=b", "", "True"]
    table = pd.DataFrame({"file": [text, "sky.png"], "x": [-1.5, np.nan], "n": [-1, 2]})
    read = list(csv.reader(io.StringIO(table_csv(table), newline="")))
    assert read == [["file", "x", "n"], [HARMFUL[text], "-1.5", "-1"], ["sky.png", "", "2"]]


def test_csv_is_written_in_one_place() -> None:
    here = Path(boresight.__file__).parent
    files = [path for path in here.glob("**/*.py") if path.name != "text_tables.py"]
    files += [path for room in here.iterdir() if room.is_dir() for path in room.rglob("*.py")]
    for path in files:
        if path.name != "text_tables.py":
            assert not re.search(r"\.to_csv\(|csv\.(Dict)?[wW]riter\(", path.read_text("utf-8")), path
    assert len(files) > 400


def test_table_without_rows_and_numbers_of_a_stated_format() -> None:
    empty = pd.DataFrame({"file": pd.Series(dtype=object), "x": pd.Series(dtype=float)})
    assert table_csv(empty) == "file,x\n"
    assert table_csv(pd.DataFrame({"x": [-1.0 / 3.0]}), "%.3g") == "x\n-0.333\n"


def test_names_of_images_are_no_formulas_in_what_identify_and_centroids_write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pixels = np.random.default_rng(1).poisson(50.0, (64, 64)).astype(np.uint8)
    pixels[30:33, 40:43] = 200
    Image.fromarray(pixels).save("=1+1.png")
    told = invoked("identify", "./=1+1.png", "=1+1.png", "--fov", 10, "--csv")
    lines = list(csv.DictReader(io.StringIO(told.stdout)))
    assert [line["file"] for line in lines] == ["'=1+1.png", "'=1+1.png"], told.output
    ran("centroids", "=1+1.png", "--out", "stars.csv")
    found = rows_of(Path("stars.csv"))
    assert found and {row["file"] for row in found} == {"'=1+1.png"}
    assert abs(float(found[0]["x_px"]) - 41.0) < 0.5, found[0]  # the star drawn at columns 40 to 42
